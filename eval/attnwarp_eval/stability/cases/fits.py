"""Hard cases of fits: skies that tell no up, pictures of sky alone, two views."""

from __future__ import annotations

import math

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.fit import (
    FitSettings,
    Views,
    fit,
    from_points,
    random_points,
    with_sky,
    without_surface,
)
from attnwarp.gaussians import Gaussians
from attnwarp_eval.stability.case import Bound, Way, exact, hard
from attnwarp_eval.stability.closed_forms import orbit

SIZE = 32
SKY, GROUND = (0.2, 0.4, 0.9), (0.3, 0.3, 0.1)

APART = math.radians(4.5)
"""Declared distance between the first splats of a sky. One may stand or lack within it from the
horizon, which cells of the pictures decide."""


def _before_a_horizon(roll: float, pitch: float) -> Views:
    """Nine pictures of a ground of one colour under a sky of another, every third of them turned
    about its axis."""
    views = []
    for k, yaw in enumerate(np.radians(np.linspace(-40, 40, 9))):
        ahead = (math.cos(pitch) * math.sin(yaw), math.cos(pitch) * math.cos(yaw))
        place = (k / 8, 0, 1)
        level = Camera.look_at(
            place,
            (place[0] + ahead[0], ahead[1], 1 + math.sin(pitch)),
            width=SIZE,
            height=SIZE,
            fov_y=50,
        )
        angle, turn = math.radians(roll if k % 3 == 0 else 0), np.eye(4)
        turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        views.append(Camera(level.K, turn @ level.world_to_camera, SIZE, SIZE))
    rays = [camera.directions() @ camera.rotation for camera in views]
    return Views(
        views, [np.where(ray[..., 2:] > 0, SKY, GROUND).astype(np.float32) for ray in rays]
    )


def _ground() -> Gaussians:
    """First splats at points of the ground, 0.5 to 60 ahead of the cameras and beside them."""
    draw = np.random.default_rng(0)
    away, side = 0.5 * 120 ** draw.random(4000), draw.uniform(-1.5, 1.5, 4000)
    points = np.stack([away * np.sin(side), away * np.cos(side), np.zeros(4000)], axis=-1)
    return from_points(points, kind="3d", sh_degree=0)


def _wrong_sky(start: Gaussians, views: Views) -> float:
    """Number of a sky's splats below the horizon, and per mille of the shown directions well above
    it that have no splat of the sky's colour near them.
    """
    every = np.random.default_rng(0).normal(size=(20_000, 3))
    every /= np.linalg.norm(every, axis=1, keepdims=True)
    sky = np.zeros(len(every), bool)
    for camera in views.cameras:
        xy, z = camera.project(1e6 * every)
        sky |= (z > 0) & (np.abs(xy / SIZE - 0.5) < 0.5).all(1)
    sky &= every[:, 2] > math.sin(2 * APART)
    far = np.linalg.norm(start.world_means(), axis=1) > start.far
    added = start.world_means()[far]
    added /= np.linalg.norm(added, axis=1, keepdims=True)
    colors = start.sh[far, 0].numpy()
    blue = np.abs(colors - Gaussians.sh_from_rgb(np.array([SKY]))[0].numpy()).max(-1) < 1e-5
    lacking = ~(every[sky] @ added[blue].T > math.cos(APART)).any(1)
    return 1000 * float(lacking.mean()) + float((added[:, 2] < -math.sin(APART)).sum())


def _rolled(roll: float, way: Way) -> float:
    """Wrong share of a sky whose pictures are turned."""
    views = _before_a_horizon(roll, 0.0)
    return _wrong_sky(with_sky(_ground(), views), views)


def _all_sky(share: float, way: Way) -> float:
    """Wrong share of a sky that fills a share of the pictures' middle column, or more; and
    after a few iterations pixels of a surface where all is sky.
    """
    # The principal point lies in the middle, so the horizon stands at tan(pitch) from it.
    views = _before_a_horizon(0.0, math.atan((2 * share - 1) * math.tan(math.radians(25))))
    start = with_sky(_ground(), views)
    wrong = _wrong_sky(start, views)
    fitted = _fitted(start, views)
    if share > 1:
        wrong += len(views) * SIZE**2 * (1 - without_surface(fitted, views))
    return wrong


def _fitted(start: Gaussians, views: Views) -> Gaussians:
    """Splats after five iterations; a value that is not finite is an error of the fit's own."""
    settings = FitSettings(kind=start.kind, iterations=5, sh_degree=0)
    return fit(start, views, settings).gaussians.detach().to(dtype=torch.float32)


def _two_views(apart: float, way: Way) -> float:
    """Error of the cube of first points of two views, over its half; fitted, it must be finite."""
    distance = 4.0
    pair = [orbit(angle, size=SIZE, distance=distance) for angle in (-apart / 2, apart / 2)]
    points, colors = random_points(pair, 2000)
    _fitted(
        from_points(points, colors, kind="3d", sh_degree=0),
        Views(pair, [np.full((SIZE, SIZE, 3), 0.5, np.float32)] * 2),
    )
    # The axes meet in the origin, as far from both cameras as the cube's faces from its middle.
    ends = np.stack([points.max(0), -points.min(0)]) / distance
    return float(np.abs(ends - 1).max())


WAYS = (Way("fit", "float32"),)
SHELL = exact(
    "stray splats, and per mille of directions", "a direction shows the sky or the ground"
)

CASES = [
    hard("sky_of_rolled_views", _rolled, WAYS, bounds=SHELL),
    hard("all_sky", _all_sky, WAYS, bounds=SHELL),
    hard(
        "two_views",
        _two_views,
        WAYS,
        bounds=Bound("of the cube's half", 0.01, "2,000 points reach within 1 % of each face"),
    ),
]
