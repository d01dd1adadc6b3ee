"""Extent of a scene, and the objects that determine it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from attnwarp_eval.scene.base import SceneNotice
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Array, Box, Mesh, Rectangle, Shape, Sphere

FEW = 1e-3
"""Share of the surface that should not determine the extent of a scene."""

SHRINK = 2.0
"""Factor by which leaving out that share may shrink the extent without a warning."""


class ExtentNotice(SceneNotice):
    """A tiny part of a scene determines its extent."""


@dataclass(frozen=True, eq=False)
class Extent:
    """The bounding box of a scene.

    Attributes:
        low, high: (3,) corners.
        makers: names of the objects that reach the box's sides, in the order of the axes.
        core: longest side of the box about all but the outermost thousandth of the surface.
    """

    low: Array
    high: Array
    makers: tuple[str, ...]
    core: float

    @property
    def size(self) -> float:
        """Longest side."""
        return float((self.high - self.low).max())

    @property
    def notice(self) -> str | None:
        """A warning if a thousandth of the surface determines the extent, else None."""
        if self.size <= SHRINK * self.core:
            return None
        return (
            f"a thousandth of the surface makes the scene {self.size:.4g} wide instead of"
            f" {self.core:.4g} ({', '.join(self.makers)}); what lies far away costs precision and"
            " moves the cameras' near limit; remove it if it is a stray"
        )


def extent(scene: Scene, shapes: Sequence[Shape] | None = None) -> Extent:
    """The extent of a scene, or of its ``shapes`` that the caller already has."""
    shapes = scene.shapes() if shapes is None else shapes
    pieces = [_pieces(shape) for shape in shapes]
    low, high, area = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    owner = np.repeat([s.object_id for s in shapes], [len(piece[2]) for piece in pieces])
    lowest, highest = low.min(0), high.max(0)
    makers: list[str] = []
    core = 0.0
    for axis in range(3):
        for side in (owner[low[:, axis].argmin()], owner[high[:, axis].argmax()]):
            makers.append(scene.object_names[int(side)])
        first = _beyond_few(low[:, axis], area)
        last = -_beyond_few(-high[:, axis], area)
        core = max(core, last - first)
    return Extent(lowest, highest, tuple(dict.fromkeys(makers)), core)


def warn_of_strays(scene: Scene, shapes: Sequence[Shape]) -> None:
    """Warn (:class:`ExtentNotice`) if a thousandth of the surface determines the extent."""
    notice = extent(scene, shapes).notice
    if notice:
        warnings.warn(f"{scene.name}: {notice}", ExtentNotice, stacklevel=3)


def _beyond_few(values: Array, area: Array) -> float:
    """The least value of a piece but for the lowest, up to :data:`FEW` of the area."""
    order = np.argsort(values)
    left_out = np.cumsum(area[order]) <= FEW * area.sum()
    return float(values[order][min(int(left_out.sum()), len(order) - 1)])


def _pieces(shape: Shape) -> tuple[Array, Array, Array]:
    """(N, 3) lower corners, (N, 3) upper corners and (N,) areas of a shape's pieces."""
    match shape:
        case Mesh():
            corners = shape.vertices[shape.faces]
            sides = corners[:, 1:] - corners[:, :1]
            area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
            return corners.min(1), corners.max(1), area
        case Box():
            a, b, c = 2 * shape.half
            area = 2 * float(a * b + b * c + c * a)
        case Rectangle():
            area = 4 * float(np.linalg.norm(np.cross(shape.u, shape.v)))
        case Sphere():
            area = 4 * np.pi * shape.radius**2
    low, high = shape.bounds()
    return low[None], high[None], np.array([area])
