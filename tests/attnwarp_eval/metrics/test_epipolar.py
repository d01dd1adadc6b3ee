"""Epipolar distances against kornia; TSED of pictures whose every colour is exact."""

import math

import cv2
import kornia.geometry.epipolar as kornia
import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.camera import fundamental
from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.truth import Geometry
from attnwarp_eval.truth.features import SolidField


def pair():
    size = {"width": 200, "height": 150}
    return (
        Camera.look_at((0.3, -4, 0.5), (0, 0, 0), fov_y=50, **size),
        Camera.look_at((1.9, -3, 1.1), (0.2, 0, 0), fov_y=70, **size),
    )


def seen(count=60):
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    return [camera.project(points)[0] for camera in pair()]


def test_exact_projections_have_distance_0():
    assert metrics.epipolar_distance(*seen(), fundamental(*pair())).max() < 1e-10  # px, float64


def test_it_is_the_mean_of_kornias_two_distances():
    random = np.random.default_rng(1)
    source, target = random.uniform(0, 200, (2, 40, 2))
    F = fundamental(*pair())
    # Kornia adds 1e-8 to what it divides by, which is nothing beside lines of this scale.
    x, y, matrix = (torch.from_numpy(each)[None] for each in (source, target, 1e6 * F))
    left = kornia.left_to_right_epipolar_distance(x, y, matrix)[0]
    right = kornia.right_to_left_epipolar_distance(x, y, matrix)[0]
    distances = metrics.epipolar_distance(source, target, F)
    np.testing.assert_allclose(distances, ((left + right) / 2).numpy(), rtol=1e-9)
    both = kornia.symmetrical_epipolar_distance(x, y, matrix, squared=True)[0]
    np.testing.assert_allclose((left**2 + right**2).numpy(), both.numpy(), rtol=1e-9)


def test_a_point_at_the_epipole_contradicts_nothing_in_the_other_view():
    # Forward motion: the epipole is the principal point of both views.
    view, key = (
        Camera.look_at((0, y, 0), (0, 0, 0), width=8, height=8, fov_y=60) for y in (-4, -3)
    )
    assert metrics.epipolar_distance([[4, 4]], [[4, 4]], fundamental(view, key)) == pytest.approx(0)


def test_pairs_are_judged_by_their_median_and_by_ten_matches():
    distances = [
        np.r_[np.full(6, 0.5), np.full(5, 90.0)],  # most matches are right
        np.r_[np.full(5, 0.5), np.full(6, 90.0)],
        np.full(10, 3.0),
        np.full(9, 0.0),
        np.zeros(0),
        None,
    ]
    result = metrics.tsed(distances)
    np.testing.assert_array_equal(result.medians, [0.5, 90, 3, np.nan, np.nan, np.nan])
    figures = result.figures()
    assert [figures[f"consistency.tsed_{limit}px"] for limit in (1, 2, 4)] == [0.2, 0.2, 0.4]
    assert figures["consistency.tsed_distance"] == 3
    assert figures["consistency.tsed_pairs"] == 6
    assert figures["consistency.tsed_few_matches"] == 2
    assert figures["consistency.tsed_no_baseline"] == 1
    assert {metrics.metric(name).unit for name in figures} == {"share", "px", "views"}


@pytest.mark.parametrize("distances", [[], [None], [np.zeros(0), np.zeros(9)], [None, np.zeros(3)]])
def test_where_no_pair_has_matches_the_share_is_undefined(distances):
    figures = metrics.tsed(distances).figures()
    assert all(math.isnan(figures[f"consistency.tsed_{limit}px"]) for limit in (1, 2, 4))
    assert math.isnan(figures["consistency.tsed_distance"])
    assert figures["consistency.tsed_few_matches"] == sum(each is not None for each in distances)


def test_matches_of_a_picture_moved_by_a_known_step_are_exact_in_both_directions():
    coarse = np.random.default_rng(2).random((24, 24, 3))
    wall = cv2.resize(coarse, (192, 192), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    source, target = metrics.sift_matches(wall[9:, :170], wall[:-9, 22:])
    assert len(source) > 30
    np.testing.assert_allclose(np.median(source - target, axis=0), [22, -9], atol=0.02)
    assert (np.hypot(*(source - target - [22, -9]).T) < 0.5).mean() > 0.95


def test_positions_of_matches_have_pixel_centres_at_half():
    # A round spot: its middle is known.
    y, x = np.mgrid[:64, :64] + 0.5
    spot = lambda cx, cy, s: np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))  # noqa: E731
    grey = 0.1 + 0.8 * spot(24.5, 30.5, 4) + 0.5 * spot(44.5, 20.5, 3)
    picture = np.stack([grey] * 3, axis=-1).clip(0, 1)
    source, target = metrics.sift_matches(picture, picture)
    assert np.array_equal(source, target)
    nearest = np.hypot(*(source - [24.5, 30.5]).T).min()
    assert nearest < 0.1


def painted(camera, seed):
    """sRGB of a smooth field of space at the pixels' surface points, exactly: no light, no noise."""
    points = Geometry(load_scene("spheres")).trace(camera).point
    field = SolidField((0, 0, 0.6), 4.0, channels=3, cycles=14.0, seed=seed)
    colors = np.moveaxis(field.on_grid(points, background=0.0), 0, -1)
    return to_srgb(np.clip(0.4 + 0.15 * np.nan_to_num(colors), 0, 1))


def test_perfect_pictures_at_exact_poses_have_a_tsed_of_100_percent():
    scene = load_scene("spheres").with_size(256, 256)
    cameras = [scene.source, *(scene.camera(name) for name in ("yaw010", "yaw020"))]
    perfect = metrics.tsed_of_views([painted(camera, 5) for camera in cameras], cameras)
    assert perfect.matches.min() > 50
    assert perfect.share(1) == 1 and perfect.medians.max() < 0.5
    # Each view shows another paint: few matches, or wrong ones.
    other = metrics.tsed_of_views([painted(c, i) for i, c in enumerate(cameras)], cameras)
    assert not other.share(1) > 0
    # Right pictures at a wrong pose: the second camera's picture is moved down by 6 px.
    pictures = [painted(camera, 5) for camera in cameras]
    pictures[1] = np.roll(pictures[1], 6, axis=0)
    assert metrics.tsed_of_views(pictures, cameras).share(2) == 0


def test_black_pictures_and_one_place_are_counted():
    view, key = pair()
    black = np.zeros((150, 200, 3))
    figures = metrics.tsed_of_views([black, black, black], [view, view, key]).figures()
    assert math.isnan(figures["consistency.tsed_1px"])
    assert figures["consistency.tsed_no_baseline"] == figures["consistency.tsed_few_matches"] == 1


def test_wrong_inputs_are_named():
    view, key = pair()
    black = np.zeros((150, 200, 3))
    with pytest.raises(ValueError, match="images: got 1, expected 2"):
        metrics.tsed_of_views([black], [view, key])
    with pytest.raises(ValueError, match=r"images\[1\]: got 20 x 20 pixels"):
        metrics.tsed_of_views([black, black[:20, :20]], [view, key])
    with pytest.raises(ValueError, match="target_xy: got shape"):
        metrics.epipolar_distance(np.zeros((3, 2)), np.zeros((2, 2)), np.eye(3))
    with pytest.raises(ValueError, match="source_xy: nan"):
        metrics.epipolar_distance([[np.nan, 0]], [[0, 0]], np.eye(3))
