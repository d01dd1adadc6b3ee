"""Depth distortion against sums over all pairs, in NumPy from the papers' formulas."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from backends import GPU
from rounding import prepared

from attnwarp import Camera, Gaussians
from attnwarp.losses import depth_distortion
from attnwarp.render import reference, render

BACKENDS = ("cpu", "reference", GPU)


def crossing_discs(count: int, seed: int) -> Gaussians:
    """Tilted discs of sigma 0.3 to 0.8 at depths of 2 to 4, which cross one another."""
    rng = np.random.default_rng(seed)
    means = np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)), rng.uniform(2, 4, count)])
    axis, angle = rng.normal(size=(count, 3)) * [1, 1, 0.2], rng.uniform(0.2, 1.0, count)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    quats = np.column_stack([np.cos(angle / 2), axis * np.sin(angle / 2)[:, None]])
    scales, opacities = rng.uniform(0.3, 0.8, (count, 2)), rng.uniform(0.05, 0.5, count)
    parts = (means, quats, scales, opacities, np.zeros((count, 1, 3)))
    return Gaussians("2d", *(torch.tensor(part) for part in parts))


def front_camera(width: int, height: int) -> Camera:
    K = np.array([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]])
    return Camera(K, np.eye(4), width, height)


def weights_and_depths(splats: Gaussians, camera: Camera):
    """(P, N) weights and depths by ray-disc intersection, front to back by the centres' depth."""
    order = np.argsort(splats.means[:, 2].numpy(), kind="stable")
    means, scales, quats, opacities = (
        part.numpy()[order]
        for part in (splats.means, splats.scales, splats.quats, splats.opacities)
    )
    w, x, y, z = quats.T
    # Columns of the rotation: the discs' axes and their normals.
    u_axis = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    v_axis = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
    normal = np.cross(u_axis, v_axis)
    rays = camera.directions().reshape(-1, 3)
    depth = (normal * means).sum(1) / (rays @ normal.T)
    offset = depth[..., None] * rays[:, None] - means
    u, v = ((offset * axis).sum(-1) for axis in (u_axis, v_axis))
    rho = (u / scales[:, 0]) ** 2 + (v / scales[:, 1]) ** 2
    alpha = opacities * np.exp(-rho / 2)
    alpha[(alpha < 1 / 255) | (depth <= 0)] = 0
    # No disc of these is so small or so steep that the screen filter draws it.
    pixels = rays[:, None, :2] * 30 - 30 * means[:, :2] / means[:, 2:]
    assert (rho <= 2 * (pixels**2).sum(-1) + 1e-9)[alpha > 0].all()
    before = np.cumprod(np.column_stack([np.ones(len(rays)), 1 - alpha[:, :-1]]), axis=1)
    assert before.min() > 1e-4  # no ray ends
    return alpha * before, depth


def over_all_pairs(splats: Gaussians, camera: Camera) -> np.ndarray:
    """(H, W) sum_ij w_i w_j |z_i - z_j|."""
    w, z = weights_and_depths(splats, camera)
    total = np.einsum("pi,pj,pij->p", w, w, np.abs(z[:, :, None] - z[:, None, :]))
    return total.reshape(camera.height, camera.width)


def over_those_in_front(splats: Gaussians, camera: Camera) -> np.ndarray:
    """(H, W) 2 sum_i w_i |sum_{j<i} w_j (z_i - z_j)|, j composited before i."""
    w, z = weights_and_depths(splats, camera)
    gaps = np.tril(w[:, None] * (z[:, :, None] - z[:, None, :]), -1).sum(-1)
    return 2 * (w * np.abs(gaps)).sum(1).reshape(camera.height, camera.width)


def leaves_of(splats: Gaussians) -> Gaussians:
    names = ("means", "scales", "opacities")
    return dataclasses.replace(
        splats, **{name: getattr(splats, name).clone().requires_grad_() for name in names}
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("width", "height"), [(32, 16), (19, 21)])  # whole tiles and parts
def test_it_is_the_sum_over_those_in_front(backend: str, width: int, height: int) -> None:
    camera, splats = front_camera(width, height), crossing_discs(16, seed=3)
    expected = over_those_in_front(splats, camera)
    view = render(splats, camera, backend=backend)
    assert np.abs(view.distortion_ordered.double().numpy() - expected).max() < 2e-6
    mean = float(depth_distortion(view, scale=2.0))
    assert mean == pytest.approx(expected.mean() / 2, rel=1e-5)


def test_the_papers_sum_is_over_all_pairs_and_more_where_splats_cross() -> None:
    camera, splats = front_camera(32, 16), crossing_discs(16, seed=3)
    expected = over_all_pairs(splats, camera)
    paper = reference.distortion_l1(prepared(splats, camera)).numpy()
    assert np.abs(paper - expected).max() < 2e-6
    ordered = render(splats, camera).distortion_ordered.double().numpy()
    assert (ordered < paper + 2e-6).all() and ordered.mean() < 0.95 * paper.mean()


@pytest.mark.parametrize("backend", BACKENDS)
def test_its_gradient_is_that_of_the_sum(backend: str) -> None:
    """Oracle: central differences of the sum in float64."""
    camera, splats = front_camera(14, 12), crossing_discs(10, seed=5)
    upstream = np.random.default_rng(0).normal(size=(12, 14))
    leaves = leaves_of(splats)
    view = render(leaves, camera, backend=backend)
    # Other outputs have gradients of their own beside it.
    loss = (view.distortion_ordered * torch.tensor(upstream)).sum()
    (loss + 0 * view.color.sum()).backward()
    step = 1e-6
    for name in ("means", "scales", "opacities"):
        values = getattr(splats, name)
        expected = np.zeros(tuple(values.shape))
        for index in np.ndindex(*values.shape):
            sums = []
            for sign in (1, -1):
                moved = values.clone()
                moved[index] += sign * step
                changed = dataclasses.replace(splats, **{name: moved})
                sums.append((over_those_in_front(changed, camera) * upstream).sum())
            expected[index] = (sums[0] - sums[1]) / (2 * step)
        error = np.abs(getattr(leaves, name).grad.double().numpy() - expected).max()
        assert error < 2e-5 * np.abs(expected).max(), name


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_does_not_depend_on_which_of_two_sheets_is_composited_first(backend: str) -> None:
    """Two planes, constant across the picture: moved in its own plane, the second comes first."""
    tilt = math.radians(40)
    quats = [[math.cos(s * tilt / 2), 0, math.sin(s * tilt / 2), 0] for s in (1, -1)]
    along = np.array([math.cos(tilt), 0, math.sin(tilt)])
    camera, views = front_camera(16, 16), []
    for shift in (-0.2, 0.2):
        means = torch.tensor(np.stack([[0, 0, 3.0], [0, 0, 3.0] + shift * along]))
        discs = Gaussians(
            "2d", means, torch.tensor(quats), torch.full((2, 2), 1e4, dtype=torch.float64),
            torch.full((2,), 0.5), torch.zeros(2, 1, 3),
        )  # fmt: skip
        views.append(render(discs, camera, backend=backend))
    column = np.arange(16) + 0.5 - 8
    slopes = [math.tan(s * tilt) for s in (1, -1)]
    depths = [3 / (1 + slope * column / 30) for slope in slopes]
    expected = 2 * 0.5 * 0.25 * np.abs(depths[0] - depths[1])
    for view in views:
        ordered = view.distortion_ordered[4].double().numpy()
        np.testing.assert_allclose(ordered, expected, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_disc_cannot_lower_the_distortion_by_growing_far_behind_what_is_composited_after_it(
    backend: str,
) -> None:
    """A wall at depth 5, and a sky 0.5 overhead whose centre is at depth 1: a ray meets it behind
    the wall, the farther the lower it goes.

    Oracle: 2 w_sky w_wall |z_sky - z_wall| of two planes.
    """
    wall_quat, sky_quat = [1.0, 0, 0, 0], [math.cos(math.pi / 4), math.sin(math.pi / 4), 0, 0]
    camera = front_camera(4, 16)
    means = torch.tensor([[0, 0, 5.0], [0, -0.5, 1.0]], dtype=torch.float64)
    scales = torch.tensor([[1e4, 1e4], [100.0, 100.0]], dtype=torch.float64, requires_grad=True)
    discs = Gaussians(
        "2d", means, torch.tensor([wall_quat, sky_quat]).double(), scales,
        torch.full((2,), 0.5).double(), torch.zeros(2, 1, 3).double(),
    )  # fmt: skip
    view = render(discs, camera, backend=backend)
    row, z = 7, 30.0  # half a pixel above the middle, of 30 px of focal length
    sky = 0.5 * math.exp(-((z - 1) ** 2 + (z / 60) ** 2) / 2 / 100**2)
    expected = 2 * sky * (1 - sky) * 0.5 * (z - 5)
    ordered = view.distortion_ordered.detach()
    assert float(ordered[row, 2]) == pytest.approx(expected, rel=1e-5)
    assert float(ordered.min()) >= 0
    view.distortion_ordered[row, 2].backward()
    assert float(scales.grad[1].min()) > 0


def test_the_order_of_the_splats_in_the_input_changes_no_bit() -> None:
    camera, splats = front_camera(33, 17), crossing_discs(40, seed=8)
    turned = splats.select(torch.tensor(np.random.default_rng(1).permutation(40)))
    pictures = [render(each, camera).distortion_ordered for each in (splats, turned)]
    assert torch.equal(*pictures)


def test_sheets_far_away_and_close_together_keep_their_digits() -> None:
    """Crossing discs moved 1000 units back: gaps of 1e-3 of the depth."""
    splats = crossing_discs(12, seed=2)
    far = dataclasses.replace(splats, means=splats.means + torch.tensor([0, 0, 1000.0]))
    K = np.array([[9000.0, 0, 8], [0, 9000, 8], [0, 0, 1]])
    camera = Camera(K, np.eye(4), 16, 16)
    expected = render(far, camera, backend="reference").distortion_ordered
    error = (render(far, camera).distortion_ordered - expected).abs().max()
    assert float(error) < 1e-4 * float(expected.max())


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_picture_of_nothing_has_none(backend: str) -> None:
    nothing = crossing_discs(2, seed=0).select(torch.tensor([], dtype=torch.long))
    assert not render(nothing, front_camera(5, 4), backend=backend).distortion_ordered.any()
