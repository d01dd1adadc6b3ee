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
        list[Path] | None, option("Splats fitted to it; may be repeated.", "SPLATS")
    ] = None,
    preset: Annotated[
        list[str] | None, option("Warp settings; paper and corrected if left out.", "NAME")
    ] = None,
    apart: Annotated[
        list[int] | None, option("Views between a pair, plus 1; 1, 3 and 6 if left out.", min=1)
    ] = None,
    max_size: Annotated[
        int, option("Measure in pictures of this many px at most.", "N", min=16)
    ] = 256,
    model: Annotated[
        Path | None, option("COLMAP's sparse model with tracks; made by pycolmap if left out.")
    ] = None,
    truth: Annotated[
        str | None, option("The scene that DATA is an export of: exact geometry.", "SCENE")
    ] = None,
    out: Annotated[Path, option("Folder for tracks.json and tracks.html.")] = Path("runs/tracks"),
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
        dataset = read_views(data, reading)
        dataset = dataset.select([k for k, path in enumerate(dataset.image_paths) if path])
        found = find.find_tracks(data, dataset, out / find.FILE, model=model, report=report)
        views = load_views(dataset, max_size=max_size)
        page = written.Page(out, views, found.resized(dataset.cameras, views.cameras))
        for path in ply:
            page.add(
                path, read_splats(path, None, None), presets, apart or (1, 3, 6), truth, report
            )
        paths = page.write({"data": str(data), "ply": [str(path) for path in ply], "truth": truth})
    Console().print(terminal(written.short_table(page.rows)))
    for path in paths:
        typer.echo(path)
