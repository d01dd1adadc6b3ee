"""The command line: attnwarp. Nothing heavy is imported until a command needs it."""

from __future__ import annotations

import functools
import io
import json
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import typer

from attnwarp import __version__
from attnwarp.editing.command import (
    MOST_PIXELS,
    SEGMENTER,
    DeviceOption,
    EditorOption,
    InstructionOption,
    SegmenterOption,
    ThreadsOption,
    WhereOption,
    check_segmenter,
    edit_image,
)
from attnwarp.errors import InputWarning
from attnwarp.process import asked_to_stop, resend_lost_interrupts, skip_last_collection

if TYPE_CHECKING:
    from attnwarp.fit import Fit, FitSettings, Views
    from attnwarp.gaussians import Gaussians
    from attnwarp.io import Dataset

USAGE = 2
"""Exit code of everything that a person can mend: arguments, files, folders."""

STOPPED = 130
"""Exit code after Ctrl-C or a polite kill, as shells have it for Ctrl-C."""

CLOSED_PIPE = 141
"""Exit code when nobody reads the output any more (128 + SIGPIPE, as shells have it)."""

app = typer.Typer(
    name="attnwarp",
    help=(
        "Gaussian splats for consistent 3D scene editing: fit them to pictures, edit, render and"
        " convert them."
    ),
    epilog=(
        "Exit codes: 0 done, 2 wrong usage or input, 130 stopped by Ctrl-C or kill with everything"
        " so far written, 141 output pipe closed."
    ),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"attnwarp {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Options without a command."""


class Kind(StrEnum):
    """What a person may type for the kind of splats."""

    two = "2dgs"
    three = "3dgs"


class Format(StrEnum):
    """What a person may type for the format of a data set."""

    transforms = "transforms"
    colmap = "colmap"


class MissingImages(StrEnum):
    """What a person may type for what happens to cameras without a picture."""

    error = "error"
    none = "none"


class Preset(StrEnum):
    """What a person may type for the choices of an edit."""

    corrected = "corrected"
    extended = "extended"
    paper = "paper"
    released = "released"
    released_controlnet = "released-controlnet"


class BaselineMethod(StrEnum):
    """What a person may type for a method that edits are compared with."""

    by_view = "by_view"
    igs2gs = "igs2gs"
    dge = "dge"
    gaussctrl = "gaussctrl"


class Store(StrEnum):
    """What a person may type for the place of recorded features."""

    cpu = "cpu"
    device = "device"
    disk = "disk"


class Coordinates(StrEnum):
    """What a person may type for the coordinates in a file of splats."""

    auto = "auto"
    world = "world"
    relative = "relative"


DataArgument = Annotated[
    Path, typer.Argument(help="transforms.json, its folder, or a COLMAP folder, with images.")
]
MaxSizeOption = Annotated[
    int | None, typer.Option(min=16, help="Shrink larger images to this many px.")
]
FormatOption = Annotated[
    Format | None, typer.Option(help="What DATA is, where its folder holds both formats.")
]
ImagesOption = Annotated[Path | None, typer.Option(help="Folder of the images of a COLMAP model.")]
ResizeOption = Annotated[
    bool, typer.Option("--resize-cameras", help="Fit cameras to images of another size.")
]
IgnoreOption = Annotated[
    list[str] | None,
    typer.Option(
        "--ignore-key", metavar="KEY", help="Pass over this key of a transforms.json (mask_path)."
    ),
]
MissingOption = Annotated[
    MissingImages, typer.Option(help="none: leave out cameras whose image is not there.")
]
SplatKindOption = Annotated[
    Kind | None, typer.Option(help="Read the file as this kind, whatever it says of itself.")
]
AntialiasedOption = Annotated[
    bool | None,
    typer.Option(
        "--antialiased/--no-antialiased",
        help="Whether the splats were fitted antialiased, whatever the file says.",
    ),
]


def fail(message: str) -> typer.Exit:
    """Say what went wrong on stderr; raise what this returns."""
    typer.echo(f"attnwarp: {message}", err=True)
    return typer.Exit(USAGE)


def _echo(text: str) -> None:
    """Say something on stderr."""
    typer.echo(text, err=True)


@contextmanager
def clear_errors(stopped: str = "stopped; nothing was written") -> Iterator[None]:
    """Turn errors about a person's input into one clear line and exit code 2.

    Args:
        stopped: what is said after Ctrl-C or a polite kill.
    """
    printed: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning) and str(message) not in printed:
            printed.add(str(message))
            typer.echo(f"attnwarp: warning: {message}", err=True)

    def terminate(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    handler = signal.signal(signal.SIGTERM, terminate)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            warnings.showwarning = show
            yield
    except typer.Exit:  # a RuntimeError too
        raise
    except KeyboardInterrupt:
        typer.echo(f"attnwarp: {stopped}", err=True)
        raise typer.Exit(STOPPED) from None
    except BrokenPipeError:
        raise _closed_pipe() from None
    except ImportError as error:
        package = error.name or str(error)
        raise fail(f"needs the package {package}: pip install {package.split('.')[0]}") from None
    except MemoryError:
        raise fail("the memory does not suffice; use smaller pictures or fewer splats") from None
    except (ValueError, RuntimeError) as error:
        raise fail(str(error)) from None
    except OSError as error:
        if error.strerror is None:  # the library's own, which says what to do
            raise fail(str(error)) from None
        raise fail(_file_error(error)) from None
    finally:
        signal.signal(signal.SIGTERM, handler)


def _file_error(error: OSError) -> str:
    name = f"{error.filename}: " if error.filename else ""
    return f"{name}{error.strerror}; check the path, the space on its disk and its permissions"


def _closed_pipe() -> typer.Exit:
    """Let what is still to be flushed go nowhere, as the reader of the output has gone."""
    with suppress(OSError, ValueError):  # no real stream, as under a test's runner
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return typer.Exit(CLOSED_PIPE)


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
    data: DataArgument,
    out: Annotated[Path, typer.Option(help="Folder for the result; a fit in it is resumed.")],
    kind: Annotated[Kind, typer.Option(help="Flat discs or ellipsoids.")] = Kind.two,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Steps, one view each (default 7000).")
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option(min=0, help="Stop after so many seconds of fitting.")
    ] = None,
    max_size: MaxSizeOption = None,
    max_splats: Annotated[
        int | None, typer.Option(min=1, help="Do not grow the model beyond.")
    ] = None,
    points: Annotated[
        int, typer.Option(min=1, help="Random first points, where DATA has none.")
    ] = 10_000,
    hold_out: Annotated[
        int, typer.Option(min=0, help="Hold out one view of so many; 0: none.")
    ] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other setting; see docs/fitting.md."),
    ] = None,
    checkpoint_seconds: Annotated[
        float, typer.Option(min=0, help="Seconds between two checkpoints.")
    ] = 30.0,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads; all cores if left out.")
    ] = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Begin again without the checkpoint.")
    ] = False,
    third_scale: Annotated[
        float | None,
        typer.Option(help="2dgs: third scale in the PLY, for viewers of 3DGS (1e-6)."),
    ] = None,
    format: FormatOption = None,
    images: ImagesOption = None,
    missing_images: MissingOption = MissingImages.error,
    resize_cameras: ResizeOption = False,
    ignore_key: IgnoreOption = None,
) -> None:
    """Fit splats to posed pictures. Stopped half-way and started again, it goes on where it was."""
    with clear_errors(
        f"stopped; what {out} holds is whole, and the same command goes on from its checkpoint"
    ):
        # What needs nothing heavy is read first: a typing error is answered at once.
        changes = _assignments(change or [])
        _check_out(out)
        _check_third_scale(third_scale, kind)
        _use_threads(threads)
        result = _fit(
            data,
            {
                "format": format,
                "images": images,
                "missing_images": missing_images,
                "resize_cameras": resize_cameras,
                "ignore_keys": ignore_key or [],
            },
            out,
            kind,
            iterations,
            max_seconds,
            max_size,
            max_splats,
            points,
            hold_out,
            seed,
            changes,
            checkpoint_seconds,
            restart,
            third_scale,
        )
        last = result.history[-1]
        held = f", held-out PSNR {last.psnr:.2f} dB" if last.psnr is not None else ""
        typer.echo(
            f"{out / 'splats.ply'}: {len(result.gaussians)} splats, {result.iteration} iterations"
            f" in {result.seconds:.0f} s{held}"
        )
        if result.stopped == "asked":
            typer.echo("stopped; the same command goes on from here", err=True)
            raise typer.Exit(STOPPED)


def _check_third_scale(third_scale: float | None, kind: Kind) -> None:
    if third_scale is None:
        return
    if kind is not Kind.two:
        raise ValueError(f"--third-scale: got {third_scale} for {kind.value}, which has three")
    if not 0 < third_scale < float("inf"):
        raise ValueError(f"--third-scale: got {third_scale}, expected a length such as 1e-6")


def _fit(
    data: Path,
    reading: dict[str, Any],
    out: Path,
    kind: Kind,
    iterations: int | None,
    max_seconds: float | None,
    max_size: int | None,
    max_splats: int | None,
    points: int,
    every: int,
    seed: int,
    changes: dict[str, Any],
    checkpoint_seconds: float,
    restart: bool,
    third_scale: float | None,
) -> Fit:
    changes = {**changes, "kind": kind.value[:2], "seed": seed}
    if iterations is not None:
        changes["iterations"] = iterations
    if max_splats is not None:
        changes["max_splats"] = max_splats
    if every == 1:
        raise ValueError(
            "--hold-out: got 1, which leaves nothing to fit on; expected 0 or at least 2"
        )

    import attnwarp.fit
    from attnwarp.fit.loop import CHECKPOINT
    from attnwarp.fit.progress import more_points, progress_display

    settings = attnwarp.fit.FitSettings.from_dict(changes)
    dataset = _read_views(data, **reading)
    train, test = attnwarp.fit.hold_out(dataset, every)
    views = attnwarp.fit.load_views(train, max_size=max_size)
    held_out = attnwarp.fit.load_views(test, max_size=max_size) if test is not None else None
    if dataset.points is not None and len(dataset.points):
        first, colors = dataset.points, dataset.colors
    else:
        typer.echo(f"{data} has no points: beginning with {points} random ones", err=True)
        first, colors = attnwarp.fit.random_points(views.cameras, points, seed=seed)
    start = attnwarp.fit.from_points(
        first, colors, kind=settings.kind, sh_degree=settings.sh_degree, seed=seed
    )
    out.mkdir(parents=True, exist_ok=True)
    if restart:
        (out / CHECKPOINT).unlink(missing_ok=True)
    if settings.max_splats is not None and len(start) > settings.max_splats:
        _echo(more_points(len(start), settings.max_splats))
    with asked_to_stop(_echo) as stop, progress_display(title=out.name) as watch:
        result = attnwarp.fit.fit(
            start, views, settings, held_out=held_out, folder=out, max_seconds=max_seconds,
            checkpoint_seconds=checkpoint_seconds, third_scale=third_scale, watch=watch, stop=stop,
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
    options = {
        name: value.value if isinstance(value, StrEnum) else value
        for name, value in options.items()
    }
    return read_dataset(path, **options)


_FIT_OPTIONS = {
    name: f"--{name.replace('_', '-')}" for name in ("kind", "seed", "iterations", "max_splats")
}


def _assignments(changes: list[str], options: dict[str, str] = _FIT_OPTIONS) -> dict[str, Any]:
    """NAME=VALUE with JSON values; a bare word is text.

    Args:
        changes: as typed.
        options: names that have an option of their own, and that option.
    """
    values: dict[str, Any] = {}
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or not name:
            raise ValueError(f"--set: got {change!r}, expected NAME=VALUE such as --set ssim=0.3")
        if name in options:
            raise ValueError(f"--set: {name} has an option of its own, {options[name]}")
        try:
            values[name] = json.loads(text)
        except (ValueError, RecursionError):
            values[name] = text
    return values


def _write_results(out: Path, result: Fit, held_out: Views | None) -> None:
    """The settings, the curve, and the held-out views beside their pictures."""
    from dataclasses import asdict

    from attnwarp.io.file import write_atomically
    from attnwarp.io.names import file_stems

    lines = "".join(json.dumps(asdict(record)) + "\n" for record in result.history)
    settings = json.dumps(
        {**result.settings.to_dict(), "extent": result.extent, "stopped": result.stopped}, indent=2
    )
    write_atomically(out / "history.jsonl", lambda stream: stream.write(lines.encode()))
    write_atomically(out / "settings.json", lambda stream: stream.write(f"{settings}\n".encode()))
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
        zip(held_out.cameras, file_stems(held_out.cameras), strict=True)
    ):
        color = render(result.gaussians, camera, background=background, near=near).color.clamp(0, 1)
        both = torch.cat([held_out.target(index, background), color], dim=1)
        _write_image(folder / f"{name}.png", both.numpy())


def _near(settings: FitSettings, extent: float) -> float:
    return settings.near * extent


@app.command()
def edit(
    data: DataArgument,
    instruction: InstructionOption,
    out: Annotated[Path, typer.Option(help="Folder for the result; an edit in it is resumed.")],
    ply: Annotated[
        Path | None, typer.Option(help="Splats of the scene; fitted first if left out.")
    ] = None,
    editor: EditorOption = "small-plain",
    preset: Annotated[
        Preset,
        typer.Option(
            metavar="NAME",
            help=f"The method's choices: {', '.join(Preset)} (see editing-a-scene.md).",
        ),
    ] = Preset.corrected,
    source: Annotated[
        str | None, typer.Option(metavar="VIEW", help="Name or number; the first if left out.")
    ] = None,
    source_picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The source view, edited elsewhere.")
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="Folder of PNG masks, NAME.png; white is edited.")
    ] = None,
    words: WhereOption = None,
    segmenter: SegmenterOption = None,
    stages: Annotated[int | None, typer.Option(min=1, help="Of editing and tuning (3).")] = None,
    views_per_stage: Annotated[
        int | None, typer.Option(min=1, help="New views a stage edits.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Of denoising (20).")] = None,
    iterations: Annotated[
        int | None, typer.Option(min=0, help="Of tuning, in each stage (300).")
    ] = None,
    size: Annotated[
        int | None,
        typer.Option(
            min=16,
            max=MOST_PIXELS,
            help="Longest side in px to edit at; the editor's own if left out.",
        ),
    ] = None,
    alone: Annotated[
        bool, typer.Option("--each-view-alone", help="Edit view by view, for comparison.")
    ] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Of everything random (0).")] = None,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other setting of the preset."),
    ] = None,
    fit_iterations: Annotated[
        int, typer.Option(min=1, help="Of the fit, where no PLY is given.")
    ] = 3_000,
    kind: Annotated[Kind, typer.Option(help="Flat discs or ellipsoids, for the fit.")] = Kind.two,
    max_splats: Annotated[
        int, typer.Option(min=1, help="Do not grow the model beyond, for the fit.")
    ] = 30_000,
    max_size: MaxSizeOption = None,
    store: Annotated[Store, typer.Option(help="Where recorded features are kept.")] = Store.cpu,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    format: FormatOption = None,
    images: ImagesOption = None,
    missing_images: MissingOption = MissingImages.error,
    resize_cameras: ResizeOption = False,
    ignore_key: IgnoreOption = None,
) -> None:
    """Edit a scene: one view by an instruction, the others along with it, the splats on all."""
    with clear_errors(f"stopped; what {out} holds is whole, and the same command goes on from it"):
        options: dict[str, Any] = {
            "stages": stages, "views_per_stage": views_per_stage, "steps": steps,
            "iterations": iterations, "size": size, "seed": seed,
            "method": "each view alone" if alone else None,
        }  # fmt: skip
        changes = {name: value for name, value in options.items() if value is not None}
        flags = {name: f"--{name.replace('_', '-')}" for name in options}
        changes |= _assignments(change or [], {**flags, "method": "--each-view-alone"})
        check_segmenter(segmenter, words)
        _check_out(out)

        import attnwarp.propagate.settings

        settings = attnwarp.propagate.settings.preset(preset.value, **changes)
        _use_threads(threads)
        dataset = _read_views(
            data,
            format=format,
            images=images,
            missing_images=missing_images,
            resize_cameras=resize_cameras,
            ignore_keys=ignore_key or [],
        )
        splats = None if ply is None else _read_splats(ply, None, None)
        from attnwarp.propagate.command import FitPlan, edit_dataset

        result, page = edit_dataset(
            dataset, splats, editor, instruction, settings, out,
            fit_plan=FitPlan(fit_iterations, kind.value[:2], max_splats), source=source,
            source_picture=source_picture, masks=masks, words=words,
            segmenter=segmenter or SEGMENTER, max_size=max_size, store=store.value, device=device,
            threads=threads,
            say=_echo,
        )  # fmt: skip
        seconds = sum(result.seconds.values())
        views = len(result.edited)
        carried = (
            f"; {result.counters['injected']:.0%} of the targets' pixels got features of the source"
            if settings.method == "warp" and views > 1
            else ""
        )
        typer.echo(
            f"{out / 'edited.ply'}: {views} edited view{'s' * (views > 1)} in {seconds:.0f} s"
            f"{carried}"
        )
        typer.echo(page)


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
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    format: FormatOption = None,
    images: ImagesOption = None,
    resize_cameras: ResizeOption = False,
    ignore_key: IgnoreOption = None,
) -> None:
    """Render splats from every camera of a data set; the images need not be there."""
    with clear_errors(f"stopped; the files in {out} are whole, and the same command renders all"):
        import numpy as np

        behind = _color(background)
        _check_out(out)

        import attnwarp.render
        from attnwarp.io.file import write_atomically
        from attnwarp.io.names import file_stems

        _use_threads(threads)
        splats = _read_splats(model, kind, antialiased)
        views = _read_views(
            cameras,
            format=format,
            images=images,
            missing_images="none",
            resize_cameras=resize_cameras,
            ignore_keys=ignore_key or [],
            points=False,
        ).cameras
        out.mkdir(parents=True, exist_ok=True)
        for camera, name in zip(views, file_stems(views), strict=True):
            if size is not None:
                factor = size / max(camera.width, camera.height)
                camera = camera.resize(
                    max(1, round(factor * camera.width)), max(1, round(factor * camera.height))
                )
            view = attnwarp.render.render(splats, camera, background=behind, near=near)
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


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Splats: .ply or .splat.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: .ply or .splat.")],
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    third_scale: Annotated[
        float | None,
        typer.Option(help="Write 2DGS as thin 3DGS with this third scale (1e-6)."),
    ] = None,
    sh_degree: Annotated[
        int | None, typer.Option(min=0, max=3, help="Cut harmonics beyond this degree.")
    ] = None,
    coordinates: Annotated[
        Coordinates,
        typer.Option(
            help="world, relative to the origin comment that attnwarp alone reads, or auto: world"
            " unless float32 would lose too much."
        ),
    ] = Coordinates.auto,
) -> None:
    """Convert splats for other programs: 2DGS as thin 3DGS, .splat, fewer harmonics, no origin."""
    with clear_errors():
        suffix = out.suffix.lower()
        if suffix not in (".ply", ".splat"):
            raise ValueError(f"OUT: got {out}, expected a name ending in .ply or .splat")
        from attnwarp.io import THIRD_SCALE, write_ply, write_splat

        splats = _read_splats(source, kind, antialiased)
        if third_scale is not None and splats.kind == "3d":
            raise ValueError(f"--third-scale: {source} holds 3DGS, which has three scales")
        if sh_degree is not None:
            splats = splats.with_sh_degree(min(sh_degree, splats.sh_degree))
        if suffix == ".splat":
            write_splat(
                out,
                splats,
                third_scale=THIRD_SCALE if third_scale is None else third_scale,
                coordinates="relative" if coordinates == "relative" else "world",
            )
        else:
            write_ply(out, splats, third_scale=third_scale, coordinates=coordinates.value)
        typer.echo(f"{out}: {len(splats)} splats")


@app.command()
def undistort(
    data: DataArgument,
    out: Annotated[Path, typer.Argument(help="Folder for transforms.json and images/.")],
    format: FormatOption = None,
    images: ImagesOption = None,
    missing_images: MissingOption = MissingImages.error,
    resize_cameras: ResizeOption = False,
    ignore_key: IgnoreOption = None,
) -> None:
    """Resample pictures to pinhole cameras, for lens models that OpenCV has."""
    with clear_errors(f"stopped; the pictures in {out} are whole, and the same command makes all"):
        _check_out(out)
        import attnwarp.io

        dataset = _read_views(
            data,
            format=format,
            images=images,
            missing_images=missing_images,
            resize_cameras=resize_cameras,
            ignore_keys=ignore_key or [],
            distorted="keep",
        )
        count = sum(lens is not None for lens in dataset.lenses)
        result = attnwarp.io.undistort(dataset, out)
        typer.echo(f"{out}: {len(result)} pictures, {count} of them undistorted")


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def inspect(
    context: typer.Context,
    splats: Annotated[
        Path, typer.Argument(help="Splats (.ply, .splat), or a folder that attnwarp edit made.")
    ],
    data: DataArgument,
) -> None:
    """See a scene, its cameras and its warps in 3D; takes the options of attnwarp-eval inspect."""
    from importlib.util import find_spec

    if find_spec("attnwarp_eval") is None:
        raise fail("inspect: needs the package attnwarp_eval: pip install 'attnwarp[inspect]'")
    # The library does not import the instrument: this process becomes its command.
    command = [sys.executable, "-m", "attnwarp_eval.cli.main", "inspect", str(splats)]
    os.execv(sys.executable, [*command, "--data", str(data), *context.args])


@app.command()
def baseline(
    method: Annotated[BaselineMethod, typer.Argument(help="Of docs/baselines.md.")],
    data: DataArgument,
    ply: Annotated[Path, typer.Option(help="Splats of the scene, such as attnwarp fit makes.")],
    instruction: InstructionOption,
    out: Annotated[Path, typer.Option(help="Folder for the result; a run in it is resumed.")],
    editor: EditorOption = "small-plain",
    preset: Annotated[
        str, typer.Option(help="The method's choices; see docs/baselines.md.")
    ] = "default",
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Begin no edit and no iteration after so many.")
    ] = None,
    network_rows: Annotated[
        int | None, typer.Option(min=0, help="Rows through the network at most.")
    ] = None,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any setting of the method."),
    ] = None,
    max_size: MaxSizeOption = None,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    format: FormatOption = None,
    images: ImagesOption = None,
    missing_images: MissingOption = MissingImages.error,
    resize_cameras: ResizeOption = False,
    ignore_key: IgnoreOption = None,
) -> None:
    """Edit a scene by another method, for comparison with attnwarp edit."""
    with clear_errors(f"stopped; what {out} holds is whole, and the same command goes on from it"):
        changes = _assignments(change or [], {})
        _check_out(out)
        import attnwarp.baselines.settings

        settings = attnwarp.baselines.settings.preset(method.value, preset, **changes)
        budget = attnwarp.baselines.settings.Budget(seconds, network_rows)
        _use_threads(threads)
        from attnwarp.baselines.command import edit_dataset

        dataset = _read_views(
            data,
            format=format,
            images=images,
            missing_images=missing_images,
            resize_cameras=resize_cameras,
            ignore_keys=ignore_key or [],
            points=False,
        )
        result = edit_dataset(
            method.value, dataset, _read_splats(ply, None, None), editor, instruction, settings,
            out, budget=budget, max_size=max_size, device=device, threads=threads,
        )  # fmt: skip
        ended = f", cut short by its {result.cut.replace('_', ' ')}" if result.cut else ""
        typer.echo(
            f"{out / 'edited.ply'}: {result.counters['edits']} edits of"
            f" {result.counters['views']} views in {sum(result.seconds.values()):.0f} s{ended}"
        )
        typer.echo(out / "sheet.png")


def _read_splats(path: Path, kind: Kind | None, antialiased: bool | None) -> Gaussians:
    from dataclasses import replace

    from attnwarp.io import read_ply, read_splat

    if path.suffix.lower() == ".splat":
        if kind is Kind.two:
            raise ValueError(f"--kind: {path} is a .splat, which holds 3DGS alone")
        return replace(read_splat(path), antialiased=bool(antialiased))
    return read_ply(
        path,
        kind=None if kind is None else "2d" if kind is Kind.two else "3d",
        antialiased=antialiased,
    )


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


def _write_image(path: Path, rgb: Any) -> None:
    """(H, W, 3) sRGB in [0, 1] as an 8-bit PNG, atomically."""
    import numpy as np

    from attnwarp.io.file import write_atomically
    from attnwarp.io.images import encode_png

    data = encode_png(np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8))
    write_atomically(path, lambda stream: stream.write(data))


app.command("edit-image")(clear_errors()(edit_image))


def main() -> None:
    """Entry point of the console script."""
    from attnwarp.errors import missing_extra

    skip_last_collection()
    resend_lost_interrupts()
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except ImportError as error:
        explained = missing_extra(error)
        if explained is None:
            raise
        sys.exit(fail(str(explained)).exit_code)
    except BrokenPipeError:
        sys.exit(_closed_pipe().exit_code)
    except OSError as error:  # help that cannot be written
        _closed_pipe()
        sys.exit(fail(_file_error(error)).exit_code)
    except SystemExit as done:
        # Typer's own code for a pipe that is closed; no command of ours gives 1.
        sys.exit(CLOSED_PIPE if done.code == 1 else done.code)


if __name__ == "__main__":
    main()
