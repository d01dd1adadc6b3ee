"""Bundled capture instead of the user's: `attnwarp edit bear`."""

from __future__ import annotations

import re
import shutil
from importlib.util import find_spec
from pathlib import Path

from attnwarp.errors import InputError
from attnwarp.reporting import Reporter

FOLDER = Path(__file__).parent / "scenes"

SIZE = 128
"""Side in px of the bundled captures' pictures: the bundled editors' larger size."""

HOW = (
    f"attnwarp-eval scenes export {{name}} {{name}} --views 24 --size {SIZE} --points 2000",
    f"attnwarp-eval scenes export {{name}} more --views 64 --size {SIZE}",
    "attnwarp fit more --out fit --iterations 3000 --max-splats 10000 --set sh_degree=0",
)
"""Commands behind a bundled capture (``scripts/bundle_scenes.py``). Its splats are fitted to more
views than it holds, as 24 leave depth between them undecided."""


def scenes() -> list[str]:
    """List the scenes of the evaluation harness, if installed."""
    package = find_spec("attnwarp_eval")
    folders = package.submodule_search_locations if package is not None else None
    return sorted(p.stem for folder in folders or () for p in Path(folder, "scenes").glob("*.yaml"))


def bundled() -> list[str]:
    """List the scenes with a bundled capture."""
    return sorted(path.stem for path in FOLDER.glob("*.zip"))


def capture(name: str, folder: Path, report: Reporter) -> str:
    """Unpack a bundled capture: cameras, pictures, exact masks, splats; one in the folder is kept.
    Return a sentence on its origin.
    """
    if not (folder / "transforms.json").is_file():  # this file is unpacked last
        shutil.unpack_archive(FOLDER / f"{name}.zip", folder)
    made = ", ".join(f"`{step.format(name=name)}`" for step in HOW)
    report.log(f"{name}: a bundled scene: {folder}")
    return f"{name} is a bundled scene, rendered and fitted by {made}"


def exact_masks(
    folder: Path, instruction: str, report: Reporter, *, anyway: bool = False
) -> Path | None:
    """Find exact masks of the object named by an instruction, in a folder of :func:`capture`.

    Args:
        anyway: True edits the whole picture if the instruction names no object.

    Returns:
        Folder of masks; None for the whole picture.
    """
    objects = sorted(path.name for path in (folder / "masks").iterdir())
    words = f" {' '.join(re.findall(r'[a-z0-9]+', instruction.lower()))} "
    named = [name for name in objects if re.search(f" {name.replace('_', ' ')}(e?s)? ", words)]
    if not named and not anyway:
        raise InputError(
            f"instruction: {instruction!r} names none of the scene's {', '.join(objects)}; name"
            " one, mark what is edited, such as by --at X,Y, or edit the whole picture by --anyway"
        )
    if not named:
        report.log("the whole picture is edited, as the instruction names nothing in it")
        return None
    report.log(f"nothing but the {named[0]} is edited, inside its exact mask: {folder / 'masks'}")
    return folder / "masks" / named[0]
