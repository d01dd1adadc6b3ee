"""Hard cases of the instrument's truth: rays and surfaces."""

from __future__ import annotations

import dataclasses
import math

import mpmath
import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval.scene.shapes import Mesh, Rectangle, Sphere
from attnwarp_eval.stability.case import Bound, Way, exact, hard
from attnwarp_eval.truth import Geometry

DIGITS = 60

RAYS = (Way("raycast"),)
BOTH = (Way("raycast"), Way("embree"))
"""Closed forms in float64, and triangles in Embree whose hits are put on their planes."""


def _square(half: float, z: float = 0.0) -> Rectangle:
    return Rectangle(np.array([0, 0, z]), np.array([half, 0, 0]), np.array([0, half, 0.0]))


def _two_triangles(half: float, z: float = 0.0, shift: float = 0.0) -> Mesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) * half
    return Mesh(corners + np.array([shift, shift, z + shift]), np.array([[0, 1, 2], [0, 2, 3]]))


def _grazing(incidence: float, way: Way) -> float:
    """Relative error of the distance of a plane along rays that graze it."""
    ground = _square(50.0) if way.backend == "raycast" else _two_triangles(50.0)
    slope = 1 / math.tan(math.radians(incidence)) if incidence < 90 else 0.0
    # Five rays that meet the plane 6 m ahead, a third of a metre apart.
    starts = np.array([[-3.0, 0.33 * k, 6 * slope] for k in range(-2, 3)])
    direction = np.array([1.0, 0.01, -slope])
    hits = Geometry([ground]).trace_rays(starts, np.tile(direction, (5, 1)))
    if not hits.valid.all():
        return math.inf
    exact_t = [mpmath.mpf(float(start[2])) / mpmath.mpf(slope) for start in starts]
    return float(
        max(abs(mpmath.mpf(float(t)) / e - 1) for t, e in zip(hits.t, exact_t, strict=True))
    )


def _squares(gap: float, way: Way) -> tuple[Geometry, Camera]:
    """Two squares, the upper one with object id 1, seen from 3 m above the lower one."""
    lower, upper = (
        (_square(2.0), _square(2.0, gap))
        if way.backend == "raycast"
        else (_two_triangles(2.0), _two_triangles(2.0, gap))
    )
    geometry = Geometry([lower, dataclasses.replace(upper, object_id=1)])
    view = Camera.look_at((0, 0, 3), (0, 0, 0), width=9, height=9, fov_y=40, up=(0, 1, 0))
    return geometry, view


def _coplanar(gap: float, way: Way) -> float:
    """Relative error of the upper square's depth."""
    geometry, view = _squares(gap, way)
    error = np.abs(geometry.trace(view).depth / (3 - gap) - 1)
    return math.inf if np.isnan(error).any() else float(error.max())


def _ties(gap: float, way: Way) -> float:
    """Pixels assigned to the lower square without a tie, and ties without the lower square."""
    geometry, view = _squares(gap, way)
    ties, lowest = geometry.ties(view)
    blamed = (geometry.trace(view).object_id != 1) & ~ties
    return float((blamed | (ties & (lowest != 0))).sum())


def _tangent(gap: float, way: Way) -> float:
    """Error of the distance of a sphere that a ray almost misses, in its tolerance."""
    radius, distance = 0.7, 3.0
    direction = np.array([1.0, 1e-3, -2e-3])
    side = np.cross(direction, [0.3, 0.2, 0.9])
    side /= np.linalg.norm(side)
    origin = -distance * direction + radius * (1 - gap) * side
    hits = Geometry([Sphere(np.zeros(3), radius)]).trace_rays(origin, direction[None])
    if not hits.valid[0]:
        return math.inf
    with mpmath.workdps(DIGITS):
        o, d = ([mpmath.mpf(float(x)) for x in row] for row in (origin, direction))
        a = sum(x * x for x in d)
        b = sum(x * y for x, y in zip(o, d, strict=True))
        c = sum(x * x for x in o) - mpmath.mpf(radius) ** 2
        under = b * b - a * c
        if under < 0:
            return math.inf
        return float(abs(mpmath.mpf(float(hits.t[0])) - (-b - mpmath.sqrt(under)) / a))


def _shared_edge(offset: float, way: Way) -> float:
    """Error of the distance along rays through the diagonal of a square of two triangles."""
    square = _two_triangles(1.0, shift=offset)
    along = np.linspace(-0.9, 0.9, 101)
    origins = np.stack([along, along, np.full(101, 3.0)], axis=-1) + offset
    hits = Geometry([square]).trace_rays(origins, np.tile([0, 0, -1.0], (101, 1)))
    if not hits.valid.all():
        return math.inf
    return float(np.abs(hits.t - (origins[:, 2] - offset)).max())


CASES = [
    hard(
        "grazing_plane",
        _grazing,
        BOTH,
        bounds=Bound(
            "relative",
            lambda incidence: 1e-6 / math.cos(math.radians(incidence)),
            "1e-6 over the cosine: a hair's height moves the hit that far",
        ),
    ),
    hard(
        "coplanar",
        _coplanar,
        BOTH,
        bounds=Bound("relative", 1e-6, "which of the two is hit does not show"),
    ),
    hard("coplanar_ties", _ties, BOTH, bounds=exact("wrong owners")),
    hard(
        "tangent_ray",
        _tangent,
        RAYS,
        bounds=Bound(
            "scene",
            lambda gap: 1e-4 * 0.7 * math.sqrt(2 * gap) + 3e-13,
            "1e-4 of half the chord, and 1e-13 of the distance",
        ),
    ),
    hard(
        "shared_edge",
        _shared_edge,
        (Way("embree"),),
        bounds=Bound("m", 3e-6, "1e-6 of the distance"),
    ),
]
