"""Shapes of a scene: spheres, rectangles and boxes in closed form, and triangle meshes.

Everything is float64 and in world coordinates.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.scene.base import SceneNotice

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

DEGENERATE_AREA = 1e-12
"""Triangles of less area than this times their longest edge squared are dropped."""

MOST_DIVIDED = 5_000_000
"""Most triangles of a divided mesh."""


class MeshNotice(SceneNotice):
    """Something in a mesh was repaired or left out."""


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere: ``center`` (3,), ``radius`` > 0."""

    center: Array
    radius: float
    object_id: int = 0

    def moved(self, scale: float, offset: npt.ArrayLike) -> Sphere:
        """The shape in a world whose points p became ``scale`` * p + ``offset``."""
        return replace(
            self, center=self.center * scale + np.asarray(offset, float), radius=self.radius * scale
        )

    def bounds(self) -> Array:
        """(2, 3) lower and upper corner of the axis-aligned bounding box."""
        return np.stack([self.center - self.radius, self.center + self.radius])

    def contains(self, point: Array) -> bool:
        """Return True if the (3,) ``point`` lies inside."""
        return bool(np.linalg.norm(point - self.center) < self.radius)


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A two-sided rectangle: ``center`` (3,) and perpendicular half edges ``u``, ``v`` (3,)."""

    center: Array
    u: Array
    v: Array
    object_id: int = 0

    @property
    def normal(self) -> Array:
        """(3,) unit normal u x v."""
        n = np.cross(self.u, self.v)
        return n / np.linalg.norm(n)

    def moved(self, scale: float, offset: npt.ArrayLike) -> Rectangle:
        """The shape in a world whose points p became ``scale`` * p + ``offset``."""
        return replace(
            self,
            center=self.center * scale + np.asarray(offset, float),
            u=self.u * scale,
            v=self.v * scale,
        )

    def bounds(self) -> Array:
        """(2, 3) lower and upper corner of the axis-aligned bounding box."""
        reach = np.abs(self.u) + np.abs(self.v)
        return np.stack([self.center - reach, self.center + reach])

    def contains(self, point: Array) -> bool:
        """A rectangle has no inside."""
        return False


@dataclass(frozen=True, eq=False)
class Box:
    """A box: ``center`` (3,), ``half`` (3,) half sizes along the columns of ``axes`` (3, 3)."""

    center: Array
    half: Array
    axes: Array = field(default_factory=lambda: np.eye(3))
    object_id: int = 0

    def moved(self, scale: float, offset: npt.ArrayLike) -> Box:
        """The shape in a world whose points p became ``scale`` * p + ``offset``."""
        return replace(
            self, center=self.center * scale + np.asarray(offset, float), half=self.half * scale
        )

    def bounds(self) -> Array:
        """(2, 3) lower and upper corner of the axis-aligned bounding box."""
        reach = np.abs(self.axes) @ self.half
        return np.stack([self.center - reach, self.center + reach])

    def contains(self, point: Array) -> bool:
        """Return True if the (3,) ``point`` lies inside."""
        return bool((np.abs((point - self.center) @ self.axes) < self.half).all())

    def rectangles(self) -> list[Rectangle]:
        """The six faces, normals (u x v) outward: -x, +x, -y, +y, -z, +z of the box's axes."""
        faces = []
        for axis in range(3):
            for sign in (-1.0, 1.0):
                a, b = (axis + 1) % 3, (axis + 2) % 3
                u, v = self.axes[:, a] * self.half[a], self.axes[:, b] * self.half[b] * sign
                center = self.center + self.axes[:, axis] * self.half[axis] * sign
                faces.append(Rectangle(center, u, v, self.object_id))
        return faces

    def mesh(self) -> Mesh:
        """Surface of the box as 12 triangles, facing outward."""
        vertices: list[list[Array]] = []
        faces: list[list[int]] = []
        for side in self.rectangles():
            k = 4 * len(vertices)
            c, u, v = side.center, side.u, side.v
            vertices.append([c - u - v, c + u - v, c + u + v, c - u + v])
            faces += [[k, k + 1, k + 2], [k, k + 2, k + 3]]
        return Mesh(
            np.array(vertices).reshape(-1, 3),
            np.array(faces, dtype=np.int64),
            object_id=self.object_id,
        )


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices into ``vertices``.
        normals: (V, 3) unit vertex normals for smooth shading, or None for flat shading. Geometry
            never uses them.
        tint: (V, 3) linear RGB that multiplies the object's texture, or None.
    """

    vertices: Array
    faces: Indices
    normals: Array | None = None
    tint: Array | None = None
    object_id: int = 0

    def moved(self, scale: float, offset: npt.ArrayLike) -> Mesh:
        """The shape in a world whose points p became ``scale`` * p + ``offset``."""
        return replace(self, vertices=self.vertices * scale + np.asarray(offset, float))

    def turned(self, R: Array) -> Mesh:
        """The mesh with every vertex p moved to R p (``R`` a (3, 3) rotation)."""
        return replace(
            self,
            vertices=self.vertices @ R.T,
            normals=None if self.normals is None else self.normals @ R.T,
        )

    def divided(self, longest: float) -> Mesh:
        """Halve edges until none is longer than ``longest``, since textures have their colours
        at vertices. The surface does not change.

        Neighbours share the new vertices, so no crack opens.

        Raises:
            ValueError: there would be more than :data:`MOST_DIVIDED` triangles.

        Example:
            >>> mesh = Mesh(np.eye(3), np.array([[0, 1, 2]])).divided(1.0)
            >>> len(mesh.faces)
            4
        """
        mesh, corners = self, self.vertices[self.faces]
        sides = corners[:, 1:] - corners[:, :1]
        area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2
        # No triangle with such edges is larger than the equilateral one.
        few = area <= MOST_DIVIDED * 3**0.5 / 4 * longest**2
        while few and len(mesh.faces) <= MOST_DIVIDED:
            ends = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
            count = len(mesh.vertices)
            edges, of_face = np.unique(ends[..., 0] * count + ends[..., 1], return_inverse=True)
            a, b = edges // count, edges % count
            long = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=1) > longest
            if not long.any():
                return mesh
            a, b = a[long], b[long]
            middle = np.where(long, count + np.cumsum(long) - 1, -1)[of_face.reshape(-1, 3)]

            values: dict[str, Any] = {
                name: np.concatenate([array, (array[a] + array[b]) / 2])
                for name in ("vertices", "normals", "tint")
                if (array := getattr(mesh, name)) is not None
            }
            if "normals" in values:
                values["normals"] /= np.linalg.norm(values["normals"], axis=1, keepdims=True)
            mesh = replace(mesh, faces=np.concatenate(list(_halved(mesh.faces, middle))), **values)
        raise ValueError(
            f"got more than {MOST_DIVIDED} triangles with no edge longer than {longest:g}; let"
            " edges be longer"
        )

    def bounds(self) -> Array:
        """(2, 3) lower and upper corner of the axis-aligned bounding box."""
        used = np.zeros(len(self.vertices), bool)
        used[self.faces] = True
        corners = self.vertices[used]
        return np.stack([corners.min(0), corners.max(0)])

    def contains(self, point: Array) -> bool:
        """Return True if the (3,) ``point`` lies inside, by the generalised winding number; never
        outside the bounding box.

        A solid angle of more than half the sphere counts as inside, so small holes and a few
        duplicated faces do not change the answer (Jacobson et al. 2013; triangle angles after Van
        Oosterom and Strackee 1983).
        """
        low, high = self.bounds()
        if (point < low).any() or (point > high).any():
            return False
        a, b, c = (self.vertices[self.faces[:, k]] - point for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
        dot = np.einsum
        denominator = (
            la * lb * lc
            + dot("ij,ij->i", a, b) * lc
            + dot("ij,ij->i", b, c) * la
            + dot("ij,ij->i", c, a) * lb
        )
        winding = np.arctan2(numerator, denominator).sum() / (2 * np.pi)
        return bool(abs(winding) > 0.5)

    def cleaned(self, name: str) -> Mesh:
        """The mesh without degenerate triangles; a :class:`MeshNotice` says how many were dropped.

        Duplicated faces and holes stay: ray casting and rendering accept them.

        Raises:
            ValueError: no triangle is left, a vertex is not finite, or a face names a vertex that
                does not exist.
        """
        if self.faces.size and (self.faces.min() < 0 or self.faces.max() >= len(self.vertices)):
            raise ValueError(
                f"{name}: a face names vertex {int(self.faces.max())}, but there are"
                f" {len(self.vertices)}"
            )
        used = np.zeros(len(self.vertices), bool)
        used[self.faces] = True
        bad = np.flatnonzero(used & ~np.isfinite(self.vertices).all(axis=1))
        if bad.size:
            raise ValueError(f"{name}: vertex {int(bad[0])} is not finite; repair the file")
        corners = self.vertices[self.faces]
        edges = corners - np.roll(corners, 1, axis=1)
        longest = (edges**2).sum(-1).max(-1)
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1)
        keep = area > DEGENERATE_AREA * longest
        if not keep.any():
            raise ValueError(f"{name}: holds no triangle with an area (of {len(self.faces)})")
        if keep.all():
            return self
        dropped = np.flatnonzero(~keep)
        warnings.warn(
            f"{name}: dropped {dropped.size} of {len(keep)} triangles without area (first: face"
            f" {int(dropped[0])})",
            MeshNotice,
            stacklevel=2,
        )
        return replace(self, faces=self.faces[keep])


Shape = Sphere | Rectangle | Box | Mesh


def _halved(faces: Indices, middle: Indices) -> Iterator[Indices]:
    """Parts of (F, 3) triangles whose edges 0-1, 1-2 and 2-0 have (F, 3) new vertices, or -1."""
    split = middle >= 0
    count = split.sum(axis=1)
    yield faces[count == 0]
    # Rotate so that the only new vertex is on the first edge, or the only unsplit edge is last.
    for n, first, parts in (
        (1, split.argmax(axis=1), [(0, 3, 2), (3, 1, 2)]),
        (2, split.argmin(axis=1) + 1, [(3, 1, 4), (0, 3, 4), (0, 4, 2)]),
        (3, 0 * count, [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]),
    ):
        turn = (first[:, None] + np.arange(3)) % 3
        six = np.hstack([np.take_along_axis(part, turn, axis=1) for part in (faces, middle)])
        for part in parts:
            yield six[count == n][:, part]
