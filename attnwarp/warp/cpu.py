"""The kernels of the CPU as differentiable steps on tensors.

Threads follow ``torch.set_num_threads``, as the renderer's do; the result has the same bits for any
number of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.render import _pool
from attnwarp.render.threads import ranges, run_jobs
from attnwarp.warp._kernels import sampling as kernels
from attnwarp.warp.taps import Taps

PIECE = 1 << 16
"""Values that one job writes, about: a few hundred kilobytes, which stay in the cache."""
CHANNELS = 64
"""Channels of one job of a gradient: whole cache lines."""
_STORED = {torch.float16: np.uint16, torch.bfloat16: np.int16}


def sample_maps(maps: Tensor, taps: Taps) -> Tensor:
    """:func:`attnwarp.warp.sampling.sample_maps` by kernels."""
    planes = maps.reshape(-1, maps.shape[-1])
    result: Tensor = _SampleMaps.apply(planes, taps)
    return result.reshape(*maps.shape[:-1], taps.index.shape[1])


def sample_tokens(tokens: Tensor, taps: Taps) -> Tensor:
    """:func:`attnwarp.warp.sampling.sample_tokens` by kernels, in the type of the tokens."""
    result: Tensor = _SampleTokens.apply(tokens, taps)
    return result


def blend_tokens(
    source: Tensor, new: Tensor, taps: Taps, mask: Tensor, alpha: float, *, in_place: bool = False
) -> Tensor:
    """:func:`attnwarp.warp.sampling.blend_tokens` by kernels; to ``new`` itself if ``in_place``."""
    if in_place and new.is_contiguous():
        _blend(_values(source), _values(new), taps, mask, alpha)
        return new
    result: Tensor = _BlendTokens.apply(source, new, taps, mask, alpha)
    return new.copy_(result) if in_place else result


class _SampleMaps(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, planes: Tensor, taps: Taps) -> Tensor:
        source, (index, weight) = _values(planes), taps.arrays
        result = _pool.empty((len(source), index.shape[1]), source.dtype)
        size = max(kernels.PLANES, PIECE // max(1, index.shape[1]))
        run_jobs(
            kernels.sample_maps,
            [(*piece, source, index, weight, result) for piece in ranges(len(source), size)],
        )
        ctx.taps, ctx.shape = taps, planes.shape
        return _tensor(result, planes.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        index, weight = ctx.taps.arrays
        gradient = _values(upstream.to(ctx.taps.weight.dtype))
        result = _pool.zeros(tuple(ctx.shape), weight.dtype)
        run_jobs(
            kernels.scatter_maps,
            [
                (*piece, gradient, index, weight, result)
                for piece in ranges(len(result), kernels.PLANES)
            ],
        )
        return torch.from_numpy(result).to(upstream.dtype), None


class _SampleTokens(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tokens: Tensor, taps: Taps) -> Tensor:
        source, (index, weight) = _values(tokens), taps.arrays
        result = _pool.empty((len(source), index.shape[1], source.shape[2]), source.dtype)
        run_jobs(
            kernels.sample_rows,
            [(*piece, source, index, weight, result) for piece in _pieces(result)],
        )
        ctx.taps, ctx.shape = taps, tokens.shape
        return _tensor(result, tokens.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        share = np.ones(upstream.shape[1], ctx.taps.arrays[1].dtype)
        return _scatter(upstream, ctx.taps, share, ctx.shape), None


class _BlendTokens(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, source: Tensor, new: Tensor, taps: Taps, mask: Tensor, alpha: float
    ) -> Tensor:
        own = _values(new)
        result = _pool.empty(own.shape, own.dtype)
        run_jobs(kernels.copy_rows, [(*piece, own, result) for piece in _pieces(result)])
        _blend(_values(source), result, taps, mask, alpha)
        ctx.taps, ctx.mask, ctx.alpha, ctx.shape = taps, mask, alpha, source.shape
        return _tensor(result, new.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, upstream: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        share = ctx.alpha * ctx.mask.to(ctx.taps.weight.dtype)
        source = own = None
        if ctx.needs_input_grad[0]:
            source = _scatter(upstream, ctx.taps, share.numpy(), ctx.shape)
        if ctx.needs_input_grad[1]:
            own = (upstream * (1 - share)[:, None]).to(upstream.dtype)
        return source, own, None, None, None


def _blend(source: np.ndarray, result: np.ndarray, taps: Taps, mask: Tensor, alpha: float) -> None:
    index, weight = taps.arrays
    shares = weight.dtype.type(alpha), weight.dtype.type(1 - alpha)
    run_jobs(
        kernels.blend_rows,
        [
            (*piece, source, index, weight, mask.numpy(), *shares, result)
            for piece in _pieces(result)
        ],
    )


def _scatter(upstream: Tensor, taps: Taps, share: np.ndarray, shape: torch.Size) -> Tensor:
    index, weight = taps.arrays
    gradient = _values(upstream.to(taps.weight.dtype))
    result = _pool.zeros(tuple(shape), weight.dtype)
    run_jobs(
        kernels.scatter_rows,
        [(*piece, gradient, index, weight, share, result) for piece in ranges(shape[2], CHANNELS)],
    )
    return torch.from_numpy(result).to(upstream.dtype)


def _pieces(tokens: np.ndarray) -> list[tuple[int, int]]:
    batch, count, channels = tokens.shape
    return ranges(count, max(1, PIECE // max(1, batch * channels)))


def _values(tensor: Tensor) -> np.ndarray:
    """The tensor's own memory where it is contiguous, half precision as integers."""
    tensor = tensor.detach().contiguous()
    stored = _STORED.get(tensor.dtype)
    return tensor.numpy() if stored is None else tensor.view(torch.int16).numpy().view(stored)


def _tensor(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    if dtype in _STORED:
        return torch.from_numpy(values.view(np.int16)).view(dtype)
    return torch.from_numpy(values)
