"""The command line: attnwarp-eval. A command imports what it needs when it runs."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

import typer

from attnwarp.cli import shell
from attnwarp.cli.options import program_options
from attnwarp_eval.cli import (
    bench,
    cache,
    compare,
    doctor,
    inspect,
    metrics,
    run,
    scenes,
    stability,
    tracks,
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

COMMANDS: dict[str, Any] = {
    "run": run.run,
    "report": run.report,
    "verdicts": run.verdicts,
    "verify": run.verify,
    "studies": run.studies,
    "captures": None,
    "compare": compare.compare,
    "stability": stability.stability,
    "metrics": metrics.metrics,
    "tracks": tracks.tracks,
    "bench": bench.app,
    "encoders": metrics.encoders,
    "inspect": inspect.inspect,
    "doctor": doctor.doctor,
    "scenes": scenes.app,
    "userstudy": None,
    "cache": cache.app,
}
"""Commands in the order of ``--help``; None marks the position of a laboratory command."""

GROUP = "attnwarp_eval.commands"
"""Group of entry points: each names a dictionary of commands by name, typer's apps or functions."""


def plugin_commands() -> dict[str, Any]:
    """Commands of installed packages. Packages that cannot be imported are named on stderr."""
    found: dict[str, Any] = {}
    for entry in entry_points(group=GROUP):
        try:
            found |= entry.load()
        except Exception as error:
            typer.echo(
                f"attnwarp-eval: warning: commands of the entry point {entry.value!r} cannot be"
                f" imported: {type(error).__name__}: {error}",
                err=True,
            )
    return found


app.callback()(program_options)
for command_name, command in (COMMANDS | plugin_commands()).items():
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=command_name)
    elif command is not None:
        app.command(command_name)(command)


def main(name: str = "attnwarp-eval") -> None:
    """Entry point of the console script."""
    shell.run(app, name)


if __name__ == "__main__":
    main()
