"""Hard cases of editing: attention features that are warped, masked and blended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import get_args

import mpmath
import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.drift import Drift, drift
from attnwarp.editing.injection import blended
from attnwarp.editing.layers import BareUNet, Layer
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.editing.schedule import DDIM, Prediction
from attnwarp.methods.algorithms.attention_warping import CORRECTED, a_t, blend, inject
from attnwarp.methods.pictures import to_bytes
from attnwarp.warp import FeatureWarp, Surface, WarpedView, preset, warp_surfaces
from attnwarp_eval.stability.bilinear import Extended, extended, sampling_matrix
from attnwarp_eval.stability.case import Bound, Way, exact, hard, ways
from attnwarp_eval.stability.cases.warps import (
    BOUNDS_ONLY,
    HALVES,
    before_a_plane,
    engine_of,
    grid_sampled,
    in_steps,
    positions,
    random_features,
)
from attnwarp_eval.stability.closed_forms import orbit, plane_depth

EVERY_TYPE = ways("reference", "cpu", precisions=("float64", "float32", *HALVES))
SIZE = 16
CHANNELS = 4


def _layer(way: Way, mask: torch.Tensor | None = None) -> FeatureWarp:
    result = positions(before_a_plane(SIZE), Way(way.backend))
    return FeatureWarp(result, result.defined if mask is None else mask, engine_of(way))


def _view(source: Camera, target: Camera, depth: np.ndarray, way: Way) -> WarpedView:
    """A warp by positions only."""
    surface = Surface(torch.from_numpy(depth))
    return warp_surfaces(
        source, target, surface, None, BOUNDS_ONLY, backend=engine_of(way), warn_empty=False
    )


def _tokens(way: Way, magnitude: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """(1, H W, 4) source and target tokens between half of a magnitude and the whole."""
    values = random_features((2, SIZE * SIZE, 4), way, seed=2, magnitude=magnitude)
    return values[:1], values[1:]


def first_step(
    layer: FeatureWarp, source: torch.Tensor, new: torch.Tensor, a0: float
) -> torch.Tensor:
    """(1, H W, C) tokens at the first step of an edit, by the method's weight and blend."""
    return blended(blend, layer, source, new, a_t(0, 1, replace(CORRECTED, a0=a0)))


def _exact_blend(
    layer: FeatureWarp, source: torch.Tensor, new: torch.Tensor, weight: float
) -> torch.Tensor:
    """a (M warp(source) + (1 - M) new) + (1 - a) new in float64, sampled by torch."""
    maps = source[0].T.reshape(4, SIZE, SIZE)
    warped = grid_sampled(layer.correspondence, maps).reshape(4, -1).T
    blended = weight * warped + (1 - weight) * new[0].double()
    return torch.where(layer.mask.reshape(-1, 1), blended, new[0].double())


def _magnitude(magnitude: float, way: Way) -> float:
    """Error of blended tokens in steps of their type."""
    layer, (source, new) = _layer(way), _tokens(way, magnitude)
    result = first_step(layer, source, new, 0.7)[0]
    return float(in_steps(result, _exact_blend(layer, source, new, 0.7), way).max())


def _weight(weight: float, way: Way) -> float:
    """Error in steps of the type; at 0 and 1 the result must equal one side bit for bit."""
    layer, (source, new) = _layer(way), _tokens(way)
    result = first_step(layer, source, new, weight)
    if weight in (0, 1):
        side = layer.warp_tokens(source) if weight else new
        inside = layer.mask.reshape(-1)
        return 0.0 if torch.equal(result[:, inside], side[:, inside]) else math.inf
    return float(in_steps(result[0], _exact_blend(layer, source, new, weight), way).max())


def _outside(share: float, way: Way) -> float:
    """Number of values changed outside a mask, and left unchanged inside, by a blend."""
    chosen = np.random.default_rng(0).permutation(SIZE * SIZE)[: round(SIZE * SIZE * share)]
    mask = torch.zeros(SIZE * SIZE, dtype=torch.bool)
    mask[torch.from_numpy(chosen)] = True
    layer = _layer(way, mask.reshape(SIZE, SIZE))
    source, new = _tokens(way)
    result = first_step(layer, source + 2, new, 1.0)
    return float(
        (result[:, ~mask] != new[:, ~mask]).sum() + (result[:, mask] == new[:, mask]).sum()
    )


class Unet(torch.nn.Module):
    """Minimal UNet for hooks: a named attention module, called with latents and a timestep."""

    def __init__(self, channels: int, dtype: torch.dtype) -> None:
        super().__init__()
        self.attn1 = torch.nn.Linear(channels, channels, dtype=dtype)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            values = torch.randn(channels, channels + 1, generator=generator, dtype=torch.float32)
            self.attn1.weight.copy_(values[:, :-1])
            self.attn1.bias.copy_(values[:, -1])

    def forward(self, sample: torch.Tensor, timestep: float) -> torch.Tensor:
        """(B, H W, C) tokens of (B, C, H, W) latents."""
        tokens: torch.Tensor = self.attn1(sample.flatten(2).transpose(1, 2))
        return tokens


def one_view_tokens(count: int, way: Way) -> tuple[Unet, torch.Tensor]:
    """The network of ``one_view``, and (count + 1, C, H, W) latents, the source's last."""
    generator = torch.Generator().manual_seed(1)
    shape = (count + 1, CHANNELS, SIZE, SIZE)
    latents = torch.randn(shape, generator=generator, dtype=torch.float64)
    return Unet(CHANNELS, way.dtype), latents.to(way.dtype)


def layer_weights(unet: Unet) -> tuple[Extended, Extended]:
    """(C, C) matrix and (C,) bias of the layer."""
    return extended(unet.attn1.weight), extended(unet.attn1.bias)


def exact_tokens(unet: Unet, latents: torch.Tensor) -> Extended:
    """(B, H W, C) output of the layer, in long double."""
    weights, bias = layer_weights(unet)
    values: Extended = extended(latents.flatten(2).transpose(1, 2)) @ weights.T + bias
    return values


def _views_of_a_batch(views: float, way: Way) -> float:
    """Error of a view's features, injected with others or alone, in steps of the type."""
    count = int(views)
    unet, latents = one_view_tokens(count, way)
    layer = Layer("attn1", "self", 0, CHANNELS)
    source, targets = (
        orbit(0, size=SIZE, height=1),
        [orbit(8.0 * k, size=SIZE, height=1) for k in range(count)],
    )
    warps = [_view(source, target, plane_depth(target, (1, 0, 0), 0.0), way) for target in targets]
    plan = RecordingPlan((layer,), (SIZE, SIZE), ("text",), 1, dtype=way.dtype)
    with torch.no_grad():
        with record(BareUNet(unet), plan) as recording:
            unet(latents[-1:], 0.0)
        weight = partial(a_t, s=replace(CORRECTED, a0=0.6))
        with inject(BareUNet(unet), recording, warps=warps, weight=weight):
            together = unet(latents[:count], 0.0)
        alone = []
        for k, warp in enumerate(warps):
            with inject(BareUNet(unet), recording, warps=[warp], weight=weight):
                alone.append(unet(latents[k : k + 1], 0.0))
    tokens = exact_tokens(unet, latents)
    expected = np.stack(
        [
            _blend_by_matrix(warp.at((SIZE, SIZE)), tokens[-1], tokens[k], 0.6)
            for k, warp in enumerate(warps)
        ]
    )
    step = torch.finfo(way.dtype).eps * np.abs(tokens).max()
    results = [extended(result) for result in (together, torch.cat(alone))]
    return float(max(np.abs(result - expected).max() for result in results) / step)


def _blend_by_matrix(
    layer: FeatureWarp, source: Extended, new: Extended, weight: float
) -> Extended:
    """(H W, C) a (M warp(source) + (1 - M) new) + (1 - a) new."""
    warped = sampling_matrix(extended(layer.correspondence.xy), SIZE, SIZE) @ source
    inside = layer.mask.numpy().reshape(-1, 1)
    return np.asarray(np.where(inside, np.longdouble(weight) * (warped - new) + new, new))


def _apart(yaw: float, way: Way) -> float:
    """Tokens accepted though the source camera, which only turned, does not show them; and bits
    outside the mask that a blend changes.
    """
    K = orbit(0, size=SIZE).K
    target = Camera(K, np.eye(4), SIZE, SIZE)
    angle = math.radians(yaw)
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = -math.sin(angle), math.sin(angle)
    source = Camera(K, pose, SIZE, SIZE)
    depth = np.full((SIZE, SIZE), 4.0)
    view = _view(source, target, depth, way)
    # A turn moves a direction's azimuth by the yaw, at any depth.
    x, y, _ = np.moveaxis(target.directions(), -1, 0)
    azimuth = np.arctan2(x, 1) - angle
    u = np.tan(azimuth)
    v = y * np.cos(np.arctan2(x, 1)) / np.cos(azimuth)
    px, py = u * K[0, 0] + K[0, 2], v * K[1, 1] + K[1, 2]
    ahead = np.abs(azimuth) < math.pi / 2
    visible = ahead & (px >= 0) & (px <= SIZE) & (py >= 0) & (py <= SIZE)
    layer = view.at((SIZE, SIZE))
    source_tokens, new = _tokens(way)
    result = first_step(layer, source_tokens + 2, new, 1.0)
    untouched = torch.from_numpy(~visible).reshape(-1)
    wrong = int((layer.mask.numpy() != visible).sum())
    return float(wrong + (result[:, untouched] != new[:, untouched]).sum())


def _behind_a_card(half: float, way: Way) -> float:
    """Tokens of a plane accepted though a card close to the source hides it from there, or rejected
    though nothing does; and values that a blend changes there, or that are not finite.
    """
    (source, target), card = (orbit(yaw, size=SIZE, height=1) for yaw in (0, 40)), 3.5

    def off_center(points: np.ndarray) -> np.ndarray:
        # Where the line from the source to a point crosses the card's plane, from its middle.
        x = source.position[0]
        crossing = source.position + (x - card) / (x - points[..., :1]) * (points - source.position)
        return np.asarray(np.abs((crossing - source.position * card / x)[..., 1:]).max(-1))

    depths = [plane_depth(camera, (1, 0, 0), 0.0) for camera in (source, target)]
    centers = target.pixel_centers()
    seen, points = (
        camera.unproject(centers, depth)
        for camera, depth in zip((source, target), depths, strict=True)
    )
    on_card = off_center(seen) < half
    depths[0] = np.where(on_card, plane_depth(source, (1, 0, 0), card), depths[0])
    away = off_center(points) - half
    xy, z = source.project(points)
    inside = (z > 0) & (xy >= 0).all(-1) & (xy <= SIZE).all(-1)
    normal = np.broadcast_to([1.0, 0, 0], (SIZE, SIZE, 3))
    surfaces = [Surface(torch.from_numpy(depth), normal) for depth in depths]
    view = warp_surfaces(
        source, target, surfaces[1], surfaces[0], preset("corrected"), backend=engine_of(way),
        warn_empty=False,
    )  # fmt: skip
    layer = view.at((SIZE, SIZE))
    tokens, new = _tokens(way)
    result = first_step(layer, tokens + 2, new, 1.0)
    # Within a pixel and a half of the card's outline both depths are read.
    near = np.abs(away) * source.K[0, 0] / (source.position[0] - card) < 1.5
    wrong = (layer.mask.numpy() != (inside & (away > 0))) & ~near
    hidden = torch.from_numpy((away < 0) & ~near).reshape(-1)
    changed = (result[:, hidden] != new[:, hidden]).sum() + (~result.isfinite()).sum()
    return float(wrong.sum() + changed)


def _latents(size: float, way: Way) -> float:
    """Distance in px of the layer's positions from exact ones; tokens must be finite."""
    n = int(size)
    K = np.array([[80.0, 0, 32], [0, 80.0, 32], [0, 0, 1]])
    near = np.eye(4)
    near[2, 3] = -1.0
    source, target = Camera(K, near, 64, 64), Camera(K, np.eye(4), 64, 64)
    view = _view(source, target, np.full((64, 64), 2.0), way)
    layer = view.at((n, n))
    # A step along the axis by half of the depth doubles the offsets from the middle.
    expected = 2 * (target.resize(n, n).pixel_centers() - n / 2) + n / 2
    tokens = torch.ones(1, n * n, 3, dtype=way.dtype)
    warped = layer.warp_tokens(tokens)
    if not torch.equal(warped, tokens):
        return math.inf
    return float(np.abs(layer.correspondence.xy.numpy() - expected).max())


ROUNDED = Bound("steps of the type", 0.51, "half precision is summed in float32, rounded once")

# Worst case, in halves of a step of the largest token T, to first order, with S the largest sum of
# |weight| |latent| + |bias|:
# - A token sums five terms: a product's rounding and four sums', 5 S, of source and target alike.
# - The place on the grid and its share are exact: multiples of the place's own last bit, below 1.
#   Of a share f, 1 - f is off by half of 1; of the four weights together that is 1 + 1 for their
#   products, so 2 T. In float32 they are rounded from float64: 1 T.
# - The four taps: a product and three sums, 4 T.
# - a = 0.6 and 1 - a = 0.4 are exact in float64 (Sterbenz), rounded once in float32: 0 or 1 T.
#   Their products: 1 T each. Their sum: 1 T, since a blend is no larger than its parts.
# float64: 0.6 (2 + 4 + 1) + 0.4 (1) + 1 = 5.6 T. float32: 0.6 (1 + 4 + 1 + 1) + 0.4 (1 + 1) + 1
# = 6 T. With S <= 1.18 T here (a test holds it): (5 S + 6 T) / 2 = 5.95 steps.
ONE_VIEW = Bound(
    "steps of the type at the largest token",
    5.95,
    "five roundings of a token, five or six of its warp and its blend, each by half a step",
)


def _step(alpha: float, way: Way) -> float:
    """Error of a DDIM step from an alpha-bar half of the way to 1, in steps of the type at its
    largest term, over all that a network may predict.
    """
    alphas = torch.tensor([(1 + alpha) / 2, alpha], dtype=torch.float64).float()
    generator = torch.Generator().manual_seed(0)
    x, output = torch.randn((2, 64), generator=generator, dtype=torch.float64).to(way.dtype)
    worst = 0.0
    for prediction in get_args(Prediction):
        if prediction == "epsilon" and not alpha:
            continue  # noise alone does not determine x_0
        result = DDIM(alphas, prediction, 1.0).step(output, x, 1, 0)
        for got, one, out in zip(result.double(), x.double(), output.double(), strict=True):
            terms = _step_terms(prediction, float(one), float(out), *map(float, alphas))
            scale = max(map(abs, terms)) * torch.finfo(way.dtype).eps
            worst = max(worst, abs(float(got) - math.fsum(terms)) / scale)
    return worst


def _step_terms(prediction: str, x: float, out: float, then: float, now: float) -> list[float]:
    """Terms of a step's result, each rounded once from mpmath: of x_0, and of the noise."""
    with mpmath.workdps(50):
        a, b = mpmath.mpf(now), mpmath.mpf(then)
        ra, rb, na, nb = (mpmath.sqrt(v) for v in (a, b, 1 - a, 1 - b))
        match prediction:
            case "sample":
                terms = [rb * out, nb * x / na, -nb * ra * out / na]
            case "epsilon":
                terms = [rb * x / ra, -rb * na * out / ra, nb * out]
            case _:
                terms = [rb * ra * x, -rb * na * out, nb * ra * out, nb * na * x]
        return [float(term) for term in terms]


def _missed(found: Drift | None, motion: Sequence[float]) -> float:
    """Largest error of a drift in its half widths; 0 if it is not told."""
    if found is None:
        return 0.0
    values = np.array([found.right, found.down, found.scale, found.turn])
    return float((np.abs(values - motion) / found.half_widths).max())


def _stripes(noise: float, way: Way) -> float:
    """Largest error of the drift of stripes that did not move, in half widths."""
    worst, at = 0.0, np.arange(128) + 0.5
    for number, angle in enumerate((0, 2.0)):
        x, y = np.meshgrid(at, at)
        across, draw = np.cos(angle) * x + np.sin(angle) * y, np.random.default_rng(number)
        for values in (
            0.5 + 0.4 * np.tanh(4 * np.sin(2 * np.pi * across / 17)),
            0.2 + 0.6 * draw.random(20)[(across // 17).astype(int) % 20],
            0.5 + 0.12 * sum(np.sin(across / c + c) for c in (2.3, 4.1, 5.9, 11.0)),
        ):
            before = np.repeat(values[..., None], 3, axis=2)
            pictures = (before, before * [0.9, 0.6, 0.8])
            one, two = (to_bytes(p + noise * draw.normal(size=p.shape)) for p in pictures)
            worst = max(worst, _missed(drift(one, two), (0.0, 0.0, 0.0, 0.0)))
    return worst


def _one_row(height: float, way: Way) -> float:
    """Largest error of a known drift of a row of texture, in half widths."""
    motion = right, down, percent, degrees = 2.0, -1.5, 1.0, 0.5
    draw, at = np.random.default_rng(0), np.arange(128) - 63.5
    waves, phases = draw.uniform(-0.5, 0.5, (2, 20)), draw.uniform(0, 2 * np.pi, 20)
    turn = np.radians(degrees)
    back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def picture(points: np.ndarray) -> np.ndarray:
        inside = 1 / (1 + np.exp((np.abs(points[..., 1]) - 64 * height) / 0.7)) if height else 0
        values = np.tanh(0.6 * np.sin(points @ waves + phases).sum(-1))
        return to_bytes(np.repeat((0.5 + 0.4 * inside * values)[..., None], 3, axis=2))

    x, y = np.meshgrid(at, at)
    moved = np.stack([x - right, y - down], -1) @ back.T / (1 + percent / 100)
    return _missed(drift(picture(np.stack([x, y], -1)), picture(moved)), motion)


DRIFT = Bound(
    "half widths", 3, "a 99 % half width, thrice: the errors of benchmarks/drift.py reach 2.6"
)

CASES = [
    hard("drift_of_stripes", _stripes, (Way("drift", "float32"),), bounds=DRIFT),
    hard("drift_of_one_row", _one_row, (Way("drift", "float32"),), bounds=DRIFT),
    hard("half_attention", _magnitude, ways("reference", "cpu", precisions=HALVES), bounds=ROUNDED),
    hard(
        "blend_weight",
        _weight,
        tuple(way for way in EVERY_TYPE if way.precision != "float64"),
        bounds=Bound("steps of the type", 4, "four taps and two products, each rounded in float32"),
    ),
    hard("empty_mask_of_tokens", _outside, EVERY_TYPE, bounds=exact("changed values")),
    hard("one_view", _views_of_a_batch, ways("reference", "cpu"), bounds=ONE_VIEW),
    hard("views_apart", _apart, EVERY_TYPE, bounds=exact("wrong tokens")),
    hard("hidden_from_the_source", _behind_a_card, EVERY_TYPE, bounds=exact("wrong tokens")),
    hard(
        "one_latent",
        _latents,
        EVERY_TYPE,
        bounds=Bound("px of the layer", 1e-4, "numerics of the warp"),
    ),
    hard(
        "alpha_bar",
        _step,
        ways("schedule", precisions=("float64", "float32", *HALVES)),
        bounds=Bound("steps of the type", 4, "eight roundings of its terms, each by half"),
    ),
]
