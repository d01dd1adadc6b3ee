"""Uneven ground, with small things on it: meshes generated from a few numbers and a seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from attnwarp_eval.scene.base import Color, Coordinate, Positive, Seed, Spec, Vector, linear_rgb
from attnwarp_eval.scene.shapes import Mesh
from attnwarp_eval.scene.textures import fractal_noise, lattice_noise

Array = npt.NDArray[np.float64]
Height = Callable[[Array], Array]
"""Function from (N, 2) positions to (N,) heights."""

FOCUS = 2.2
"""Factor by which the middle of a terrain is meshed finer than its rim: cosh of it, 4.6 times."""


class TerrainSpec(Spec):
    """Uneven ground: noise of ``height`` up and down with features of ``feature``, level within
    ``level[0]`` of the middle and in full relief from ``level[1]`` on. The mesh is finest in the
    middle."""

    type: Literal["terrain"]
    center: Vector = (0.0, 0.0, 0.0)
    size: tuple[Positive, Positive]
    height: Positive
    feature: Positive
    octaves: int = Field(4, ge=1, le=8)
    level: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    seed: Seed = 0
    resolution: int = Field(320, ge=2, le=2048)

    @model_validator(mode="after")
    def _ordered(self) -> TerrainSpec:
        if not 0 <= self.level[0] <= self.level[1]:
            raise ValueError(
                f"got level {list(self.level)}, expected [radius of the level middle, radius of the"
                " relief]"
            )
        return self

    def height_at(self, xy: Array) -> Array:
        """(N,) height of the ground at (N, 2) places."""
        xy = np.asarray(xy, dtype=np.float64)
        away = np.linalg.norm(xy - np.array(self.center[:2]), axis=-1)
        inner, outer = self.level
        rise = np.clip((away - inner) / max(outer - inner, 1e-9), 0, 1)
        rise = rise * rise * (3 - 2 * rise)
        places = np.concatenate([xy / self.feature, np.zeros((len(xy), 1))], axis=1)
        noise = 2 * fractal_noise(np.ascontiguousarray(places), self.octaves, self.seed) - 1
        return self.center[2] + self.height * rise * noise

    def below(self, point: Array) -> bool:
        """Return True if a (3,) point lies under the ground."""
        here = (np.abs(point[:2] - np.array(self.center[:2])) <= np.array(self.size) / 2).all()
        return bool(here and point[2] < self.height_at(point[None, :2])[0])

    def mesh(self) -> Mesh:
        """The ground as triangles facing up, with the normals of the height field."""
        n = self.resolution
        line = np.sinh(FOCUS * np.linspace(-1, 1, n + 1)) / np.sinh(FOCUS)
        x, y = np.meshgrid(line * self.size[0] / 2, line * self.size[1] / 2, indexing="ij")
        xy = np.stack([x.ravel() + self.center[0], y.ravel() + self.center[1]], axis=-1)
        vertices = np.column_stack([xy, self.height_at(xy)])
        step = 1e-4 * self.feature
        slope = [
            (self.height_at(xy + d) - self.height_at(xy - d)) / (2 * step) for d in np.eye(2) * step
        ]
        normals = np.stack([-slope[0], -slope[1], np.ones(len(xy))], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        k = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
        faces = np.concatenate(
            [np.stack([k, k + n + 1, k + n + 2], axis=-1), np.stack([k, k + n + 2, k + 1], axis=-1)]
        ).astype(np.int64)
        return Mesh(vertices, faces, normals)


class ScatterSpec(Spec):
    """``count`` small things scattered evenly between two radii about ``center``, on the object
    named ``on``.

    Attributes:
        kind: stones, tufts of grass, flowers, or fallen leaves.
        size: smallest and largest; a stone's radius, the height of grass and flowers, the length of
            a leaf.
        radius: [inner, outer] of the ring.
        avoid: discs [x, y, radius] to keep free.
        colors: one is chosen for each thing, and multiplies the object's texture.
        on: supporting terrain or horizontal rectangle; by default the height of ``center``.
    """

    type: Literal["scatter"]
    kind: Literal["stones", "grass", "flowers", "leaves"]
    count: int = Field(ge=1, le=20000)
    size: tuple[Positive, Positive]
    radius: tuple[Annotated[float, Field(ge=0)], Positive]
    center: Vector = (0.0, 0.0, 0.0)
    avoid: tuple[tuple[Coordinate, Coordinate, Positive], ...] = ()
    colors: tuple[Color, ...] = ("#ffffff",)
    on: str | None = None
    seed: Seed = 0

    @model_validator(mode="after")
    def _ordered(self) -> ScatterSpec:
        for name, (low, high) in (("size", self.size), ("radius", self.radius)):
            if low > high:
                raise ValueError(f"got {name} [{low}, {high}], expected [smallest, largest]")
        return self

    def places(self) -> Array:
        """(M, 2) positions of the things: those of ``count`` samples outside ``avoid``."""
        dice = self._dice(3)
        inner, outer = self.radius
        r = np.sqrt(inner**2 + dice[:, 0] * (outer**2 - inner**2))  # even over the area
        xy = np.stack(
            [r * np.cos(2 * np.pi * dice[:, 1]), r * np.sin(2 * np.pi * dice[:, 1])], axis=-1
        )
        xy += np.array(self.center[:2])
        free = np.ones(len(xy), dtype=bool)
        for x, y, radius in self.avoid:
            free &= np.hypot(xy[:, 0] - x, xy[:, 1] - y) > radius
        return xy[free]

    def _dice(self, columns: int, salt: int = 0) -> Array:
        # The hash used for textures: the same numbers on every machine and with every version of
        # numpy.
        grid = np.stack(
            np.meshgrid(np.arange(self.count), np.arange(columns), indexing="ij"), axis=-1
        ).reshape(-1, 2)
        cells = np.column_stack([grid, np.full(len(grid), 1000 + salt)]).astype(np.float64)
        return lattice_noise(cells, self.seed).reshape(self.count, columns)

    def mesh(self, height: Height) -> Mesh:
        """All things as one mesh, on the ground of this height.

        Raises:
            ValueError: ``avoid`` excludes every position.
        """
        xy = self.places()
        if not len(xy):
            raise ValueError(
                "avoid leaves no room for any of them; make it smaller or the radius larger"
            )
        dice = self._dice(12, 1)[: len(xy)]
        z = height(xy)
        build = {"stones": _stone, "grass": _tuft, "flowers": _flower, "leaves": _leaf}[self.kind]
        palette = np.array([linear_rgb(color) for color in self.colors])
        vertices: list[Array] = []
        faces: list[npt.NDArray[np.int64]] = []
        tints: list[Array] = []
        start = 0
        for k, roll in enumerate(dice):
            size = self.size[0] + roll[0] * (self.size[1] - self.size[0])
            color = palette[min(int(roll[1] * len(palette)), len(palette) - 1)] * (
                0.75 + 0.25 * roll[2]
            )
            for points, triangles, shade in build(size, roll[3:], color):
                vertices.append(points + np.array([xy[k, 0], xy[k, 1], z[k]]))
                faces.append(triangles + start)
                tints.append(np.broadcast_to(shade, points.shape))
                start += len(points)
        return Mesh(np.concatenate(vertices), np.concatenate(faces), None, np.concatenate(tints))


Piece = tuple[Array, npt.NDArray[np.int64], Array]
"""Vertices, faces and colours (one, or one per vertex) of a thing's part at the origin."""

STEM = np.array(linear_rgb("#4d7a35"))
HEART = np.array(linear_rgb("#e8b93a"))


def _stone(size: float, dice: Array, color: Array) -> Iterator[Piece]:
    points, faces = _ball()
    turn = 2 * np.pi * dice[0]
    bumps = 0.75 + 0.5 * fractal_noise(np.ascontiguousarray(1.2 * points + 50 * dice[1]), 2, 5)
    points = (
        points
        * bumps[:, None]
        * [size, size * (0.6 + 0.4 * dice[2]), size * (0.45 + 0.3 * dice[3])]
    )
    yield _about(points, turn) + np.array([0, 0, 0.15 * size]), faces, color


def _tuft(size: float, dice: Array, color: Array) -> Iterator[Piece]:
    for blade in range(7):
        turn = 2 * np.pi * (blade / 7 + 0.3 * math.sin(40 * dice[blade % 9] + blade))
        tall = size * (0.55 + 0.45 * abs(math.sin(9 * dice[(blade + 3) % 9] + 2.4 * blade)))
        lean = tall * (0.25 + 0.45 * abs(math.sin(7 * dice[(blade + 1) % 9] + blade)))
        yield _blade(tall, lean, 0.05 * size, turn, 0.12 * size, color)


def _blade(tall: float, lean: float, width: float, turn: float, out: float, color: Array) -> Piece:
    # Two quads and a tip, bent outward.
    t = np.array([0.0, 0.45, 0.8])
    spine = np.stack([out + lean * t**2, 0 * t, tall * t], axis=-1)
    half = np.stack([0 * t, width * np.array([1.0, 0.8, 0.45]), 0 * t], axis=-1)
    points = np.concatenate([spine - half, spine + half, [[out + lean, 0, tall]]])
    faces = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 6, 5]])
    shade = color * np.array([0.5, 0.8, 1.0, 0.5, 0.8, 1.0, 1.1])[:, None]
    return _about(points, turn), faces, shade


def _flower(size: float, dice: Array, color: Array) -> Iterator[Piece]:
    turn = 2 * np.pi * dice[0]
    lean = 0.25 * size * dice[1]
    yield _blade(size, lean, 0.025 * size, turn, 0.0, STEM)
    yield _blade(0.6 * size, 0.4 * size, 0.05 * size, turn + 2.5, 0.0, STEM)
    top = _about(np.array([[lean, 0.0, size]]), turn)[0]
    petal = 0.22 * size * (0.8 + 0.4 * dice[2])
    for k in range(6):
        a = turn + k * np.pi / 3
        leaf = np.array([[0, 0, 0], [0.6, -0.42, 0.25], [1, 0, 0.15], [0.6, 0.42, 0.25]]) * petal
        yield _about(leaf, a) + top, np.array([[0, 1, 2], [0, 2, 3]]), color
    points, faces = _ball()
    yield (
        points * [0.3 * petal, 0.3 * petal, 0.2 * petal] + top + [0, 0, 0.08 * petal],
        faces,
        HEART,
    )


def _leaf(size: float, dice: Array, color: Array) -> Iterator[Piece]:
    curl = 0.1 + 0.25 * dice[1]
    leaf = np.array(
        [
            [-0.5, 0, curl * 0.5],
            [0, -0.28, curl],
            [0, 0, 0.06],
            [0, 0.28, curl],
            [0.5, 0, curl * 0.7],
        ]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2], [2, 4, 3]])
    yield _about(leaf * size, 2 * np.pi * dice[0]) + np.array([0, 0, 0.01 * size]), faces, color


def _about(points: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _ball() -> tuple[Array, npt.NDArray[np.int64]]:
    """An icosahedron, once divided: 42 vertices on the unit sphere, 80 triangles."""
    g = (1 + math.sqrt(5)) / 2
    corners = [(0, a, b * g) for a in (-1, 1) for b in (-1, 1)]
    points = [p[k:] + p[:k] for k in range(3) for p in corners]
    base = np.array(points, dtype=np.float64) / math.hypot(1, g)
    near = np.linalg.norm(base[:, None] - base[None], axis=-1) < 1.1
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    vertices = [tuple(p) for p in base]
    index = {v: k for k, v in enumerate(vertices)}

    def middle(i: int, j: int) -> int:
        m = (base[i] + base[j]) / 2
        v = tuple(m / np.linalg.norm(m))
        if v not in index:
            index[v] = len(vertices)
            vertices.append(v)
        return index[v]

    divided = []
    for i, j, k in faces:
        a, b, c = base[i], base[j], base[k]
        if np.cross(b - a, c - a) @ a < 0:
            j, k = k, j
        ij, jk, ki = middle(i, j), middle(j, k), middle(k, i)
        divided += [(i, ij, ki), (j, jk, ij), (k, ki, jk), (ij, jk, ki)]
    return np.array(vertices), np.array(divided, dtype=np.int64)
