"""Oracles: OpenCV's projectPoints and Rodrigues, mpmath, SciPy's rotations, matrices multiplied by
hand.
"""

import json

import cv2
import mpmath
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from attnwarp import Camera
from attnwarp.camera import up_of

K = np.array([[500.0, 2.0, 330.0], [0.0, 480.0, 215.0], [0.0, 0.0, 1.0]])


def pose(rotation=(0.2, -0.4, 0.1), translation=(0.3, -0.2, 5.0)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def camera(**changes):
    return Camera(**{"K": K, "world_to_camera": pose(), "width": 640, "height": 480, **changes})


def test_projection_is_opencvs():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    K_straight = K.copy()
    K_straight[0, 1] = 0  # OpenCV has no skew
    cam = camera(K=K_straight)
    rotation, _ = cv2.Rodrigues(cam.rotation.copy())
    expected, _ = cv2.projectPoints(points, rotation, cam.translation.copy(), K_straight, None)
    xy, z = cam.project(points)
    # OpenCV's pixel centres are whole numbers, but a projection is K times a point in both.
    assert np.abs(xy - expected[:, 0]).max() < 1e-9
    assert np.allclose(z, (points @ cam.rotation.T + cam.translation)[:, 2], atol=1e-12)


def test_unproject_undoes_project_with_skew_and_unequal_focal_lengths():
    points = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    xy, z = camera().project(points)
    assert np.abs(camera().unproject(xy, z) - points).max() < 1e-12


def test_directions_are_the_inverse_of_k_times_the_pixel():
    xy = np.array([[0.5, 0.5], [639.5, 479.5], [-40.0, 900.0]])
    expected = (np.linalg.inv(K) @ np.c_[xy, np.ones(3)].T).T
    assert np.abs(camera().directions(xy) - expected).max() < 1e-12
    assert camera().directions().shape == (480, 640, 3)


@pytest.mark.parametrize("focal", [1.0, 1e5])
def test_focal_lengths_from_one_to_a_hundred_thousand_pixels_keep_their_digits(focal):
    cam = camera(
        K=np.array([[focal, 0, 320.3], [0, focal, 240.7], [0, 0, 1]]), world_to_camera=np.eye(4)
    )
    with mpmath.workdps(40):
        x = (mpmath.mpf(17.5) - mpmath.mpf(320.3)) / mpmath.mpf(focal)
        expected = float(x)
    assert cam.directions(np.array([17.5, 3.5]))[0] == pytest.approx(expected, rel=1e-15)


def test_looking_at_a_point_puts_it_in_the_middle_with_up_upward():
    cam = Camera.look_at([3, -2, 1.5], [0.2, 0.1, 0.4], width=200, height=100, fov_y=50)
    xy, z = cam.project([[0.2, 0.1, 0.4]])
    assert np.abs(xy - [100, 50]).max() < 1e-9
    assert z[0] == pytest.approx(np.linalg.norm(np.array([3, -2, 1.5]) - [0.2, 0.1, 0.4]))
    above, _ = cam.project([[0.2, 0.1, 0.5]])
    assert above[0, 1] < 50
    # The top of the image is half of the field of view up.
    top = cam.directions(np.array([100.0, 0.0]))
    assert np.degrees(np.arctan(-top[1])) == pytest.approx(25)


def test_the_relative_pose_keeps_a_tiny_baseline_in_a_far_away_world():
    far = np.array([1e6, -2e6, 5e5])
    here, there = camera().moved(far), camera().moved(far + np.array([1e-6, 0, 0]))
    rotation = camera().rotation
    expected = rotation @ (here.position - there.position)
    relative = there.relative_to(here)
    # A micrometre at 2e6 m is known to the float64 spacing of the coordinates there, 2.3e-10.
    assert np.abs(relative[:3, 3] - expected).max() < 1e-9
    assert np.abs(relative[:3, 3] - rotation @ [-1e-6, 0, 0]).max() < 2e-9
    assert np.abs(relative[:3, :3] - np.eye(3)).max() < 1e-15


@pytest.mark.parametrize("error", ["float32", "scale"])
def test_a_rough_rotation_far_from_the_origin_gives_one_camera(error):
    rough, there = pose(), np.array([6000.0, -7000.0, 4000.0])
    R = rough[:3, :3]
    R[:] = R.astype(np.float32) if error == "float32" else (1 + 4e-6) * R
    assert 1e-8 < np.abs(R @ R.T - np.eye(3)).max() < 1e-5
    rough[:3, 3] = -R @ there
    cam = camera(world_to_camera=rough)
    assert np.abs(cam.position - there).max() < 1e-8
    # K (R p + t) by the pose that was given, and by the camera's own, which renders use.
    points = there + np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)) + 2 * cam.forward
    xy, z = cam.project(points)
    for matrix, bound in ((rough, 0.01), (cam.world_to_camera, 1e-6)):
        h = (points @ matrix[:3, :3].T + matrix[:3, 3]) @ K.T
        assert np.abs(h[:, :2] / h[:, 2:] - xy).max() < bound
    assert np.abs(cam.unproject(xy, z) - points).max() < 1e-8
    assert np.array_equal(Camera.from_dict(cam.to_dict()).world_to_camera, cam.world_to_camera)


def test_relative_poses_chain_as_matrices_do():
    a, b = camera(), camera(world_to_camera=pose((1.2, 0.1, -0.3), (0.0, 1.0, 2.0)))
    assert (
        np.abs(a.relative_to(b) - a.world_to_camera @ np.linalg.inv(b.world_to_camera)).max()
        < 1e-12
    )


def test_moving_the_world_leaves_what_is_seen():
    points = np.random.default_rng(3).uniform(-1, 1, (20, 3))
    offset = np.array([10.0, -20.0, 30.0])
    assert (
        np.abs(
            camera().moved(offset).project(points + offset)[0] - camera().project(points)[0]
        ).max()
        < 1e-9
    )


def test_json_brings_back_the_same_camera_bit_for_bit():
    cam = camera(name="left")
    again = Camera.from_dict(json.loads(json.dumps(cam.to_dict())))
    assert np.array_equal(again.K, cam.K)
    assert np.array_equal(again.world_to_camera, cam.world_to_camera)
    assert (again.width, again.height, again.name) == (640, 480, "left")


def test_a_camera_cannot_be_changed_in_place():
    source = K.copy()
    cam = camera(K=source)
    source[0, 0] = 1
    assert cam.K[0, 0] == 500
    with pytest.raises(ValueError, match="read-only"):
        cam.K[0, 0] = 1


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": np.eye(4)}, r"K: got shape \(4, 4\), expected \(3, 3\)"),
        ({"K": np.diag([-1.0, 1, 1])}, "focal lengths fx=-1.0"),
        ({"K": np.where(np.eye(3) > 0, np.nan, K)}, r"K: nan at index \(0, 0\)"),
        ({"K": K + np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]])}, "expected \\[\\[fx, skew, cx\\]"),
        ({"width": 0}, "got 0 x 480"),
        ({"height": 96.5}, "height: got 96.5, expected a whole number of pixels"),
        ({"width": "160"}, "width: got '160', expected a whole number of pixels"),
        ({"width": float("nan")}, "width: got nan, expected a whole number of pixels"),
        ({"world_to_camera": np.ones((4, 4))}, "last row"),
        ({"world_to_camera": np.diag([2.0, 2, 2, 1])}, "not orthonormal.*= 3"),
        ({"world_to_camera": np.diag([1.0, 1, -1, 1])}, "mirrors"),
    ],
)
def test_a_wrong_camera_says_what_came_and_what_was_expected(changes, message):
    with pytest.raises(ValueError, match=message):
        camera(**changes)


def test_a_whole_number_of_any_type_is_a_size():
    for size in (96.0, np.int64(96), np.uint16(96), np.float32(96)):
        made = camera(width=size, height=size)
        assert (made.width, type(made.width), made.height) == (96, int, 96)


@pytest.mark.door
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0, 1], [0, 0, 1], 50), "has no direction"),
        (([0, 0, 5], [0, 0, 1], 50), "parallel"),
        (([1, 0, 0], [0, 0, 0], 180), "degrees in"),
    ],
)
def test_a_view_that_cannot_be_looked_along_is_refused(arguments, message):
    position, target, fov = arguments
    with pytest.raises(ValueError, match=message):
        Camera.look_at(position, target, width=4, height=4, fov_y=fov)


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("tensors", [False, True])
def test_a_pose_from_camera_to_world_projects_as_opencv_does(rows, tensors):
    """Oracles: projectPoints with the inverse by hand; OpenGL's axes are turned by hand."""
    straight = K.copy()
    straight[0, 1] = 0
    R, t = pose()[:3, :3], pose()[:3, 3]
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = R.T, -R.T @ t
    gl = to_world.copy()
    gl[:, 1:3] *= -1
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, straight, None)
    for axes, matrix in (("opencv", to_world), ("opengl", gl)):
        given = [torch.from_numpy(x) if tensors else x for x in (matrix[:rows], straight)]
        xy, _ = Camera.from_c2w(*given, 640, 480, axes=axes).project(points)
        assert np.abs(xy - expected[:, 0]).max() < 1e-8


@pytest.mark.door
@pytest.mark.parametrize(
    ("matrix", "axes", "message"),
    [
        (np.eye(3), "opencv", r"camera_to_world: got shape \(3, 3\)"),
        (np.zeros((4, 4)), "opencv", "camera_to_world: is singular"),
        (np.eye(4), "blender", "axes: got 'blender'"),
    ],
)
def test_a_pose_that_is_none_is_refused(matrix, axes, message):
    with pytest.raises(ValueError, match=message):
        Camera.from_c2w(matrix, K, 8, 8, axes=axes)


def ring(count, elevation, arc=360.0, rolls=(0,)):
    """Cameras on an arc about the origin, which they see from this elevation, in degrees; the
    pictures rolled by these angles in turn."""
    result = []
    for k, yaw in enumerate(np.radians(arc) * np.arange(count) / count):
        low = np.radians(elevation)
        place = [3 * np.cos(yaw) * np.cos(low), 3 * np.sin(yaw) * np.cos(low), 3 * np.sin(low)]
        level = Camera.look_at(place, (0, 0, 0), width=8, height=8, fov_y=50)
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", rolls[k % len(rolls)], degrees=True).as_matrix()
        result.append(Camera(level.K, turn @ level.world_to_camera, 8, 8))
    return result


@pytest.mark.parametrize("elevation", [0, 30, 45])
@pytest.mark.parametrize("rolls", [(0,), (0, 90), (0, 0, 180), (0, -90, 0, 90), (1, -1, 2, -2)])
def test_level_pictures_tell_which_way_is_up_even_if_some_stand_on_their_side(elevation, rolls):
    """Oracle: the cameras were placed with z up; rolls of both signs cancel to a degree."""
    up, known = up_of(ring(24, elevation, rolls=rolls))
    assert known and up[2] > np.cos(np.radians(1))


@pytest.mark.parametrize(
    "cameras",
    [
        ring(8, 40, arc=0), ring(8, 40, arc=5), ring(1, 0), ring(24, 89),
        ring(24, 20, rolls=(90,)), ring(24, 20, rolls=(10, 100, 55, 200, -50, 300, 150)),
    ],
    ids=["one way", "nearly one way", "one", "straight down", "all on their side", "any roll"],
)  # fmt: skip
def test_pictures_that_do_not_tell_which_way_is_up_say_so(cameras):
    up, known = up_of(cameras)
    assert not known and np.linalg.norm(up) == pytest.approx(1)
