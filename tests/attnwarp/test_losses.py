"""Losses against other libraries, closed forms and finite differences."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians, losses
from attnwarp.render import render


def pictures(height=40, width=52, channels=3, dtype=torch.float64, seed=0):
    random = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, channels, generator=random, dtype=dtype)
    target = (image + 0.2 * torch.randn(image.shape, generator=random, dtype=dtype)).clamp(0, 1)
    return image, target


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_ssim_is_that_of_scikit_image(channels):
    from skimage.metrics import structural_similarity

    image, target = pictures(channels=channels)
    expected = structural_similarity(
        image.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=-1,
        data_range=1.0,
    )
    # Both in float64; scikit-image's kernel is cut at 3.5 sigma, 11 taps as here.
    assert float(losses.ssim(image, target)) == pytest.approx(expected, abs=1e-12)


def test_the_window_by_convolutions_is_that_by_opencv():
    values = torch.randn(19, 14, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(
        losses._convolved(values), losses._filter(values), rtol=0, atol=1e-12
    )


def test_ssim_map_is_that_of_kornia():
    import kornia

    image, target = pictures()
    expected = kornia.metrics.ssim(
        image.permute(2, 0, 1)[None],
        target.permute(2, 0, 1)[None],
        window_size=11,
        padding="valid",
        eps=0.0,
    )
    # kornia's C1, C2 are the same; eps is what it adds to the denominator.
    torch.testing.assert_close(
        losses.ssim_map(image, target), expected[0].permute(1, 2, 0), rtol=0, atol=1e-10
    )


def test_ssim_in_float32_keeps_five_digits():
    image, target = pictures()
    # E[x^2] - E[x]^2 loses about 1e-7 against C2 = 9e-4.
    assert float(losses.ssim(image.float(), target.float())) == pytest.approx(
        float(losses.ssim(image, target)), abs=1e-5
    )


def test_ssim_gradient_is_that_of_finite_differences_in_both_pictures():
    image, target = pictures(13, 12, 2)
    image.requires_grad_(True)
    target.requires_grad_(True)
    assert torch.autograd.gradcheck(losses.ssim_map, (image, target), atol=1e-7)


@pytest.mark.parametrize("shape", [(10, 30, 3), (1, 1, 3), (30, 10, 3)])
def test_ssim_below_its_window_is_refused(shape):
    with pytest.raises(ValueError, match="undefined below 11 x 11"):
        losses.ssim(torch.zeros(shape), torch.zeros(shape))


@pytest.mark.door
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.uint8])
def test_ssim_of_another_type_is_refused_by_name(dtype):
    image, target = pictures(dtype=torch.float32)
    with pytest.raises(ValueError, match=f"image: got {dtype}, expected float32 or float64"):
        losses.ssim(image.to(dtype), target)
    with pytest.raises(ValueError, match=f"target: got {dtype}"):
        losses.ssim_terms(image, target.to(dtype))


@pytest.mark.door
def test_pictures_of_different_shapes_are_refused():
    with pytest.raises(ValueError, match=r"target: got shape \(8, 9, 3\)"):
        losses.l1(torch.zeros(9, 9, 3), torch.zeros(8, 9, 3))


def test_l1_is_the_mean_absolute_difference():
    image, target = pictures()
    assert float(losses.l1(image, target)) == pytest.approx(
        np.abs(image.numpy() - target.numpy()).mean(), rel=1e-12
    )


def test_psnr_is_that_of_scikit_image_and_infinite_for_equal_pictures():
    from skimage.metrics import peak_signal_noise_ratio

    image, target = pictures()
    expected = peak_signal_noise_ratio(image.numpy(), target.numpy(), data_range=1.0)
    assert losses.psnr(image, target) == pytest.approx(expected, abs=1e-9)
    assert losses.psnr(image, image) == math.inf


def test_psnr_of_nan_is_nan_as_in_scikit_image():
    from skimage.metrics import peak_signal_noise_ratio

    image, target = pictures()
    image[3, 5, 1] = math.nan
    assert math.isnan(peak_signal_noise_ratio(image.numpy(), target.numpy(), data_range=1.0))
    assert math.isnan(losses.psnr(image, target))


def plane(angle, size=0.12, half=12):
    """A sheet of discs through the origin, turned by ``angle`` degrees about the y axis, that face
    its own normal.
    """
    u, v = np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1))
    flat = np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], -1) * size
    a = math.radians(angle)
    R = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    n = len(flat)
    quats = torch.tensor([math.cos(a / 2), 0, math.sin(a / 2), 0], dtype=torch.float64).repeat(n, 1)
    return Gaussians(
        "2d", torch.tensor(flat @ R.T), quats, torch.full((n, 2), 0.7 * size, dtype=torch.float64),
        torch.full((n,), 0.9, dtype=torch.float64), torch.zeros(n, 1, 3, dtype=torch.float64),
    )  # fmt: skip


CAMERA = Camera.look_at([0, 0, 4], [0, 0, 0], width=24, height=24, fov_y=20, up=[0, 1, 0])


def test_normals_of_a_tilted_plane_agree_with_its_depth():
    view = render(plane(35), CAMERA, backend="reference")
    # Depth by intersection is exact on a plane, so both normals are the plane's; the rest is
    # rounding.
    assert float(losses.normal_consistency(view)) == pytest.approx(0, abs=1e-6)


def test_discs_turned_out_of_their_plane_cost_one_minus_the_cosine():
    sheet = plane(0)
    turned = math.radians(20)
    sheet.quats[:] = torch.tensor(
        [math.cos(turned / 2), math.sin(turned / 2), 0, 0], dtype=torch.float64
    )
    view = render(sheet, CAMERA, backend="reference", depth="center")
    # By centre depth the sheet is flat at z = 4 whatever way its discs are turned, so N is its true
    # normal. 22 x 22 of the 24 x 24 pixels have one.
    inner = view.alpha[1:-1, 1:-1].sum() / 24**2
    expected = float(inner) * (1 - math.cos(turned))
    assert float(losses.normal_consistency(view)) == pytest.approx(expected, rel=1e-6)


def test_normal_consistency_of_nothing_is_zero_with_zero_gradient():
    sheet = plane(0)
    sheet.means = (sheet.means + torch.tensor([0.0, 0, 9])).requires_grad_(
        True
    )  # behind the camera
    loss = losses.normal_consistency(render(sheet, CAMERA, backend="reference"))
    loss.backward()
    assert float(loss.detach()) == 0
    assert float(sheet.means.grad.abs().max()) == 0


def hilly(width, height, seed=0):
    """A picture of hills with holes from a turned, skewed camera, as float32 maps; and the same as
    leaves in float64 that the definition in torch reads.
    """
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.linalg.det(turn), [0.1, 0.2, 0.3]
    K = np.array([[50.0, 1.5, 0.3 * width], [0, 60.0, 0.7 * height], [0, 0, 1]])
    camera = Camera(K, pose, width, height)
    y, x = np.mgrid[:height, :width]
    depth = 2 + 0.3 * np.sin(x / 3) + 0.2 * np.cos(y / 4)
    depth[random.random(depth.shape) < 0.05] = np.nan
    maps = {
        "depth": depth,
        "alpha": random.random(depth.shape),
        "normal": random.standard_normal((height, width, 3)),
    }
    maps = {name: torch.tensor(value, dtype=torch.float32) for name, value in maps.items()}
    rendered = render(plane(0), camera, backend="reference")
    views = []
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        leaves = {name: m.to(dtype, copy=True).requires_grad_(True) for name, m in maps.items()}
        views.append(dataclasses.replace(rendered, backend=backend, **leaves))
    return views


@pytest.mark.parametrize("size", [(31, 40), (64, 9), (3, 3), (2, 7), (1, 1)])
def test_kernels_of_normal_consistency_have_the_definitions_value_and_gradients(size):
    ours, definition = hilly(*size)
    values = [losses.normal_consistency(view) for view in (ours, definition)]
    assert float(values[0].detach()) == pytest.approx(float(values[1].detach()), abs=1e-7)
    for value in values:
        (3 * value).backward()
    for name in ("depth", "alpha", "normal"):
        got, expected = (getattr(view, name).grad for view in (ours, definition))
        if expected is None:  # no pixel has a normal: the definition's 0 is a constant
            assert min(size) < 3
            expected = torch.zeros_like(got)
        # Differences of float32 points keep 4 to 5 digits; the largest gradients set the scale.
        scale = max(float(expected.abs().max()), 1e-12)
        assert float((got - expected).abs().max()) < 2e-5 * scale, name


def test_normal_consistency_moves_a_camera_whose_pose_has_a_gradient():
    gradients = []
    for backend in ("cpu", "reference"):
        pose = torch.tensor(CAMERA.world_to_camera, requires_grad=True)
        losses.normal_consistency(render(plane(20), CAMERA, backend=backend, pose=pose)).backward()
        gradients.append(pose.grad.numpy())
    # The kernels take the pose for a constant; the part of the surface's normal would be missing.
    assert gradients[0] == pytest.approx(gradients[1], rel=1e-3, abs=1e-4)


def two_discs(gap):
    return Gaussians(
        "2d",
        torch.tensor([[0.0, 0, gap / 2], [0, 0, -gap / 2]]),
        torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.full((2, 2), 50.0),
        torch.tensor([0.5, 0.8]),
        torch.zeros(2, 1, 3),
    )


def test_distortion_of_two_sheets_is_the_closed_form():
    gap = 0.6
    view = render(two_discs(gap), CAMERA, backend="reference")
    w1, w2 = 0.5, 0.5 * 0.8
    # Discs of sigma 50 are constant across the picture to 1e-4.
    assert float(losses.depth_distortion(view)) == pytest.approx(2 * w1 * w2 * gap, rel=1e-3)
    assert float(losses.depth_distortion(view, scale=5.0)) == pytest.approx(
        2 * w1 * w2 * gap / 5, rel=1e-3
    )
