"""The command that opens a warp in 3D."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from attnwarp.cli.options import option
from attnwarp_eval.cli.shell import clear_errors

if TYPE_CHECKING:
    from attnwarp_eval.inspect.pair import Pair
    from attnwarp_eval.inspect.subject import Subject


def inspect(
    what: Annotated[
        str,
        typer.Argument(
            help="A run's folder, a scene's name or file, or with --data: splats or an edit's"
            " folder."
        ),
    ],
    data: Annotated[
        Path | None, option("Cameras of your own scene: transforms.json, its folder, or COLMAP's.")
    ] = None,
    ply: Annotated[
        Path | None, option("Read the splats before the edit, as given to attnwarp edit.", "FILE")
    ] = None,
    images: Annotated[
        Path | None, option("Read the pictures of a COLMAP model from this folder.", "FOLDER")
    ] = None,
    source: Annotated[
        str | None, option("Warp from this view of your own scene (default: the first).", "VIEW")
    ] = None,
    scene: Annotated[
        str | None, option("Show this scene of a run (default: its first).", "NAME")
    ] = None,
    seed: Annotated[
        int | None, option("Show this seed of a run (default: its first).", "N")
    ] = None,
    variant: Annotated[
        str | None,
        option("Warp by this variant of the run, or by a preset (default: corrected).", "NAME"),
    ] = None,
    view: Annotated[
        str | None,
        option("Warp to this view, EDIT/VIEW in a run of edits (default: the first).", "VIEW"),
    ] = None,
    pixel: Annotated[
        str | None,
        option("Explain the numbers of this pixel of the target, such as 120,84.", "COLUMN,ROW"),
    ] = None,
    layer: Annotated[
        str | None,
        option("Show this feature grid, such as 64x64; --pixel then names its cell.", "WxH"),
    ] = None,
    step: Annotated[
        str | None, option("Show this step of an edit: before, 'stage 1', ..., or edited.", "STEP")
    ] = None,
    color: Annotated[
        str,
        option(
            "Colour the surface by picture, mask, rules or incidence; with truth by endpoint error"
            " or depth error; in an edit by edit disagreement."
        ),
    ] = "mask",
    splats: Annotated[bool, option("Draw the splats as discs, beside the surface.")] = False,
    size: Annotated[
        int | None,
        option(
            "Render views of so many px a side (default: the run's, else 512).",
            "PX",
            min=16,
            max=4096,
        ),
    ] = None,
    screenshot: Annotated[
        Path | None, option("Write this picture (.png) in place of opening a window.", "FILE")
    ] = None,
    export: Annotated[
        Path | None,
        option("Write this file (.html, .glb) in place of opening a window.", "FILE"),
    ] = None,
    web: Annotated[
        bool, option("Serve the window to a browser; Ctrl-C ends it.", None, "--web")
    ] = False,
    host: Annotated[
        str, option("Serve --web at this address; 0.0.0.0 lets other machines in.", "ADDRESS")
    ] = "127.0.0.1",
    port: Annotated[
        int, option("Serve --web at this port; 0 takes a free one.", "N", min=0, max=65535)
    ] = 0,
) -> None:
    """Open a warp in 3D: surface, cameras, mask against truth, and a pixel's numbers."""
    with clear_errors(), _quick_start():
        place = _numbers(pixel, ",", "--pixel", "COLUMN,ROW such as 120,84")
        if export is not None:
            from attnwarp_eval.inspect.export import check_ending

            check_ending(export)
        if web:
            from attnwarp_eval.inspect.web import check_web

            check_web()
        from attnwarp.errors import InputError
        from attnwarp_eval.inspect.capture import one_of
        from attnwarp_eval.inspect.gl import has_display
        from attnwarp_eval.inspect.pair import COLORINGS, EDIT_DISAGREEMENT
        from attnwarp_eval.inspect.scene import State

        one_of(color, COLORINGS, "--color")
        if screenshot is not None and screenshot.suffix.lower() != ".png":
            raise InputError(f"--screenshot: got {screenshot}, expected a name that ends in .png")
        chosen = _subject(what, data, ply, images, source, scene, size, seed)
        variant = variant or chosen.preferred
        view = view or chosen.targets[0]
        pair = chosen.pair(variant, view)
        if chosen.elsewhere and pair.edit is None and (color == EDIT_DISAGREEMENT or step):
            raise InputError(f"{'--step' if step else '--color'}: {chosen.elsewhere}")
        one_of(color, pair.colorings, "--color")
        if step is not None:
            one_of(step, chosen.steps, "--step")
        state = State(
            variant,
            view,
            color,
            _layer(layer, pair),
            chosen.steps[0] if step is None else step,
            splats,
        )
        picked = None if place is None else _report(pair, state.layer, place)
        if picked is not None:
            typer.echo("\n".join(picked.lines()))
        if export is not None:
            from attnwarp_eval.inspect.export import write_export

            write_export(export, chosen, state, picked)
            typer.echo(export)
        answered = export is not None or (picked is not None and not has_display())
        if screenshot is None and answered and not web:
            return
        from attnwarp_eval.inspect.window import Window

        window = Window(chosen, state, off_screen=web or screenshot is not None)
        if place is not None:
            window.pick(*place)
        if screenshot is not None:
            window.screenshot(screenshot)
            typer.echo(screenshot)
        gc.enable()
        if web:
            from attnwarp_eval.inspect.web import serve

            typer.echo("Ctrl-C, or closing the page, ends this.", err=True)
            serve(window, host=host, port=port, announce=typer.echo)
        elif screenshot is None:
            window.open()
        window.close()


@contextmanager
def _quick_start() -> Iterator[None]:
    """Turn off garbage collection, a fifth of the time of imports that leave no garbage, and
    torch's threads, which wait by spinning; the renderer has separate threads.
    """
    gc.disable()
    import torch

    from attnwarp.render.threads import set_thread_count

    threads = torch.get_num_threads()
    set_thread_count(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        set_thread_count(None)
        gc.enable()


def _subject(
    what: str,
    data: Path | None,
    ply: Path | None,
    images: Path | None,
    source: str | None,
    scene: str | None,
    size: int | None,
    seed: int | None,
) -> Subject:
    from attnwarp.errors import InputError
    from attnwarp_eval.inspect import subject
    from attnwarp_eval.inspect.capture import is_edit

    path = Path(what)
    of_runs = {"--scene": scene, "--seed": seed}
    for name in (name for name, value in of_runs.items() if value is not None):
        if not (path / "study.json").is_file():
            raise InputError(f"{what}: not a run's folder, so {name} has no meaning; leave it out")
    if data is not None:
        return subject.of_capture(
            path, data, ply=ply, images=images, source=source, size=size or subject.SIZE
        )
    given = {"--ply": ply, "--images": images, "--source": source}
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{name}: only goes with --data; name the cameras of your scene")
    if (path / "study.json").is_file():
        return subject.of_run(path, scene, size, seed)
    if path.suffix.lower() in (".ply", ".splat") or is_edit(path):
        raise InputError(f"{what}: needs cameras; name them with --data FOLDER")
    return subject.of_scene(what, size or subject.SIZE)


def _report(pair: Pair, layer: tuple[int, int] | None, place: tuple[int, int]) -> Any:
    from attnwarp.errors import InputError
    from attnwarp_eval.inspect.cell import cell_of, cell_report
    from attnwarp_eval.inspect.pixel import report

    try:
        if layer is None:
            return report(pair, *place)
        return cell_report(pair, layer, *cell_of(pair, layer, *place))
    except ValueError as error:
        raise InputError(f"--pixel: {str(error).removeprefix('pixel: ')}") from None


def _layer(text: str | None, pair: Pair) -> tuple[int, int] | None:
    from attnwarp_eval.inspect.capture import one_of

    size = _numbers(text, "x", "--layer", "WIDTHxHEIGHT such as 64x64")
    if size is None:
        return None
    width, height = size
    names = [f"{w}x{h}" for h, w in pair.layers]
    one_of(f"{width}x{height}", names, "--layer")
    return height, width


def _numbers(
    text: str | None, separator: str, option: str, expected: str
) -> tuple[int, int] | None:
    from attnwarp.errors import InputError

    if text is None:
        return None
    try:
        first, second = (int(part) for part in text.split(separator))
    except ValueError:
        raise InputError(f"{option}: got {text!r}, expected {expected}") from None
    return first, second
