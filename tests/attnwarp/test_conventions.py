"""Tests for each line of docs/start/concepts.md, by numbers that can be worked out in the head."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.render import render
from attnwarp.warp import angle_between, correspond, in_bounds, resize_mask, sample, sample_at

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


def test_the_nearest_rotation_about_the_same_centre_is_taken():
    clean, noisy = np.eye(4), np.eye(4)
    clean[0, 0] += 1e-13
    assert Camera(camera().K, clean, 8, 4).rotation[0, 0] == 1 + 1e-13
    # A scaled rotation's nearest is itself without the scale.
    noisy[:3, :3] *= 1 + 2**-20
    noisy[:3, 3] = [1, 2, 3]
    taken = Camera(camera().K, noisy, 8, 4)
    assert np.allclose(taken.rotation, np.eye(3), rtol=0, atol=1e-15)
    center = -np.array([1, 2, 3]) / (1 + 2**-20)
    assert np.allclose(taken.position, center, rtol=0, atol=1e-14)


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
    xy, z = camera().project([[0, 0, 0], [1, 1, -2]])
    assert np.isnan(xy).all()
    assert z.tolist() == [0, -2]


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


def test_a_poses_rotation_is_orthonormal_to_1e_5():
    stretched = np.diag([1 + 4e-6, 1, 1, 1])  # max |R R^T - I| = 8e-6
    Camera(camera().K, stretched, 8, 4)
    with pytest.raises(ValueError, match="not orthonormal"):
        Camera(camera().K, np.diag([1 + 6e-6, 1, 1, 1]), 8, 4)


def test_fx_fy_skew_and_any_principal_point_are_used():
    # x = 3/4, y = 1/2: u = 10 * 3/4 + 4 * 1/2 - 20, v = 20 * 1/2 + 50: outside of 8 x 4 px.
    K = np.array([[10.0, 4, -20], [0, 20, 50], [0, 0, 1]])
    skewed = Camera(K, IDENTITY, 8, 4)
    xy, _ = skewed.project([1.5, 1.0, 2.0])
    assert xy.tolist() == [-10.5, 60.0]
    assert skewed.directions(xy).tolist() == [0.75, 0.5, 1.0]
    # Resizing by 2 and 3 scales the first and the second row.
    assert skewed.resize(16, 12).K.tolist() == [[20, 8, -40], [0, 60, 150], [0, 0, 1]]


def test_a_picture_is_drawn_with_the_skew_and_the_principal_point():
    # The centre of the splat, at (0, 0.2, 2), is at u = 4 * 0.1 + 3.1 = 3.5, v = 20 * 0.1 + 0.5 = 2.5.
    K = np.array([[10.0, 4, 3.1], [0, 20, 0.5], [0, 0, 1]])
    splat = one_splat(means=torch.tensor([[0.0, 0.2, 2.0]]), scales=torch.tensor([[0.02, 0.02]]))
    alpha = render(splat, Camera(K, IDENTITY, 8, 5), backend="reference").alpha
    assert divmod(int(alpha.argmax()), 8) == (2, 3)
    far = Camera(np.array([[10.0, 0, 1003.5], [0, 10, 2.5], [0, 0, 1]]), IDENTITY, 8, 5)
    aside = one_splat(means=torch.tensor([[-200.0, 0.0, 2.0]]))  # u = 10 * -100 + 1003.5 = 3.5
    assert divmod(int(render(aside, far, backend="reference").alpha.argmax()), 8) == (2, 3)


@pytest.mark.parametrize("depth", [0.0, -1.0, math.inf, math.nan])
def test_depth_that_cannot_be_is_undefined(depth):
    c = correspond(camera(1, 1), camera(1, 1), np.full((1, 1), depth))
    assert not c.defined.any()


def test_quaternions_have_any_length_but_zero():
    long = one_splat(quats=torch.tensor([[0.0, 0, 0, 250.0]]))
    assert long.rotations()[0].tolist() == [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]
    with pytest.raises(ValueError, match="zero quaternion"):
        one_splat(quats=torch.zeros(1, 4))


def test_normals_are_flipped_to_the_camera():
    for quats in ([1.0, 0, 0, 0], [0.0, 1, 0, 0]):  # the second is turned upside down
        seen = render(one_splat(quats=torch.tensor([quats])), camera(), backend="reference")
        normal = seen.normal[2, 4] / seen.alpha[2, 4]
        assert torch.allclose(normal, torch.tensor([0.0, 0, -1], dtype=normal.dtype), atol=1e-5)


def test_features_are_read_at_their_own_size():
    # 8 px become 2 columns: the centre of the first four pixels is column 0.5.
    c = correspond(camera(), camera(), np.full((4, 8), 2.0))
    features = torch.tensor([[[1.0, 3.0]]])
    warped, _ = sample(features, c)
    expected = [1 + 2 * min(max((j + 0.5) / 4 - 0.5, 0), 1) for j in range(8)]
    np.testing.assert_allclose(warped[0, 0].numpy(), expected, atol=1e-6)


def test_outside_takes_the_border_and_no_position_gives_zero():
    right = Camera(camera().K, IDENTITY, 8, 4).moved((1.0, 0, 0))  # sees 5 px further
    c = correspond(camera(), right, np.full((4, 8), 2.0))
    warped, mask = sample(torch.arange(1.0, 9).repeat(4, 1)[None], c)
    assert warped[0, 0, -1] == 8 and not mask[0, -1]
    lost = correspond(camera(), camera(), np.full((4, 8), math.nan))
    warped, mask = sample(torch.ones(1, 4, 8), lost)
    assert (warped == 0).all() and not mask.any()


def test_a_grid_of_half_precision_is_refused():
    random = torch.Generator().manual_seed(0)
    features = 1 + torch.rand(1, 4, 8, generator=random)
    grid = 0.5 + torch.rand(9, 9, 2, generator=random) * torch.tensor([7.0, 3.0])
    # The unit roundoff of each type: what one rounding at the end, and no more, may cost.
    for dtype, unit in ((torch.float16, 2**-11), (torch.bfloat16, 2**-8)):
        with pytest.raises(ValueError, match="half precision"):
            sample_at(features, grid.to(dtype))
        values = features.to(dtype)
        exact = sample_at(values.double(), grid.double())
        error = (sample_at(values, grid).double() - exact).abs() / exact
        assert error.max() <= unit * (1 + 1e-4)


def test_yaw_is_around_the_scene_from_the_source_and_folded():
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.world import World

    world = World(load_scene("spheres"), 8)
    assert len(world.yaw) > 3 and all(0 <= yaw <= 180 for yaw in world.yaw.values())

    def azimuth(a):
        x, y = (a.position - world.scene.center)[:2]
        return math.degrees(math.atan2(y, x))

    for name, yaw in world.yaw.items():
        turn = abs(azimuth(world.targets[name]) - azimuth(world.source))
        assert yaw == pytest.approx(min(turn, 360 - turn), abs=1e-6)


PINNED = {
    "camera axes": [test_axes_are_x_right_y_down_z_forward],
    "pose": [
        test_poses_are_float64_rigid_and_do_not_mirror,
        test_the_nearest_rotation_about_the_same_centre_is_taken,
        test_a_poses_rotation_is_orthonormal_to_1e_5,
    ],
    "pixels": [test_the_centre_of_pixel_j_is_at_j_plus_a_half],
    "resizing by s": [test_resizing_maps_u_to_u_times_s],
    "principal point": [
        test_fx_fy_skew_and_any_principal_point_are_used,
        test_a_picture_is_drawn_with_the_skew_and_the_principal_point,
    ],
    "depth": [test_depth_is_along_the_axis_and_not_along_the_ray],
    "distance": [test_depth_is_along_the_axis_and_not_along_the_ray],
    "undefined depth": [test_undefined_depth_is_nan, test_depth_that_cannot_be_is_undefined],
    "a point at or behind a camera": [test_a_point_behind_has_no_pixel],
    "quaternions": [test_quaternions_are_wxyz, test_quaternions_have_any_length_but_zero],
    "scales": [test_scales_are_linear_standard_deviations],
    "splat normals": [test_normals_are_the_thin_axis, test_normals_are_flipped_to_the_camera],
    "spherical harmonics": [test_harmonics_store_srgb_around_a_half],
    "images": [test_features_are_channels_first_and_images_channels_last],
    "world": [test_axes_are_x_right_y_down_z_forward, test_an_origin_keeps_far_worlds_exact],
    "masks": [test_masks_are_true_where_a_pixel_counts],
    "angles": [test_angles_are_degrees],
    "yaw": [test_yaw_is_around_the_scene_from_the_source_and_folded],
    "size of features": [test_features_are_read_at_their_own_size],
    "outside the image": [test_outside_takes_the_border_and_no_position_gives_zero],
    "no position": [test_outside_takes_the_border_and_no_position_gives_zero],
    "half precision": [test_a_grid_of_half_precision_is_refused],
}


def test_every_line_of_the_page_is_pinned_by_a_test_here():
    page = (Path(__file__).parents[2] / "docs/start/concepts.md").read_text()
    lines = re.findall(r"^\| ([^|]+?) \| [^|]", page, re.MULTILINE)
    names = [line.replace("`", "") for line in lines if line not in ("what", "---")]
    assert names == list(PINNED)
