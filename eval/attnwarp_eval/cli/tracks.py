"""The command that compares a capture's warps with tracks of structure from motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.files import read_splats, read_views
from attnwarp.cli.options import DataArgument, Reading, option, options_of
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import clear_errors


@options_of(Reading)
def tracks(
    data: DataArgument,
    ply: Annotated[
        list[Path] | None, option("Judge these splats, fitted to DATA; may be repeated.", "SPLATS")
    ] = None,
    preset: Annotated[
        list[str] | None,
        option("Warp by this preset; may be repeated (default paper and corrected).", "NAME"),
    ] = None,
    apart: Annotated[
        list[int] | None,
        option(
            "Warp each view to the one so many places before it; may be repeated (default 1, 3"
            " and 6).",
            "N",
            min=1,
        ),
    ] = None,
    max_size: Annotated[
        int, option("Shrink pictures to so many px on the longer side.", "PX", min=16)
    ] = 256,
    model: Annotated[
        Path | None,
        option(
            "Read the tracks from COLMAP's sparse model in this folder (default made by pycolmap).",
            "FOLDER",
        ),
    ] = None,
    out: Annotated[
        Path, option("Write tracks.json and tracks.html to this folder.", "FOLDER")
    ] = Path("runs/tracks"),
    *,
    reading: Reading,
) -> None:
    """Check warps and masks of any capture against the tracks of structure from motion.

    Tracks see no hidden surface that a mask accepts; `attnwarp-eval run` on scenes with truth does.
    """
    from rich.console import Console

    with clear_errors(strict=False), reporter(title=out.name) as report:
        from attnwarp import check
        from attnwarp.errors import InputError
        from attnwarp.fit import load_views
        from attnwarp.warp import PRESETS
        from attnwarp_eval.document.write import terminal
        from attnwarp_eval.tracks import find
        from attnwarp_eval.tracks import report as written

        presets = preset or ["paper", "corrected"]
        for name in presets:
            check.one_of(name, list(PRESETS), "--preset")
        if not ply:
            raise InputError("--ply: expected splats to judge")
        dataset = read_views(data, reading).with_pictures()
        found = find.find_tracks(data, dataset, out / find.FILE, model=model, report=report)
        views = load_views(dataset, max_size=max_size)
        page = written.Page(out, views, found.resized(dataset.cameras, views.cameras))
        for path in ply:
            page.add(path, read_splats(path, None, None), presets, apart or (1, 3, 6), report)
        paths = page.write({"data": str(data), "ply": [str(path) for path in ply]})
    Console().print(terminal(written.short_table(page.rows)))
    for path in paths:
        typer.echo(path)
