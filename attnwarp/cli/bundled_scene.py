"""A scene of the evaluation harness in place of a person's capture: `attnwarp edit bear`."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import typer

from attnwarp.reporting import Reporter

VIEWS, SIZE = 24, 128
"""Pictures of a bundled scene, and their edge in px: the larger size of the bundled editors."""


def scenes() -> list[str]:
    """Names of the scenes that the evaluation harness ships, where it is installed."""
    package = find_spec("attnwarp_eval")
    folders = package.submodule_search_locations if package is not None else None
    return sorted(p.stem for folder in folders or () for p in Path(folder, "scenes").glob("*.yaml"))


def view_names() -> list[str]:
    """Names of the views that :func:`capture` renders."""
    return [f"images/orbit_{k:03d}_of_{VIEWS}.png" for k in range(VIEWS)]


def capture(name: str, folder: Path, report: Reporter) -> Path:
    """Render a scene's pictures, points and exact masks into a folder; what is there is kept.

    Raises:
        typer.Exit: the harness failed, and said why.
    """
    if not (folder / "transforms.json").is_file():  # it is written last
        report.log(f"{name}: a bundled scene; rendering {VIEWS} pictures of it: {folder}")
        # The library does not import the instrument: its command runs beside this one.
        command = [sys.executable, "-m", "attnwarp_eval", "scenes", "export", name, str(folder)]
        options = ["--views", str(VIEWS), "--size", str(SIZE)]
        done = subprocess.run([*command, *options], stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            raise typer.Exit(done.returncode)
    return folder


def exact_masks(folder: Path, instruction: str, report: Reporter) -> Path | None:
    """Exact masks of the object that an instruction names, in a folder of :func:`capture`.

    Returns:
        The folder of masks; None, which is said, where the instruction names no object.
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
