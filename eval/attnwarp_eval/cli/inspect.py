"""The command that opens a warp in 3D."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from attnwarp_eval.cli.shell import clear_errors


def inspect(
    what: Annotated[str, typer.Argument(help="A run's folder, or a scene's name or file.")],
    scene: Annotated[str | None, typer.Option(help="Of a run; its first if left out.")] = None,
    variant: Annotated[
        str | None, typer.Option(help="Of the run, or a preset; corrected if left out.")
    ] = None,
    view: Annotated[str | None, typer.Option(help="Target view; the first if left out.")] = None,
    pixel: Annotated[str | None, typer.Option(help="Target pixel COLUMN,ROW to explain.")] = None,
    color: Annotated[
        str, typer.Option(help="picture, mask, endpoint error, depth error or incidence.")
    ] = "mask",
    splats: Annotated[bool, typer.Option(help="Draw the splats as discs.")] = False,
    size: Annotated[int | None, typer.Option(min=16, max=4096, help="Image size in px.")] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Write a PNG instead of opening a window.")
    ] = None,
    export: Annotated[
        Path | None, typer.Option(help="Write .html, .gltf or .vtp instead of a window.")
    ] = None,
) -> None:
    """Open a warp in 3D: surface, cameras, mask against truth, and a pixel's numbers."""
    from attnwarp.errors import InputError
    from attnwarp_eval.inspect import subject
    from attnwarp_eval.inspect.pair import COLORINGS
    from attnwarp_eval.inspect.pixel import report
    from attnwarp_eval.inspect.window import Window

    with clear_errors():
        subject.one_of(color, list(COLORINGS), "--color")
        place = _pixel(pixel)
        if (Path(what) / "study.json").is_file():
            chosen = subject.of_run(Path(what), scene, size)
        elif scene is not None:
            raise InputError(f"{what}: not a run's folder, so --scene has no meaning; leave it out")
        else:
            chosen = subject.of_scene(what, size or subject.SIZE)
        variants, targets = list(chosen.variants), list(chosen.targets)
        preferred = "corrected" if "corrected" in variants else variants[0]
        variant, view = variant or preferred, view or targets[0]
        pair = chosen.pair(variant, view)
        if place is not None:
            try:
                typer.echo("\n".join(report(pair, *place).lines()))
            except ValueError as error:
                raise InputError(f"--pixel: {error}") from None
        window = Window(
            chosen.pair,
            variants,
            targets,
            variant=variant,
            target=view,
            coloring=color,
            splats=splats,
            off_screen=screenshot is not None or export is not None,
        )
        if place is not None:
            window.pick(*place)
        if screenshot is not None:
            window.screenshot(screenshot)
            typer.echo(screenshot)
        if export is not None:
            window.export(export)
            typer.echo(export)
        if screenshot is None and export is None:
            window.open()


def _pixel(text: str | None) -> tuple[int, int] | None:
    from attnwarp.errors import InputError

    if text is None:
        return None
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--pixel: got {text!r}, expected COLUMN,ROW such as 120,84") from None
    return column, row
