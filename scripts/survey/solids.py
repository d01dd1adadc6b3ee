"""Solids whose area, volume and bounds have closed forms, made from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solid:
    """Polygons with a closed form of what they enclose.

    Attributes:
        name: what it is.
        vertices: (V, 3), exact in float32.
        faces: polygons as lists of indices, counterclockwise from outside.
        triangles: (F, 3) the same surface as triangles, for formats that hold nothing else.
    """

    name: str
    vertices: Array
    faces: list[list[int]]
    triangles: list[list[int]]

    def closed_form(self) -> tuple[float, float]:
        """Area and volume, each planar polygon by the shoelace formula in its plane."""
        area = volume = 0.0
        for face in self.faces:
            points = self.vertices[face]
            spokes = points - points[0]
            twice = np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
            area += float(np.linalg.norm(twice)) / 2
            volume += float(points[0] @ twice) / 6
        return area, volume


def _float32(values: Array) -> Array:
    return values.astype(np.float32).astype(np.float64)


def prism(name: str, outline: Array, height: float) -> Solid:
    """A prism over a polygon that the origin sees whole; its caps' triangles meet at the axis."""
    n = len(outline)
    flat = _float32(np.asarray(outline, dtype=np.float64))
    top = float(np.float32(height))
    vertices = np.concatenate(
        [
            np.column_stack([flat, np.zeros(n)]),
            np.column_stack([flat, np.full(n, top)]),
        ]
    )
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    faces = [list(range(n))[::-1], list(range(n, 2 * n)), *sides]
    centers = np.array([[0, 0, 0], [0, 0, top]])
    triangles = [t for a, b, c, d in sides for t in ([a, b, c], [a, c, d])]
    triangles += [t for k in range(n) for t in
                  ([(k + 1) % n, k, 2 * n], [n + k, n + (k + 1) % n, 2 * n + 1])]  # fmt: skip
    return Solid(name, np.concatenate([vertices, centers]), faces, triangles)


def star(rng: np.random.Generator, corners: int) -> Array:
    """(corners, 2) a concave outline about the origin."""
    angle = (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) * 2 * np.pi / corners
    radius = np.where(np.arange(corners) % 2, rng.uniform(0.2, 0.5, corners), 1.0)
    return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def torus(rings: int, sides: int) -> Solid:
    """Planar quadrilaterals: every ring's chord is parallel to its neighbour's."""
    u = np.arange(rings) * 2 * np.pi / rings
    v = np.arange(sides) * 2 * np.pi / sides
    radius = 2 + 0.75 * np.cos(v)[None, :]
    vertices = np.stack(
        [
            np.cos(u)[:, None] * radius,
            np.sin(u)[:, None] * radius,
            np.broadcast_to(0.75 * np.sin(v), (rings, sides)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    faces = [
        [i * sides + j, (i + 1) % rings * sides + j,
         (i + 1) % rings * sides + (j + 1) % sides, i * sides + (j + 1) % sides]
        for i in range(rings) for j in range(sides)
    ]  # fmt: skip
    triangles = [t for a, b, c, d in faces for t in ([a, b, c], [a, c, d])]
    return Solid("torus", _float32(vertices), faces, triangles)


def solids(seed: int) -> list[Solid]:
    """Convex and concave prisms, and a torus, other ones for every seed."""
    rng = np.random.default_rng(seed)
    angle = np.arange(12) * np.pi / 6
    letter = np.array([[-1, -1], [3, -1], [3, 0.5], [0.5, 0.5], [0.5, 3], [-1, 3.0]])
    arrow = np.array([[-0.25, 0], [-1, -1], [2, 0], [-1, 1.0]])
    box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    return [
        prism("box", box * rng.uniform(0.5, 2, 2), rng.uniform(0.5, 2)),
        prism("wedge", np.array([[-1, -1], [2, -1], [-1, 2.0]]), rng.uniform(0.5, 2)),
        prism("dodecagon", np.column_stack([np.cos(angle), np.sin(angle)]), rng.uniform(0.5, 2)),
        prism("letter L", letter, rng.uniform(0.5, 2)),
        prism("arrow", arrow, rng.uniform(0.5, 2)),
        prism("star of 14", star(rng, 14), rng.uniform(0.5, 2)),
        prism("star of 60", star(rng, 60), rng.uniform(0.5, 2)),
        torus(int(rng.integers(8, 16)), int(rng.integers(5, 9))),
    ]
