"""Hard cases of cameras and warps: positions in the source, and sampling there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import mpmath
import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.warp import (
    Correspondence,
    WarpSettings,
    correspond,
    preset,
)
from attnwarp_eval.stability.case import Bound, Case, Way, ways

DIGITS = 60

WARPS = ways("reference", "cpu")
"""The definition in torch and the kernels; the precision is that of the depth map."""

POSITION = Bound("px", 1e-4, "numerics of the warp; a thousandth of what a feature grid resolves")
LOOSE = Bound("px", 1e-3, "the world's own coordinates are rounded before the warp reads them")

MP = "pinhole projection in mpmath with 60 digits, from the stored poses and depths"


@dataclass(frozen=True)
class Pair:
    """Two cameras and the target's depth.

    Attributes:
        source, target: the cameras.
        depth: (H, W) of the target, float64.
        exact: the poses (world to camera) that the oracle reads, those of the cameras if None.
    """

    source: Camera
    target: Camera
    depth: np.ndarray
    exact: tuple[np.ndarray, np.ndarray] | None = None


BOUNDS_ONLY = WarpSettings.from_dict(
    {
        **preset("corrected").to_dict(),
        "opaque": None,
        "depth_agreement": False,
        "normal_test": "none",
    }
)
"""Positions alone: no rule needs a surface."""


def positions(pair: Pair, way: Way) -> Correspondence:
    """The correspondence of a pair by a way."""
    depth = torch.from_numpy(pair.depth.astype(way.numpy))
    if way.backend == "reference":
        return correspond(pair.source, pair.target, depth)
    from attnwarp.warp import Surface, warp_surfaces

    view = warp_surfaces(pair.source, pair.target, Surface(depth), None, BOUNDS_ONLY)
    return view.correspondence


def exact_positions(pair: Pair, depth: np.ndarray) -> list[list[tuple[Any, Any, Any]]]:
    """Row by row (x, y, z) of every pixel in the source, with 60 digits."""
    with mpmath.workdps(DIGITS):
        poses = pair.exact or (pair.source.world_to_camera, pair.target.world_to_camera)
        Ps, Pt = (mpmath.matrix(pose.tolist()) for pose in poses)
        relative = Ps * mpmath.inverse(Pt)
        Kt, Ks = (mpmath.matrix(camera.K.tolist()) for camera in (pair.target, pair.source))
        rows = []
        for i in range(pair.target.height):
            row = []
            for j in range(pair.target.width):
                y = (mpmath.mpf(i) + 0.5 - Kt[1, 2]) / Kt[1, 1]
                x = (mpmath.mpf(j) + 0.5 - Kt[0, 2] - Kt[0, 1] * y) / Kt[0, 0]
                z = mpmath.mpf(float(depth[i, j]))
                p = relative * mpmath.matrix([x * z, y * z, z, 1])
                q = Ks * p[0:3]
                row.append((q[0] / p[2], q[1] / p[2], p[2]))
            rows.append(row)
        return rows


def position_error(build: Callable[[float], Pair]) -> Callable[[float, Way], float]:
    """The measure of a case of positions: the largest distance in px from the exact position, over
    all pixels, all of which must have one.
    """

    @cache
    def pair(level: float) -> Pair:
        return build(level)

    @cache
    def truth(level: float, precision: str) -> list[list[tuple[Any, Any, Any]]]:
        made = pair(level)
        return exact_positions(made, made.depth.astype(precision))

    def measure(level: float, way: Way) -> float:
        result = positions(pair(level), way).xy.numpy()
        worst = 0.0
        for row, exact_row in zip(result, truth(level, way.precision), strict=True):
            for (x, y), (u, v, _) in zip(row, exact_row, strict=True):
                if not (math.isfinite(x) and math.isfinite(y)):
                    return math.inf
                worst = max(worst, math.hypot(float(x - u), float(y - v)))
        return worst

    return measure


def _look(position: Sequence[float], size: int = 8) -> Camera:
    return Camera.look_at(position, (0, 0, 0), width=size, height=size, fov_y=45)


def _depth(camera: Camera, low: float = 3.0, high: float = 5.0) -> np.ndarray:
    """A depth map that rises over the picture."""
    return np.linspace(low, high, camera.width * camera.height).reshape(camera.height, camera.width)


def _focal(focal: float) -> Pair:
    K = np.array([[focal, 0, 4.0], [0, focal, 4.0], [0, 0, 1]])
    turn = np.eye(4)
    angle = 1.0 / (focal + 10)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    turn[0, 3] = 0.3 / focal
    target, source = Camera(K, np.eye(4), 8, 8), Camera(K, turn, 8, 8)
    return Pair(source, target, _depth(target, 2.0, 2.5))


def _baseline(baseline: float) -> Pair:
    focal = 500.0
    K = np.array([[focal, 0, 3.5], [0, focal, 2.0], [0, 0, 1]])
    start = Camera.look_at((0, 0, 0), (3, 1, 2), width=7, height=4, fov_y=40)
    target = Camera(K, start.world_to_camera, 7, 4)
    pose = target.world_to_camera.copy()
    pose[0, 3] += baseline
    # The depth follows the baseline, so that the displacement stays half a pixel.
    return Pair(Camera(K, pose, 7, 4), target, _depth(target, 0.9, 1.1) * baseline * 1e3)


CASES = [
    Case(
        7,
        "tiny_baseline",
        "Two cameras a hair apart, before a surface a hair away",
        input="a displacement of half a pixel at every baseline",
        oracle=MP,
        hardness="baseline, scene units",
        levels=(1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14),
        required=1e-8,
        quick=(1, 1e-6, 1e-10),
        bounds={"forward": LOOSE},
        ways=WARPS,
        measure=position_error(_baseline),
        group="warps",
    ),
    Case(
        11,
        "focal_length",
        "Focal lengths from 1 px on",
        input="a turned and shifted camera; the turn shrinks as the picture narrows",
        oracle=MP,
        hardness="focal length, px",
        levels=(1, 30, 1e3, 1e5, 1e6, 1e8, 1e10, 1e12),
        required=1e6,
        quick=(1, 1e3, 1e6),
        bounds={"forward": POSITION},
        ways=WARPS,
        measure=position_error(_focal),
        group="warps",
    ),
]
