"""Scene of the evaluation harness instead of the user's capture: `attnwarp edit bear`."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import typer

from attnwarp.reporting import Reporter

VIEWS, SIZE = 24, 128
"""Number of pictures of a bundled scene, and their side in px: the bundled editors' larger size."""


def scenes() -> list[str]:
    """List the scenes of the evaluation harness, if installed."""
    package = find_spec("attnwarp_eval")
    folders = package.submodule_search_locations if package is not None else None
    return sorted(p.stem for folder in folders or () for p in Path(folder, "scenes").glob("*.yaml"))


def view_names() -> list[str]:
    """List the names of the views rendered by :func:`capture`."""
    return [f"images/orbit_{k:03d}_of_{VIEWS}.png" for k in range(VIEWS)]


def capture(name: str, folder: Path, report: Reporter) -> Path:
    """Render a scene's pictures, points and exact masks into a folder; a finished one is kept.

    Raises:
        typer.Exit: the harness failed and printed the reason.
    """
    if not (folder / "transforms.json").is_file():  # this file is written last
        report.log(f"{name}: a bundled scene; rendering {VIEWS} pictures of it: {folder}")
        # The library must not import the evaluation harness, so its command runs as a subprocess.
        command = [sys.executable, "-m", "attnwarp_eval", "scenes", "export", name, str(folder)]
        options = ["--views", str(VIEWS), "--size", str(SIZE)]
        done = subprocess.run([*command, *options], stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            raise typer.Exit(done.returncode)
    return folder


def exact_masks(folder: Path, instruction: str, report: Reporter) -> Path | None:
    """Find exact masks of the object named by an instruction, in a folder of :func:`capture`.

    Returns:
        Folder of masks; None, with a report line, if the instruction names no object.
    """
    objects = sorted(path.name for path in (folder / "masks").iterdir())
    words = f" {' '.join(re.findall(r'[a-z0-9]+', instruction.lower()))} "
    named = [name for name in objects if f" {name.replace('_', ' ')} " in words]
    if not named:
        report.log(
            f"the whole picture is edited: {instruction!r} names none of {', '.join(objects)}"
        )
        return None
    report.log(f"nothing but the {named[0]} is edited, inside its exact mask: {folder / 'masks'}")
    return folder / "masks" / named[0]
