"""The command line: attnwarp-eval. A command imports what it needs when it runs."""

from __future__ import annotations

import sys

import typer

from attnwarp.cli.options import program_options
from attnwarp.cli.shell import CLOSED_PIPE, USAGE, closed_pipe
from attnwarp.process import resend_lost_interrupts, skip_last_collection
from attnwarp_eval.cli import (
    cache,
    compare,
    doctor,
    inspect,
    metrics,
    run,
    scenes,
    stability,
    userstudy,
)
from attnwarp_eval.cli.shell import (
    CRASH,
    REGRESSION,
    Regression,
    fail,
    file_error,
)

app = typer.Typer(
    name="attnwarp-eval",
    help=(
        "Check warps, masks and depth of Gaussian scenes against exact truth, and report what"
        " accuracy costs in time."
    ),
    epilog=(
        "Exit codes: 0 pass, 1 regression, 2 wrong usage or input, 3 nothing or too little was"
        " measured; 130 interrupted by Ctrl-C or kill, 141 output pipe closed."
    ),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

app.callback()(program_options)
for command in (
    run.run,
    run.report,
    run.verify,
    run.studies,
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


def main() -> None:
    """Entry point of the console script."""
    import traceback

    from attnwarp.errors import missing_extra

    skip_last_collection()
    resend_lost_interrupts()
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        sys.exit(closed_pipe().exit_code)
    except OSError as error:  # output that cannot be written
        closed_pipe()
        sys.exit(fail(file_error(error)).exit_code)
    except Regression:
        raise
    except SystemExit as done:
        # Typer's own code for a closed pipe is that of a regression, which has its own exception.
        sys.exit(CLOSED_PIPE if done.code == REGRESSION else done.code)
    except Exception as error:
        explained = missing_extra(error) if isinstance(error, ImportError) else None
        if explained is not None:
            typer.echo(f"attnwarp-eval: {explained}", err=True)
            raise SystemExit(USAGE) from None
        # Python's own exit code for a crash is 1, which here means a regression.
        traceback.print_exc()
        raise SystemExit(CRASH) from None


if __name__ == "__main__":
    main()
