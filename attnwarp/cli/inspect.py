"""Command attnwarp inspect: attnwarp-eval's command for the user's scene."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.options import DataArgument
from attnwarp.cli.shell import fail
from attnwarp.errors import install_command


def inspect(
    context: typer.Context,
    splats: Annotated[
        Path,
        typer.Argument(
            help="Splats (.ply, .splat, .spz, .sog, .ksplat), or a folder that attnwarp edit made."
        ),
    ],
    data: DataArgument,
) -> None:
    """View a scene, its cameras and its warps in 3D; takes the options of attnwarp-eval inspect."""
    from importlib.util import find_spec

    if find_spec("attnwarp_eval") is None:
        raise fail(f"inspect: needs the package attnwarp_eval; {install_command('inspect')}")
    # The library must not import the evaluation harness, so this process executes its command.
    become = "from attnwarp.cli.entry import enter; enter('attnwarp', 'attnwarp_eval.cli.main')"
    command = [sys.executable, "-c", become, "inspect", str(splats), "--data", str(data)]
    os.execv(sys.executable, [*command, *context.args])
