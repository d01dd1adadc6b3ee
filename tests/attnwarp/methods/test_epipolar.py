"""Oracles: points in space projected in float64, OpenCV's eight-point algorithm, lines drawn through two projections."""

import cv2
import numpy as np
import pytest
from drawn_lines import drawn_distances

from attnwarp import Camera
from attnwarp.camera import fundamental
from attnwarp.methods.epipolar import line_distances


def pair():
    """Two cameras with different intrinsics, one of them with skew."""
    first = Camera.look_at((0.3, -4, 0.5), (0, 0, 0), width=12, height=8, fov_y=50)
    second = Camera.look_at((1.9, -3, 1.1), (0.2, 0, 0), width=9, height=10, fov_y=70)
    K = second.K.copy()
    K[0, 1], K[0, 2] = 0.4, 3.7
    return first, Camera(K, second.world_to_camera, 9, 10)


def test_points_seen_by_both_cameras_lie_on_their_lines():
    view, key = pair()
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    x, y = (np.c_[camera.project(points)[0], np.ones(50)] for camera in (view, key))
    lines = x @ fundamental(view, key).T
    distance = np.abs((lines * y).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
    assert distance.max() < 1e-10  # px, float64
    wrong = x @ fundamental(key, view).T
    assert (np.abs((wrong * y).sum(1)) / np.hypot(wrong[:, 0], wrong[:, 1])).max() > 0.1


def test_the_matrix_is_what_opencv_fits_to_correspondences():
    view, key = pair()
    points = np.random.default_rng(1).uniform(-1, 1, (60, 3))
    fitted, _ = cv2.findFundamentalMat(
        view.project(points)[0], key.project(points)[0], cv2.FM_8POINT
    )
    matrix = fundamental(view, key)
    matrix = matrix / matrix[2, 2]
    # OpenCV rounds the points to float32.
    assert np.allclose(matrix, fitted, rtol=0, atol=2e-6 * np.abs(fitted).max())


@pytest.mark.parametrize("size", [(4, 6), (5, 3)])
def test_distances_are_those_from_lines_drawn_through_two_projections(size):
    view, key = pair()
    distances = line_distances(view, key, size).numpy()
    expected = drawn_distances(view, key, size)
    assert np.abs(distances - expected).max() < 1e-5  # float32 of at most 7 cells
    assert expected.max() > 3


def test_cameras_at_one_place_have_no_lines():
    view, _ = pair()
    pose = view.world_to_camera.copy()
    pose[:3] = cv2.Rodrigues(np.array([0.0, 0.3, 0.0]))[0] @ pose[:3]  # turned about its centre
    turned = Camera(view.K, pose, view.width, view.height)
    assert line_distances(view, view, (4, 6)) is None
    assert np.linalg.norm(view.position - turned.position) < 1e-12
    assert line_distances(view, turned, (4, 6)) is None  # their distance is rounding
