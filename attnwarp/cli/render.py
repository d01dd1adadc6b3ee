"""Command attnwarp render."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.files import UNSEEN, check_inputs_stay, read_splats, read_views, write_image
from attnwarp.cli.options import (
    AntialiasedOption,
    Reading,
    ScreenFilterOption,
    SplatKindOption,
    ThreadsOption,
    option,
    options_of,
)
from attnwarp.cli.shell import check_out, clear_errors, use_threads
from attnwarp.errors import InputWarning
from attnwarp.reporting import reporter


@options_of(Reading, without="missing_images")
def render(
    model: Annotated[
        Path, typer.Argument(help="Splats to render: .ply, .splat, .spz, .sog or .ksplat.")
    ],
    cameras: Annotated[
        Path,
        typer.Argument(help="Cameras: transforms.json or its folder, COLMAP, BlendedMVS."),
    ],
    out: Annotated[Path, option("Write the pictures to this folder.", "FOLDER")],
    background: Annotated[
        str, option("Draw before this colour: black, white, or r,g,b, each in [0, 1].", "COLOR")
    ] = "black",
    size: Annotated[
        int | None,
        option("Render at this longest side in px (default: the cameras' own).", "N", min=1),
    ] = None,
    near: Annotated[
        float | None,
        option(
            "Draw nothing nearer than this depth in scene units (default: as in a fit).", "DEPTH"
        ),
    ] = None,
    depth: Annotated[
        bool, option("Also write NAME.depth.npy: median depth, NaN where none.", None, "--depth")
    ] = False,
    threads: ThreadsOption = None,
    normal: Annotated[
        bool, option("Also write NAME.normal.png: (n + 1) / 2 in world axes.", None, "--normal")
    ] = False,
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    screen_filter: ScreenFilterOption = None,
    *,
    reading: Reading,
) -> None:
    """Render splats from every camera of a data set; the images need not be there."""
    with clear_errors(f"stopped; the files in {out} are whole, and the same command renders all"):
        import numpy as np

        behind = _color(background)
        check_out(out)

        import attnwarp.render
        from attnwarp.io.file import write_atomically
        from attnwarp.io.names import file_stems
        from attnwarp.methods.scene import near_of

        use_threads(threads)
        splats = read_splats(model, kind, antialiased, screen_filter)
        # Cameras are resized to their images, so the images must exist.
        missing = "error" if reading.scale > 1 else "none"
        dataset = read_views(cameras, reading, missing_images=missing, points=False)
        views = dataset.cameras
        check_inputs_stay((out / f"{name}.png" for name in file_stems(views)), dataset.image_paths)
        out.mkdir(parents=True, exist_ok=True)
        near = near_of(views, splats) if near is None else near
        seen = False
        with reporter(title=out.name) as report:
            for number, (camera, name) in enumerate(zip(views, file_stems(views), strict=True), 1):
                if size is not None:
                    factor = size / max(camera.width, camera.height)
                    camera = camera.resize(
                        max(1, round(factor * camera.width)), max(1, round(factor * camera.height))
                    )
                view = attnwarp.render.render(splats, camera, background=behind, near=near)
                seen = seen or bool(view.alpha.any())
                write_image(out / f"{name}.png", view.color.clamp(0, 1).numpy())
                if depth:
                    write = functools.partial(np.save, arr=view.median_depth.numpy())
                    write_atomically(out / f"{name}.depth.npy", write)
                if normal:
                    write_image(out / f"{name}.normal.png", (view.normal.numpy() + 1) / 2)
                report.step(number, len(views), name if number < len(views) else "done")
        if not seen:
            warnings.warn(
                f"{model}: no view shows any of its splats beyond --near {near:g}; {UNSEEN}",
                InputWarning,
                stacklevel=1,
            )
        typer.echo(f"{out}: {len(views)} views of {len(splats)} splats")


def _color(text: str) -> list[float]:
    named = {"black": [0.0, 0.0, 0.0], "white": [1.0, 1.0, 1.0]}
    if text in named:
        return named[text]
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(0 <= value <= 1 for value in values):
        raise ValueError(
            f"--background: got {text!r}, expected black, white or r,g,b in [0, 1] such as"
            " 0.2,0.5,1"
        )
    return values
