"""Hard cases of cameras and warps: positions in the source, and sampling there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import mpmath
import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.warp import (
    TAP_SPREAD,
    Correspondence,
    FeatureWarp,
    Surface,
    WarpSettings,
    angle_between,
    correspond,
    in_bounds,
    preset,
    resize_depth,
    sample_at,
    warp_surfaces,
)
from attnwarp.warp.features import Backend
from attnwarp_eval.stability.case import Bound, Way, exact, hard, ways
from attnwarp_eval.stability.closed_forms import orbit, plane_depth, sphere
from attnwarp_eval.stability.visibility import Labels, exact_labels

DIGITS = 60

WARPS = ways("reference", "cpu")
"""The definition in torch and the kernels; the precision is that of the depth map."""

POSITION = Bound("px", 1e-4, "numerics of the warp; a thousandth of what a feature grid resolves")
LOOSE = Bound("px", 1e-3, "the world's own coordinates are rounded before the warp reads them")


@dataclass(frozen=True)
class Pair:
    """Two cameras and the target's depth.

    Attributes:
        depth: (H, W) of the target, float64.
        exact: the poses (world to camera) that the oracle reads, those of the cameras if None.
    """

    source: Camera
    target: Camera
    depth: np.ndarray
    exact: tuple[np.ndarray, np.ndarray] | None = None


BOUNDS_ONLY = WarpSettings.from_dict(
    {
        **preset("corrected").to_dict(),
        "opaque": None,
        "depth_agreement": False,
        "normal_test": "none",
    }
)
"""Positions alone: no rule needs a surface."""

SCALED_RULES = preset("corrected", depth_relative=1e-4)
"""Every rule, with the tolerance of exact depth."""


def positions(pair: Pair, way: Way) -> Correspondence:
    """The correspondence of a pair by a way."""
    depth = torch.from_numpy(pair.depth.astype(way.numpy))
    if way.backend == "reference":
        return correspond(pair.source, pair.target, depth)
    view = warp_surfaces(
        pair.source, pair.target, Surface(depth), None, BOUNDS_ONLY, warn_empty=False
    )
    return view.correspondence


def exact_positions(pair: Pair, depth: np.ndarray) -> list[list[tuple[Any, Any, Any]]]:
    """Row by row (x, y, z) of every pixel in the source, with 60 digits."""
    with mpmath.workdps(DIGITS):
        poses = pair.exact or (pair.source.world_to_camera, pair.target.world_to_camera)
        Ps, Pt = (mpmath.matrix(pose.tolist()) for pose in poses)
        # By blocks: mpmath takes a matrix with a translation of 1e30 for a singular one.
        turn = Ps[0:3, 0:3] * mpmath.inverse(Pt[0:3, 0:3])
        shift = Ps[0:3, 3] - turn * Pt[0:3, 3]
        Kt, Ks = (mpmath.matrix(camera.K.tolist()) for camera in (pair.target, pair.source))
        rows = []
        for i in range(pair.target.height):
            row = []
            for j in range(pair.target.width):
                y = (mpmath.mpf(i) + 0.5 - Kt[1, 2]) / Kt[1, 1]
                x = (mpmath.mpf(j) + 0.5 - Kt[0, 2] - Kt[0, 1] * y) / Kt[0, 0]
                z = mpmath.mpf(float(depth[i, j]))
                p = turn * mpmath.matrix([x * z, y * z, z]) + shift
                q = Ks * p
                row.append((q[0] / p[2], q[1] / p[2], p[2]))
            rows.append(row)
        return rows


def position_error(build: Callable[[float], Pair]) -> Callable[[float, Way], float]:
    """The measure of a case of positions: the largest distance in px from the exact position, over
    all pixels, all of which must have one.
    """

    @cache
    def pair(level: float) -> Pair:
        return build(level)

    @cache
    def truth(level: float, precision: str) -> list[list[tuple[Any, Any, Any]]]:
        made = pair(level)
        return exact_positions(made, made.depth.astype(precision))

    def measure(level: float, way: Way) -> float:
        result = positions(pair(level), way).xy.numpy()
        worst = 0.0
        for row, exact_row in zip(result, truth(level, way.precision), strict=True):
            for (x, y), (u, v, _) in zip(row, exact_row, strict=True):
                if not (math.isfinite(x) and math.isfinite(y)):
                    return math.inf
                worst = max(worst, math.hypot(float(x - u), float(y - v)))
        return worst

    return measure


def _depth(camera: Camera, low: float = 3.0, high: float = 5.0) -> np.ndarray:
    """A depth map that rises over the picture."""
    return np.linspace(low, high, camera.width * camera.height).reshape(camera.height, camera.width)


def _focal(focal: float) -> Pair:
    K = np.array([[focal, 0, 4.0], [0, focal, 4.0], [0, 0, 1]])
    turn = np.eye(4)
    angle = 1.0 / (focal + 10)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    turn[0, 3] = 0.3 / focal
    target, source = Camera(K, np.eye(4), 8, 8), Camera(K, turn, 8, 8)
    return Pair(source, target, _depth(target, 2.0, 2.5))


def _baseline(baseline: float) -> Pair:
    focal = 500.0
    K = np.array([[focal, 0, 3.5], [0, focal, 2.0], [0, 0, 1]])
    start = Camera.look_at((0, 0, 0), (3, 1, 2), width=7, height=4, fov_y=40)
    target = Camera(K, start.world_to_camera, 7, 4)
    pose = target.world_to_camera.copy()
    pose[0, 3] += baseline
    # The depth follows the baseline, so that the displacement stays half a pixel.
    return Pair(Camera(K, pose, 7, 4), target, _depth(target, 0.9, 1.1) * baseline * 1e3)


def _far(offset: float) -> Pair:
    source, target = orbit(0, size=8, height=1), orbit(25, size=8, height=1.5)
    shift = (offset, -offset, 0.5 * offset)
    exact_poses = (source.world_to_camera, target.world_to_camera)
    return Pair(source.moved(shift), target.moved(shift), _depth(target), exact_poses)


def _baseline_far(offset: float) -> Pair:
    """The baseline of 1e-6 in a world that is moved; the exact poses are those as stored."""
    near = _baseline(1e-6)
    shift = (offset, -offset, offset)
    target = near.target.moved(shift)
    pose = target.world_to_camera.copy()
    pose[0, 3] += 1e-6
    return Pair(Camera(near.source.K, pose, 7, 4), target, near.depth)


def _scaled(exponent: float) -> Pair:
    scale = 2.0**exponent
    source, target = orbit(0, size=8, height=1), orbit(25, size=8, height=1.5)
    return Pair(_in_units(source, scale), _in_units(target, scale), _depth(target) * scale)


def _in_units(camera: Camera, scale: float) -> Camera:
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= scale
    return Camera(camera.K, pose, camera.width, camera.height)


def _with_intrinsics(change: Callable[[np.ndarray], None]) -> Pair:
    """Two cameras that look the same way, so that no ray of one ends behind the other."""
    target = orbit(25, size=8, height=1.5)
    K, pose = target.K.copy(), target.world_to_camera.copy()
    change(K)
    pose[:3, 3] += [0.2, 0.1, 0.3]
    view = Camera(K, target.world_to_camera, 8, 8)
    return Pair(Camera(K, pose, 8, 8), view, _depth(target))


def _principal_point(widths: float) -> Pair:
    def change(K: np.ndarray) -> None:
        K[:2, 2] += [8 * widths, -8 * widths]

    return _with_intrinsics(change)


def _skew(ratio: float) -> Pair:
    def change(K: np.ndarray) -> None:
        K[0, 0] *= 1.3
        K[0, 1] = ratio * K[0, 0]

    return _with_intrinsics(change)


def _same_view(distance: float) -> Pair:
    camera = orbit(33, size=8, distance=4.0, height=0.7).moved((distance, -distance, distance))
    return Pair(camera, camera, _depth(camera))


def _no_rotation(deviation: float) -> Pair:
    target = orbit(25, size=8, height=1.5)
    pose = np.eye(4)
    pose[0, 0] = math.sqrt(1 + deviation)  # max |R R^T - I| is the deviation
    pose[2, 3] = 1.0
    plain = Camera(target.K, np.eye(4), 8, 8)
    return Pair(Camera(target.K, pose, 8, 8), plain, _depth(target))


def _small_picture(size: float) -> Pair:
    """A step along the axis by half of the depth doubles the offsets from the middle."""
    n = int(size)
    K = np.array([[10.0, 0, n / 2], [0, 10.0, n / 2], [0, 0, 1]])
    near = np.eye(4)
    near[2, 3] = -1.0
    return Pair(Camera(K, near, n, n), Camera(K, np.eye(4), n, n), np.full((n, n), 2.0))


def _behind(distance: float, way: Way) -> float:
    """Wrong labels of points in front of, in and behind the plane of the source camera."""
    target = Camera(np.array([[1.0, 0, 2.5], [0, 1.0, 0.5], [0, 0, 1]]), np.eye(4), 5, 1)
    pose = np.eye(4)
    pose[2, 3] = -3.0
    source = Camera(target.K, pose, 5, 1)
    depth = np.array([[3 - distance, 3 - 2 * distance, 3.0, 3 + distance, 3 + 2 * distance]])
    result = positions(Pair(source, target, depth), way)
    stored = depth.astype(way.numpy).astype(np.float64)
    return float((result.defined.numpy() != (stored > 3)).sum())


def _undefined_depth(share: float, way: Way) -> float:
    """Number of wrong labels and invented values if some depths are undefined."""
    camera = orbit(10, size=8)
    depth = _depth(camera)
    bad = [0.0, np.nan, np.inf, -1.0, -np.inf, -0.0]
    chosen = np.random.default_rng(0).permutation(64)[: round(64 * share)]
    depth.ravel()[chosen] = [bad[k % len(bad)] for k in range(len(chosen))]
    result = positions(Pair(orbit(0, size=8), camera, depth), way)
    expected = np.ones(64, bool)
    expected[chosen] = False
    wrong = (result.defined.numpy().ravel() != expected).sum()
    warped = _warped(result, torch.ones(1, 8, 8, dtype=way.dtype), way).numpy().ravel()
    return float(wrong + (warped[~expected] != 0).sum() + (~np.isfinite(warped)).sum())


def engine_of(way: Way) -> Backend:
    """Backend that samples features: torch's definition, or the kernels."""
    return "reference" if way.backend == "reference" else "auto"


def _warped(result: Correspondence, features: torch.Tensor, way: Way) -> torch.Tensor:
    """Features along a correspondence wherever it is defined."""
    return FeatureWarp(result, result.defined, engine_of(way)).warp(features)


def random_features(
    shape: tuple[int, ...], way: Way, seed: int, magnitude: float = 1.0
) -> torch.Tensor:
    """Between half of a magnitude and the whole, rounded to the type of a way."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
    return ((0.5 + uniform / 2) * magnitude).to(way.dtype)


def before_a_plane(size: int) -> Pair:
    """Two cameras, 25 degrees apart, and a plane through their look-at point."""
    source, target = orbit(0, size=size, height=1), orbit(25, size=size, height=1)
    return Pair(source, target, plane_depth(target, (1, 0, 0), 0.0))


def in_steps(result: torch.Tensor, expected: torch.Tensor, way: Way) -> torch.Tensor:
    """Errors in steps of the type: one unit in the last place is at most eps * value."""
    step = torch.finfo(way.dtype).eps * expected.abs()
    return (result.double() - expected).abs() / step


def _identity_bits(distance: float, way: Way) -> float:
    """Values that a view warped onto itself changes."""
    pair = _same_view(distance)
    result = positions(pair, Way(way.backend, "float64"))
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(3, 8, 8, generator=generator, dtype=torch.float64).to(way.dtype)
    return float((_warped(result, features, way) != features).sum())


def _opposed(yaw: float, way: Way) -> float:
    """Pixels of a sphere that the mask accepts though their points look away from the source."""
    source, target = orbit(0, size=48), orbit(yaw, size=48)
    (depth, normal), (source_depth, _) = sphere(target), sphere(source)
    view = warp_surfaces(
        source,
        target,
        Surface(torch.from_numpy(depth.astype(way.numpy)), normal),
        Surface(torch.from_numpy(source_depth.astype(way.numpy))),
        preset("corrected"),
        backend=engine_of(way),
    )
    # Outward normals of the unit sphere are its points.
    cosine = ((source.position - normal) * normal).sum(-1)
    hidden = cosine < -1e-6 * np.linalg.norm(source.position)
    return float((view.mask.numpy() & hidden).sum())


def _rules_of_scale(exponent: float, way: Way) -> tuple[tuple[Camera, Surface], ...]:
    """Source and target with views of a sphere before a wall, in other units, with holes."""
    size = 2.0**exponent
    views = []
    for camera in (orbit(0, height=1, size=48), orbit(40, height=1, size=48)):
        depth, normal = sphere(camera)
        wall = plane_depth(camera, (1, 0, 0), -1.5)
        on = ~(depth > np.nan_to_num(wall, nan=np.inf)) & np.isfinite(depth)
        z = size * np.where(on, depth, wall).astype(way.numpy).astype(np.float64)
        z[20:26, 8:14] = np.nan
        stored = torch.from_numpy(z.astype(way.numpy))
        surface = Surface(stored, np.where(on[..., None], normal, [1.0, 0, 0]))
        views.append((_in_units(camera, size), surface))
    return tuple(views)


@cache
def _labels_of_rules(precision: str) -> Labels:
    """Labels of the scene in its original units. Each rule compares lengths with lengths and shares
    with shares, and a power of two scales lengths exactly: in any units the labels are these.
    """
    (source, seen), (target, surface) = _rules_of_scale(0, Way("reference", precision))
    return exact_labels(
        source,
        target,
        np.asarray(seen.depth),
        np.asarray(surface.depth),
        np.asarray(surface.normal),
        relative=SCALED_RULES.depth_relative,
        slope=SCALED_RULES.depth_slope,
        spread=float(SCALED_RULES.depth_spread or np.inf),
    )


def _scaled_rules(exponent: float, way: Way) -> float:
    """Pixels whose label by any rule is not the exact one."""
    (source, seen), (target, surface) = _rules_of_scale(exponent, way)
    backend = engine_of(way)
    view = warp_surfaces(
        source, target, surface, seen, SCALED_RULES, backend=backend, warn_empty=False
    )
    exact_rules = _labels_of_rules(way.precision)
    # Nothing has an alpha here, so every pixel is opaque.
    wrong = int((~view.rules["opaque"]).sum())
    for name, expected in exact_rules.rules.items():
        differs = view.rules[name].numpy() != expected
        wrong += int((differs & ~exact_rules.undecided[name]).sum())
    return float(wrong)


def _angle(near: float) -> Callable[[float, Way], float]:
    def measure(small: float, way: Way) -> float:
        """Relative error of an angle near 0, or of its distance from 180 degrees."""
        a = torch.tensor([1.0, 0, 0], dtype=way.dtype) * 3
        b = torch.tensor([-1.0 if near else 1.0, 0, small], dtype=way.dtype) * 0.5
        result = float(angle_between(a, b))
        with mpmath.workdps(DIGITS):
            exact_angle = mpmath.degrees(
                mpmath.atan2(*(abs(mpmath.mpf(float(b[k]))) for k in (2, 0)))
            )
            error = abs((near - mpmath.mpf(result)) - exact_angle if near else result - exact_angle)
            return float(error if near else error / exact_angle)

    return measure


def _resized(
    way: Way, camera: Camera, depth: np.ndarray, size: tuple[int, int], spread: float | None
) -> np.ndarray:
    """Depth on another grid, by a way."""
    stored = torch.from_numpy(depth.astype(way.numpy))
    if way.backend == "reference":
        return resize_depth(stored, size, spread=spread).numpy()
    chosen = WarpSettings.from_dict({**BOUNDS_ONLY.to_dict(), "depth_spread": spread})
    view = warp_surfaces(camera, camera, Surface(stored), None, chosen, warn_empty=False)
    return view.at(size, source_size=size).correspondence.target_depth.numpy()


def _step(ratio: float, way: Way) -> float:
    """Depths that lie on neither side of a step."""
    depth = np.full((6, 6), 2.0)
    depth[:, 3:] = 2.0 * ratio
    result = _resized(
        way, orbit(0, size=6), depth, (6, 3), TAP_SPREAD
    )  # centres at 1, 3, 5: one on the step
    sides = depth.astype(way.numpy).astype(np.float64)[0, [0, 5]]
    off = np.abs(result[..., None] / sides - 1).min(axis=-1)
    # The step has no depth; the two adjacent columns have one.
    beside = np.array([True, False, True])
    wrong = np.isfinite(result) & (off > 1e-12) | (beside & ~np.isfinite(result))
    return float(wrong.sum())


def _slanted(tilt: float, way: Way) -> float:
    """Relative error of a slanted plane's depth on a grid of a quarter of the pixels."""
    camera = Camera(np.array([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]), np.eye(4), 64, 64)
    angle = math.radians(tilt)
    normal = (math.sin(angle), 0.0, -math.cos(angle))
    depth, small = plane_depth(camera, normal, normal[2] * 4), camera.resize(16, 16)
    exact_depth = plane_depth(small, normal, normal[2] * 4)
    result = _resized(way, camera, depth, (16, 16), None)
    # A pixel whose four taps all lie on the plane; beyond the horizon there is none.
    whole = np.isfinite(depth).reshape(16, 4, 16, 4).all(axis=(1, 3))
    if not np.isfinite(result[whole]).all():
        return math.inf
    return float(np.abs(result / exact_depth - 1)[whole].max())


def _ramp(size: float, way: Way) -> float:
    """Error of a linear ramp read on a feature grid, as a share of the image."""
    n = int(size)
    source, target = orbit(0, size=128, height=1), orbit(20, size=128, height=1)
    pair = Pair(source.resize(n, n), target.resize(n, n), np.full((n, n), 4.0))
    layer = positions(pair, Way(way.backend))
    ramp = np.moveaxis(source.resize(n, n).pixel_centers() / n, -1, 0)
    features = torch.from_numpy(ramp.astype(way.numpy))
    warped = _warped(layer, features, way).double().numpy()
    position = np.moveaxis(layer.xy.numpy() / n, -1, 0)
    # Nearer the border than half a pixel the ramp is clamped.
    inner = ((position > 0.5 / n) & (position < 1 - 0.5 / n)).all(0)
    return float(np.abs(warped - position)[:, inner].max())


def _half(magnitude: float, way: Way) -> float:
    """Error of warped features in units of their last place, against torch's float64 sampling."""
    result = positions(before_a_plane(32), Way(way.backend))
    features = random_features((3, 32, 32), way, seed=1, magnitude=magnitude)
    errors = in_steps(_warped(result, features, way), grid_sampled(result, features), way)
    return float(errors[:, in_bounds(result)].max())


def grid_sampled(result: Correspondence, features: torch.Tensor) -> torch.Tensor:
    """(C, H, W) float64: features (C, h, w) at the positions, by torch's sampler."""
    size = torch.tensor([result.source.width, result.source.height])
    grid = torch.nan_to_num(2 * result.xy / size - 1, nan=-2.0)
    return torch.nn.functional.grid_sample(
        features.double()[None], grid[None], padding_mode="border", align_corners=False
    )[0]


def _grid_type(position: float, way: Way) -> float:
    """Distance in px from where a grid of this type reads a ramp to the intended position."""
    width = int(position) + 4
    ramp = (torch.arange(width, dtype=torch.float64) + 0.5).reshape(1, 1, width)
    xy = torch.tensor([[[position + 0.37, 0.5]]], dtype=torch.float64).to(way.dtype)
    return abs(float(sample_at(ramp, xy)) - (position + 0.37))


def _nan_positions(share: float, way: Way) -> float:
    """Number of values invented or changed by positions outside the source."""
    source, target = orbit(0, size=16, height=1), orbit(25, size=16, height=1)
    whole = positions(Pair(source, target, np.full((16, 16), 4.0)), Way(way.backend))
    xy = whole.xy.clone()
    chosen = torch.from_numpy(np.random.default_rng(0).permutation(256)[: round(256 * share)])
    xy.reshape(-1, 2)[chosen] = torch.nan
    holed = Correspondence(source, target, xy, whole.points, whole.target_depth)
    generator = torch.Generator().manual_seed(0)
    features = torch.rand(2, 16, 16, generator=generator, dtype=torch.float64).to(way.dtype)
    results = [_warped(c, features, way).reshape(2, -1) for c in (whole, holed)]
    expected = results[0].clone()
    expected[:, chosen] = 0
    return float((expected != results[1]).sum())


HALVES = ("float16", "bfloat16")

CASES = [
    hard("behind_the_camera", _behind, WARPS, bounds=exact("wrong labels")),
    hard("undefined_depth", _undefined_depth, WARPS, bounds=exact("wrong labels or values")),
    hard("zero_baseline", position_error(_same_view), WARPS, bounds=LOOSE),
    hard(
        "zero_baseline_features",
        _identity_bits,
        ways("reference", "cpu", precisions=("float64", "float32", *HALVES)),
        bounds=exact("changed values"),
    ),
    hard("tiny_baseline_far", position_error(_baseline_far), WARPS, bounds=LOOSE),
    hard("opposed_views", _opposed, WARPS, bounds=exact("hidden pixels accepted")),
    hard("far_world", position_error(_far), WARPS, bounds=LOOSE),
    hard("scene_scale", position_error(_scaled), WARPS, bounds=POSITION),
    hard(
        "scene_scale_rules",
        _scaled_rules,
        WARPS,
        bounds=exact("wrong labels", "a power of two rounds nothing"),
    ),
    hard("principal_point", position_error(_principal_point), WARPS, bounds=POSITION),
    hard("skew", position_error(_skew), WARPS, bounds=POSITION),
    hard("small_picture", position_error(_small_picture), WARPS, bounds=POSITION),
    hard(
        "not_a_rotation",
        position_error(_no_rotation),
        WARPS,
        bounds=Bound("px", 1e-3, "the deviation allowed, over a picture of 8 px, twice"),
        must_refuse=lambda level, way: level > 1e-5,
    ),
    hard(
        "angle_near_0",
        _angle(0),
        ways("reference"),
        bounds=Bound("relative", 1e-5, "an arccosine would return 0 below 1e-8"),
    ),
    hard(
        "angle_near_180",
        _angle(180),
        ways("reference"),
        bounds=Bound("degrees", 4e-5, "two steps of a float32 of 180"),
    ),
    hard("taps_across_an_edge", _step, WARPS, bounds=exact("depths on neither side")),
    hard(
        "slanted_depth",
        _slanted,
        WARPS,
        bounds=Bound("relative", 1e-6, "float32 depths are stored to 6e-8"),
    ),
    hard(
        "feature_size",
        _ramp,
        WARPS,
        bounds=Bound("share of the image", 1e-5, "u' = u s; 1/200 px at 512"),
    ),
    hard(
        "half_features",
        _half,
        ways("reference", "cpu", precisions=HALVES),
        bounds=Bound(
            "steps of the type", 0.51, "rounded once: half a step, and float32's own rounding"
        ),
    ),
    hard(
        "grid_type",
        _grid_type,
        ways("reference", precisions=("float64", "float32", *HALVES)),
        bounds=Bound("px", 1e-2, "a hundredth of a pixel of the grid"),
        must_refuse=lambda level, way: way.precision in HALVES,
    ),
    hard(
        "nan_positions",
        _nan_positions,
        ways("reference", "cpu", precisions=("float64", "float32", "float16")),
        bounds=exact("changed values"),
    ),
    hard("tiny_baseline", position_error(_baseline), WARPS, bounds=LOOSE),
    hard("focal_length", position_error(_focal), WARPS, bounds=POSITION),
]
