"""Hard cases of the instrument's truth: rays and surfaces."""

from __future__ import annotations

import dataclasses
import math

import mpmath
import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Mesh, Rectangle, Sphere
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.stability.case import Bound, Way, exact, hard
from attnwarp_eval.truth import Geometry
from attnwarp_eval.truth.shapes import NEW, UNCOVERED, UNTOUCHED, ShapeEdit
from attnwarp_eval.two_view import AMBIGUOUS

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


EYE, FIELD = 4.0, 40.0
"""Distance of the cameras from the ball's centre, in scene units, and field of view in degrees."""


def _ball_scene(radius: float, card: float) -> Scene:
    """A ball at the origin, seen by the source along x and by a target along y.

    Args:
        radius: radius of the ball, 0 for none.
        card: half the side of a square before the target, half way to the ball; 0 for none.
    """
    there = {"wall": True, "card": card > 0, "ball": radius > 0}
    shapes = {
        "wall": {"type": "box", "center": [-3, -3, 0], "size": [1, 1, 1]},
        "card": {"type": "box", "center": [0, 2, 0], "size": [2 * card, 1e-6, 2 * card]},
        "ball": {"type": "sphere", "center": [0, 0, 0], "radius": radius},
    }
    grey = {"type": "plain", "color": "#808080"}
    views = {"look_at": [0, 0, 0], "radius": EYE, "fov": FIELD, "size": [24, 24]}
    spec = {
        "name": "ball",
        "title": "a ball",
        "objects": [
            {"name": name, "shape": shape, "texture": grey}
            for name, shape in shapes.items()
            if there[name]
        ],
        "lights": [{"type": "sun", "elevation": 60, "azimuth": 0, "irradiance": 1}],
        "cameras": {
            **views,
            "source": {"yaw": 0, "height": 0},
            "targets": [{"yaw": 90, "height": 0}],
        },
    }
    return Scene(SceneSpec.model_validate(spec))


def _wrong_labels(before: Scene, after: Scene, radius: float, card: float, label: int) -> float:
    """Pixels of both views whose label is not the one that the ball's outline gives."""
    edit, wrong = ShapeEdit(before, after), 0
    for camera, hidden in ((before.source, 0.0), (before.targets[0], card)):
        labels = edit.labels(camera)
        corners = np.stack(np.meshgrid(*2 * [np.arange(25.0)]), axis=-1)
        answers = []
        for xy in (corners, camera.pixel_centers()):
            ray = camera.directions(xy)
            x, y = ray[..., 0], ray[..., 1]
            # The outline of a sphere: an angle from the axis whose sine is radius over distance.
            ball = np.hypot(x, y) < math.tan(math.asin(radius / EYE))
            answers.append(ball & ~(np.maximum(abs(x), abs(y)) * EYE / 2 < hidden))
        corner, center = answers
        four = [corner[i : i + 24, j : j + 24] for i in (0, 1) for j in (0, 1)]
        sure = np.all([each == center for each in four], axis=0)
        wanted = np.where(sure, np.where(center, label, UNTOUCHED), AMBIGUOUS)
        gone = sure & center if label == UNCOVERED else np.zeros_like(sure)
        wrong += int((labels.label != wanted).sum() + (labels.gone != gone).sum())
    return float(wrong)


def _removed_unseen(share: float, way: Way) -> float:
    """Wrong labels of a ball that is removed, which a card hides from the target, up to a share."""
    radius = 0.7
    card = share * EYE / 2 * math.tan(math.asin(radius / EYE))
    return _wrong_labels(_ball_scene(radius, card), _ball_scene(0, card), radius, card, UNCOVERED)


def _added_filling(share: float, way: Way) -> float:
    """Wrong labels of a ball that is added and fills a share of the source's half diagonal."""
    diagonal = math.atan(math.sqrt(2) * math.tan(math.radians(FIELD / 2)))
    radius = EYE * math.sin(share * diagonal)
    return _wrong_labels(_ball_scene(0, 0), _ball_scene(radius, 0), radius, 0, NEW)


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
    hard("removed_unseen", _removed_unseen, RAYS, bounds=exact("wrong labels")),
    hard("added_filling", _added_filling, RAYS, bounds=exact("wrong labels")),
]
