"""Command attnwarp poses."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import check_out, clear_errors, warn
from attnwarp.errors import InputError
from attnwarp.reporting import Reporter, reporter

LEAST = 3
"""Fewest photographs: the scale of two views is free, and a fit of them shows no other side."""


def poses(
    pictures: Annotated[Path, typer.Argument(help="Folder of photographs of one scene at rest.")],
    out: Annotated[
        Path, option("Write the capture, which attnwarp fit reads, to this folder.", "CAPTURE")
    ] = Path("capture"),
    each_camera: Annotated[
        bool,
        option(
            "Find a lens for each photograph, as they differ in camera, zoom or size (default: one"
            " lens for all).",
            None,
            "--each-camera",
        ),
    ] = False,
) -> None:
    """Find the pose and lens of each photograph by COLMAP, and undistort them for attnwarp fit.

    Needs the extra colmap. Stopped and started again, it keeps the features and matches it has.
    """
    began = time.perf_counter()
    again = f"stopped; features and matches in {out} are kept, the same command goes on"
    with clear_errors(again, out), reporter(title=out.name) as report:
        check_out(out)
        import attnwarp.io

        names = _names(pictures, out, each_camera)
        figures = _reconstruct(pictures, names, out / "colmap", each_camera, report)
        dataset = attnwarp.io.read_colmap(out / "colmap", images=pictures, distorted="keep")
        attnwarp.io.undistort(dataset, out, report=report)
        if left := sorted(set(names) - {camera.name for camera in dataset.cameras}):
            more = f" and {len(left) - 5} more" if len(left) > 5 else ""
            warn(
                f"{len(left)} of {len(names)} photographs have no pose, and are left out:"
                f" {', '.join(left[:5])}{more}; take others between them and the rest"
            )
    typer.echo(
        f"{out}: {len(dataset)} of {len(names)} photographs, {figures['points']} points,"
        f" {figures['reprojection_error']:.2f} px off in the mean,"
        f" {time.perf_counter() - began:.0f} s; next: attnwarp fit {out} --out FIT"
    )


def _names(pictures: Path, out: Path, each_camera: bool) -> list[str]:
    """Names of the photographs of a folder, checked before the work."""
    from attnwarp.io import image_size
    from attnwarp.io.file import check_other, visible
    from attnwarp.io.images import IMAGE_SUFFIXES, orientation

    if not pictures.is_dir():
        raise InputError(f"{pictures}: expected a folder of photographs")
    for own in (out, out / "images"):
        check_other(own, pictures, "the folder of photographs")
    if (out / "transforms.json").exists():
        raise InputError(f"{out}: holds a capture; name another --out, or remove it")
    paths = [p for p in visible(pictures.iterdir()) if p.suffix.lower() in IMAGE_SUFFIXES]
    if len(paths) < LEAST:
        raise InputError(
            f"{pictures}: holds {len(paths)} pictures ({', '.join(IMAGE_SUFFIXES[:3])} and the like"
            f"), expected {LEAST} at least; a fit needs 20 or more, from all around"
        )
    sizes = {image_size(path): path.name for path in paths}
    if len(sizes) > 1 and not each_camera:
        shown = " and ".join(f"{n} of {w} x {h} px" for (w, h), n in list(sizes.items())[:2])
        raise InputError(
            f"{pictures}: has pictures of several sizes, {shown}; take those of one camera, or pass"
            " --each-camera"
        )
    if turned := [path.name for path in paths if orientation(path) != 1]:
        warn(
            f"{len(turned)} photographs, {turned[0]} first, are turned by an EXIF tag alone; they"
            " are used as stored, on their side; turn their pixels first to edit them upright"
        )
    return [path.name for path in paths]


def _reconstruct(
    pictures: Path, names: list[str], folder: Path, each_camera: bool, report: Reporter
) -> dict[str, float]:
    """Run COLMAP in a folder, which keeps its database for the same photographs, and return the
    model's figures.
    """
    import shutil

    from attnwarp import sfm

    listed = folder / "pictures.json"
    times = [(pictures / name).stat().st_mtime_ns for name in names]
    state = json.dumps([str(pictures.resolve()), names, not each_camera, times])
    if folder.exists() and not listed.is_file():
        raise InputError(f"{folder}: is not of this command; name another --out, or remove it")
    if not folder.exists() or listed.read_text() != state:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        listed.write_text(state)
    sfm.run("photographs", folder, listed, report=report)
    figures: dict[str, float] | None = json.loads((folder / "result.json").read_text())
    if figures is None or figures["registered"] < LEAST:
        raise InputError(
            f"{pictures}: no {LEAST} of its {len(names)} pictures show enough of the same points;"
            " photographs need texture, sharpness, and two thirds of each in the next"
        )
    return figures
