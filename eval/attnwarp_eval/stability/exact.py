"""Splats at single pixels with 50 digits: the oracle of the rendering cases.

Written from the formulas of the papers and the declared constants of
:mod:`attnwarp.render.constants`, in mpmath and one splat at a time; it shares no code with the
renderers. Gradients are central differences with a step of 1e-20, exact to more digits than a
float64 has.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import constants

DIGITS = 50
STEP = mpmath.mpf(10) ** -20
FIELDS = ("means", "quats", "scales", "opacities")

Number = Any  # mpmath.mpf
Vector = list[Number]
Drawn = tuple[Number, Number, Number]
"""A splat at one pixel: depth of its centre, alpha before the cut-offs, depth."""


@dataclass(frozen=True)
class Pixel:
    """Values drawn at one pixel.

    Attributes:
        alpha: sum of the weights.
        depth: expected depth; None if nothing is drawn.
        nearest_threshold: smallest distance of an alpha from the cut-off 1/255; if it is small,
            rounding decides.
    """

    alpha: Number
    depth: Number | None
    nearest_threshold: Number


class ExactSplats:
    """Splats before a camera, with 50 digits.

    Args:
        gaussians: few splats; their stored values are taken as exact.
        near: near-plane depth.
        antialiased: screen filter of 3D splats.
        depth: the mode, as in :func:`attnwarp.render.render`.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        *,
        near: float = constants.NEAR,
        antialiased: bool = False,
        depth: str | None = None,
    ) -> None:
        self.kind = gaussians.kind
        self.depth = depth or {"2d": "intersection", "3d": "center"}[gaussians.kind]
        self.near, self.antialiased = mpmath.mpf(near), antialiased
        self.size = camera.width, camera.height
        with mpmath.workdps(DIGITS):
            self.K = _matrix(camera.K)
            self.R = _matrix(camera.rotation)
            position = _vector(camera.translation)
            origin = _apply(self.R, _vector(gaussians.origin))
            self.shift = [a + b for a, b in zip(position, origin, strict=True)]
            self.values: dict[str, list[Vector]] = {
                name: [_vector(np.atleast_1d(row)) for row in getattr(gaussians, name).tolist()]
                for name in FIELDS
            }

    def pixel(self, x: float, y: float) -> Pixel:
        """The splats composited at pixel coordinates (centres at +0.5)."""
        with mpmath.workdps(DIGITS):
            return _composite(self._splats(x, y))

    def gradient(
        self, pixels: Sequence[tuple[float, float]], weights: Sequence[tuple[float, float]]
    ) -> dict[str, np.ndarray]:
        """Derivatives of sum_p a_p alpha_p + b_p depth_p by field, with weights (a, b)
        of pixels (x, y).
        """
        with mpmath.workdps(DIGITS):
            # One splat moves at a time; the others are fixed.
            still = [self._splats(x, y) for x, y in pixels]
            gradient = {}
            for name in FIELDS:
                rows = []
                for splat, values in enumerate(self.values[name]):
                    row = []
                    step = STEP * (max(map(abs, values)) or 1)
                    for k, value in enumerate(values):
                        ends = []
                        for moved in (value + step, value - step):
                            values[k] = moved
                            drawn = [
                                [*others[:splat], self._splat(splat, x, y), *others[splat + 1 :]]
                                for others, (x, y) in zip(still, pixels, strict=True)
                            ]
                            ends.append(_loss(map(_composite, drawn), weights))
                        values[k] = value
                        row.append(float((ends[0] - ends[1]) / (2 * step)))
                    rows.append(row)
                gradient[name] = np.array(rows)
            return gradient

    def _splats(self, x: float, y: float) -> list[Drawn]:
        return [self._splat(k, x, y) for k in range(len(self.values["means"]))]

    def _splat(self, k: int, x: float, y: float) -> Drawn:
        """One splat at a pixel; its alpha is 0 if it is not drawn."""
        mean, quat, scale = (self.values[name][k] for name in ("means", "quats", "scales"))
        opacity = self.values["opacities"][k][0]
        center = [a + b for a, b in zip(_apply(self.R, mean), self.shift, strict=True)]
        turn = _rotation(quat)
        axes = [_apply(self.R, [turn[row][axis] for row in range(3)]) for axis in range(3)]
        px, py = mpmath.mpf(x), mpmath.mpf(y)
        ray_y = (py - self.K[1][2]) / self.K[1][1]
        ray = [(px - self.K[0][2] - self.K[0][1] * ray_y) / self.K[0][0], ray_y, mpmath.mpf(1)]
        if center[2] <= self.near:
            return center[2], mpmath.mpf(0), center[2]
        if self.kind == "2d":
            raw, z = self._disc(center, axes, scale, opacity, ray, px, py)
        else:
            raw, z = self._ellipsoid(center, axes, scale, opacity, ray, px, py)
        return center[2], raw, z

    def _disc(
        self,
        center: Vector,
        axes: list[Vector],
        scale: Vector,
        opacity: Number,
        ray: Vector,
        x: Number,
        y: Number,
    ) -> tuple[Number, Number]:
        """Ray-plane intersection, the screen filter, and the bound on its depth."""
        near, normal = self.near, axes[2]
        nc, nd = _dot(normal, center), _dot(normal, ray)
        floor = mpmath.mpf(constants.EDGE_ON) * mpmath.sqrt(_dot(center, center))
        if abs(nc) < floor:
            tilted = -floor if nc < 0 else floor
            nd += (tilted - nc) / center[2]
            nc = tilted
        ahead = nd / nc > 0
        z = nc / nd if ahead else mpmath.mpf(1)
        cx, cy = self._project(center)
        rho = ((x - cx) ** 2 + (y - cy) ** 2) * 2
        if ahead and z >= near:
            hit = [z * r - c for r, c in zip(ray, center, strict=True)]
            rho = min(rho, sum((_dot(hit, axes[k]) / scale[k]) ** 2 for k in range(2)))
        alpha = opacity * mpmath.exp(-rho / 2)
        if self.depth == "center":
            return alpha, center[2]
        variance = sum((scale[k] * axes[k][2]) ** 2 for k in range(2))
        low, high = self._extent(center[2], variance)
        return alpha, min(max(z, low), high) if ahead else high

    def _ellipsoid(
        self,
        center: Vector,
        axes: list[Vector],
        scale: Vector,
        opacity: Number,
        ray: Vector,
        x: Number,
        y: Number,
    ) -> tuple[Number, Number]:
        """J S J^T + 0.3 I with the clamped Jacobian of 3DGS."""
        slopes = []
        for k in range(2):
            margin = mpmath.mpf(constants.JACOBIAN_MARGIN) * self.size[k] / 2 / self.K[k][k]
            low = -self.K[k][2] / self.K[k][k] - margin
            high = (self.size[k] - self.K[k][2]) / self.K[k][k] + margin
            slopes.append(min(max(center[k] / center[2], low), high))
        S = [
            [sum(axes[m][i] * axes[m][j] * scale[m] ** 2 for m in range(3)) for j in range(3)]
            for i in range(3)
        ]
        to_pixel = [
            _combine(self.K[0][0], [1, 0, -slopes[0]], self.K[0][1], [0, 1, -slopes[1]]),
            _combine(mpmath.mpf(0), [1, 0, -slopes[0]], self.K[1][1], [0, 1, -slopes[1]]),
        ]
        rows = [[value / center[2] for value in row] for row in to_pixel]
        sharp = [[_dot(rows[i], _apply(S, rows[j])) for j in range(2)] for i in range(2)]
        blur = mpmath.mpf(constants.BLUR_3D)
        a, b, d = sharp[0][0] + blur, sharp[0][1], sharp[1][1] + blur
        det = a * d - b * b
        if self.antialiased:
            ratio = (sharp[0][0] * sharp[1][1] - sharp[0][1] ** 2) / det
            opacity = opacity * mpmath.sqrt(max(ratio, mpmath.mpf(constants.COMPENSATION_MIN)))
        cx, cy = self._project(center)
        dx, dy = x - cx, y - cy
        alpha = opacity * mpmath.exp(-(d * dx * dx - 2 * b * dx * dy + a * dy * dy) / det / 2)
        if self.depth == "center":
            return alpha, center[2]
        scaled = [[_dot(v, axes[m]) / scale[m] for m in range(3)] for v in (ray, center)]
        low, high = self._extent(center[2], S[2][2])
        peak = _dot(scaled[0], scaled[1]) / _dot(scaled[0], scaled[0])
        return alpha, min(max(peak, low), high)

    def _project(self, center: Vector) -> tuple[Number, Number]:
        K = self.K
        x = (K[0][0] * center[0] + K[0][1] * center[1]) / center[2] + K[0][2]
        return x, K[1][1] * center[1] / center[2] + K[1][2]

    def _extent(self, z: Number, variance: Number) -> tuple[Number, Number]:
        reach = mpmath.sqrt(2 * mpmath.log(255)) * mpmath.sqrt(variance)
        return max(z - reach, self.near), max(z + reach, self.near)


def _composite(splats: Sequence[Drawn]) -> Pixel:
    """Front to back by the depth of the centres, with the declared cut-offs."""
    before, total, weighted = mpmath.mpf(1), mpmath.mpf(0), mpmath.mpf(0)
    threshold = mpmath.mpf(constants.ALPHA_MIN)
    nearest = mpmath.inf
    for _, raw, z in sorted(splats, key=lambda splat: splat[0]):
        nearest = min(nearest, abs(raw - threshold))
        if raw < threshold or before <= mpmath.mpf(constants.TRANSMITTANCE_STOP):
            continue
        alpha = min(raw, mpmath.mpf(constants.ALPHA_MAX))
        total += before * alpha
        weighted += before * alpha * z
        before *= 1 - alpha
    return Pixel(total, weighted / total if total > 0 else None, nearest)


def _loss(pixels: Iterable[Pixel], weights: Sequence[tuple[float, float]]) -> Number:
    loss = mpmath.mpf(0)
    for pixel, (a, b) in zip(pixels, weights, strict=True):
        loss += a * pixel.alpha
        if b and pixel.depth is not None:
            loss += b * pixel.depth
    return loss


def _vector(values: Any) -> Vector:
    return [mpmath.mpf(float(value)) for value in values]


def _matrix(values: Any) -> list[Vector]:
    return [_vector(row) for row in values]


def _dot(a: Vector, b: Vector) -> Number:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _apply(matrix: list[Vector], vector: Vector) -> Vector:
    return [_dot(row, vector) for row in matrix]


def _combine(p: Number, a: Sequence[Any], q: Number, b: Sequence[Any]) -> Vector:
    return [p * x + q * y for x, y in zip(a, b, strict=True)]


def _rotation(quat: Vector) -> list[Vector]:
    length = mpmath.sqrt(_dot(quat, quat))
    w, x, y, z = (value / length for value in quat)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
