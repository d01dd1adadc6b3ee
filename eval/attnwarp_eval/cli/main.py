"""The command line: attnwarp-eval. A command imports what it needs when it runs."""

from __future__ import annotations

import typer

from attnwarp.cli import shell
from attnwarp.cli.options import program_options
from attnwarp_eval.cli import (
    cache,
    compare,
    doctor,
    inspect,
    metrics,
    reproduce,
    run,
    scenes,
    stability,
    userstudy,
)

app = typer.Typer(
    name="attnwarp-eval",
    cls=shell.Program,
    help=(
        "Check warps, masks and depth of Gaussian scenes against exact truth, and report what"
        " accuracy costs in time."
    ),
    epilog=(
        "Exit codes: 0 pass, 1 regression, 2 wrong usage or input, 3 nothing or too little was"
        " measured; 130 stopped by Ctrl-C or kill, 141 output pipe closed."
    ),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

app.callback()(program_options)
for command in (
    run.run,
    run.report,
    run.verdicts,
    run.verify,
    run.studies,
    reproduce.reproduce,
    compare.compare,
    stability.stability,
    metrics.metrics,
    metrics.encoders,
    inspect.inspect,
    doctor.doctor,
):
    app.command()(command)
app.add_typer(scenes.app, name="scenes")
app.add_typer(userstudy.app, name="userstudy")
app.add_typer(cache.app, name="cache")


def main(name: str = "attnwarp-eval") -> None:
    """Entry point of the console script."""
    shell.run(app, name)


if __name__ == "__main__":
    main()
