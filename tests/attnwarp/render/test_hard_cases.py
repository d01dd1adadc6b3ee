"""The numerically hard cases of rendering, each by name; both backends unless one of them is the
oracle. Those whose oracle draws single pixels are in attnwarp_eval.stability, which tests there run.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from backends import GPU

from attnwarp import Camera, Gaussians
from attnwarp.render import binned, constants, render
from attnwarp.render.interface import OUTPUTS

BACKENDS = ("reference", "cpu", GPU)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tilt", [89.0, 89.9, 89.99, 89.9999, 90.0])
def test_case_2_an_edge_on_splat_stays_within_its_own_extent(
    backend, tilt, facing, front_camera
) -> None:
    angle = math.radians(tilt)
    sigma = 0.1
    splat = facing([[0, 0, 4]], sigma, 0.9, normals=[[math.sin(angle), 0, -math.cos(angle)]])
    view = render(splat, front_camera(21, 100.0), backend=backend)
    assert bool(torch.isfinite(view.depth[view.valid]).all())
    assert int(view.valid.sum()) > 5
    reach = constants.EXTENT_SIGMAS * sigma * math.sin(angle)
    assert float((view.depth[view.valid] - 4).abs().max()) <= reach * (1 + 1e-5)
    # Along the disc it is drawn by the screen filter: never less than that, at the centre exactly
    # the opacity.
    assert float(view.alpha[10, 10]) == pytest.approx(0.9, abs=1e-5)
    assert float(view.alpha[10, 11]) >= 0.9 * math.exp(-1) - 1e-5


def test_case_2_edge_on_weights_agree_with_float64(facing, front_camera) -> None:
    rng = np.random.default_rng(0)
    tilts = np.pi / 2 - 10.0 ** rng.uniform(-9, -1, 60)
    roll = rng.uniform(0, 2 * np.pi, 60)
    normals = np.stack(
        [np.sin(tilts) * np.cos(roll), np.sin(tilts) * np.sin(roll), -np.cos(tilts)], -1
    )
    points = np.stack(
        [rng.uniform(-0.3, 0.3, 60), rng.uniform(-0.3, 0.3, 60), rng.uniform(2, 6, 60)], -1
    )
    splats = facing(points, 0.1, 0.3, normals=normals)
    camera = front_camera(31, 100.0)
    exact, fast = render(splats, camera, backend="reference"), render(splats, camera, backend="cpu")
    # Up to the pairs on the 1/255 threshold, of which there is none here.
    assert float((exact.weight - fast.weight).abs().max()) < 1e-5 * float(exact.weight.max())
    assert float((exact.alpha - fast.alpha).abs().max()) < 1e-5


@pytest.mark.parametrize("backend", BACKENDS)
def test_case_4_a_disc_whose_centre_is_behind_the_camera_is_not_drawn(
    backend, facing, front_camera
) -> None:
    """A ceiling whose plane is met in front, in each row above the middle."""
    camera = front_camera(21, 30.0)
    wall = facing([[0, 0, 4]], 0.5, 0.8)
    both = facing(
        [[0, 0, 4], [0, -1, -0.5]], [[0.5] * 2, [9.0] * 2], 0.8, normals=[[0, 0, -1], [0, 1, 0]]
    )
    ahead = both.means.clone()
    ahead[1, 2] = 0.5
    assert bool((render(dataclasses.replace(both, means=ahead), camera).alpha[0] > 0.7).all())
    leaves = {
        name: getattr(both, name).requires_grad_() for name in ("means", "scales", "opacities")
    }
    view, alone = render(both, camera, backend=backend), render(wall, camera, backend=backend)
    for name in OUTPUTS[:-1]:
        expected, actual = getattr(alone, name), getattr(view, name)
        assert torch.equal(actual.detach().nan_to_num(-1), expected.nan_to_num(-1)), name
    (view.color.sum() + view.depth.nansum() + view.distortion_ordered.sum()).backward()
    assert all(not bool(leaf.grad[1].any()) for leaf in leaves.values())


@pytest.mark.parametrize("scale", [1e-3, 1e3])
@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_case_10_the_scale_of_the_scene_changes_nothing(
    kind, scale, make_camera, make_splats
) -> None:
    camera = make_camera(4, 40, 30)
    splats = make_splats(4, kind, 40, camera)
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= scale
    large = dataclasses.replace(splats, means=splats.means * scale, scales=splats.scales * scale)
    here = render(splats, camera, near=0.05)
    there = render(large, Camera(camera.K, pose, 40, 30), near=0.05 * scale)
    assert torch.equal(here.valid, there.valid)
    assert float((here.color - there.color).abs().max()) < 1e-5
    spread = there.distortion_ordered / scale
    assert float((here.distortion_ordered - spread).abs().max()) < 1e-5
    assert float((here.depth - there.depth / scale).abs()[here.valid].max()) < 1e-5


@pytest.mark.parametrize("alpha", [0.005, 0.3])
def test_case_20_a_hundred_thousand_splats_on_one_ray(alpha, facing, front_camera) -> None:
    count = 100_000
    means = np.zeros((count, 3))
    means[:, 2] = np.linspace(2, 6, count)
    view = render(facing(means, 1.0, alpha, kind="2d"), front_camera(1, 30.0))
    logs = np.cumsum(np.full(count, np.log1p(-alpha)))
    stop = int(np.searchsorted(-logs, -np.log(constants.TRANSMITTANCE_STOP)))
    expected = -np.expm1(logs[min(stop, count - 1)])
    assert abs(float(view.alpha[0, 0]) - expected) < 1e-4
    assert abs(float(view.weight.double().sum()) - float(view.alpha[0, 0])) < 2e-4
    # The stop is there for a reason: the work is that of the splats before it, and a first attempt
    # with the nearest.
    assert view.counters["tile_pairs"] <= stop + 8 + binned.FRONT


@pytest.mark.parametrize("backend", BACKENDS)
def test_case_22_depth_is_undefined_where_nothing_is_drawn(backend, facing, front_camera) -> None:
    view = render(facing([[0, 0, 4.0]], 0.1, 0.012), front_camera(), backend=backend)
    assert torch.equal(view.depth.isnan(), ~view.valid)
    assert torch.equal(view.median_depth.isnan(), ~view.valid)
    assert 0 < int(view.valid.sum()) < view.valid.numel()
    # Faint, but defined to the last digit: dividing by a clamped weight would read half of it.
    assert float((view.depth[view.valid] - 4).abs().max()) < 1e-6
    empty = render(facing([[0, 0, 4.0]], 0.1, 0.003), front_camera(), backend=backend)
    assert not bool(empty.valid.any()) and float(empty.alpha.max()) == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_case_23_a_permutation_of_the_input_changes_nothing(
    kind, backend, make_camera, make_splats
) -> None:
    camera = make_camera(6, 30, 20)
    splats = make_splats(6, kind, 60, camera)
    splats.means[20:50] = torch.tensor(
        camera.position
        + np.c_[np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2)), np.full(30, 3.0)]
        @ camera.rotation
    )
    # Without the twins (7 = 8): which of two equal splats is in front has no answer.
    splats = splats.select(torch.tensor([i for i in range(60) if i != 7]))
    first = render(splats, camera, backend=backend)
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        shuffle = torch.randperm(59, generator=generator)
        other = render(splats.select(shuffle), camera, backend=backend)
        for name in OUTPUTS[:-1]:
            a, b = getattr(first, name), getattr(other, name)
            # The reference sums over the splats in their order: the same bits for the same order.
            assert torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)), name
        assert torch.equal(first.weight[shuffle], other.weight)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("kind", ["2d", "3d"])
@pytest.mark.parametrize("far", [30.0, 1e3, 3e4])
def test_the_outline_of_a_huge_splat_far_outside_of_the_picture_is_not_lost(kind, far) -> None:
    """Its edge crosses the picture; outlines are found in float32 and must then be taken wider.

    The edge, where alpha is 1/255, is put through the picture: by bisection of the splat's size in
    the float64 definition, until a third to two thirds of the pixels are inside.
    """
    camera = Camera.look_at([0, 0, 0], [0, 0, 1], width=64, height=48, fov_y=40, up=[0, -1, 0])
    random = np.random.default_rng(0)
    crossed = 0
    for angle in random.uniform(0, 2 * np.pi, 6):
        means = torch.tensor([[far * np.cos(angle), far * np.sin(angle), 5.0]]).double()

        def splat_of(sigma: float, means: torch.Tensor = means) -> Gaussians:
            return Gaussians(
                kind,
                means,
                torch.tensor([[1.0, 0, 0, 0]]).double(),
                torch.full((1, 2 if kind == "2d" else 3), sigma, dtype=torch.float64),
                torch.ones(1).double(),
                torch.zeros(1, 1, 3).double(),
            )

        low, high = far / 20, far
        for _ in range(60):
            splat = splat_of((low + high) / 2)
            truth = render(splat, camera, backend="reference").alpha
            inner = truth > constants.ALPHA_MIN * (1 + 1e-4)
            share = float(inner.double().mean())
            if 1 / 3 < share < 2 / 3:
                break
            low, high = ((low + high) / 2, high) if share < 0.5 else (low, (low + high) / 2)
        crossed += bool(inner.any()) and not bool(inner.all())
        actual = render(splat, camera, backend="cpu").alpha.double()
        assert float((actual - truth)[inner].abs().max()) < 1e-6
    assert crossed == 6
