"""One test for each line of docs/conventions.md, by numbers that can be worked out in the head."""

import math

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.render import render
from attnwarp.warp import angle_between, correspond, in_bounds, resize_mask, sample

IDENTITY = np.eye(4)


def camera(width=8, height=4, f=10.0, cx=None, cy=None):
    K = np.array(
        [
            [f, 0, width / 2 if cx is None else cx],
            [0, f, height / 2 if cy is None else cy],
            [0, 0, 1],
        ]
    )
    return Camera(K, IDENTITY, width, height)


def one_splat(**changes):
    values = {
        "kind": "2d",
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.tensor([[0.3, 0.3]]),
        "opacities": torch.tensor([0.9]),
        "sh": Gaussians.sh_from_rgb(torch.tensor([[0.25, 0.5, 0.75]])),
    }
    return Gaussians(**{**values, **changes})


def test_axes_are_x_right_y_down_z_forward():
    xy, z = camera().project([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [0.0, 0.0, -1.0]])
    assert xy[0].tolist() == [5.0, 2.0]
    assert xy[1].tolist() == [4.0, 3.0]
    assert z.tolist() == [1, 1, -1]
    above = Camera.look_at((5, 0, 0), (0, 0, 0), width=8, height=8, fov_y=90)
    up, _ = above.project([0, 0, 1.0])  # world z is up, and up is toward row 0
    right, _ = above.project([0, 1.0, 0])
    assert up[1] < 4
    assert right[0] > 4


def test_poses_are_float64_rigid_and_do_not_mirror():
    assert camera().world_to_camera.dtype == np.float64
    with pytest.raises(ValueError, match="determinant -1"):
        Camera(camera().K, np.diag([-1.0, 1, 1, 1]), 8, 4)


def test_the_centre_of_pixel_j_is_at_j_plus_a_half():
    assert camera().pixel_centers()[3, 7].tolist() == [7.5, 3.5]
    c = correspond(camera(), camera(), np.full((4, 8), 2.0))
    assert in_bounds(c).all()
    # A splat whose centre projects onto a pixel's centre is brightest there, and equally bright on
    # both sides.
    at = camera(width=9, height=5, cx=4.5, cy=2.5)
    row = render(one_splat(), at, backend="reference").alpha[2]
    assert row.argmax() == 4
    assert torch.allclose(row, row.flip(0), atol=1e-12)


def test_resizing_maps_u_to_u_times_s():
    small, big = camera(), camera().resize(32, 8)
    point = [0.07, -0.03, 1.3]
    assert np.allclose(big.project(point)[0], small.project(point)[0] * [4, 2], rtol=0, atol=1e-12)


def test_depth_is_along_the_axis_and_not_along_the_ray():
    at = camera(f=4.0)
    corner = at.unproject(at.pixel_centers(), np.full((4, 8), 2.0))[0, 0]
    assert corner[2] == 2.0
    assert np.linalg.norm(corner) == pytest.approx(
        2 * math.sqrt(1 + (3.5 / 4) ** 2 + (1.5 / 4) ** 2)
    )


def test_undefined_depth_is_nan():
    seen = render(
        one_splat(scales=torch.tensor([[0.01, 0.01]])), camera(64, 64, f=64.0), backend="reference"
    )
    assert torch.isnan(seen.depth[0, 0])
    assert not seen.valid[0, 0]
    c = correspond(camera(1, 1), camera(1, 1), np.zeros((1, 1)))
    assert torch.isnan(c.target_depth).all()


def test_a_point_behind_has_no_pixel():
    xy, z = camera().project([0.0, 0.0, 0.0])
    assert np.isnan(xy).all()
    assert z == 0


def test_quaternions_are_wxyz():
    # A quarter turn about z takes x to y.
    turned = one_splat(quats=torch.tensor([[math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]]))
    assert torch.allclose(turned.rotations()[0, :, 0], torch.tensor([0.0, 1, 0]), atol=1e-6)


def test_scales_are_linear_standard_deviations():
    # One standard deviation off the centre, exp(-1/2) of the opacity; the screen filter is smaller
    # here.
    at = camera(width=41, height=41, f=100.0, cx=20.5, cy=20.5)
    alpha = render(one_splat(scales=torch.tensor([[0.2, 0.2]])), at, backend="reference").alpha
    assert alpha[20, 20] == pytest.approx(0.9, abs=1e-6)
    assert alpha[20, 30] == pytest.approx(0.9 * math.exp(-0.5), abs=1e-6)


def test_normals_are_the_thin_axis():
    assert one_splat().normals().tolist() == [[0, 0, 1]]
    flat = one_splat(kind="3d", scales=torch.tensor([[0.3, 0.01, 0.3]]))
    assert flat.normals().tolist() == [[0, 1, 0]]


def test_harmonics_store_srgb_around_a_half():
    at = camera(width=41, height=41, f=100.0, cx=20.5, cy=20.5)
    color = render(one_splat(), at, backend="reference").color[20, 20]
    assert torch.allclose(
        color, 0.9 * torch.tensor([0.25, 0.5, 0.75], dtype=color.dtype), atol=1e-6
    )


def test_features_are_channels_first_and_images_channels_last():
    c = correspond(camera(), camera(), np.full((4, 8), 2.0))
    warped, mask = sample(torch.zeros(3, 4, 8), c)
    assert warped.shape == (3, 4, 8)
    assert mask.dtype == torch.bool
    assert render(one_splat(), camera(), backend="reference").color.shape == (4, 8, 3)


def test_an_origin_keeps_far_worlds_exact():
    far = one_splat(origin=np.array([1e6, -1e6, 1e6]))
    there = camera().moved((1e6, -1e6, 1e6))
    here = render(one_splat(), camera(), backend="reference").depth
    assert torch.allclose(
        render(far, there, backend="reference").depth, here, rtol=0, atol=1e-6, equal_nan=True
    )


def test_masks_are_true_where_a_pixel_counts():
    assert resize_mask(torch.tensor([[True, True], [True, False]]), (1, 1)).item() is True


def test_angles_are_degrees():
    assert angle_between(
        torch.tensor([1.0, 0, 0]), torch.tensor([0, 2.0, 0])
    ).item() == pytest.approx(90)
