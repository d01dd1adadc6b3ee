"""Fits of a scene under a sky, which has no depth: a disc of it must not pay for colour with depth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from edit_folders import Watched

from attnwarp import Camera, Gaussians
from attnwarp.fit import (
    FitSettings,
    Views,
    first_splats,
    fit,
    from_points,
    with_sky,
    without_surface,
)
from attnwarp.fit.model import LARGEST
from attnwarp.io import Dataset
from attnwarp.render import render

SIZE = 64


def waves(places, seed, low=0.5, high=6.0):
    """(P,) a random pattern of about unit variance, of 12 waves of these frequencies."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(12, 3)) * np.exp(rng.uniform(np.log(low), np.log(high), (12, 1)))
    return np.cos(places @ axes.T + rng.uniform(0, 2 * np.pi, 12)).sum(-1) / math.sqrt(12)


def photograph(camera):
    """(H, W, 3) colours and (H, W) depth, infinite in the sky: a ground, a wall 9 ahead and a card
    3 ahead, each of a colour and a pattern, under clouds."""
    rays, eye = camera.directions().reshape(-1, 3) @ camera.rotation, camera.position
    cloud = 0.75 + 0.12 * waves(rays / np.linalg.norm(rays, axis=1, keepdims=True), 5, 2, 12)
    color, depth = np.stack([cloud, cloud, 0.6 * cloud + 0.4], 1), np.full(len(rays), np.inf)
    surfaces = [
        (2, 0.0, (-60, 60), (-60, 60), (0.45, 0.42, 0.3)),
        (1, 9.0, (-5, 5), (0, 3), (0.6, 0.4, 0.35)),
        (1, 3.0, (-0.2, 0.8), (0, 1.2), (0.3, 0.4, 0.6)),
    ]
    for seed, (axis, place, across, along, paint) in enumerate(surfaces, 1):
        t = (place - eye[axis]) / rays[:, axis]
        hit = eye + t[:, None] * rays
        first, second = hit[:, 0], hit[:, 3 - axis]
        met = (across[0] < first) & (first < across[1]) & (along[0] < second) & (second < along[1])
        met &= (t > 0) & (t < depth)
        color[met] = np.array(paint) * (1 + 0.35 * waves(hit[met], seed))[:, None]
        depth[met] = t[met]
    shape = (camera.height, camera.width)
    return color.clip(0, 1).astype(np.float32).reshape(*shape, 3), depth.reshape(shape)


def cameras():
    """Eleven side by side, which look ahead and a little up."""
    return [
        Camera.look_at(
            (1.5 * a, 0.3 * abs(a), 1 + 0.1 * (k % 3)), (0.15 * a, 5, 1.4), width=SIZE, height=SIZE,
            fov_y=49, name=f"{k:02d}",
        )
        for k, a in enumerate(np.linspace(-1, 1, 11))
    ]  # fmt: skip


def points():
    """(1800, 3) on the surfaces, as structure from motion finds them: none in the sky."""
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform(-1, 1, (3, 1800))
    ground = np.stack([8 * x, 10.25 + 9.75 * y, 0 * z], 1)[:900]
    wall = np.stack([5 * x, 9 + 0 * y, 1.5 + 1.5 * z], 1)[900:1600]
    card = np.stack([0.3 + 0.5 * x, 3 + 0 * y, 0.6 + 0.6 * z], 1)[1600:]
    return np.concatenate([ground, wall, card])


def test_a_sky_takes_colour_and_no_depth():
    """Without it the splats of the scene are drawn over the sky."""
    shots = [photograph(camera) for camera in cameras()]
    views = Views(cameras(), [color for color, _ in shots])
    first = from_points(points(), kind="2d", sh_degree=0)
    settings = FitSettings(iterations=100, sh_degree=0, densify=False)
    shares, solids = [], []
    for start in (first, with_sky(first, views)):
        result = fit(start, views, settings)
        view = render(result.gaussians, views.cameras[5], near=0.01 * result.extent)
        sky = ~np.isfinite(shots[5][1])
        shares.append(float(view.alpha[sky].mean()))
        solids.append(float(view.alpha[~sky].mean()))
    error = view.color[sky] - torch.from_numpy(shots[5][0])[sky]
    assert shares[1] < 0.5 * shares[0] and solids[1] > 0.8 * solids[0], (shares, solids)
    assert float(error.abs().mean()) < 0.06  # half of the clouds' contrast


def from_above():
    """17 cameras around the origin that look down at it by 50 degrees, and 300 points near it."""
    turns = 2 * np.pi * np.arange(17) / 17
    places = np.stack([5 * np.cos(turns), 5 * np.sin(turns), np.full(17, 6.0)], 1)
    ring = [Camera.look_at(place, (0, 0, 0), width=SIZE, height=SIZE, fov_y=60) for place in places]
    return ring, np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [1, 1, 0]


def test_pictures_from_above_have_no_sky_however_few_points_their_lawn_has():
    ring, middle = from_above()
    views = Views(ring, [photograph(camera)[0] for camera in ring])
    start = from_points(middle, kind="2d", sh_degree=0)
    assert with_sky(start, views) is start


def sky_of(rolls):
    """Directions, (P, 3), and colours, (P, 3), of the first sky of pictures that stand on their
    side after so many quarter turns, in turn."""
    turned, shots = [], []
    for k, camera in enumerate(cameras()):
        quarter = rolls[k % len(rolls)]
        turn = np.linalg.matrix_power(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), quarter)
        pose = np.eye(4)
        pose[:3, :3] = turn
        turned.append(Camera(camera.K, pose @ camera.world_to_camera, SIZE, SIZE))
        shots.append(np.rot90(photograph(camera)[0], quarter).copy())
    start = with_sky(from_points(points(), kind="2d", sh_degree=0), Views(turned, shots))
    return start.world_means()[1800:] / start.far, start.sh[1800:, 0].numpy()


@pytest.mark.parametrize("rolls", [(0, 0, 2), (0, 1, 0, 0), (0, 3, 0)])
def test_pictures_on_their_side_or_upside_down_have_the_sky_of_upright_ones(rolls):
    """Oracle: rolled about its axis, a camera sees the same things, turned; the shell is above the
    horizon, and the wall, 3 high 9 ahead of cameras 1 above the ground, hides 12 degrees of it."""
    (places, colors), (same, alike) = sky_of((0,)), sky_of(rolls)
    assert np.allclose(places, same) and np.allclose(colors, alike, atol=1e-6)
    around, height = np.degrees(np.arctan2(places[:, 0], places[:, 1])), places[:, 2] / 2
    assert len(places) > 40 and height.min() > math.sin(math.radians(4))
    assert height[np.abs(around) < 20].min() > math.sin(math.radians(12))


def test_a_fit_whose_cameras_do_not_tell_up_has_a_sky_only_where_the_settings_name_an_axis():
    same_way = [
        Camera.look_at((x, 0, 1), (x, 5, 2), width=SIZE, height=SIZE, fov_y=49) for x in (0, 1, 2)
    ]
    views = Views(same_way, [photograph(camera)[0] for camera in same_way])
    data, said = Dataset(same_way, ["a.png", "b.png", "c.png"], points()), []

    def first(sky):
        settings = FitSettings(sky=sky, sh_degree=0)
        return first_splats(data, same_way, settings, Watched(log=said.append), views=views)

    assert math.isinf(first(True).far) and "--set sky=z" in said.pop()
    assert len(first("z")) > 1800 == len(first("-z")) and not said


def test_no_splat_of_the_sky_sinks_below_the_highest_camera():
    """Steps as long as the lowest ones are high carry splats anywhere, the scene's too."""
    views = Views(cameras(), [photograph(camera)[0] for camera in cameras()])
    start = with_sky(from_points(points(), kind="2d", sh_degree=0), views)
    settings = FitSettings(
        iterations=3, sh_degree=0, lr_means=30.0, lr_means_final=30.0, densify=False
    )
    means = fit(start, views, settings).gaussians.world_means()
    highest = max(camera.position[2] for camera in cameras())
    assert means[1800:, 2].min() > highest - 1e-3 > means[:1800, 2].min()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_fit_under_a_sky_keeps_its_depth(seed):
    """A loss in which gaps out of order count negative lets a disc of the sky grow to 1000 extents,
    and falls below 0, with each of these seeds."""
    shots = [photograph(camera) for camera in cameras()]
    views = Views(cameras(), [color for color, _ in shots])
    settings = FitSettings(iterations=3000, max_splats=4000, sh_degree=1, seed=seed)
    result = fit(from_points(points(), kind="2d", sh_degree=1, seed=seed), views, settings)
    splats = result.gaussians
    assert result.history[-1].loss > 0
    assert float(splats.scales.max()) <= 1.001 * LARGEST * result.extent
    errors = []
    for camera, (_, depth) in zip(views.cameras, shots, strict=True):
        drawn = render(splats, camera, near=0.01 * result.extent).depth.double().numpy()
        solid = np.isfinite(depth)
        errors.append(np.abs(drawn[solid] / depth[solid] - 1))
    error = np.concatenate(errors)
    # Half a pixel at the card's outline, and the ground's far end, which no first point describes.
    assert np.median(error) < 0.05 and (error > 0.5).mean() < 0.02


def test_the_area_without_a_surface_is_measured_where_no_mask_ignores_it():
    """Oracle: a wall before the left half of a picture, whole or so far away that it is sky."""
    across, up = torch.meshgrid(torch.arange(-60, 0), torch.arange(-60, 60), indexing="ij")
    places = torch.stack([across + 0.5, up + 0.5, 0 * up], -1).reshape(-1, 3).float() / 20
    n = len(places)
    wall = Gaussians(
        "2d", places, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 2), 0.04),
        torch.full((n,), 0.99), torch.zeros(n, 1, 3),
    )  # fmt: skip
    size = {"width": 64, "height": 48}
    front = Camera.look_at((0, 0, 3), (0, 0, 0), **size, fov_y=40, up=(0, 1, 0))
    right = np.arange(64)[None].repeat(48, 0) >= 32
    shot = [np.zeros((48, 64, 3), np.uint8)]

    def share(scene, *mask):
        return without_surface(scene, Views([front], shot, mask))

    assert share(wall) == pytest.approx(0.5, abs=0.02)
    assert share(wall, right) > 0.96 and share(wall, ~right) < 0.02
    assert share(replace(wall, far=0.01)) == 1
