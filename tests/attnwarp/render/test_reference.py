"""The definition itself: closed forms worked out by hand, and its gradients by finite differences
in float64.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from backends import GPU

from attnwarp import Gaussians
from attnwarp.render import constants, harmonics, render
from attnwarp.render.api import normal_from_depth
from attnwarp.render.interface import OUTPUTS

BACKENDS = ("reference", "cpu", GPU)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    ("kind", "mode", "antialiased", "channels"),
    [
        ("2d", "intersection", False, None),
        ("2d", "center", False, None),
        ("3d", "center", False, None),
        ("3d", "center", True, None),
        ("3d", "peak", False, None),
        ("3d", "peak", True, None),
        ("2d", "intersection", False, 4),
        ("3d", "center", True, 4),
    ],
)
def test_every_gradient_is_the_finite_difference(
    kind, mode, antialiased, channels, make_camera, make_splats
) -> None:
    """``channels``: of features in place of the harmonics."""
    camera = make_camera(8, 9, 7)
    # Without ties (4, 5, 7), whose order jumps, and without the splat edge-on to 1e-9 (9), whose
    # normal does.
    start = make_splats(8, kind, 16, camera, degree=2)
    start = start.select(torch.tensor([i for i in range(16) if i not in (4, 5, 7, 9)]))
    leaves = [
        t.clone() for t in (start.means, start.quats, start.scales, start.opacities, start.sh)
    ]
    # Scales apart: which axis is the shortest, the normal of a 3D splat, must not change within a
    # step.
    leaves[2] = leaves[2] * torch.linspace(1, 1.2, leaves[2].shape[1], dtype=torch.float64)
    # Inside (0, 1), so that a step to either side is a valid opacity.
    leaves[3] = leaves[3].clamp(0.01, 0.95)
    leaves += [
        torch.tensor(camera.world_to_camera),
        torch.tensor([0.2, 0.5, 0.8], dtype=torch.float64),
    ]
    generator = torch.Generator().manual_seed(0)
    if channels is not None:
        for k, shape in ((4, (len(start), channels)), (6, (channels,))):
            leaves[k] = torch.rand(shape, generator=generator, dtype=torch.float64)
    weights: dict[str, torch.Tensor] = {}

    def loss(values: list[torch.Tensor]) -> torch.Tensor:
        view = render(
            Gaussians(kind, *values[:4], values[4] if channels is None else start.sh),
            camera,
            backend="reference",
            features=None if channels is None else values[4],
            depth=mode,
            antialiased=antialiased if kind == "3d" else None,
            pose=values[5],
            background=values[6],
        )
        total = torch.zeros((), dtype=torch.float64)
        for name in OUTPUTS:
            value = getattr(view, name)
            value = torch.where(value.isnan(), 0.0, value)
            weights.setdefault(
                name, torch.randn(value.shape, generator=generator, dtype=torch.float64)
            )
            total = total + (value * weights[name]).sum()
        return total

    traced = [leaf.clone().requires_grad_() for leaf in leaves]
    gradients = torch.autograd.grad(loss(traced), traced)
    for k, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        scale = float(gradient.abs().max())
        for _ in range(3):
            direction = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
            if k == 5:
                direction[3] = 0
            expected = float((gradient * direction).sum())
            # Central differences: h^2 of truncation and 1e-16 * loss / h of rounding, about 1e-6 of
            # the gradient here.
            tolerance = 2e-5 * scale * math.sqrt(leaf.numel()) + 1e-6
            slopes: list[float] = []
            # A threshold crossed within the step would read as a slope of 1/h: the best of three
            # steps counts.
            for h in (1e-6, 1e-7, 3e-8):
                if slopes and abs(slopes[-1] - expected) <= tolerance:
                    break
                ends = []
                for sign in (1, -1):
                    moved = [t.clone() for t in leaves]
                    moved[k] = leaf + sign * h * direction
                    ends.append(float(loss(moved)))
                slopes.append((ends[0] - ends[1]) / (2 * h))
            assert min(abs(slope - expected) for slope in slopes) <= tolerance, (
                k,
                expected,
                slopes,
            )


def test_the_gradient_of_normals_from_depth_is_the_finite_difference(make_camera) -> None:
    camera = make_camera(8, 7, 6)
    generator = torch.Generator().manual_seed(0)
    depth = 3 + 0.2 * torch.rand(6, 7, generator=generator, dtype=torch.float64)
    depth[2, 4] = torch.nan
    pose = torch.tensor(camera.world_to_camera)
    undefined = normal_from_depth(depth, camera).isnan()
    # The hole takes its neighbours along; the rest of the inside is defined, or nothing was tested.
    assert int((~undefined[..., 0]).sum()) == 4 * 5 - 5

    def normals(depth: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        return normal_from_depth(depth, camera, pose)[~undefined]

    depth.requires_grad_()
    pose.requires_grad_()
    # Steps of 1e-6 in depths of 3: h^2 of truncation, 1e-16 / h of rounding; the NaN stays one and
    # must have gradient 0.
    assert torch.autograd.gradcheck(normals, (depth, pose), eps=1e-6, atol=1e-6, rtol=1e-6)
    (gradient,) = torch.autograd.grad(
        normals(depth, pose).square().sum() + normals(depth, pose).sum(), depth
    )
    assert (
        bool(gradient.isfinite().all())
        and float(gradient[2, 4]) == 0
        and float(gradient.abs().max()) > 0.1
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_splat_at_its_centre(backend, facing, front_camera) -> None:
    splat = facing([[0, 0, 4]], scales=0.5, opacities=0.6, colors=[0.2, 0.4, 0.8])
    view = render(splat, front_camera(), backend=backend, background=[1, 1, 1])
    middle = (16, 16)
    assert float(view.alpha[middle]) == pytest.approx(0.6, abs=1e-6)
    assert view.color[middle].tolist() == pytest.approx(
        [0.6 * c + 0.4 for c in (0.2, 0.4, 0.8)], abs=1e-6
    )
    assert float(view.depth[middle]) == pytest.approx(4, abs=1e-6)
    assert float(view.median_depth[middle]) == pytest.approx(4, abs=1e-6)
    assert view.normal[middle].tolist() == pytest.approx([0, 0, -0.6], abs=1e-6)
    assert float(view.distortion_ordered[middle]) == pytest.approx(0, abs=1e-9)
    # The footprint is that of a Gaussian of sigma f s / z = 5 pixels, down to 1/255.
    dx = torch.arange(33) + 0.5 - 16.5
    rho = (dx[:, None] ** 2 + dx**2) / 25
    expected = 0.6 * torch.exp(-0.5 * rho)
    expected = torch.where(expected >= constants.ALPHA_MIN, expected, 0.0)
    assert float((view.alpha - expected).abs().max()) < 1e-6
    assert torch.equal(view.valid, expected > 0)
    assert float(view.weight[0]) == pytest.approx(float(expected.sum()), rel=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_splats_one_behind_the_other(backend, facing, front_camera) -> None:
    pair = facing(
        [[0, 0, 5], [0, 0, 3]], scales=0.5, opacities=[0.7, 0.4], colors=[[1, 0, 0], [0, 1, 0]]
    )
    view = render(pair, front_camera(), backend=backend)
    near, far = 0.4, 0.6 * 0.7
    at = (16, 16)
    assert float(view.alpha[at]) == pytest.approx(near + far, abs=1e-6)
    assert view.color[at].tolist() == pytest.approx([far, near, 0], abs=1e-6)
    assert float(view.depth[at]) == pytest.approx((near * 3 + far * 5) / (near + far), abs=2e-6)
    # T before the second is 0.6 > 1/2, so the median is the second's.
    assert float(view.median_depth[at]) == pytest.approx(5, abs=1e-6)
    assert float(view.distortion_ordered[at]) == pytest.approx(2 * near * far * 2, abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tilt", [0, 30, 60, 75, 85])
def test_a_plane_of_splats_gives_the_planes_depth_by_intersection(
    backend, tilt, facing, front_camera
) -> None:
    normal = np.array([0, math.sin(math.radians(tilt)), -math.cos(math.radians(tilt))])
    side, along = np.array([1.0, 0, 0]), np.cross(normal, [1.0, 0, 0])
    rng = np.random.default_rng(0)
    # Splats wider than a pixel even when tilted by 85 degrees: narrower ones are drawn by the
    # screen filter, beyond 3.33 of their sigmas, where depth is bounded to their extent
    # (docs/method/rendering.md says what that costs).
    grid = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), -1).reshape(-1, 2) * 0.02
    grid = grid + rng.uniform(-0.005, 0.005, grid.shape)
    points = np.array([0, 0, 4.0]) + grid[:, :1] * side + grid[:, 1:] * along
    plane = facing(points, scales=0.012, opacities=0.9, normals=np.tile(normal, (len(points), 1)))
    camera = front_camera(24, 3000.0)
    view = render(plane, camera, backend=backend)
    exact = normal[2] * 4 / (torch.tensor(camera.directions()) @ torch.tensor(normal))
    # Where the ray meets the patch; the screen filter draws a little beyond its rim.
    hit = torch.tensor(camera.directions()) * exact[..., None] - torch.tensor([0, 0, 4.0])
    reach = torch.maximum((hit @ torch.tensor(side)).abs(), (hit @ torch.tensor(along)).abs())
    seen = view.valid & (reach < 0.22)
    assert int(seen.sum()) > 100
    error = (view.depth - exact).abs()[seen]
    assert float(error.max()) < 5e-5
    assert float((view.median_depth - exact).abs()[seen].max()) < 5e-5
    # By centre the same plane is pulled off by millimetres: the bias that intersection removes.
    if tilt == 60:
        by_center = render(plane, camera, backend=backend, depth="center")
        assert float((by_center.depth - exact).abs()[seen].mean()) > 0.001
    # And the surface's normal from depth is the plane's.
    result = view.normal_from_depth[seen & ~view.normal_from_depth.isnan().any(-1)].double()
    assert len(result) > 50
    assert float((result @ torch.tensor(normal)).min()) > (
        1 - 1e-9 if backend == "reference" else 0.99
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_peak_depth_of_a_thin_ellipsoid_is_that_of_its_disc(backend, facing, front_camera) -> None:
    normal = np.array([[0, math.sin(0.7), -math.cos(0.7)]])
    camera = front_camera()
    disc = render(facing([[0.1, 0, 4]], 0.4, 0.8, normals=normal), camera, backend=backend)
    thin = torch.tensor([0.4, 0.4, 1e-4])
    ball = facing([[0.1, 0, 4]], thin, 0.8, kind="3d", normals=normal)
    peak = render(ball, camera, backend=backend, depth="peak")
    both = disc.valid & peak.valid
    assert int(both.sum()) > 50
    # Thickness over extent, squared.
    assert float((disc.depth - peak.depth).abs()[both].max()) < 2e-5


def test_harmonics_are_orthonormal() -> None:
    """Independent of signs and order: the integral of Y_j Y_k over the sphere is 1 if j = k, else
    0.
    """
    nodes, weights = np.polynomial.legendre.leggauss(12)
    phi = np.arange(24) * 2 * np.pi / 24
    z, p = np.meshgrid(nodes, phi, indexing="ij")
    r = np.sqrt(1 - z**2)
    direction = torch.tensor(np.stack([r * np.cos(p), r * np.sin(p), z], -1))
    values = harmonics.basis(direction, 3).reshape(-1, 16)
    area = torch.tensor(np.repeat(weights, 24) * 2 * np.pi / 24)
    gram = values.T @ (values * area[:, None])
    assert float((gram - torch.eye(16)).abs().max()) < 1e-12


def test_harmonics_agree_with_scipy() -> None:
    from scipy.special import sph_harm_y

    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(order), polar, azimuth)
            # scipy's carry the Condon-Shortley sign, which is that of the splat files' convention
            # for odd orders.
            part = y.imag if order < 0 else y.real
            expected.append(part * (math.sqrt(2) if order else 1))
    ours = harmonics.basis(torch.tensor(d), 3).numpy().T
    assert np.abs(ours - np.array(expected)).max() < 1e-12


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_splat_of_the_sky_is_drawn_like_any_other_and_counts_in_colour_alone(
    backend, make_camera, make_splats
) -> None:
    """Splats of the sky lie behind all others here, so plain rendering has their colour."""
    camera = make_camera(8, 9, 7)
    splats = make_splats(8, "3d", 11, camera).to(dtype=torch.float32)
    away = splats.means - torch.from_numpy(camera.position).to(splats.means)
    splats.means[::3] += 9 * away[::3]
    splats.scales[::3] *= 10
    sky = torch.arange(11) % 3 == 0
    far = (10 * float(away[sky].norm(dim=1).min()) + float(away[~sky].norm(dim=1).max())) / 2
    whole, scene, both = (
        render(each, camera, backend=backend, background=[0.2, 0.4, 0.6])
        for each in (splats, splats.select(~sky), dataclasses.replace(splats, far=far))
    )
    torch.testing.assert_close(both.color, whole.color, rtol=0, atol=2e-4)  # where a ray ends
    for name in ("alpha", "depth", "median_depth", "normal", "distortion_ordered"):
        torch.testing.assert_close(getattr(both, name), getattr(scene, name), equal_nan=True)
