"""The command line: attnwarp-eval. A command imports what it needs when it runs."""

from __future__ import annotations

import os
import sys
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

app = shell.App(
    name="attnwarp-eval",
    help=(
        "Check warps, masks and depth of Gaussian scenes against exact truth, and report what"
        " accuracy costs in time."
    ),
    epilog=(
        "Exit codes: 0 pass, 1 regression, 2 wrong usage or input, 3 nothing or too little was"
        " measured; 130 stopped by Ctrl-C or kill, 141 output pipe closed."
    ),
    no_args_is_help=True,
)

STUDIES, PICTURES, MACHINE = (
    "Studies and claims",
    "Your pictures and captures",
    "Scenes and machine",
)
"""Panels of the help below the commands that most people call."""

COMMANDS: dict[str, tuple[str | None, Any]] = {
    "run": (None, run.run),
    "report": (None, run.report),
    "compare": (None, compare.compare),
    "bench": (None, bench.app),
    "inspect": (None, inspect.inspect),
    "studies": (STUDIES, run.studies),
    "verify": (STUDIES, run.verify),
    "verdicts": (STUDIES, run.verdicts),
    "stability": (STUDIES, stability.stability),
    "metrics": (PICTURES, metrics.metrics),
    "encoders": (PICTURES, metrics.encoders),
    "tracks": (PICTURES, tracks.tracks),
    "captures": (PICTURES, None),
    "userstudy": (PICTURES, None),
    "scenes": (MACHINE, scenes.app),
    "doctor": (MACHINE, doctor.doctor),
    "cache": (MACHINE, cache.app),
}
"""Panel and command by name, in the order of ``--help``; None marks the place of a laboratory
command."""

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
commands = {name: command for name, (_, command) in COMMANDS.items()} | plugin_commands()
for command_name, command in commands.items():
    panel = COMMANDS.get(command_name, (None,))[0]
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=command_name, rich_help_panel=panel)
    elif command is not None:
        app.command(command_name, rich_help_panel=panel)(command)


FIRST = """\
attnwarp-eval measures warps, masks and edits of Gaussian scenes against exact truth.
Where to begin:

  attnwarp-eval run quick --scenes spheres           an ablation of one scene, with a report
  attnwarp-eval inspect spheres                      a warp in 3D, with a pixel's numbers on a click
  attnwarp-eval metrics --edited E --originals O     scores of edited pictures of your own
  attnwarp-eval compare BASELINE runs/quick          did a change make anything worse? exit code 1

attnwarp-eval studies and scenes list say what ships, --help what the commands are."""


def main(name: str = "attnwarp-eval") -> None:
    """Entry point of the console script; without a command, what a newcomer does first."""
    completes = any(name.endswith("_COMPLETE") for name in os.environ)  # a shell asks for names
    if len(sys.argv) == 1 and not completes:
        typer.echo(FIRST)
        return
    shell.run(app, name)


if __name__ == "__main__":
    main()
