"""Hard cases of gradients: through warped features, blended tokens and injected attention."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.editing.layers import BareUNet, Layer
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.methods.algorithms.attention_warping import CORRECTED, a_t, inject
from attnwarp.warp import Correspondence, FeatureWarp, Surface, preset, warp_surfaces
from attnwarp.warp.sampling import work_type
from attnwarp_eval.stability.bilinear import Extended, extended, sampling_matrix
from attnwarp_eval.stability.case import Bound, Way, hard
from attnwarp_eval.stability.cases.editing import Unet, first_step, layer_weights
from attnwarp_eval.stability.cases.warps import HALVES, engine_of, random_features
from attnwarp_eval.stability.closed_forms import orbit

SIZE = 16
CHANNELS = 3


def backward(*precisions: str) -> tuple[Way, ...]:
    """Gradients by the definition in torch and by the kernels."""
    return tuple(
        Way(backend, precision, "backward")
        for backend in ("reference", "cpu")
        for precision in precisions
    )


WHOLE, HALF = backward("float64", "float32"), backward(*HALVES)


def _camera(height: int, width: int) -> Camera:
    """Camera of which a warp uses only the grid."""
    return orbit(0, size=height, width=width)


def _warp(xy: torch.Tensor, size: tuple[int, int], way: Way) -> FeatureWarp:
    """The warp of positions (H, W, 2) on a source grid of ``size``."""
    target, source = _camera(*xy.shape[:2]), _camera(*size)
    points = torch.zeros(*xy.shape[:2], 3, dtype=torch.float64)
    depth = torch.ones(xy.shape[:2], dtype=torch.float64)
    result = Correspondence(source, target, xy, points, depth)
    return FeatureWarp(result, result.defined, engine_of(way))


def _shifted(share: float) -> torch.Tensor:
    """Pixel centres moved by a share of a pixel along both axes; those of the last two rows and
    columns are NaN, so that no position lies beyond the border.
    """
    xy = torch.from_numpy(_camera(SIZE, SIZE).pixel_centers()) + share
    xy[-2:] = torch.nan
    xy[:, -2:] = torch.nan
    return xy


def steps_between(result: torch.Tensor, expected: Extended, way: Way) -> float:
    """The largest error in steps of the type; where a value is subnormal its step is that of the
    smallest normal number. Where the expected value is 0, the result must be 0.
    """
    kind = torch.finfo(way.dtype)
    values = extended(result).reshape(expected.shape)
    if not np.isfinite(values).all() or (values[expected == 0] != 0).any():
        return math.inf
    step = kind.eps * np.maximum(np.abs(expected), kind.smallest_normal)
    return float((np.abs(values - expected) / step).max(initial=0.0))


def _of_maps(
    warp: FeatureWarp, features: torch.Tensor, upstream: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients (C, h w) in the features (C, h, w), sampled as maps and as tokens.

    Args:
        upstream: (C, H, W) gradient in the warped features.
    """
    leaves = [features.clone().requires_grad_() for _ in range(2)]
    warp.warp(leaves[0]).backward(upstream)
    tokens = warp.warp_tokens(leaves[1].flatten(1).T[None])
    tokens.backward(upstream.flatten(1).T[None].contiguous())
    maps, rows = (leaf.grad for leaf in leaves)
    assert maps is not None and rows is not None
    return maps.flatten(1), rows.flatten(1)


def _gradient_error(
    xy: torch.Tensor, size: tuple[int, int], upstream: torch.Tensor, way: Way
) -> float:
    """Error of the gradient in features, infinite or NaN if unread features get one; the gradient
    in pixels without a position is NaN.
    """
    shares = sampling_matrix(extended(xy), *size)
    undefined = torch.isnan(xy).any(-1)
    expected = extended(torch.where(undefined, 0, upstream)).reshape(CHANNELS, -1) @ shares
    features = random_features((CHANNELS, *size), way, seed=3)
    unread = torch.from_numpy(~(shares > 0).any(0).reshape(size))
    features[:, unread] = torch.nan
    features[0, unread] = torch.inf
    upstream = torch.where(undefined, torch.nan, upstream)
    results = _of_maps(_warp(xy, size, way), features, upstream)
    return max(steps_between(result, expected, way) for result in results)


def _taps(share: float, way: Way) -> float:
    upstream = random_features((CHANNELS, SIZE, SIZE), way, seed=4)
    return _gradient_error(_shifted(share), (SIZE, SIZE), upstream, way)


def _magnitude(magnitude: float, way: Way) -> float:
    upstream = random_features((CHANNELS, SIZE, SIZE), way, seed=4, magnitude=magnitude)
    return _gradient_error(_shifted(0.375), (SIZE, SIZE), upstream, way)


def _holes(share: float, way: Way) -> float:
    xy = _shifted(0.375)
    chosen = np.random.default_rng(0).permutation(SIZE**2)[: round(SIZE**2 * share)]
    xy.reshape(-1, 2)[torch.from_numpy(chosen)] = torch.nan
    upstream = random_features((CHANNELS, SIZE, SIZE), way, seed=4)
    return _gradient_error(xy, (SIZE, SIZE), upstream, way)


def _readers(count: float, way: Way) -> float:
    """Error of the gradient in the four inner pixels of 4 x 4, which share all positions."""
    generator = torch.Generator().manual_seed(5)
    xy = 1.5 + torch.rand(int(count), 1, 2, generator=generator, dtype=torch.float64)
    upstream = random_features((CHANNELS, int(count), 1), way, seed=4, magnitude=1 / count)
    return _gradient_error(xy, (4, 4), upstream, way)


def _held(weight: float, way: Way) -> np.longdouble:
    """A weight rounded to the sums' type: near 1, its complement has few digits."""
    return np.longdouble(torch.tensor(weight, dtype=work_type(way.dtype)).item())


def _blend_error(layer: FeatureWarp, weight: float, way: Way, upstream: torch.Tensor) -> float:
    """Error of the gradients in source and target tokens of a blend."""
    source, new = (
        values[None].clone().requires_grad_()
        for values in random_features((2, SIZE**2, CHANNELS), way, seed=6)
    )
    first_step(layer, source, new, weight).backward(upstream[None])
    assert source.grad is not None and new.grad is not None
    share = _held(weight, way) * layer.mask.numpy().reshape(-1, 1)
    shares = sampling_matrix(extended(layer.correspondence.xy), SIZE, SIZE)
    gradient = extended(upstream)
    return max(
        steps_between(source.grad, shares.T @ (share * gradient), way),
        steps_between(new.grad, (1 - share) * gradient, way),
    )


def _half_masked(share: float, way: Way) -> FeatureWarp:
    """A layer whose mask holds a share of the tokens that have a position."""
    layer = _warp(_shifted(0.375), (SIZE, SIZE), way)
    chosen = np.random.default_rng(0).permutation(SIZE**2)[: round(SIZE**2 * share)]
    mask = torch.zeros(SIZE**2, dtype=torch.bool)
    mask[torch.from_numpy(chosen)] = True
    return FeatureWarp(layer.correspondence, mask.reshape(SIZE, SIZE) & layer.mask, layer.backend)


def _blend_weight(weight: float, way: Way) -> float:
    upstream = random_features((SIZE**2, CHANNELS), way, seed=4)
    return _blend_error(_half_masked(0.5, way), weight, way, upstream)


def _mask(share: float, way: Way) -> float:
    upstream = random_features((SIZE**2, CHANNELS), way, seed=4)
    return _blend_error(_half_masked(share, way), 1.0, way, upstream)


def _near_equal_depth(gap: float, way: Way) -> float:
    """Error of a blend at a = 1 where the source sees a wall before the target's by a share of its
    depth; the cameras are side by side.
    """
    K = np.array([[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = 4 * 0.375 / 20  # 0.375 px at depth 4
    source, target = Camera(K, pose, SIZE, SIZE), Camera(K, np.eye(4), SIZE, SIZE)
    normal = np.broadcast_to([0.0, 0, -1], (SIZE, SIZE, 3))
    kind = np.dtype("float32" if way.precision == "float32" else "float64")
    depths = [np.full((SIZE, SIZE), z).astype(kind) for z in (4 * (1 - gap), 4)]
    settings = preset("corrected", depth_relative=1e-4)
    seen, own = (Surface(torch.from_numpy(depth), normal) for depth in depths)
    view = warp_surfaces(source, target, own, seen, settings, backend=engine_of(way))
    before, behind = (Fraction(float(depth[0, 0])) for depth in depths)
    agrees = behind - before <= Fraction(settings.depth_relative) * behind
    layer = view.at((SIZE, SIZE))
    inside = layer.correspondence.xy[..., 0] <= SIZE
    if not torch.equal(layer.mask, inside & agrees):
        return math.inf
    return _blend_error(layer, 1.0, way, random_features((SIZE**2, CHANNELS), way, seed=4))


def _injected(weight: float, way: Way) -> float:
    """Error of the gradient in a target's latents, through a layer into which features are
    injected, in steps of the type at the sum of magnitudes; a fully replaced token must
    have none.
    """
    unet = Unet(CHANNELS, way.dtype)
    layer = Layer("attn1", "self", 0, CHANNELS)
    latents = random_features((2, CHANNELS, SIZE, SIZE), way, seed=7)
    upstream = random_features((SIZE**2, CHANNELS), way, seed=4)
    warp = _half_masked(0.5, way)
    plan = RecordingPlan((layer,), (SIZE, SIZE), ("text",), 1, dtype=way.dtype)
    with torch.no_grad(), record(BareUNet(unet), plan) as recording:
        unet(latents[:1], 0.0)
    target = latents[1:].clone().requires_grad_()
    a = partial(a_t, s=replace(CORRECTED, a0=weight))
    with inject(BareUNet(unet), recording, warps=[_At(warp)], weight=a):
        unet(target, 0.0).backward(upstream[None])
    assert target.grad is not None
    share = 1 - _held(weight, way) * warp.mask.numpy().reshape(-1, 1)
    matrix, gradient = layer_weights(unet)[0], share * extended(upstream)
    errors = np.abs(extended(target.grad[0].flatten(1)).T - gradient @ matrix)
    magnitudes = np.abs(gradient) @ np.abs(matrix)
    if not np.isfinite(errors).all() or (errors[magnitudes == 0] != 0).any():
        return math.inf
    some = magnitudes > 0
    return float((errors[some] / magnitudes[some]).max(initial=0.0) / torch.finfo(way.dtype).eps)


class _At:
    """A layer's warp where :func:`attnwarp.editing.injection.inject` asks for a view's."""

    def __init__(self, layer: FeatureWarp) -> None:
        self.layer = layer

    def at(
        self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None
    ) -> FeatureWarp:
        """The one layer."""
        return self.layer


STEPS = "steps of the type"
ROUNDED_ONCE = Bound(STEPS, 0.51, "summed in float32, rounded once to half precision")
# Each rounding is at most half a step of the sum, all of whose terms are positive. In float64 the
# share 1 - f is rounded on each axis, and their product; float32 rounds them once, from float64.
# Then come the product with the gradient, and the sum of at most four.
WARPED = Bound(STEPS, 3.5, "three roundings of a weight, one of its product, three of the sum")
BLENDED = Bound(STEPS, 4, "as for a warp, and the product with a")

CASES = [
    hard("gradient_of_taps", _taps, WHOLE, bounds=WARPED),
    hard("half_gradient", _magnitude, HALF, bounds=ROUNDED_ONCE),
    hard(
        "many_readers",
        _readers,
        HALF,
        bounds=Bound(
            STEPS,
            lambda count: 0.5 + (count + 1) * 2.0**-14,
            "rounded once, after as many sums in float32, each off by 2^-14 steps of float16",
        ),
    ),
    hard("gradient_of_holes", _holes, WHOLE + HALF, bounds=WARPED),
    hard("blend_gradient", _blend_weight, WHOLE, bounds=BLENDED),
    hard("half_blend_gradient", _blend_weight, HALF, bounds=ROUNDED_ONCE),
    hard("gradient_of_masks", _mask, WHOLE + HALF, bounds=BLENDED),
    hard("gradient_near_equal_depth", _near_equal_depth, WHOLE + HALF, bounds=BLENDED),
    hard(
        "injected_gradient",
        _injected,
        WHOLE,
        bounds=Bound(
            "steps of the type at the sum of magnitudes",
            2.5,
            "1 - a, its product, the product with the matrix, the sum of three channels",
        ),
    ),
]
