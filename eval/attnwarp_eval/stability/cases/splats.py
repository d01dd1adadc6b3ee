"""Hard cases of rendering: splats edge-on, tiny, huge, opaque, invisible, in great numbers."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from tempfile import TemporaryDirectory

import mpmath
import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.io import read_ply
from attnwarp.render import constants
from attnwarp_eval.stability.case import Bound, Way, hard
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


def _long_needle(ratio: float) -> Shot:
    scales = torch.tensor([0.01, 0.01 * ratio, 0.01], dtype=torch.float64)
    turn = [math.cos(0.6), 0, 0.05, math.sin(0.6)]  # aslant in the picture and in depth
    made = splats([[0.02, 0.01, 4]], scales, 0.8, kind="3d", quats=[turn])
    return Shot(made, front_camera(), CROSS, {"depth": "peak"})


def _floor(sigma: float) -> Shot:
    camera = Camera.look_at([0, 0, 1], [0, 5, 1], width=48, height=40, fov_y=80)
    floor = Gaussians(
        "2d",
        torch.tensor([[0.0, 4, 0]], dtype=torch.float64),
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

    In the order of depth, the sum over those in front is that over all pairs.

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
        return abs(float(made.render(way, base).distortion_ordered[0, 0]) - exact) / depth
    means_of = base.means.clone().requires_grad_()
    made.render(way, dataclasses.replace(base, means=means_of)).distortion_ordered.sum().backward()
    assert means_of.grad is not None
    # Where the gaps to those in front are declared to have no sign, any slope between -1 and 1 is a
    # subgradient of each of their pairs; pairs cancel in the sum.
    front = np.tril(np.ones((count, count)), -1)
    order = np.argsort(z, kind="stable")
    flat = (front * pairs[np.ix_(order, order)] * abs(steps[np.ix_(order, order)])).sum(axis=1)
    flat = flat <= 2 * constants.GAP_MIN * z[order] * w[order]
    loose = np.zeros((count, count), dtype=bool)
    loose[np.ix_(order, order)] = (front > 0) & flat[:, None]
    slopes = means_of.grad[:, 2].double().numpy()
    apart = np.abs(slopes - 2 * (pairs * np.sign(steps)).sum(axis=1))
    free = 2 * (pairs * (loose | loose.T)).sum(axis=1)
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
    """Error of the colour of splats of equal depth; infinite if memory order decides it."""
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
    wider than a pixel, so that the screen filter has no effect.
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


def _on_a_pixel(count: float, way: Way) -> float:
    """Error of the colour and the alpha of shuffled splats on one ray, the farther the redder."""
    n, opacity = int(count), 0.005
    rank = np.random.default_rng(0).permutation(n)
    means = np.zeros((n, 3))
    means[:, 2] = 2 + 4 * rank / n
    # Red rises over the splats before the ray ends, and is 1 beyond.
    stop = math.ceil(math.log(constants.TRANSMITTANCE_STOP) / math.log1p(-opacity))
    colors = np.zeros((n, 3))
    colors[:, 0] = np.minimum(rank / stop, 1)
    made = Shot(splats(means, 1.0, opacity, colors=colors), front_camera(1, 30.0), [(0, 0)])
    base = made.gaussians.to(dtype=way.dtype)
    view, drawn = made.render(way, base), min(n, stop)
    with mpmath.workdps(50):
        keep = 1 - mpmath.mpf(float(base.opacities[0].double()))
        # sum_k k (1 - q) q^k over k < m, in closed form.
        red = (keep - drawn * keep**drawn + (drawn - 1) * keep ** (drawn + 1)) / (1 - keep) / stop
        mine = float(view.color[0, 0, 0]), float(view.alpha[0, 0])
        return float(max(abs(mine[0] - red), abs(mine[1] - (1 - keep**drawn))))


def _stored_logit(logit: float, way: Way) -> float:
    """Error of opacities read from the logits of a file, +-x, and of what two such splats draw."""
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    head = "".join(f"property float {name}\n" for name in names.split())
    rows = [[0, 0, z, 0, 0, 0, x, -1, -1, -1, 1, 0, 0, 0] for z, x in ((4, -logit), (5, logit))]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "splats.ply"
        start = f"ply\nformat binary_little_endian 1.0\nelement vertex 2\n{head}end_header\n"
        path.write_bytes(start.encode() + np.array(rows, "<f4").tobytes())
        read = read_ply(path)
    with mpmath.workdps(50):
        exact = [1 / (1 + mpmath.exp(-mpmath.mpf(float(np.float32(row[6]))))) for row in rows]
        clear, solid = (min(value, mpmath.mpf(constants.ALPHA_MAX)) for value in exact)
        clear = clear if clear >= constants.ALPHA_MIN else mpmath.mpf(0)
        seen = Shot(read, front_camera(), [(16, 16)]).render(way).alpha[16, 16]
        wrong = [float(a) - b for a, b in zip(read.opacities, exact, strict=True)]
        return float(max(map(abs, [*wrong, float(seen) - (1 - (1 - clear) * (1 - solid))])))


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
    hard("edge_on_splat", against_exact(_edge_on, ("alpha",)), RENDERERS, bounds=render_bounds()),
    hard(
        "edge_on_depth",
        against_exact(_edge_on, ("depth",)),
        RENDERERS,
        bounds=render_bounds(
            Bound("relative depth", 1e-5, "the tilted plane's slope multiplies rounding errors")
        ),
    ),
    hard("far_world_splats", against_exact(_far_world), RENDERERS, bounds=render_bounds()),
    hard(
        "short_quaternion",
        against_exact(_quaternion),
        RENDERERS,
        bounds=render_bounds(),
        must_refuse=lambda level, way: level == 0,
    ),
    hard("opacity_to_0_2d", against_exact(_opacity("2d")), RENDERERS, bounds=render_bounds()),
    hard("opacity_to_0_3d", against_exact(_opacity("3d")), RENDERERS, bounds=render_bounds()),
    hard("opacity_to_1_2d", against_exact(_opacity("2d")), RENDERERS, bounds=render_bounds()),
    hard("opacity_to_1_3d", against_exact(_opacity("3d")), RENDERERS, bounds=render_bounds()),
    hard(
        "faint_depth",
        against_exact(_faint, ("depth",)),
        RENDERERS,
        bounds=render_bounds(
            Bound("relative depth", 1e-5, "a weight clamped from below would read half of it")
        ),
    ),
    hard(
        "distortion_equal_depth",
        _distortion,
        tuple(way for way in RENDERERS if way.backend != "gpu"),
        bounds={
            "forward": Bound("of the depth", 1e-6, "depths in float32 have steps of 6e-8"),
            "backward": Bound("of 1", 1e-5, "a weight is below 1; 0.001 % of it"),
        },
    ),
    hard("needle", against_exact(_needle), RENDERERS, bounds=render_bounds()),
    hard("long_needle", against_exact(_long_needle), RENDERERS, bounds=render_bounds()),
    hard(
        "splats_on_a_pixel",
        _on_a_pixel,
        FORWARD,
        bounds=Bound("of 1", 1e-4, "the declared limit at which a ray ends"),
    ),
    hard(
        "stored_logit",
        _stored_logit,
        tuple(way for way in FORWARD if way.precision == "float32"),
        bounds=Bound("opacity", 1e-6, "a float32 of about 1 has steps of 1.2e-7"),
    ),
    hard("scene_scale_splats", against_exact(_scale), RENDERERS, bounds=render_bounds()),
    hard(
        "deep_ray",
        _deep_ray,
        RENDERERS,
        bounds=render_bounds(
            Bound("transmittance", 1e-4, "the declared limit at which a ray ends"),
            Bound("relative", 1e-3, "of a gradient's length"),
        ),
    ),
    hard(
        "opaque_stack",
        _opaque_stack,
        FORWARD,
        bounds=Bound("alpha", 1.01e-4, "the declared limit, and rounding of 1 - 1e-4"),
    ),
    hard(
        "equal_depth",
        _permuted,
        FORWARD,
        bounds=Bound("of 1", 1e-5, "1/400 of a step of an 8-bit picture"),
    ),
    hard("duplicates", against_exact(_duplicates), FORWARD, bounds=ALPHA),
    hard("thin_disc", against_exact(_ratio), RENDERERS, bounds=render_bounds()),
    hard("below_a_pixel", against_exact(_antialiased), RENDERERS, bounds=render_bounds()),
    hard(
        "coverage_below_a_pixel",
        _coverage,
        FORWARD,
        bounds=Bound("share of the integral", 0.01, "a quadrature of 36 places"),
    ),
    hard("near_plane", against_exact(_near), RENDERERS, bounds=render_bounds()),
    hard("crossing_floor", against_exact(_floor), RENDERERS, bounds=render_bounds(ALPHA)),
]
