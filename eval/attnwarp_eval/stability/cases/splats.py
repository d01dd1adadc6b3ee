"""Hard cases of rendering: splats edge-on, tiny, huge, opaque, invisible, in great numbers."""

from __future__ import annotations

import dataclasses
import math

import mpmath
import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import constants
from attnwarp_eval.stability.case import Bound, Case, Way
from attnwarp_eval.stability.rendered import (
    ALPHA,
    RENDERERS,
    UNDECIDED,
    Shot,
    against_exact,
    front_camera,
    render_bounds,
    splats,
)

CROSS = [(16, 16), (16, 17), (15, 16), (17, 18), (19, 16), (16, 13)]
"""Pixels around the middle of a picture of 33 x 33."""

MP = "the renderer's formulas in mpmath with 50 digits, gradients by central differences"


def _edge_on(tilt: float) -> Shot:
    angle = math.radians(tilt)
    splat = splats([[0, 0, 4]], 0.1, 0.9, normals=[[math.sin(angle), 0, -math.cos(angle)]])
    pixels = [(10, 10), (10, 11), (9, 10), (12, 9), (10, 9), (13, 10)]
    return Shot(splat, front_camera(21, 100.0), pixels)


def _far_world(offset: float) -> Shot:
    shift = [offset, -offset, offset / 2]
    base = splats([[0, 0, 0], [0.2, 0.1, -1]], 0.3, [0.6, 0.8], normals=[[0.6, 0, -0.8]] * 2)
    camera = Camera.look_at([1.1, 2.3, 3], [0, 0, 0], width=33, height=33, fov_y=45)
    moved = dataclasses.replace(base, origin=np.array(shift))
    return Shot(moved, camera.moved(shift), CROSS, unmoved=Shot(base, camera, CROSS))


def _quaternion(length: float) -> Shot:
    turn = np.array([math.cos(0.4), 0, math.sin(0.4), 0]) * length
    return Shot(splats([[0, 0, 4]], [0.5, 0.2], 0.8, quats=[turn]), front_camera(), CROSS)


def _opacity(kind: str):  # type: ignore[no-untyped-def]
    def build(opacity: float) -> Shot:
        made = splats([[0, 0, 3], [0, 0, 4]], 0.3, [opacity, 0.5], kind=kind)
        return Shot(made, front_camera(), CROSS)

    return build


def _needle(thickness: float) -> Shot:
    scales = torch.tensor([thickness, 0.3, thickness], dtype=torch.float64)
    turn = [math.cos(0.2), 0.1, 0.05, math.sin(0.2)]
    return Shot(splats([[0, 0, 4]], scales, 0.8, kind="3d", quats=[turn]), front_camera(), CROSS)


def _floor(sigma: float) -> Shot:
    camera = Camera.look_at([0, 0, 1], [0, 5, 1], width=48, height=40, fov_y=80)
    floor = Gaussians(
        "2d",
        torch.zeros(1, 3, dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        torch.full((1, 2), sigma, dtype=torch.float64),
        torch.full((1,), 0.9, dtype=torch.float64),
        torch.zeros(1, 1, 3, dtype=torch.float64),
    )
    return Shot(floor, camera, [(19, 24), (20, 24), (21, 10), (25, 40), (39, 24), (0, 24)])


def _faint(opacity: float) -> Shot:
    made = splats([[0, 0, 4], [0.05, 0, 6]], 0.1, opacity, normals=[[0.6, 0, -0.8]] * 2)
    return Shot(made, front_camera(), CROSS)


def _scale(exponent: float) -> Shot:
    scale = 2.0**exponent
    base = splats([[0, 0, 4], [0.2, 0.1, 5]], 0.3, [0.6, 0.8], normals=[[0.6, 0, -0.8]] * 2)
    large = dataclasses.replace(base, means=base.means * scale, scales=base.scales * scale)
    return Shot(large, front_camera(), CROSS, {"near": 0.01 * scale})


def _ratio(ratio: float) -> Shot:
    # The row of pixel centres lies 0.7 sigma from the disc's long axis, where alpha is steepest.
    thin = 0.3 / ratio
    made = splats([[0, -0.7 * thin, 4]], [0.3, thin], 0.8)
    return Shot(made, front_camera(), [(16, 16), (16, 17), (16, 14)])


def _near(near: float) -> Shot:
    made = _floor(100.0)
    return dataclasses.replace(made, options={"near": near})


def _antialiased(sigma: float) -> Shot:
    made = splats([[0.01, 0.02, 4]], sigma * 4 / 40, 1.0, kind="3d")
    return Shot(made, front_camera(), CROSS, {"antialiased": True})


def _duplicates(count: float) -> Shot:
    made = splats([[0.05, 0, 4]] * int(count), 0.3, 0.1, normals=[[0.6, 0, -0.8]] * int(count))
    return Shot(made, front_camera(), CROSS[:3])


def _distortion(gap: float, way: Way) -> float:
    """Error of w_i w_j |z_i - z_j| over all pairs of facing discs on one ray, or of its gradient.

    On the middle ray alpha is the opacity, so weights are powers and depths are as stored.
    """
    opacity, count, depth = 0.3, 6, 4.0
    means = np.zeros((count, 3))
    means[:, 2] = depth * (1 + gap * np.random.default_rng(0).permutation(count))
    made = Shot(splats(means, 1.0, opacity), front_camera(1, 30.0), [(0, 0)])
    base = made.gaussians.to(dtype=way.dtype)
    a, z = float(base.opacities[0].double()), base.means[:, 2].double().numpy()
    w = np.empty(count)
    w[np.argsort(z, kind="stable")] = a * (1 - a) ** np.arange(count)
    pairs, steps = np.outer(w, w), z[:, None] - z
    if way.direction == "forward":
        exact = math.fsum((pairs * abs(steps)).ravel())
        return abs(float(made.render(way, base).distortion_l1[0, 0]) - exact) / depth
    means_of = base.means.clone().requires_grad_()
    made.render(way, dataclasses.replace(base, means=means_of)).distortion_l1.sum().backward()
    assert means_of.grad is not None
    # Where depths are equal, any slope between -1 and 1 is a subgradient; pairs cancel in the sum.
    slopes = means_of.grad[:, 2].double().numpy()
    apart = np.abs(slopes - 2 * (pairs * np.sign(steps)).sum(axis=1))
    free = 2 * (pairs * ((steps == 0) & ~np.eye(count, dtype=bool))).sum(axis=1)
    return float(max((apart - free).max(), abs(slopes.sum())))


def _deep_ray(count: float, way: Way) -> float:
    """Transmittance of equal splats on one ray, and its gradient, against powers of 1 - a."""
    n, opacity = int(count), 0.005
    means = np.zeros((n, 3))
    means[:, 2] = np.linspace(2, 6, n)
    made = Shot(splats(means, 1.0, opacity), front_camera(1, 30.0), [(0, 0)])
    base = made.gaussians.to(dtype=way.dtype)
    alpha = float(base.opacities[0].double())
    # The ray ends behind the splat that brings the transmittance to the declared limit.
    stop = math.ceil(math.log(constants.TRANSMITTANCE_STOP) / math.log1p(-alpha))
    drawn = min(n, stop)
    if way.direction == "forward":
        view = made.render(way, base)
        exact = -math.expm1(drawn * math.log1p(-alpha))
        total = float(view.weight.double().sum())
        return max(abs(float(view.alpha[0, 0]) - exact), abs(total - float(view.alpha[0, 0])) / 2)
    opacities = base.opacities.clone().requires_grad_()
    view = made.render(way, dataclasses.replace(base, opacities=opacities))
    view.alpha.sum().backward()
    assert opacities.grad is not None
    expected = np.where(np.arange(n) < drawn, math.exp((drawn - 1) * math.log1p(-alpha)), 0)
    error = np.linalg.norm(opacities.grad.double().cpu().numpy() - expected)
    return float(error / np.linalg.norm(expected))


def _opaque_stack(opacity: float, way: Way) -> float:
    """Coverage of 40 splats, against a product that no rule ends."""
    means = np.zeros((40, 3))
    means[:, 2] = np.linspace(2, 6, 40)
    made = Shot(splats(means, 1.0, opacity), front_camera(1, 30.0), [(0, 0)])
    with mpmath.workdps(50):
        stored = mpmath.mpf(float(made.gaussians.to(dtype=way.dtype).opacities[0].double()))
        exact = 1 - (1 - min(stored, mpmath.mpf(constants.ALPHA_MAX))) ** 40
        return float(abs(exact - mpmath.mpf(float(made.render(way).alpha[0, 0]))))


def _permuted(count: float, way: Way) -> float:
    """Error of the colour of splats of equal depth; infinite where it depends on their order in
    memory.
    """
    n, depth, camera = int(count), 4.0, front_camera()
    rng = np.random.default_rng(n)
    means = np.c_[rng.uniform(-1, 1, (n, 2)), np.full(n, depth)]
    scales, colors = rng.uniform(0.1, 0.6, (n, 2)), rng.uniform(0, 1, (n, 3))
    made = splats(means, scales, 0.4, colors=colors).to(dtype=way.dtype)
    shot = Shot(made, camera, CROSS)
    first = shot.render(way)
    for seed in range(3):
        order = torch.from_numpy(np.random.default_rng(seed).permutation(n))
        other = shot.render(way, made.select(order))
        for name in ("color", "alpha", "depth", "median_depth"):
            a, b = (getattr(view, name).nan_to_num(-1) for view in (first, other))
            if not torch.equal(a, b):
                return math.inf
    expected, decided = _facing_discs(made, colors, camera, depth)
    return float(np.abs(first.color.double().numpy() - expected)[decided].max())


def _facing_discs(
    made: Gaussians, colors: np.ndarray, camera: Camera, depth: float
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) colour of discs that face the camera at one depth, splat by splat in float64, and
    (H, W) bool where no cut-off is too close to call.

    Equal depths are drawn by x: the order's definition, whose first key this is. Discs here are
    wider than a pixel, so that the screen filter has no say.
    """
    means, scales = (value.double().numpy() for value in (made.means, made.scales))
    points = camera.directions() * depth
    color = np.zeros((camera.height, camera.width, 3))
    before = np.ones((camera.height, camera.width))
    decided = np.ones(before.shape, bool)
    for i in np.argsort(means[:, 0]):
        rho = (((points[..., :2] - means[i, :2]) / scales[i]) ** 2).sum(-1)
        alpha = float(made.opacities[i].double()) * np.exp(-rho / 2)
        decided &= np.abs(alpha - constants.ALPHA_MIN) > UNDECIDED
        decided &= np.abs(before / constants.TRANSMITTANCE_STOP - 1) > 1e-3
        drawn = (alpha >= constants.ALPHA_MIN) & (before > constants.TRANSMITTANCE_STOP)
        alpha = np.where(drawn, np.minimum(alpha, constants.ALPHA_MAX), 0.0)
        color += (before * alpha)[..., None] * colors[i]
        before = before * (1 - alpha)
    return color, decided


def _coverage(sigma: float, way: Way) -> float:
    """Mean coverage of a splat over the places of its centre in a pixel, against its integral."""
    steps, apart, focal, depth = 6, 12, 40.0, 4.0
    size = steps * apart
    place = (np.arange(steps) + 0.5) * apart + (np.arange(steps) + 0.5) / steps
    x, y = np.meshgrid(place, place)
    pixels = np.stack([x.ravel() - size / 2, y.ravel() - size / 2], -1)
    means = np.c_[pixels * depth / focal, np.full(len(pixels), depth)]
    # Flat across the view: a splat as deep as wide is magnified toward the picture's border.
    flat = torch.tensor([1, 1, 1e-9], dtype=torch.float32) * sigma * depth / focal
    made = splats(means, flat, 1.0, kind="3d")
    shot = Shot(made, front_camera(size, focal), [], {"antialiased": True})
    mean = float(shot.render(way).alpha.double().sum()) / len(means)
    integral = 2 * math.pi * sigma**2
    lost = 2 * math.pi * (sigma**2 + constants.BLUR_3D) * constants.ALPHA_MIN
    return abs(mean - max(integral - lost, 0.0)) / integral


FORWARD = tuple(way for way in RENDERERS if way.direction == "forward")

CASES = [
    Case(
        2,
        "edge_on_splat",
        "A flat splat seen edge-on",
        input="a disc of sigma 0.1 at depth 4, turned away from the camera",
        oracle=MP,
        hardness="tilt, degrees",
        levels=(0, 60, 80, 89, 89.9, 89.99, 89.999, 89.9999, 89.99999),
        required=89.99,
        required_backward=80,
        quick=(60, 89, 89.999),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_edge_on, ("alpha",)),
        limit="the disc is thinner than 0.01 px; pixels' positions are float32",
    ),
    Case(
        2,
        "edge_on_depth",
        "The depth of a flat splat seen edge-on",
        input="the disc of `edge_on_splat`",
        oracle=MP,
        hardness="tilt, degrees",
        levels=(0, 60, 80, 89, 89.9, 89.99, 89.999, 89.9999, 89.99999),
        required=89.9,
        required_backward=80,
        quick=(60, 89, 89.999),
        bounds=render_bounds(
            Bound("relative depth", 1e-5, "the tilted plane's slope multiplies rounding errors")
        ),
        ways=RENDERERS,
        measure=against_exact(_edge_on, ("depth",)),
        limit="depth changes by its whole extent within 0.01 px, and pixels' positions are float32",
    ),
    Case(
        9,
        "far_world_splats",
        "Splats in a world far from its origin",
        input="two discs whose origin, and the camera's, are moved",
        oracle=MP + ", where the world was not moved",
        hardness="offset of the world, scene units",
        levels=(0, 1e2, 1e4, 1e6, 1e7, 1e8, 1e9, 1e11, 1e13),
        required=1e9,
        quick=(1e2, 1e6, 1e9),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_far_world),
        limit="the camera's translation is rounded: 1e11 is stored to 1.5e-5",
    ),
    Case(
        16,
        "short_quaternion",
        "A quaternion of length almost 0",
        input="a turned disc whose quaternion is scaled",
        oracle=MP,
        hardness="length of the quaternion",
        levels=(1, 1e-3, 1e-6, 1e-12, 1e-18, 1e-22, 1e-30, 1e-38, 1e-44, 0),
        required=1e-18,
        quick=(1, 1e-12, 0),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_quaternion),
        must_refuse=lambda level, way: level == 0,
        limit="the squares of a float32 below 1e-23 underflow, so its length is 0",
    ),
    *(
        Case(
            18,
            f"opacity_to_0_{kind}",
            f"A {kind.upper()} splat whose opacity goes to 0",
            input="a splat before another one of opacity 0.5",
            oracle=MP,
            hardness="opacity",
            levels=(0.5, 0.1, 0.01, 0.004, 1e-3, 1e-6, 1e-12, 0),
            required=0,
            quick=(0.5, 0.004, 0),
            bounds=render_bounds(),
            ways=RENDERERS,
            measure=against_exact(_opacity(kind)),
        )
        for kind in ("2d", "3d")
    ),
    *(
        Case(
            19,
            f"opacity_to_1_{kind}",
            f"A {kind.upper()} splat whose opacity goes to 1",
            input="a splat before another one of opacity 0.5",
            oracle=MP,
            hardness="opacity",
            levels=(0.9, 0.98, 0.995, 0.9999, 1),
            required=1,
            quick=(0.9, 1),
            bounds=render_bounds(),
            ways=RENDERERS,
            measure=against_exact(_opacity(kind)),
        )
        for kind in ("2d", "3d")
    ),
    Case(
        22,
        "faint_depth",
        "Expected depth where alpha is almost 0",
        input="two faint discs, one behind the other",
        oracle=MP,
        hardness="opacity of both",
        levels=(0.5, 0.1, 0.02, 0.008, 0.005, 0.0045, 0.003),
        required=0.003,
        quick=(0.5, 0.005, 0.003),
        bounds=render_bounds(
            Bound("relative depth", 1e-5, "a weight clamped from below would read half of it")
        ),
        ways=RENDERERS,
        measure=against_exact(_faint, ("depth",)),
    ),
    Case(
        59,
        "distortion_equal_depth",
        "Depth distortion of splats of almost equal depth, and of equal depth",
        input="six facing discs on one ray, in another order in memory",
        oracle="the double sum over pairs of the stored depths; at equal ones any subgradient",
        hardness="gap, of the depth",
        levels=(0.1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-12, 0),
        required=0,
        quick=(0.1, 1e-5, 0),
        bounds={
            "forward": Bound("of the depth", 1e-6, "depths in float32 have steps of 6e-8"),
            "backward": Bound("of 1", 1e-5, "a weight is below 1; 0.001 % of it"),
        },
        ways=tuple(way for way in RENDERERS if way.backend != "gpu"),
        measure=_distortion,
    ),
    Case(
        24,
        "needle",
        "A needle, whose covariance is almost singular",
        input="a 3D splat 0.3 long at depth 4",
        oracle=MP,
        hardness="thickness, scene units",
        levels=(0.1, 1e-2, 1e-4, 1e-6, 1e-9, 1e-12, 1e-20, 1e-30),
        required=1e-12,
        quick=(0.1, 1e-6, 1e-12),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_needle),
    ),
    Case(
        10,
        "scene_scale_splats",
        "Splats in a world in other units",
        input="two discs, their camera and the near plane, scaled by a power of two",
        oracle=MP,
        hardness="log2 of the scale",
        levels=(0, -20, 20, -60, 60, -100, 100),
        required=20,
        quick=(-20, 20),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_scale),
        limit="gradients grow as 1 / scale and leave float32",
    ),
    Case(
        20,
        "deep_ray",
        "A great number of splats on one ray",
        input="discs of opacity 0.005, one behind the other",
        oracle="log1p of the opacity, summed in float64",
        hardness="number of splats",
        levels=(10, 100, 1e3, 1e4, 1e5, 3e5),
        required=1e5,
        quick=(10, 1e3, 1e4),
        bounds=render_bounds(
            Bound("transmittance", 1e-4, "the declared limit at which a ray ends"),
            Bound("relative", 1e-3, "of a gradient's length"),
        ),
        ways=RENDERERS,
        measure=_deep_ray,
    ),
    Case(
        21,
        "opaque_stack",
        "Transmittance that underflows",
        input="40 splats of equal opacity, one behind the other",
        oracle="their product in mpmath, which no rule ends",
        hardness="opacity",
        levels=(0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1),
        required=1,
        quick=(0.1, 0.5, 1),
        bounds={"forward": Bound("alpha", 1.01e-4, "the declared limit, and rounding of 1 - 1e-4")},
        ways=FORWARD,
        measure=_opaque_stack,
    ),
    Case(
        23,
        "equal_depth",
        "Splats of equal depth in another order in memory",
        input="discs that face the camera at one depth, three times shuffled",
        oracle="the discs blended by x, splat by splat in float64; the same bits in every order",
        hardness="number of splats",
        levels=(2, 8, 64, 512),
        required=64,
        quick=(2, 64),
        bounds={"forward": Bound("of 1", 1e-5, "1/400 of a step of an 8-bit picture")},
        ways=FORWARD,
        measure=_permuted,
        version=2,
    ),
    Case(
        23,
        "duplicates",
        "The same splat several times",
        input="tilted discs of opacity 0.1 in one place",
        oracle=MP,
        hardness="number of splats",
        levels=(1, 2, 4, 8),
        required=8,
        quick=(1, 4),
        bounds={"forward": ALPHA},
        ways=FORWARD,
        measure=against_exact(_duplicates),
    ),
    Case(
        24,
        "thin_disc",
        "A 2D splat of unequal scales",
        input="a disc of sigma 3 px along a row of pixel centres",
        oracle=MP,
        hardness="ratio of its scales",
        levels=(1, 10, 100, 1e3, 1e4, 1e6, 1e9, 1e12),
        required=100,
        quick=(1, 100, 1e6),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_ratio),
        limit="pixels' positions are float32: 1e-6 px count once the disc is thinner than 1e-3 px",
    ),
    Case(
        25,
        "below_a_pixel",
        "An antialiased splat smaller than a pixel",
        input="a ball at depth 4",
        oracle=MP,
        hardness="sigma, px",
        levels=(1, 0.3, 0.1, 0.05, 0.03, 0.01, 1e-3, 1e-6),
        required=1e-6,
        quick=(1, 0.1, 0.01),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_antialiased),
    ),
    Case(
        25,
        "coverage_below_a_pixel",
        "The coverage of an antialiased splat, wherever it falls in a pixel",
        input="36 places of a centre in a pixel",
        oracle="the integral of the splat, less what lies under the cut-off 1/255",
        hardness="sigma, px",
        levels=(1, 0.5, 0.2, 0.1, 0.07, 0.05, 0.02, 0.01),
        required=0.1,
        quick=(1, 0.5, 0.1),
        bounds={"forward": Bound("share of the integral", 0.01, "a quadrature of 36 places")},
        ways=FORWARD,
        measure=_coverage,
    ),
    Case(
        39,
        "near_plane",
        "A near plane that cuts a splat, pixel by pixel",
        input="the floor of `crossing_floor`, sigma 100 m",
        oracle=MP,
        hardness="near plane, m",
        levels=(3, 1, 0.1, 1e-2, 1e-4, 1e-8, 1e-12, 1e-30),
        required=1e-12,
        quick=(3, 1e-2, 1e-8),
        bounds=render_bounds(),
        ways=RENDERERS,
        measure=against_exact(_near),
    ),
    Case(
        39,
        "crossing_floor",
        "A splat that reaches behind the camera",
        input="a disc on the floor, 1 m under the camera",
        oracle=MP,
        hardness="sigma of the disc, m",
        levels=(1, 10, 100, 1e3, 1e4, 1e6, 1e8),
        required=1e4,
        quick=(1, 100, 1e4),
        bounds=render_bounds(ALPHA),
        ways=RENDERERS,
        measure=against_exact(_floor),
    ),
]
