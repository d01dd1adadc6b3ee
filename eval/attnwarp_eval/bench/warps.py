"""Warps alone on a bench: where a view's pixels lie in the source, and what the source sees.

A folder has SCENE/VIEW.npz. A view without a file, and a pixel whose position is NaN, is without
an answer: nothing is accepted there.
"""

from __future__ import annotations

import io
import time
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.io import read_dataset, read_image, read_ply
from attnwarp.reporting import SILENT, Reporter
from attnwarp.warp import (
    PRESETS,
    Surface,
    parts_read,
    preset,
    render_surface,
    warp_surfaces,
    warp_view,
)
from attnwarp_eval import metrics
from attnwarp_eval.bench.result import WARP_FIGURES, WARPS, Method, Score, mean
from attnwarp_eval.bench.suite import FILE, Suite, sha256, truth_file
from attnwarp_eval.document.model import Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.files import write_atomic
from attnwarp_eval.two_view import AMBIGUOUS, TwoView
from attnwarp_eval.world import World, world

Points = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NEAR = 1.0
"""Pixels of the picture within which a position is right."""

PARTS: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "points": ("f", (2,)),
    "visible": ("b", ()),
    "depth": ("f", ()),
}
"""Arrays of a file, with the kind of their numbers and their shape after (h, w)."""

SETTINGS = replace(PRESETS["tolerant"], normal_test="none")
"""Rules that tell visibility from depth alone, of any size and accuracy."""

SLIPS: Mapping[str, Callable[[Points, Points], Points]] = {
    "are x and y swapped": lambda points, own: points[..., ::-1],
    "do pixel centres lie at integers, not at + 0.5": lambda points, own: points + 0.5,
    "is 0.5 added twice": lambda points, own: points - 0.5,
    "are they displacements, not positions": lambda points, own: points + own,
    "do they lead from the source to the view": lambda points, own: 2 * own - points,
}
SLIP = 0.5
"""Slips of convention, by what mends them, of positions and the pixels' own places: told if it
halves a median error of more pixels. The last only comes near, as a step back from elsewhere."""


def handed_in(bench: Suite, folder: Path) -> bool:
    """Tell whether a folder has warps of any view."""
    return any(
        (folder / scene / f"{view}.npz").is_file() for scene in bench.scenes for view in bench.views
    )


def score(bench: Suite, suite: Path, scene: str, folder: Path) -> Score:
    """Score a scene's warps, a folder with VIEW.npz, against the truth of the bench.

    Raises:
        InputError: a file is damaged, or an array has another name, size or type.
    """
    of = world(str(truth_file(suite, scene)), bench.size)
    views = bench.views[1:]
    answers = {view: _answer(folder, of, view) for view in views}
    truths = {view: of.pair(view, bench.size) for view in views}
    rows = {view: figures(*answers[view], truths[view]) for view in views}
    given = [view for view in views if (folder / f"{view}.npz").is_file()]
    missing = [view for view in views if view not in given]
    remarks = [f"missing: {', '.join(missing)}"] if missing else []
    if given:
        true = [np.where(truths[v].visible[..., None], truths[v].xy, np.nan) for v in given]
        points, visible = zip(*(answers[view] for view in given), strict=True)
        remarks += _remarks(np.stack(points), np.stack(visible), np.stack(true))
    values = {name: mean(row[name] for row in rows.values()) for name in WARP_FIGURES}
    by_view = {view: {"yaw": of.yaw[view], **row} for view, row in rows.items()}
    return Score(scene, WARPS, values, by_view, remarks)


def figures(points: Points, visible: Mask, truth: TwoView) -> dict[str, float]:
    """Figures of one view in the names of studies, and ``wrong``.

    ``wrong`` is 1 - 2 right / (accepted + visible): right pixels are accepted, truly visible and
    within :data:`NEAR` of their place. It is 1 if nothing is accepted, and undefined if, besides,
    nothing is visible.

    Args:
        points: (H, W, 2) positions in the source, NaN without an answer.
        visible: (H, W) bool, the accepted pixels; one without a position is not accepted.
        truth: exact relation of the source and the view.
    """
    visible = visible & np.isfinite(points).all(axis=-1)
    near = np.hypot(*np.moveaxis(points - truth.xy, -1, 0)) < NEAR
    right = int((visible & truth.visible & near).sum())
    counted = int((visible & (truth.label != AMBIGUOUS)).sum()) + int(truth.visible.sum())
    return {
        "wrong": 1 - 2 * right / counted if counted else float("nan"),
        **metrics.endpoint_error(points, truth.xy, truth.visible),
        **metrics.mask_error(visible, truth.label, truth.hits.valid, truth.behind),
    }


def by_yaw(scores: Sequence[Score]) -> Table:
    """Shares of all scenes' counts by the yaw between source and view."""
    counts = [
        (view["yaw"], {name: int(view[f"occlusion.{name}"]) for name in metrics.COUNTS})
        for score in scores
        for view in score.by_view.values()
    ]
    bins = [one for one in metrics.by_yaw(counts) if one.views]
    shares = {key: head for key, head in WARP_FIGURES.items() if key in bins[0].scores}
    rows = [[head, *(number(one.scores[key]) for one in bins)] for key, head in shares.items()]
    heads = [f"{one.low:g}–{one.high:g}°" for one in bins]
    return Table(["counts of all scenes, by yaw", *heads], rows)


def _answer(folder: Path, of: World, view: str) -> tuple[Points, Mask]:
    """Positions and accepted pixels of a view."""
    size = of.source.width
    path = folder / f"{view}.npz"
    if not path.is_file():
        return np.full((size, size, 2), np.nan), np.zeros((size, size), bool)
    held = _arrays(path, size)
    if "points" in held:
        points = held["points"].astype(np.float64)
        inside: Mask = np.all((points >= 0) & (points <= size), axis=-1)
        if inside.any() and np.median(points[inside]) <= 1:
            raise InputError(f"{path}: points: lie within 1; give pixels, not shares of the width")
        return points, held.get("visible", inside)
    if "depth" not in held:
        raise InputError(f"{path}: has neither points nor depth; see docs/measuring/bench.md")
    beside = folder / f"{of.source.name}.npz"
    source = _arrays(beside, size).get("depth") if beside.is_file() else None
    if source is None:
        if "visible" not in held:
            raise InputError(f"{beside}: has no depth, which tells what is visible; add it")
        source = np.full_like(held["depth"], np.nan)
    seen = Surface(held["depth"]), Surface(source)
    warped = warp_surfaces(of.source, of.camera(view), *seen, SETTINGS, warn_empty=False)
    return warped.correspondence.xy.numpy(), held.get("visible", warped.mask.numpy())


def _arrays(path: Path, size: int) -> dict[str, npt.NDArray[Any]]:
    try:
        with np.load(io.BytesIO(path.read_bytes())) as stored:
            held = dict(stored)
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        raise InputError(f"{path}: is no .npz of arrays; write it with numpy.savez") from None
    for name, array in held.items():
        if name not in PARTS:
            raise InputError(f"{path}: {name}: is unknown, expected {', '.join(PARTS)}")
        kind, beyond = PARTS[name]
        if array.dtype.kind != kind or array.shape != (size, size, *beyond):
            raise InputError(
                f"{path}: {name}: is {array.dtype} {array.shape}, expected"
                f" {'bool' if kind == 'b' else 'float'} {(size, size, *beyond)}, the picture's size"
            )
    return held


def _remarks(points: Points, visible: Mask, true: Points) -> list[str]:
    """Describe warps without merit, and slips of convention.

    Args:
        points, visible: answers of several views.
        true: exact positions of what is visible, else NaN.
    """
    remarks = ["everything is kept"] if visible.all() else []
    remarks += [] if visible.any() else ["nothing is kept"]
    own = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in points.shape[2:0:-1])), axis=-1)
    moved = np.abs(points - own)[~np.isnan(points)]
    if moved.size and moved.max() < 1e-3:
        remarks.append("every pixel lies at its own place: nothing is warped")
    error = _error(points, true)
    slips = [slip for slip, mend in SLIPS.items() if _error(mend(points, own), true) < error / 2]
    return remarks + [f"{slip}?" for slip in slips if error > SLIP]


def _error(points: Points, true: Points) -> float:
    offset = (points - true)[np.isfinite(points - true).all(axis=-1)]
    return float(np.median(np.hypot(*offset.T))) if offset.size else 0.0


def run(suite: Path, out: Path, options: Mapping[str, Any], report: Reporter = SILENT) -> Method:
    """Hand in this package's warps of the exported splats; see :func:`attnwarp_eval.bench.run.run`.

    Args:
        options: fields of :class:`attnwarp.warp.WarpSettings`, and ``preset``.
    """
    bench, fields = Suite.read(suite), dict(options)
    name = fields.pop("preset", "corrected")
    settings = preset(name, **fields)
    words = ", ".join(["warp", name, *(f"{key}={value}" for key, value in fields.items())])
    told = Method(
        name=words, track=WARPS, settings=settings.to_dict(), seconds=0.0,
        bench=sha256(suite / FILE),
    ).begun(out)  # fmt: skip
    for k, scene in enumerate(bench.scenes):
        targets = [view for view in bench.views[1:] if not (out / scene / f"{view}.npz").is_file()]
        if not targets:
            continue
        report.step(k, len(bench.scenes), scene)
        start = time.perf_counter()
        data = read_dataset(suite / scene / "transforms.json")
        files = {path.stem: path for path in data.image_paths if path is not None}
        cameras = dict(zip(files, data.cameras, strict=True))
        splats, source = read_ply(suite / scene / "splats.ply"), bench.views[0]
        surface = render_surface(splats, cameras[source], settings)
        for view in targets:
            images: dict[str, Any] = {}
            if "source_image" in parts_read(settings):
                images = {
                    f"{role}_image": read_image(files[of])[..., :3] / np.float32(255)
                    for role, of in (("source", source), ("target", view))
                }
            warped = warp_view(
                splats, cameras[source], cameras[view], settings, **images,
                source_surface=surface, warn_empty=False,
            )  # fmt: skip
            points, visible = warped.correspondence.xy.numpy(), warped.mask.numpy()
            buffer = io.BytesIO()
            np.savez_compressed(buffer, points=points, visible=visible)
            write_atomic(out / scene / f"{view}.npz", buffer.getvalue())
            end = time.perf_counter()
            told = told.model_copy(update={"seconds": (told.seconds or 0) + end - start})
            told.write(out)
            start = end
    return told
