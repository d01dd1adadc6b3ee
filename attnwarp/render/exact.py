"""Exact distortion of the backends with kernels: it takes a second pass, which runs on first
use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from attnwarp.render.interface import PICTURES, Inputs, Outputs


class _Exact(torch.autograd.Function):
    """The exact distortion as a differentiable output.

    Its gradient goes to a placeholder among the outputs of the first pass, whose backward pass
    handles it together with the gradients of the other outputs.
    """

    @staticmethod
    def forward(ctx: Any, placeholder: Tensor, make: Callable[[], Tensor]) -> Tensor:
        return make()

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        return upstream, None


def outputs_of(
    inputs: Inputs,
    tensors: Sequence[Tensor],
    counters: dict[str, int],
    of_drawn: Callable[[], Tensor],
    anew: Callable[[], Tensor],
) -> Outputs:
    """Assemble the outputs of a backend.

    Args:
        tensors: pictures, a placeholder for the exact distortion, and the weights.
        of_drawn: function that computes the exact distortion from the first pass's state.
        anew: function that computes it by drawing again.
    """
    *pictures, placeholder, weight = tensors
    # Without gradients no state is kept for a second pass, which most pictures never need.
    exact = (
        partial(_later, placeholder, of_drawn)
        if placeholder.requires_grad
        else partial(_anew, inputs, _versions(inputs), anew)
    )
    named = dict(zip(PICTURES, pictures, strict=True))
    return Outputs(**named, weight=weight, counters=counters, exact=exact)


def _later(placeholder: Tensor, make: Callable[[], Tensor]) -> Tensor:
    # The first reader may have disabled gradients, but later readers share the result.
    with torch.enable_grad():
        result: Tensor = _Exact.apply(placeholder, make)
    return result


def _versions(inputs: Inputs) -> list[int]:
    tensors = (inputs.means, inputs.quats, inputs.scales, inputs.opacities)
    return [0 if tensor.is_inference() else tensor._version for tensor in tensors]


def _anew(inputs: Inputs, versions: list[int], make: Callable[[], Tensor]) -> Tensor:
    if _versions(inputs) != versions:
        raise RuntimeError(
            "distortion_l1: is made when it is first read, and the splats were modified by an"
            " inplace operation since they were rendered; read it before that"
        )
    with torch.no_grad():
        return make()
