"""The command that compares a capture's warps with tracks of structure from motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from attnwarp.cli.files import read_splats, read_views
from attnwarp.cli.options import DataArgument, Reading, options_of
from attnwarp.cli.shell import log
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import clear_errors


@options_of(Reading)
def tracks(
    data: DataArgument,
    ply: Annotated[
        list[Path] | None,
        typer.Option(metavar="SPLATS", help="Splats fitted to it; may be repeated."),
    ] = None,
    preset: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Warp settings; paper and corrected if left out."),
    ] = None,
    apart: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Views between a pair, plus 1; 1, 3 and 6 if left out."),
    ] = None,
    max_size: Annotated[
        int, typer.Option(min=16, metavar="N", help="Measure in pictures of this many px at most.")
    ] = 256,
    model: Annotated[
        Path | None,
        typer.Option(help="COLMAP's sparse model with tracks; made by pycolmap if left out."),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(metavar="SCENE", help="The scene that DATA is an export of: exact geometry."),
    ] = None,
    halve: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Write DATA there with half of the points to fit from; the others judge.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for tracks.json and tracks.html.")] = Path(
        "runs/tracks"
    ),
    *,
    reading: Reading,
) -> None:
    """Check warps and masks of any capture against the tracks of structure from motion.

    Tracks see no hidden surface that a mask accepts; `attnwarp-eval run` on scenes with truth does.
    """
    from rich.console import Console

    with clear_errors(), reporter(title=out.name) as report:
        from attnwarp.errors import InputError
        from attnwarp.fit import load_views
        from attnwarp.methods.scene import near_of
        from attnwarp.warp import PRESETS
        from attnwarp_eval.document.write import terminal
        from attnwarp_eval.tracks import find, measure
        from attnwarp_eval.tracks import report as written

        presets = preset or ["paper", "corrected"]
        if unknown := [name for name in presets if name not in PRESETS]:
            raise InputError(f"--preset: got {unknown[0]!r}, expected one of {', '.join(PRESETS)}")
        if not ply and halve is None:
            raise InputError(
                "--ply: expected splats to judge, or --halve FOLDER to make a fit's data"
            )
        try:
            dataset = read_views(data, reading)
        except (FileNotFoundError, ValueError) as error:
            raise InputError(str(error)) from None
        there = [k for k, path in enumerate(dataset.image_paths) if path is not None]
        dataset = dataset.select(there)
        found = find.find_tracks(data, dataset, out / find.FILE, model=model, report=report)
        if halve is not None:
            count = find.halve(dataset, found, halve)
            log(
                f"{halve}: {count} of {len(found.started)} points to begin from; attnwarp fit"
                f" {halve} --out FIT, then attnwarp-eval tracks {halve} --ply FIT/splats.ply"
            )
        geometry = None
        if truth is not None:
            from attnwarp_eval.scene.file import load_scene
            from attnwarp_eval.truth import Geometry

            geometry = Geometry(load_scene(truth))
        rows, pictures, notes = [], {}, []
        views = load_views(dataset, max_size=max_size)
        cameras = list(views.cameras)
        scaled = found.resized(dataset.cameras, cameras)
        for path in ply or ():
            splats = read_splats(path, None, None)
            label = path.parent.name or path.stem
            held = [
                (path.parent / "held_out" / f"{Path(camera.name).stem}.png").is_file()
                for camera in cameras
            ]
            for name in presets:
                pairs = measure.measure(
                    splats, cameras, scaled, name, apart=apart or (1, 3, 6), held_out=held,
                    geometry=geometry, near=near_of(cameras, splats), report=report,
                )  # fmt: skip
                if not pairs:
                    raise InputError(
                        f"--apart: no pair of views has {measure.LEAST} points in common; take"
                        " nearer ones"
                    )
                rows += written.rows_of(label, name, pairs)
                middle = pairs[len(pairs) // 2].target
                image = out / "pictures" / f"{label}-{name}.png"
                written.draw(pairs, scaled, _shown(views.images[middle]), middle, image)
                pictures[f"{label}, {name}: {cameras[middle].name}"] = image
        if not rows:
            return
        judged = int((~found.started).sum())
        notes.append(
            f"{judged} points in {len(cameras)} pictures, measured at"
            f" {cameras[0].width} x {cameras[0].height} px."
        )
        if not found.started.any():
            notes.append(
                "The fit may have begun from these points; --halve keeps half of them from it."
            )
        inputs = {"data": str(data), "ply": [str(path) for path in ply or ()], "truth": truth}
        paths = written.write(rows, pictures, inputs, notes, out)
    Console().print(terminal(written.short_table(rows)))
    for path in paths:
        typer.echo(path)


def _shown(image: Any) -> Any:
    """(H, W, C) values in [0, 1]."""
    import numpy as np

    return image / np.iinfo(image.dtype).max if image.dtype.kind == "u" else image
