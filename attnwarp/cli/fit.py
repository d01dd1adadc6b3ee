"""Command attnwarp fit."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from attnwarp.cli.files import (
    check_inputs_stay,
    check_seen,
    read_splats,
    read_views,
    warn_of_misfit,
    write_image,
)
from attnwarp.cli.options import (
    DataArgument,
    DeviceOption,
    Kind,
    MaxSizeOption,
    Reading,
    ThreadsOption,
    option,
    options_of,
)
from attnwarp.cli.shell import STOPPED, assignments, check_out, clear_errors, use_threads, warn
from attnwarp.process import asked_to_stop
from attnwarp.reporting import Reporter, reporter

if TYPE_CHECKING:
    from attnwarp.fit import Fit, Views
    from attnwarp.gaussians import Gaussians


OWN_OPTIONS = {
    name: f"--{name.replace('_', '-')}" for name in ("kind", "seed", "iterations", "max_splats")
}


PATIENCE = 4
"""Evaluations without a gain after which a fit with held-out views stops."""

PIXELS_PER_SPLAT, GROWTH = 2, 2
"""Default limit of the splats: one for so many pixels of a picture, or so many times the first
ones if more."""


RESULTS = ("splats.ply", "checkpoint.pt", "history.jsonl", "settings.json", "exposures.json")
"""Files of a fit, in addition to ``held_out``."""


@options_of(Reading)
def fit(
    data: DataArgument,
    out: Annotated[
        Path, option("Write the result to this folder, or resume the fit in it.", "FOLDER")
    ],
    kind: Annotated[
        Kind | None,
        option(
            "Fit flat discs (2dgs, the default) or ellipsoids (3dgs); --start has its own kind."
        ),
    ] = None,
    start: Annotated[
        Path | None,
        option(
            "Go on from these splats (.ply, .splat, .spz, .sog, .ksplat) in place of DATA's"
            " points.",
            "SPLATS",
        ),
    ] = None,
    iterations: Annotated[
        int | None, option("Fit for so many steps, one view each (default 7000).", "N", min=1)
    ] = None,
    max_seconds: Annotated[
        float | None,
        option("Stop after this many seconds of fitting; the fit can be resumed.", "S", min=0),
    ] = None,
    max_size: MaxSizeOption = None,
    max_splats: Annotated[
        int | None,
        option(
            "Grow the model to so many splats at most (default: half of a picture's pixels, or"
            " twice the first splats if that is more).",
            "N",
            min=1,
        ),
    ] = None,
    points: Annotated[
        int | None,
        option(
            "Begin at so many random points where DATA has no points (default 10000).", "N", min=1
        ),
    ] = None,
    hold_out: Annotated[
        str,
        option(
            "Hold out one view of so many from the fit, 0 for none, where DATA names no splits; or"
            " hold out these views, with commas between their names.",
            "N|NAMES",
        ),
    ] = "8",
    seed: Annotated[int, option("Draw everything random by this seed.", "N", min=0)] = 0,
    change: Annotated[
        list[str] | None,
        option(
            "Change any other setting, see docs/method/fitting.md; may be repeated.",
            "NAME=VALUE",
            "--set",
        ),
    ] = None,
    checkpoint_seconds: Annotated[
        float, option("Write a checkpoint every so many seconds.", "S", min=0)
    ] = 30.0,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    restart: Annotated[
        bool, option("Begin again, over the fit that --out holds.", None, "--restart")
    ] = False,
    *,
    reading: Reading,
) -> None:
    """Fit splats to posed pictures. A fit that was stopped goes on when it is started again."""
    stopped = (
        f"stopped; what {out} holds is whole, and the same command goes on from its checkpoint"
    )
    with clear_errors(stopped, out), reporter(title=out.name) as report:
        # Inputs that need no heavy library are read first, to report typing errors at once.
        changes = assignments(change or [], OWN_OPTIONS)
        check_out(out)
        if start is not None and points is not None:
            raise ValueError(f"--points: got {points}, but --start names the first splats")
        first = None if start is None else _read_start(start, out, kind)
        kind = kind or ("3dgs" if first is not None and first.kind == "3d" else "2dgs")
        apart = _held_out(hold_out)
        use_threads(threads)
        limits = {"iterations": iterations, "max_splats": max_splats}
        changes |= {"kind": kind[:2], "seed": seed}
        changes |= {name: value for name, value in limits.items() if value is not None}
        if first is not None and first.antialiased:
            changes.setdefault("antialiased", True)
        result = _fit(
            data, reading, out, changes, start, first, points, apart, max_size, device, report,
            restart=restart, max_seconds=max_seconds, checkpoint_seconds=checkpoint_seconds,
        )  # fmt: skip
        from attnwarp.devices import peak_memory

        place = result.gaussians.means.device
        psnr = result.kept.psnr
        held = f", held-out PSNR {psnr:.2f} dB" if psnr is not None else ""
        typer.echo(
            f"{out / 'splats.ply'}: {len(result.gaussians)} splats, {result.iteration} iterations"
            f" in {result.seconds:.0f} s{peak_memory(str(place))}{held}"
        )
        if result.stopped == "asked":
            report.log("stopped; the same command goes on from here")
            raise typer.Exit(STOPPED)


def _held_out(text: str) -> int | list[str]:
    """Read ``--hold-out``: a number, or names."""
    if not text.isdecimal():
        return [name.strip() for name in text.split(",")]
    if int(text) == 1:
        raise ValueError(
            "--hold-out: got 1, which leaves nothing to fit on; expected 0, at least 2, or names"
        )
    return int(text)


def _read_start(start: Path, out: Path, kind: Kind | None) -> Gaussians:
    if start.resolve() == (out / "splats.ply").resolve():
        raise ValueError(
            f"--start: the fit would write over {start}; name another folder with --out"
        )
    return read_splats(start, kind, None)


def _fit(
    data: Path,
    reading: Reading,
    out: Path,
    changes: dict[str, Any],
    start: Path | None,
    first: Gaussians | None,
    points: int | None,
    apart: int | list[str],
    max_size: int | None,
    device: str,
    report: Reporter,
    **options: Any,
) -> Fit:
    """Run the fit, with settings that replace the defaults; ``options`` are those of
    :func:`attnwarp.fit.fit`.
    """
    import attnwarp.fit
    from attnwarp.devices import choose
    from attnwarp.fit.loop import CHECKPOINT, LEAST_CHOOSING, SPLATS, choosing
    from attnwarp.fit.start import FIRST_POINTS
    from attnwarp.io.names import file_stems

    settings = attnwarp.fit.FitSettings.from_dict(changes)
    device = choose(device, report)
    dataset = read_views(data, reading)
    # A view without a picture can be neither fitted nor held out.
    dataset = dataset.with_pictures() or dataset
    try:
        train, test = attnwarp.fit.hold_out(dataset, apart)
    except ValueError as error:
        raise ValueError(str(error).replace("every:", "--hold-out:", 1)) from None
    shown = [] if test is None else [f"held_out/{stem}.png" for stem in file_stems(test.cameras)]
    check_inputs_stay((out / name for name in (*RESULTS, *shown)), dataset.image_paths)
    max_size = attnwarp.fit.views.shrunk_to(max_size, train.cameras, device, report)
    views = attnwarp.fit.load_views(train, max_size=max_size)
    held_out = None
    if test is not None:
        held_out = attnwarp.fit.load_views(test, max_size=max_size)
    if first is not None and start is not None:
        check_seen(start, first, train.cameras, report)
        warn_of_misfit(start, first, train)
        if settings.max_splats is not None and len(first) > settings.max_splats:
            raise ValueError(
                f"--max-splats: got {settings.max_splats}, but {start} holds {len(first)} splats,"
                " and a fit drops none for the limit; take more, or leave it out"
            )
        first = first.with_sh_degree(settings.sh_degree)
    else:
        first = attnwarp.fit.first_splats(
            dataset, views.cameras, settings, report, random=points or FIRST_POINTS, views=views
        )
    pixels = views.cameras[0].width * views.cameras[0].height
    most = max(pixels // PIXELS_PER_SPLAT, GROWTH * len(first))
    settings = attnwarp.fit.FitSettings.from_dict(
        {"max_splats": most, "patience": PATIENCE if held_out else None, **changes}
    )
    if held_out and settings.patience and not choosing(len(held_out), settings):
        report.log(
            f"held-out views: {len(held_out)}, too few to choose by; all iterations are done and"
            f" the last splats kept; hold out {LEAST_CHOOSING + 1} or more to stop early"
        )
    first = first.to(device=device)
    out.mkdir(parents=True, exist_ok=True)
    try:
        with asked_to_stop(report) as stop:
            result = attnwarp.fit.fit(
                first, views, settings, held_out=held_out, folder=out, report=report, stop=stop,
                **options,
            )  # fmt: skip
    except ValueError as error:
        if not any(str(out / name) in str(error) for name in (CHECKPOINT, SPLATS)):
            raise
        raise ValueError(
            f"{error} (--restart does so; --start SPLATS.ply goes on from splats in another folder)"
        ) from error
    _write_results(out, result, views, held_out)
    share = attnwarp.fit.without_surface(result.gaussians, views)
    if line := attnwarp.fit.say_without_surface(share):
        typer.echo(line)
    seen = views if held_out is None else held_out
    unlike = attnwarp.fit.beside_mean_color(result.gaussians, seen)
    if line := attnwarp.fit.say_unlike(*unlike):
        warn(line)
    return result


def _write_results(out: Path, result: Fit, views: Views, held_out: Views | None) -> None:
    """Write the settings, the history, the exposures, and the held-out views with their pictures;
    print each view's distance from its picture.
    """
    from dataclasses import asdict

    from attnwarp.fit.exposure import write_exposures
    from attnwarp.io.file import write_atomically
    from attnwarp.io.names import file_stems

    # An exactly reproduced picture has an infinite PSNR, which JSON lacks.
    rows = [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
        for row in map(asdict, result.history)
    ]
    lines = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    settings = json.dumps(
        {**result.settings.to_dict(), "extent": result.extent, "stopped": result.stopped}, indent=2
    )
    write_atomically(out / "history.jsonl", lambda stream: stream.write(lines.encode()))
    write_atomically(out / "settings.json", lambda stream: stream.write(f"{settings}\n".encode()))
    write_exposures(out, views.cameras, result.exposures)
    if held_out is None:
        return

    import torch

    from attnwarp.fit.loop import choosing
    from attnwarp.losses import psnr_of_mse
    from attnwarp.render import render

    folder = out / "held_out"
    folder.mkdir(exist_ok=True)
    near = result.settings.near * result.extent
    chooses = choosing(len(held_out), result.settings)
    behind = 1.0 if result.settings.background == "white" else 0.0
    background = torch.full((3,), behind, dtype=torch.float32, device=result.gaussians.means.device)
    for index, (camera, name) in enumerate(
        zip(held_out.cameras, file_stems(held_out.cameras), strict=True)
    ):
        color = render(result.gaussians, camera, background=background, near=near).color.clamp(0, 1)
        target = held_out.target(index, background)
        path = folder / f"{name}.png"
        write_image(path, torch.cat([target, color], dim=1).cpu().numpy())
        psnr = psnr_of_mse(held_out.error(index, color, background))
        role = ", one that chose the splats" if index in chooses else ""
        typer.echo(f"{path}: {psnr:.2f} dB{role}")
