"""Warps and masks at the points of tracks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.reporting import SILENT, Reporter
from attnwarp.warp import PRESETS, Surface, render_surface, warp_view
from attnwarp.warp.depth import blend_depth, valid_depth
from attnwarp_eval.tracks.find import Array, Mask, Tracks, world_points

OFF = 2.0
"""Error in px beyond which a position is wrong."""

LEAST = 5
"""Least common points of a pair."""

RESAMPLES = 400


@dataclass(frozen=True, eq=False)
class Pair:
    """A warp at the n points of tracks common to a source and a target.

    Attributes:
        source, target: indices of the cameras.
        apart: number of views between them in order, plus 1.
        held_out: whether one of the two was held out of the fit.
        angle: (n,) degrees between the rays of the two views.
        error: (n,) px in the source between the warped position and the track's; NaN if the
            splats give none.
        kept: (n,) bool whether the mask keeps the point.
        floor: (n,) px between the track's 3D point and its observation, in the source.
        flat: (n,) px of a warp whose depth is the target's median everywhere.
    """

    source: int
    target: int
    apart: int
    held_out: bool
    angle: Array
    error: Array
    kept: Mask
    floor: Array
    flat: Array


def measure(
    splats: Gaussians,
    cameras: Sequence[Camera],
    tracks: Tracks,
    preset: str,
    *,
    apart: Sequence[int] = (1, 3, 6),
    held_out: Sequence[bool] | None = None,
    near: float | None = None,
    report: Reporter = SILENT,
) -> list[Pair]:
    """Warp each view to the views ``apart`` before it, and compare with the tracks.

    The target's depth is read at a track's point as a feature grid reads it, between pixel
    centres; the mask is that of the pixel that holds the point.

    Args:
        splats: the fitted scene.
        cameras: in the order of the capture, at the measured size.
        tracks: in px of ``cameras``.
        preset: name of the warp's settings.
        apart: distances between the views of a pair, in the cameras' order.
        held_out: flag of each camera: held out of the fit.
        near: near plane in scene units, as in :func:`attnwarp.warp.render_surface`.
        report: callback for each finished pair.

    Returns:
        Pairs with at least :data:`LEAST` points in common.
    """
    settings = PRESETS[preset]
    held_out = held_out or [False] * len(cameras)
    points = world_points(tracks, cameras)

    @lru_cache(maxsize=max(apart) + 1)
    def surface(k: int) -> Surface:
        return render_surface(splats, cameras[k], settings, near=near)

    wanted = [(k - n, k, n) for k in range(len(cameras)) for n in apart if k >= n]
    pairs = []
    for done, (s, t, n) in enumerate(wanted):
        report.step(done, len(wanted), f"{preset}: {cameras[s].name} to {cameras[t].name}")
        first, second = tracks.shared(s, t)
        if len(first) < LEAST:
            continue
        source, target = cameras[s], cameras[t]
        seen, at = tracks.xy[first], tracks.xy[second]
        view = warp_view(
            splats, source, target, settings, source_surface=surface(s), near=near, warn_empty=False
        )
        depth = valid_depth(view.target.depth, "depth")
        read = blend_depth(
            depth, torch.as_tensor(at), settings.depth_interpolation, settings.depth_spread
        )
        middle = depth[~depth.isnan()]
        flat = float(middle.median()) if len(middle) else float("nan")

        def distance(world: Array, seen: Array = seen, source: Camera = source) -> Array:
            return np.linalg.norm(source.project(world)[0] - seen, axis=1)

        where = points[tracks.point[first]]
        pairs.append(
            Pair(
                s, t, n, held_out[s] or held_out[t],
                _angle(where, source.position, target.position),
                distance(target.unproject(at, read.numpy())),
                _holds(view.mask, at),
                distance(where),
                distance(target.unproject(at, np.full(len(at), flat))),
            )
        )  # fmt: skip
    report.step(len(wanted), len(wanted), preset)
    return pairs


def _angle(points: Array, a: Array, b: Array) -> Array:
    first, second = points - a, points - b
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.degrees(np.arctan2(sine, (first * second).sum(axis=1)))


def _holds(mask: torch.Tensor, xy: Array) -> Mask:
    """Values of the mask at the pixels that contain ``xy``."""
    values = mask.numpy()
    x = np.clip(np.floor(xy[:, 0]).astype(int), 0, values.shape[1] - 1)
    y = np.clip(np.floor(xy[:, 1]).astype(int), 0, values.shape[0] - 1)
    return np.asarray(values[y, x], dtype=bool)


@dataclass(frozen=True)
class Figure:
    """A figure over the points of all pairs, with its bootstrap interval over target pictures."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if np.isnan(self.value):
            return ""
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"


FIGURES: Mapping[str, Callable[[Mapping[str, Array]], float]] = {
    "median": lambda p: _median(p["error"]),
    "kept": lambda p: _mean(p["kept"]),
    "median_kept": lambda p: _median(p["error"][p["kept"] > 0]),
    "off": lambda p: _mean(~(p["error"] <= OFF)),
    "dropped_off": lambda p: _mean(1 - p["kept"][~(p["error"] <= OFF)]),
    "floor": lambda p: _median(p["floor"]),
    "flat": lambda p: _median(p["flat"]),
}
"""Figures of a row: median px, share kept, median px of those, share off by more than :data:`OFF`
px or without a position, share of those that the mask drops, and the medians of the tracks' 3D
points and of a flat depth."""


def summarise(pairs: Sequence[Pair], seed: int = 0) -> dict[str, Figure]:
    """The :data:`FIGURES` of pairs.

    Points of one picture share its pose and its splats, so whole target pictures are resampled,
    :data:`RESAMPLES` times; an interval holds the middle 95 percent.
    """
    targets = sorted({pair.target for pair in pairs})
    parts = [
        {
            name: np.concatenate(
                [np.asarray(getattr(p, name), dtype=float) for p in pairs if p.target == target]
            )
            for name in ("error", "kept", "floor", "flat")
        }
        for target in targets
    ]
    rng = np.random.default_rng(seed)
    draws = [np.arange(len(parts)), *rng.integers(len(parts), size=(RESAMPLES, len(parts)))]
    values = {name: np.empty(len(draws)) for name in FIGURES}
    for k, drawn in enumerate(draws):
        pooled = {name: np.concatenate([parts[i][name] for i in drawn]) for name in parts[0]}
        for name, figure in FIGURES.items():
            values[name][k] = figure(pooled)
    found = {}
    for name, row in values.items():
        resampled = row[1:][~np.isnan(row[1:])]
        low, high = np.percentile(resampled, [2.5, 97.5]) if len(resampled) else (np.nan, np.nan)
        found[name] = Figure(float(row[0]), float(low), float(high))
    return found


def _median(values: npt.NDArray[np.floating]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _mean(values: npt.NDArray[np.generic]) -> float:
    return float(values.mean()) if len(values) else float("nan")
