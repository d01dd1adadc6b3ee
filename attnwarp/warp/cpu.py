"""CPU kernels on tensors: pairs of views, and differentiable sampling.

Threads follow ``torch.set_num_threads``, as in the renderer; the result has the same bits for any
number of threads.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.render.threads import ranges, run_jobs, thread_count
from attnwarp.warp._kernels import pair, sampling
from attnwarp.warp.correspondence import Correspondence, check_proportions
from attnwarp.warp.depth import Array, as_tensor
from attnwarp.warp.masks import axis_weights
from attnwarp.warp.rules import RULES, Rule
from attnwarp.warp.settings import DepthInterpolation, MaskResize, WarpSettings
from attnwarp.warp.taps import SNAP, Taps

PIECE = 1 << 16
"""Approximate number of values written by one job: a few hundred kilobytes, which fit the cache."""
CHANNELS = 64
"""Number of channels of one gradient job: complete cache lines."""
_STORED = {torch.float16: np.uint16, torch.bfloat16: np.int16}


def correspond_and_mask(
    source: Camera,
    target: Camera,
    parts: Mapping[str, Array],
    rules: Sequence[Rule],
    settings: WarpSettings,
) -> tuple[Correspondence, dict[str, Tensor], Tensor]:
    """Compute the correspondence and the rules that have a kernel, in one pass over the pixels.

    Args:
        parts: parts of both surfaces, by :func:`attnwarp.warp.rules.parts_of`, with checked
            pictures.

    Returns:
        Correspondence, the (H, W) mask of each rule with a kernel, and their conjunction.
    """
    size = (target.height, target.width)
    kernels = [rule for name in pair.RULES for rule in RULES if rule.name == name]
    asked = [rule for rule in rules if rule in kernels]
    row = {name: k for k, name in enumerate(("defined", "in_bounds", *(r.name for r in asked)))}
    rows = tuple(row.get(rule.name, -1) for rule in kernels)
    limits = tuple(
        tuple(_limit(getattr(settings, field)) for field in rule.limits.values())
        for rule in kernels
    )
    read = {"target_depth", *(part for rule in asked for part in rule.parts)}
    seen, other = _views(source, {k: part for k, part in parts.items() if k in read}, size)
    positions = _positions(size)
    passes, mask = np.empty((len(row), *size), np.bool_), np.empty(size, np.bool_)
    views = _pair(source, target, settings)
    run_jobs(
        pair.rules_of_pair,
        [
            (*piece, views, rows, limits, seen, other, positions, passes, mask)
            for piece in _rows(size[0])
        ],
    )
    masks = {name: torch.from_numpy(passes[k]) for name, k in row.items()}
    return _correspondence(source, target, positions, settings), masks, torch.from_numpy(mask)


def correspond_layer(
    source: Camera,
    target: Camera,
    target_depth: Tensor,
    settings: WarpSettings,
) -> Correspondence:
    """Compute :func:`attnwarp.warp.correspond_at` by kernels.

    Args:
        target_depth: (H, W) float64 depth of the target's image.
    """
    positions = _positions((target.height, target.width))
    views = _pair(source, target, settings)
    how = _INTERPOLATION[settings.depth_interpolation]
    depth = target_depth.contiguous().numpy()
    run_jobs(
        pair.layer,
        [
            (*piece, views, depth, how, _limit(settings.depth_spread), positions)
            for piece in _rows(target.height)
        ],
    )
    return _correspondence(source, target, positions, settings)


def resize_mask(mask: Tensor, size: tuple[int, int], mode: MaskResize, defined: Tensor) -> Tensor:
    """Compute :func:`attnwarp.warp.resize_mask` by kernels and intersect ``defined``, (h, w)."""
    rows, columns = _axis(size[0], mask.shape[0], mode), _axis(size[1], mask.shape[1], mode)
    result = np.empty(size, np.bool_)
    run_jobs(
        pair.resize_mask,
        [
            (*piece, mask.contiguous().numpy(), rows, columns, defined.numpy(), result)
            for piece in _rows(size[0])
        ],
    )
    return torch.from_numpy(result)


def taps_at(
    correspondence: Correspondence, size: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> Taps:
    """Compute :func:`attnwarp.warp.sampling.taps_at` by kernels; ``device`` must be the CPU."""
    xy = correspondence.xy.contiguous().numpy()
    shape = (4, *xy.shape[:2])
    index = np.empty(shape, np.int32)
    weight = np.empty(shape, np.float32 if dtype == torch.float32 else np.float64)
    source, integer = _lens(correspondence.source), correspondence.pixel_centers == "integer"
    run_jobs(
        pair.taps_of,
        [(*piece, xy, source, integer, size, SNAP, index, weight) for piece in _rows(xy.shape[0])],
    )
    return Taps(*(torch.from_numpy(part.reshape(4, -1)) for part in (index, weight)))


def sample_maps(maps: Tensor, taps: Taps) -> Tensor:
    """Compute :func:`attnwarp.warp.sampling.sample_maps` by kernels."""
    planes = maps.reshape(-1, maps.shape[-1])
    result: Tensor = _Sampled.apply(planes, taps, False)
    return result.reshape(*maps.shape[:-1], taps.index.shape[1])


def sample_tokens(tokens: Tensor, taps: Taps) -> Tensor:
    """Compute :func:`attnwarp.warp.sampling.sample_tokens` by kernels, in the tokens' dtype."""
    result: Tensor = _Sampled.apply(tokens, taps, True)
    return result


class _Sampled(torch.autograd.Function):
    """Planes (N, pixels), or tokens (N, pixels, C), read at taps."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, taps: Taps, tokens: bool) -> Tensor:
        source, (index, weight) = _values(values), taps.arrays
        result = np.empty((len(source), index.shape[1], *source.shape[2:]), source.dtype)
        if tokens:
            kernel, pieces = sampling.sample_rows, _pieces(result)
        else:
            size = max(sampling.PLANES, PIECE // max(1, index.shape[1]))
            kernel, pieces = sampling.sample_maps, ranges(len(source), size)
        run_jobs(kernel, [(*piece, source, index, weight, result) for piece in pieces])
        ctx.taps, ctx.shape, ctx.tokens = taps, values.shape, tokens
        return _tensor(result, values.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        index, weight = ctx.taps.arrays
        gradient = _values(upstream.to(ctx.taps.weight.dtype))
        result = np.zeros(tuple(ctx.shape), weight.dtype)
        if ctx.tokens:
            kernel, pieces = sampling.scatter_rows, ranges(result.shape[2], CHANNELS)
        else:
            kernel, pieces = sampling.scatter_maps, ranges(len(result), sampling.PLANES)
        run_jobs(kernel, [(*piece, gradient, index, weight, result) for piece in pieces])
        return torch.from_numpy(result).to(upstream.dtype), None, None


def _pieces(tokens: np.ndarray) -> list[tuple[int, int]]:
    batch, count, channels = tokens.shape
    return ranges(count, max(1, PIECE // max(1, batch * channels)))


def _values(tensor: Tensor) -> np.ndarray:
    """View a tensor as numpy (a copy unless contiguous), half precision as integers."""
    tensor = tensor.detach().contiguous()
    stored = _STORED.get(tensor.dtype)
    return tensor.numpy() if stored is None else tensor.view(torch.int16).numpy().view(stored)


def _tensor(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    if dtype in _STORED:
        return torch.from_numpy(values.view(np.int16)).view(dtype)
    return torch.from_numpy(values)


_INTERPOLATION: dict[DepthInterpolation, int] = {
    "inverse": pair.INVERSE,
    "bilinear": pair.BILINEAR,
    "nearest": pair.NEAREST,
}


@functools.lru_cache(maxsize=32)
def _axis(new: int, old: int, mode: MaskResize) -> pair.Axis:
    weights = axis_weights(new, old, mode).numpy()
    used = weights > 0
    return pair.Axis(weights, used.argmax(axis=1), old - used[:, ::-1].argmax(axis=1))


def _rows(height: int) -> list[tuple[int, int]]:
    return ranges(height, max(1, -(-height // (4 * thread_count()))))


def _limit(value: float | None) -> float:
    return float("inf") if value is None else value


def _lens(camera: Camera) -> pair.Lens:
    K = camera.K
    values = (K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height)
    return pair.Lens(*map(float, values))


def _pair(source: Camera, target: Camera, settings: WarpSettings) -> pair.Pair:
    bounds = source if settings.bounds == "source" else target
    return pair.Pair(
        _lens(source),
        _lens(target),
        np.ascontiguousarray(source.relative_to(target)[:3]),
        source.rotation.copy(),
        target.rotation.copy(),
        settings.pixel_centers == "integer",
        settings.in_front,
        SNAP,
        float(bounds.width),
        float(bounds.height),
    )


def _positions(size: tuple[int, int]) -> pair.Positions:
    return pair.Positions(
        np.empty((*size, 2), np.float64),
        np.empty((*size, 3), np.float64),
        np.empty(size, np.float64),
    )


def _correspondence(
    source: Camera, target: Camera, positions: pair.Positions, settings: WarpSettings
) -> Correspondence:
    xy, points, depth = (torch.from_numpy(part) for part in positions)
    return Correspondence(
        source, target, xy, points, depth, settings.pixel_centers, settings.in_front
    )


def _views(
    source: Camera, maps: Mapping[str, Array], size: tuple[int, int]
) -> tuple[pair.View, pair.View]:
    """Collect the target's and source's maps read by the rules: all float32 or all float64."""
    arrays = {name: _floating(value, name) for name, value in maps.items()}
    for name, array in arrays.items():
        view, _, part = name.partition("_")
        axes = _AXES[part]
        check.shape(array, (*(size if view == "target" else ("H", "W")), *axes), name)
        if view == "source":
            check_proportions(array.shape, source, name)
    single = all(array.dtype == np.float32 for array in arrays.values())
    kind = np.float32 if single else np.float64

    def view_of(view: str) -> pair.View:
        nothing = {part: np.zeros((0, 0, *(0 for _ in axes)), kind) for part, axes in _AXES.items()}
        return pair.View(
            *(
                np.ascontiguousarray(arrays.get(f"{view}_{part}", empty), kind)
                for part, empty in nothing.items()
            )
        )

    return view_of("target"), view_of("source")


_AXES: dict[str, tuple[int | str, ...]] = {
    "depth": (),
    "alpha": (),
    "image": ("C",),
    "normal": (3,),
}
"""Parts of a surface in the order of :class:`pair.View`, and their axes after (H, W)."""


def _floating(value: Array, name: str) -> np.ndarray:
    tensor = as_tensor(value, name)
    return (tensor.float() if tensor.dtype in _STORED else tensor).cpu().numpy()
