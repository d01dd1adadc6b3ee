"""The rules of visibility from their definitions, in long double: the oracle of their labels.

It shares no code with the library: poses are composed as matrices, distances to tangent planes are
taken in world coordinates, and depth between pixels is summed over the hat functions of the whole
grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.stability.bilinear import Extended, sampling_matrix

UNDECIDED = 1e-12
"""A comparison this close, relative to what is compared, may go either way in float64."""


@dataclass(frozen=True)
class Labels:
    """Labels of the target's pixels by each rule.

    Attributes:
        rules: (H, W) bool by the rule's name, True for pixels that pass.
        undecided: pixels at which rounding decides, by the same names.
    """

    rules: dict[str, npt.NDArray[np.bool_]]
    undecided: dict[str, npt.NDArray[np.bool_]]


def exact_labels(
    source: Camera,
    target: Camera,
    source_depth: npt.NDArray[Any],
    target_depth: npt.NDArray[Any],
    target_normal: npt.NDArray[Any],
    *,
    relative: float,
    slope: float,
    spread: float,
) -> Labels:
    """The rules of a pair of views.

    Args:
        source, target: cameras of pictures of one size (H, W).
        source_depth, target_depth: (H, W) as stored, NaN without a surface.
        target_normal: (H, W, 3) in world axes.
        relative, slope, spread: tolerances of :class:`attnwarp.warp.WarpSettings`.
    """
    height, width = target_depth.shape
    z, d = target_depth.astype(np.longdouble), source_depth.astype(np.longdouble)
    present = np.isfinite(z) & (z > 0)
    y, x = np.mgrid[:height, :width] + np.longdouble(0.5)
    seen_by_target = _rays(target.K, x, y) * z[..., None]
    # R^T (p - t): exact up to the pose's deviation from a rotation.
    points = (seen_by_target - _long(target.translation)) @ _long(target.rotation)
    seen = points @ _long(source.rotation).T + _long(source.translation)
    depth = seen[..., 2]
    position = (seen / depth[..., None]) @ _long(source.K).T
    u, v = position[..., 0], position[..., 1]
    ahead = present & (depth > 0)
    inside = ahead & (u >= 0) & (u <= width) & (v >= 0) & (v <= height)

    there, mixed = _depth_between(d, np.where(inside, u, 0.5), np.where(inside, v, 0.5), spread)
    column, row = (
        np.clip(np.floor(np.where(inside, place, 0)), 0, length - 1).astype(int)
        for place, length in ((u, width), (v, height))
    )
    allowed = relative * depth + slope * _slope(d)[row, column]
    difference = np.abs(depth - there)

    normal = target_normal.astype(np.longdouble)
    sides = [(normal * (_long(camera.position) - points)).sum(-1) for camera in (source, target)]
    reach = [
        np.linalg.norm(camera.position - points.astype(float), axis=-1)
        for camera in (source, target)
    ]
    level = np.minimum(*(np.abs(side) / far for side, far in zip(sides, reach, strict=True)))
    return Labels(
        {
            "defined": ahead,
            "in_bounds": inside,
            "in_front": ahead,
            "depth_agrees": inside & (difference <= allowed),
            "facing": present & (sides[0] * sides[1] > 0),
        },
        {
            "defined": _close(depth, 0, z),
            "in_front": _close(depth, 0, z),
            "in_bounds": _close(u, 0, width)
            | _close(u, width, width)
            | _close(v, 0, height)
            | _close(v, height, height),
            "depth_agrees": inside & (_close(difference, allowed, depth) | mixed),
            "facing": level < UNDECIDED,
        },
    )


def _depth_between(
    depth: Extended, u: Extended, v: Extended, spread: float
) -> tuple[Extended, npt.NDArray[np.bool_]]:
    """Depth interpolated in 1 / z, NaN where a tap has none or taps spread too far; and where the
    spread is within rounding of its limit.
    """
    flat = depth.reshape(-1)
    share = sampling_matrix(np.stack([u, v], axis=-1), *depth.shape)
    used = share > 0
    holed = (used & ~(np.isfinite(flat) & (flat > 0))).any(axis=1)
    finite = np.where(np.isfinite(flat) & (flat > 0), flat, 1)
    result = 1 / (share / finite).sum(axis=1)
    largest = np.where(used, finite, -np.inf).max(axis=1)
    limit = np.where(used, finite, np.inf).min(axis=1) * (1 + spread)
    result = np.where(holed | (largest > limit), np.nan, result)
    return result.reshape(u.shape), _close(largest, limit, limit).reshape(u.shape)


def _slope(depth: Extended) -> Extended:
    """The smaller one-sided |dz| of each axis, summed; an axis without a neighbour adds 0."""
    total = np.zeros_like(depth)
    for axis in (0, 1):
        padded = np.pad(
            depth, [(1, 1) if k == axis else (0, 0) for k in (0, 1)], constant_values=np.nan
        )
        steps = np.abs(np.diff(padded, axis=axis))
        before, after = (steps.take(range(k, k + depth.shape[axis]), axis=axis) for k in (0, 1))
        smaller = np.fmin(before, after)
        total += np.where(np.isfinite(smaller), smaller, 0)
    return np.where(np.isfinite(depth), total, 0)


def _rays(K: npt.NDArray[np.float64], x: Extended, y: Extended) -> Extended:
    """(H, W, 3) camera-space points at depth 1 that a pinhole puts at (x, y)."""
    exact = _long(K)
    below = (y - exact[1, 2]) / exact[1, 1]
    right = (x - exact[0, 2] - exact[0, 1] * below) / exact[0, 0]
    return np.stack([right, below, np.ones_like(below)], axis=-1)


def _close(a: Any, b: Any, scale: Any) -> npt.NDArray[np.bool_]:
    return np.asarray(np.abs(a - b) < UNDECIDED * np.abs(scale))


def _long(values: Sequence[Any] | npt.NDArray[Any]) -> Extended:
    return np.asarray(values).astype(np.longdouble)
