"""Procedural albedo: a colour for every point of space.

A texture is a pure function of the world position, so the same surface point has the same colour in
every view, for any mesh or picture it is baked into.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numba
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from attnwarp.numba_cache import CACHE
from attnwarp_eval.scene.base import Color, Coordinate, Direction, Positive, Spec, linear_rgb

Array = npt.NDArray[np.float64]


class _Texture(Spec):
    variation: float = Field(
        0.0, ge=0, le=1
    )  # share by which a fine noise brightens or darkens the colour
    grain: Positive = 0.1  # size of that noise, scene units


class Plain(_Texture):
    """One colour."""

    type: Literal["plain"] = "plain"
    color: Color


class Checker(_Texture):
    """Cubes of two colours, ``size`` wide."""

    type: Literal["checker"]
    colors: tuple[Color, Color]
    size: Positive


class Stripes(_Texture):
    """Layers of the given colours across ``direction``, each ``size`` thick."""

    type: Literal["stripes"]
    colors: tuple[Color, ...] = Field(min_length=2)
    size: Positive
    direction: Direction = (0.0, 0.0, 1.0)
    wobble: float = Field(0.0, ge=0)  # how far noise bends the layers, in layers


class Noise(_Texture):
    """Fractal noise with features of ``size``, coloured by a ramp over ``colors``."""

    type: Literal["noise"]
    colors: tuple[Color, ...] = Field(min_length=2)
    size: Positive
    octaves: int = Field(4, ge=1, le=8)


class Bricks(_Texture):
    """Courses of bricks (``size``: length, height) with mortar, each row offset."""

    type: Literal["bricks"]
    colors: tuple[Color, ...] = Field(min_length=1)
    mortar: Color
    size: tuple[Positive, Positive]
    joint: Positive = 0.02


class Rings(_Texture):
    """Rings of colours, each ``size`` wide, about the vertical of ``center``, as in wood."""

    type: Literal["rings"]
    colors: tuple[Color, ...] = Field(min_length=2)
    size: Positive
    center: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    wobble: float = Field(0.0, ge=0)  # how far noise bends the rings, in rings


class Cells(_Texture):
    """Voronoi cells: each location has the colour of its nearest point."""

    type: Literal["cells"]
    centers: tuple[tuple[Coordinate, Coordinate, Coordinate], ...] = Field(min_length=1)
    colors: tuple[Color, ...]

    @model_validator(mode="after")
    def _a_color_a_center(self) -> Cells:
        if len(self.colors) != len(self.centers):
            raise ValueError(
                f"got {len(self.colors)} colors for {len(self.centers)} centers, expected one for"
                " each"
            )
        return self


AnyTexture = Plain | Checker | Stripes | Noise | Bricks | Rings | Cells

Texture = Annotated[AnyTexture, Field(discriminator="type")]


def nearest(points: Array, centers: Array) -> npt.NDArray[np.int64]:
    """(N,) index of the nearest of (P, 3) ``centers`` to each of (N, 3) ``points``.

    Example:
        >>> nearest(np.array([[0.1, 0, 0], [0.9, 0, 0]]), np.array([[0.0, 0, 0], [1, 0, 0]]))
        array([0, 1])
    """
    # |p - c|^2 without |p|^2, about the centres' mean, to keep precision far from the origin.
    middle = centers.mean(axis=0)
    away = centers - middle
    return ((away**2).sum(axis=1) - 2 * (points - middle) @ away.T).argmin(axis=1)


def albedo(texture: AnyTexture, points: npt.ArrayLike) -> Array:
    """(N, 3) linear RGB albedo in [0, 0.9] at (N, 3) world ``points``."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    match texture:
        case Plain():
            color = np.tile(linear_rgb(texture.color), (len(points), 1))
        case Checker():
            # Shifted so that surfaces at round coordinates, a ground at z = 0 above all, lie inside
            # a layer of cubes.
            cell = np.floor(points / texture.size + 0.37).sum(axis=1).astype(np.int64) % 2
            color = _palette(texture.colors)[cell]
        case Stripes():
            axis = np.asarray(texture.direction) / np.linalg.norm(texture.direction)
            height = points @ axis / texture.size + 0.37
            if texture.wobble:
                height = height + texture.wobble * (
                    2 * fractal_noise(points / (3 * texture.size), 2, 11) - 1
                )
            color = _palette(texture.colors)[
                np.floor(height).astype(np.int64) % len(texture.colors)
            ]
        case Noise():
            ramp = _palette(texture.colors)
            # The middle of the noise's range is stretched over the whole ramp; its extremes are
            # rare.
            value = np.clip(
                1.8 * (fractal_noise(points / texture.size, texture.octaves, 3) - 0.5) + 0.5, 0, 1
            )
            position = value * (len(ramp) - 1)
            low = np.minimum(position.astype(np.int64), len(ramp) - 2)
            part = (position - low)[:, None]
            color = ramp[low] * (1 - part) + ramp[low + 1] * part
        case Rings():
            away = points[:, :2] - np.array(texture.center)
            ring = np.linalg.norm(away, axis=-1) / texture.size + 0.37
            if texture.wobble:
                ring = ring + texture.wobble * (
                    2 * fractal_noise(points / (6 * texture.size), 3, 13) - 1
                )
            color = _palette(texture.colors)[np.floor(ring).astype(np.int64) % len(texture.colors)]
        case Cells():
            color = _palette(texture.colors)[nearest(points, np.array(texture.centers))]
        case Bricks():
            length, height = texture.size
            row = np.floor(points[:, 2] / height)
            # x + y runs along any wall that is parallel to one of the two axes.
            along = (points[:, 0] + points[:, 1]) / length + 0.5 * (row % 2)
            brick = np.floor(along)
            shade = lattice_noise(np.stack([brick, row, np.zeros_like(row)], axis=-1), 5)
            color = _palette(texture.colors)[
                np.minimum((shade * len(texture.colors)).astype(np.int64), len(texture.colors) - 1)
            ]
            joint = ((along - brick) * length < texture.joint) | (
                points[:, 2] - row * height < texture.joint
            )
            color = np.where(
                joint[:, None], linear_rgb(texture.mortar), color * (0.8 + 0.4 * shade[:, None])
            )
    if texture.variation:
        color = (
            color
            * (1 + texture.variation * (2 * fractal_noise(points / texture.grain, 3, 7) - 1))[
                :, None
            ]
        )
    return np.clip(color, 0.0, 0.9)  # largest albedo of real diffuse surfaces


def _palette(colors: tuple[str, ...]) -> Array:
    return np.array([linear_rgb(color) for color in colors])


@numba.njit(cache=CACHE, nogil=True, inline="always")
def _lattice(ix: Any, iy: Any, iz: Any, seed: Any) -> Any:
    # An integer hash (the finaliser of splitmix64): the same value on every machine, no table, no
    # random state.
    h = np.uint64(ix) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(iy) * np.uint64(
        0xC2B2AE3D27D4EB4F
    )
    h = (
        h
        ^ np.uint64(iz) * np.uint64(0x165667B19E3779F9)
        ^ np.uint64(seed) * np.uint64(0xD6E8FEB86659FD93)
    )
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ (h >> np.uint64(31))
    return float(h >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@numba.njit(cache=CACHE, nogil=True)
def lattice_noise(points: Array, seed: int) -> Array:
    """(N,) white noise in [0, 1): a value for each integer cell of the (N, 3) ``points``."""
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, y, z = np.floor(points[i, 0]), np.floor(points[i, 1]), np.floor(points[i, 2])
        out[i] = _lattice(np.int64(x), np.int64(y), np.int64(z), seed)
    return out


@numba.njit(cache=CACHE, nogil=True)
def fractal_noise(points: Array, octaves: int, seed: int) -> Array:
    """Value noise summed over octaves (each twice as fine, half as strong), scaled to [0, 1].

    Args:
        points: (N, 3), in units of the coarsest feature.
        octaves: at least 1.

    Returns:
        (N,) float64, with a mean of about one half.
    """
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        total, weight, norm, scale = 0.0, 1.0, 0.0, 1.0
        for octave in range(octaves):
            # Shifted per octave, so that surfaces at round coordinates do not run along the
            # lattice.
            x, y, z = (
                points[i, 0] * scale + 0.31,
                points[i, 1] * scale + 0.57,
                points[i, 2] * scale + 0.43,
            )
            fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
            ix, iy, iz = np.int64(fx), np.int64(fy), np.int64(fz)
            u, v, w = x - fx, y - fy, z - fz
            u = u * u * u * (u * (u * 6 - 15) + 10)
            v = v * v * v * (v * (v * 6 - 15) + 10)
            w = w * w * w * (w * (w * 6 - 15) + 10)
            s = seed + octave
            a = _lattice(ix, iy, iz, s) * (1 - u) + _lattice(ix + 1, iy, iz, s) * u
            b = _lattice(ix, iy + 1, iz, s) * (1 - u) + _lattice(ix + 1, iy + 1, iz, s) * u
            c = _lattice(ix, iy, iz + 1, s) * (1 - u) + _lattice(ix + 1, iy, iz + 1, s) * u
            d = _lattice(ix, iy + 1, iz + 1, s) * (1 - u) + _lattice(ix + 1, iy + 1, iz + 1, s) * u
            total += weight * ((a * (1 - v) + b * v) * (1 - w) + (c * (1 - v) + d * v) * w)
            norm += weight
            weight *= 0.5
            scale *= 2.0
        out[i] = total / norm
    return out
