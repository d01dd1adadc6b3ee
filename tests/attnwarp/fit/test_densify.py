"""Places where splats are added and removed, and Adam's memory of those that stay."""

import math

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.fit import FitSettings
from attnwarp.fit.densify import Density, screen_gradient
from attnwarp.fit.model import NAMES, Model

EXTENT = 2.0


def splats(count=8, kind="3d", scale=0.05, opacity=0.5):
    random = torch.Generator().manual_seed(1)
    return Gaussians(
        kind, torch.randn(count, 3, generator=random), torch.randn(count, 4, generator=random),
        torch.full((count, 2 if kind == "2d" else 3), scale), torch.full((count,), opacity),
        torch.randn(count, 4, 3, generator=random),
    )  # fmt: skip


def model_and_density(start, **changes):
    """Refined at every iteration of 1,000, or of as many as ``changes`` say."""
    each = {"densify_from": 0, "densify_every": 0.001, "densify_least": 1, "iterations": 1000}
    settings = FitSettings(kind=start.kind, sh_degree=1, **{**each, **changes})
    model = Model(start, settings, EXTENT)
    return model, Density(settings, EXTENT, np.zeros(3), len(start))


def wanting(density, indices, gradient=1.0):
    """Pretend that one view was seen in which these splats had a large gradient on screen."""
    density.seen[:] = 1
    density.total[torch.tensor(indices, dtype=torch.long)] = gradient


def step(model):
    """One step along gradients that differ from splat to splat."""
    for k, tensor in enumerate(model.tensors.values()):
        tensor.grad = torch.linspace(-1, 1, tensor.numel()).reshape(tensor.shape) * (k + 1)
    model.step(0.5)


@pytest.mark.parametrize("skew", [0.0, 7.0])
def test_gradient_on_screen_is_that_of_the_pixels_for_a_loss_of_pixels(skew):
    random = np.random.default_rng(0)
    pose = Camera.look_at([3, 1, 2], [0, 0, 0], width=80, height=60, fov_y=50).world_to_camera
    camera = Camera(np.array([[64.0, skew, 31], [0, 70, 35], [0, 0, 1]]), pose, 80, 60)
    origin = np.array([0.2, -0.1, 0.3])
    means = torch.tensor(random.normal(0, 0.5, (20, 3)), requires_grad=True)
    upstream = torch.tensor(random.normal(0, 1, (20, 2)))
    # The oracle projects with torch and asks autograd for both gradients.
    c = (means + torch.tensor(origin)) @ torch.tensor(camera.rotation.T.copy()) + torch.tensor(
        camera.translation
    )
    pixels = (c @ torch.tensor(camera.K.T.copy()))[:, :2] / c[:, 2:]
    (pixels * upstream).sum().backward()
    ours = screen_gradient(means.grad, means.detach(), camera, origin, near=0.01)
    expected = (upstream * torch.tensor([40.0, 30.0])).norm(dim=1)
    torch.testing.assert_close(ours, expected.float(), rtol=1e-5, atol=0)


def test_gradient_on_screen_of_what_is_behind_the_camera_is_zero():
    camera = Camera.look_at([0, 0, 3], [0, 0, 0], width=8, height=8, fov_y=50, up=[0, 1, 0])
    means = torch.tensor([[0.0, 0, 4], [0, 0, 3], [0, 0, 0]])
    length = screen_gradient(torch.ones(3, 3), means, camera, np.zeros(3), near=0.01)
    assert (length > 0).tolist() == [False, False, True]


def test_small_splats_are_cloned_and_large_ones_split():
    start = splats(4)
    start.scales[1] = 0.5  # small is up to 0.01 of an extent of 2
    start.scales[0] = 0.01
    model, density = model_and_density(start, prune_scale=1.0)
    wanting(density, [0, 1])
    assert density.refine(model, 5, torch.Generator().manual_seed(0))
    g = model.gaussians().detach()
    # 0, 2 and 3 stay, then the clone of 0, then the halves of 1.
    assert len(g) == 6
    torch.testing.assert_close(g.means[:4], start.means[[0, 2, 3, 0]])
    torch.testing.assert_close(g.scales[4:], torch.full((2, 3), 0.5 / 1.6))
    torch.testing.assert_close(g.sh[4:], start.sh[[1, 1]])
    assert not torch.equal(g.means[4], g.means[5])


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_halves_are_drawn_from_the_splat_they_replace(kind):
    count = 4000
    start = splats(1, kind)
    scales = torch.tensor([[0.9, 0.3, 0.1]][:1])[:, : 2 if kind == "2d" else 3]
    many = Gaussians(
        kind, start.means.repeat(count, 1), start.quats.repeat(count, 1), scales.repeat(count, 1),
        start.opacities.repeat(count), start.sh.repeat(count, 1, 1),
    )  # fmt: skip
    model, density = model_and_density(many, prune_scale=10.0)
    wanting(density, range(count))
    density.refine(model, 5, torch.Generator().manual_seed(0))
    offset = (model.tensors["means"].detach() - start.means).double()
    assert len(offset) == 2 * count
    R = start.rotations()[0].double()
    sigma = torch.zeros(3, dtype=torch.float64)
    sigma[: scales.shape[1]] = scales[0].double()
    expected = R @ torch.diag(sigma**2) @ R.T
    # The standard error of a variance s^2 from n draws is s^2 sqrt(2 / n), 1.6 % of the largest
    # here; 4 of them.
    torch.testing.assert_close(
        offset.T @ offset / len(offset), expected, rtol=0, atol=4 * 0.81 * math.sqrt(2 / 8000)
    )


def test_transparent_and_huge_splats_are_removed_but_far_ones_may_be_large():
    start = splats(4, scale=0.05)
    start.opacities[0] = 0.004
    start.scales[1] = 0.3  # above 0.1 of the extent
    start.scales[2] = 0.3
    start.means[2] = torch.tensor([0.0, 0, 30.0])  # but not above 0.1 of its distance
    model, density = model_and_density(start, reset_every=0.2, reset_least=1)
    density.refine(model, 305, torch.Generator().manual_seed(0))
    torch.testing.assert_close(model.gaussians().means.detach(), start.means[[2, 3]])


def test_an_opacity_that_a_reset_lowered_is_no_reason_to_go_before_it_could_recover():
    start = splats(3, "2d")
    model, density = model_and_density(start, reset_every=0.2, reset_least=1)
    density.refine(model, 200, torch.Generator().manual_seed(0))  # to 0.01, below the floor of 0.05
    density.refine(model, 299, torch.Generator().manual_seed(0))
    assert len(model) == 3
    with pytest.raises(RuntimeError, match="every one of the 3 splats fell below prune_opacity"):
        density.refine(model, 300, torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("iterations", "first", "between"), [(300, 30, 15), (1000, 100, 50), (30_000, 3000, 1500)]
)
def test_a_fit_of_any_length_refines_from_its_share_on_at_its_share(iterations, first, between):
    # 7 % and 5 % of the iterations, by hand; never more often than each 15 iterations.
    start = splats(2)
    settings = FitSettings(kind="3d", sh_degree=1, iterations=iterations)
    model, density = Model(start, settings, EXTENT), Density(settings, EXTENT, np.zeros(3), 2)
    random = torch.Generator().manual_seed(0)
    refined = [k for k in range(first + between + 1) if density.refine(model, k, random)]
    assert refined == [first, first + between]


def test_before_the_first_reset_size_is_no_reason_to_go():
    start = splats(3, scale=0.5)
    model, density = model_and_density(start)
    density.refine(model, 5, torch.Generator().manual_seed(0))
    assert len(model) == 3


def test_a_fit_that_is_too_short_for_a_reset_removes_huge_splats_too():
    start = splats(3, scale=0.05)
    start.scales[1] = 0.3
    model, density = model_and_density(start, iterations=16, densify_until=0.5)
    density.refine(model, 4, torch.Generator().manual_seed(0))
    assert len(model) == 3
    density.refine(model, 5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(model.gaussians().means.detach(), start.means[[0, 2]])


def test_growth_stops_at_the_limit_and_prefers_the_largest_gradients():
    start = splats(6, scale=0.01)
    model, density = model_and_density(start, max_splats=8)
    density.seen[:] = 1
    density.total[:] = torch.tensor([1.0, 5, 2, 4, 3, 0])
    density.refine(model, 5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        model.gaussians().means.detach(), start.means[[0, 1, 2, 3, 4, 5, 1, 3]]
    )


def test_nothing_is_added_after_its_share_of_the_iterations():
    start = splats(3)
    model, density = model_and_density(start, iterations=100, densify_until=0.5)
    wanting(density, [0, 1, 2])
    assert not density.refine(model, 50, torch.Generator())
    assert density.refine(model, 49, torch.Generator().manual_seed(0))


def test_those_that_stay_keep_adams_memory_and_new_ones_have_none():
    start = splats(5, scale=0.01)
    model, _ = model_and_density(start)
    step(model)
    before = model.state()
    model.replace(
        torch.tensor([3, 0]), {name: tensor.detach()[[1]] for name, tensor in model.tensors.items()}
    )
    for name in NAMES:
        for moment in ("first", "second"):
            after = getattr(model, moment)[name]
            torch.testing.assert_close(after[:2], before[moment][name][[3, 0]], rtol=0, atol=0)
            assert float(after[2].abs().max()) == 0
    step(model)  # and Adam accepts what it finds


def test_a_reset_lowers_every_opacity_and_forgets_where_it_was_going():
    start = splats(3)
    start.opacities[:] = torch.tensor([0.9, 0.2, 0.006])
    model, density = model_and_density(start, reset_every=0.005, reset_least=1)
    step(model)
    was = model.gaussians().opacities.detach().clone()
    density.refine(model, 5, torch.Generator())
    now = model.gaussians().opacities.detach()
    torch.testing.assert_close(now, was.clamp_max(0.01), rtol=1e-5, atol=0)
    assert (
        float(model.first["opacity"].abs().max()) == float(model.second["opacity"].abs().max()) == 0
    )


def test_the_centres_learning_rate_falls_exponentially_with_the_scenes_size():
    model, _ = model_and_density(splats(2), lr_means=1.6e-4, lr_means_final=1.6e-6)
    for progress, expected in ((0.0, 1.6e-4), (0.5, 1.6e-5), (1.0, 1.6e-6)):
        for tensor in model.tensors.values():
            tensor.grad = torch.zeros_like(tensor)
        model.step(progress)
        assert model.rates["means"] == pytest.approx(expected * EXTENT, rel=1e-12)


def test_a_step_is_adams():
    # Kingma and Ba 2015, algorithm 1, in float64 by hand; two steps.
    model, _ = model_and_density(splats(2))
    x = model.tensors["scales"].detach().double().clone()
    m = v = torch.zeros_like(x)
    for t in (1, 2):
        g = torch.linspace(-1, 2, x.numel(), dtype=torch.float64).reshape(x.shape) * t
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        x = x - 5e-3 * (m / (1 - 0.9**t)) / ((v / (1 - 0.999**t)).sqrt() + 1e-15)
        for tensor in model.tensors.values():
            tensor.grad = torch.zeros_like(tensor)
        model.tensors["scales"].grad = g.float()
        model.step(0)
    torch.testing.assert_close(model.tensors["scales"].detach().double(), x, rtol=1e-5, atol=1e-6)


def test_scales_and_opacities_stay_where_float32_can_hold_them():
    model, _ = model_and_density(splats(2))
    with torch.no_grad():
        model.tensors["scales"][0], model.tensors["scales"][1] = -500.0, 500.0
        model.tensors["opacity"][:] = torch.tensor([-80.0, 80.0])
    for tensor in model.tensors.values():
        tensor.grad = torch.zeros_like(tensor)
    model.step(0)
    g = model.gaussians().detach()
    assert float(g.scales.min()) == pytest.approx(1e-7 * EXTENT, rel=1e-4)
    assert float(g.scales.max()) == pytest.approx(30 * EXTENT, rel=1e-4)
    assert 0 < float(g.opacities.min()) < float(g.opacities.max()) < 1
