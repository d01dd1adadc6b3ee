"""The command line: attnwarp. Nothing heavy is imported until a command needs it."""

from __future__ import annotations

import functools
import io
import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import typer

from attnwarp.editing.cli import edit_image

if TYPE_CHECKING:
    from attnwarp.fit import Fit, FitSettings, Views
    from attnwarp.io import Dataset

USAGE = 2
"""Exit code of everything that a person can mend: arguments, files, folders."""

STOPPED = 130
"""Exit code of a fit that was asked to stop and wrote what it had, as shells have it for Ctrl-C."""

app = typer.Typer(
    name="attnwarp",
    help="Gaussian splats for consistent 3D scene editing: fit them to pictures, render them.",
    epilog=(
        "Exit codes: 0 done, 2 wrong usage or input, 130 stopped by Ctrl-C with everything so far"
        " written."
    ),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


class Kind(StrEnum):
    """What a person may type for the kind of splats."""

    two = "2dgs"
    three = "3dgs"


def fail(message: str) -> typer.Exit:
    """Say what went wrong on stderr; raise what this returns."""
    typer.echo(f"attnwarp: {message}", err=True)
    return typer.Exit(USAGE)


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors about a person's input into one clear line and exit code 2."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise fail(str(error)) from None
    except OSError as error:
        if error.strerror is None:  # the library's own, which says what to do
            raise fail(str(error)) from None
        where = f"{error.filename}: " if error.filename else ""
        raise fail(
            f"{where}{error.strerror}; check the path, the space on its disk and its permissions"
        ) from None


def _check_out(out: Path) -> None:
    """A mistaken --out is answered before the work, not after it; the folder is made once there is
    something for it.
    """
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(
            f"{out}: --out is a file, expected a folder (made if need be); choose another name"
        )


def _use_threads(threads: int | None) -> None:
    """Threads for the renderer alone: the rest is too small for them, and its bits would depend on
    their number.
    """
    import os

    import cv2
    import torch

    from attnwarp.render.threads import set_thread_count

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    set_thread_count(threads or len(os.sched_getaffinity(0)))


@app.command()
def fit(
    data: Annotated[
        Path, typer.Argument(help="transforms.json, its folder, or a COLMAP folder, with images.")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder for the result; a fit found in it is gone on with.")
    ],
    kind: Annotated[Kind, typer.Option(help="Flat discs or ellipsoids.")] = Kind.two,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Steps, one view each (default 7000).")
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option(min=0, help="Stop after so many seconds of fitting.")
    ] = None,
    max_size: Annotated[
        int | None, typer.Option(min=16, help="Shrink larger images to this many px.")
    ] = None,
    max_splats: Annotated[
        int | None, typer.Option(min=1, help="Do not grow the model beyond.")
    ] = None,
    points: Annotated[
        int, typer.Option(min=1, help="Random first points, where DATA has none.")
    ] = 10_000,
    hold_out: Annotated[
        int, typer.Option(min=0, help="Hold out one view of so many; 0: none.")
    ] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other setting; see docs/fitting.md."),
    ] = None,
    checkpoint_seconds: Annotated[
        float, typer.Option(min=0, help="Write what there is so often.")
    ] = 30.0,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads; all cores if left out.")
    ] = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Begin again, whatever is in the folder.")
    ] = False,
) -> None:
    """Fit splats to posed pictures. Stopped half-way and started again, it goes on where it was."""
    with clear_errors():
        # What needs nothing heavy is read first: a typing error is answered at once.
        given = _assignments(change or [])
        _check_out(out)
        _use_threads(threads)
        result = _fit(
            data,
            out,
            kind,
            iterations,
            max_seconds,
            max_size,
            max_splats,
            points,
            hold_out,
            seed,
            given,
            checkpoint_seconds,
            restart,
        )
    last = result.history[-1]
    held = f", held-out PSNR {last.psnr:.2f} dB" if last.psnr is not None else ""
    typer.echo(
        f"{out / 'splats.ply'}: {len(result.gaussians)} splats, {result.iteration} iterations in "
        f"{result.seconds:.0f} s{held}"
    )
    if result.stopped == "asked":
        typer.echo("stopped; the same command goes on from here", err=True)
        raise typer.Exit(STOPPED)


def _fit(
    data: Path,
    out: Path,
    kind: Kind,
    iterations: int | None,
    max_seconds: float | None,
    max_size: int | None,
    max_splats: int | None,
    points: int,
    every: int,
    seed: int,
    given: dict[str, Any],
    checkpoint_seconds: float,
    restart: bool,
) -> Fit:
    given = {**given, "kind": kind.value[:2], "seed": seed}
    if iterations is not None:
        given["iterations"] = iterations
    if max_splats is not None:
        given["max_splats"] = max_splats
    if every == 1:
        raise ValueError(
            "--hold-out: got 1, which leaves nothing to fit on; expected 0 or at least 2"
        )

    from attnwarp import fit as fitting
    from attnwarp.fit.loop import CHECKPOINT
    from attnwarp.fit.progress import shown

    settings = fitting.FitSettings.from_dict(given)
    dataset = _read_views(data)
    train, test = fitting.hold_out(dataset, every)
    views = fitting.load_views(train, max_size=max_size)
    held_out = fitting.load_views(test, max_size=max_size) if test is not None else None
    if dataset.points is not None and len(dataset.points):
        first, colors = dataset.points, dataset.colors
    else:
        typer.echo(f"{data} has no points: beginning with {points} random ones", err=True)
        first, colors = fitting.random_points(views.cameras, points, seed=seed)
    start = fitting.from_points(
        first, colors, kind=settings.kind, sh_degree=settings.sh_degree, seed=seed
    )
    out.mkdir(parents=True, exist_ok=True)
    if restart:
        (out / CHECKPOINT).unlink(missing_ok=True)
    with _asked_to_stop() as stop, shown(title=out.name) as watch:
        result = fitting.fit(
            start, views, settings, held_out=held_out, folder=out, max_seconds=max_seconds,
            checkpoint_seconds=checkpoint_seconds, watch=watch, stop=stop,
        )  # fmt: skip
    _write_results(out, result, held_out)
    return result


def _read_views(path: Path, **options: Any) -> Dataset:
    """The data set at ``path``; whoever gives a scene in its place is told how a scene becomes
    one."""
    from attnwarp.io import read_dataset

    export = f"attnwarp-eval scenes export {path} DIR"
    if path.suffix in (".yaml", ".yml") and not path.is_dir():
        raise ValueError(
            f"{path}: expected transforms.json, its folder or a COLMAP folder; for a scene:"
            f" {export}, then give DIR"
        )
    if path.name == str(path) and not path.exists():
        raise FileNotFoundError(
            f"{path}: no such file or folder; for a scene: {export}, then give DIR"
        )
    return read_dataset(path, **options)


def _assignments(changes: list[str]) -> dict[str, Any]:
    """NAME=VALUE with JSON values; a bare word is text."""
    found: dict[str, Any] = {}
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or not name:
            raise ValueError(f"--set: got {change!r}, expected NAME=VALUE such as --set ssim=0.3")
        if name in ("kind", "seed", "iterations", "max_splats"):
            raise ValueError(f"--set: {name} has an option of its own, --{name.replace('_', '-')}")
        try:
            found[name] = json.loads(text)
        except json.JSONDecodeError:
            found[name] = text
    return found


@contextmanager
def _asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C or a polite kill came; a second Ctrl-C stops at once, as it would without
    this.
    """
    came = False

    def note(number: int, frame: Any) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True
        typer.echo("stopping after this iteration; press Ctrl-C again to leave at once", err=True)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _write_results(out: Path, result: Fit, held_out: Views | None) -> None:
    """The settings, the curve, and the held-out views beside their pictures."""
    from dataclasses import asdict

    from attnwarp.io.file import write_atomically

    lines = "".join(json.dumps(asdict(record)) + "\n" for record in result.history)
    said = json.dumps(
        {**result.settings.to_dict(), "extent": result.extent, "stopped": result.stopped}, indent=2
    )
    write_atomically(out / "history.jsonl", lambda stream: stream.write(lines.encode()))
    write_atomically(out / "settings.json", lambda stream: stream.write(f"{said}\n".encode()))
    if held_out is None:
        return

    import torch

    from attnwarp.render import render

    folder = out / "held_out"
    folder.mkdir(exist_ok=True)
    near = _near(result.settings, result.extent)
    white = result.settings.background == "white"
    background = torch.full((3,), 1.0 if white else 0.0)
    for index, (camera, name) in enumerate(
        zip(held_out.cameras, _file_names(held_out.cameras), strict=True)
    ):
        color = render(result.gaussians, camera, background=background, near=near).color.clamp(0, 1)
        both = torch.cat([held_out.target(index, background), color], dim=1)
        _write_image(folder / f"{name}.png", both.numpy())


def _near(settings: FitSettings, extent: float) -> float:
    return settings.near * extent


@app.command()
def render(
    model: Annotated[Path, typer.Argument(help="Splats: a PLY file.")],
    cameras: Annotated[
        Path, typer.Argument(help="transforms.json, its folder, or a COLMAP folder.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")],
    background: Annotated[
        str, typer.Option(help="black, white, or three numbers in [0, 1]: r,g,b.")
    ] = "black",
    size: Annotated[
        int | None, typer.Option(min=1, help="Longest side in px; the cameras' own if left out.")
    ] = None,
    near: Annotated[
        float, typer.Option(help="Nothing nearer than this is drawn, scene units.")
    ] = 0.01,
    depth: Annotated[
        bool, typer.Option("--depth", help="Also NAME.depth.npy: median depth, NaN where none.")
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads; all cores if left out.")
    ] = None,
    normal: Annotated[
        bool, typer.Option("--normal", help="Also NAME.normal.png: (n + 1) / 2 in world axes.")
    ] = False,
) -> None:
    """Render splats from every camera of a data set; the images need not be there."""
    with clear_errors():
        import numpy as np

        behind = _color(background)
        _check_out(out)

        from attnwarp.io import read_ply
        from attnwarp.io.file import write_atomically
        from attnwarp.render import render as draw

        _use_threads(threads)
        splats = read_ply(model)
        views = _read_views(cameras, missing_images="none", points=False).cameras
        out.mkdir(parents=True, exist_ok=True)
        for camera, name in zip(views, _file_names(views), strict=True):
            if size is not None:
                factor = size / max(camera.width, camera.height)
                camera = camera.resize(
                    max(1, round(factor * camera.width)), max(1, round(factor * camera.height))
                )
            view = draw(splats, camera, background=behind, near=near)
            _write_image(out / f"{name}.png", view.color.clamp(0, 1).numpy())
            if depth:
                buffer = io.BytesIO()
                np.save(buffer, view.median_depth.numpy())
                write_atomically(
                    out / f"{name}.depth.npy", functools.partial(_put, data=buffer.getvalue())
                )
            if normal:
                _write_image(out / f"{name}.normal.png", (view.normal.numpy() + 1) / 2)
    typer.echo(f"{out}: {len(views)} views of {len(splats)} splats")


def _put(stream: BinaryIO, data: bytes) -> None:
    stream.write(data)


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


def _file_names(cameras: Any) -> list[str]:
    """A file name a camera: the last part of its own, numbered where two would be the same."""
    stems = [Path(camera.name).stem or "view" for camera in cameras]
    return [
        stem if stems.count(stem) == 1 else f"{index:04d}-{stem}"
        for index, stem in enumerate(stems)
    ]


def _write_image(path: Path, rgb: Any) -> None:
    """(H, W, 3) sRGB in [0, 1] as an 8-bit PNG, atomically."""
    import cv2
    import numpy as np

    from attnwarp.io.file import write_atomically

    pixels = np.round(255 * np.clip(rgb[..., ::-1], 0, 1)).astype(np.uint8)
    _, data = cv2.imencode(".png", pixels)
    write_atomically(path, lambda stream: stream.write(data.tobytes()))


app.command("edit-image")(clear_errors()(edit_image))


def main() -> None:
    """Entry point of the console script."""
    app()


if __name__ == "__main__":
    main()
