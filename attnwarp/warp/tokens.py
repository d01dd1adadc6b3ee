"""Sampling and blending of tokens in torch: the definition, and the path of GPUs.

Tokens are what attention works on: (B, H*W, C), a row of C contiguous values for each pixel, row by
row of the picture.
"""

from __future__ import annotations

import torch
from torch import Tensor

from attnwarp.warp.taps import Taps


def work_type(dtype: torch.dtype) -> torch.dtype:
    """The type of weights and sums: float32 for half precision, else the features' own."""
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def sample_rows(tokens: Tensor, taps: Taps) -> Tensor:
    """(B, N, C) sums of weighted tokens, in the type of the weights.

    Args:
        tokens: (B, h*w, C).
        taps: of N positions, with weights of :func:`work_type`, on the tokens' device.
    """
    total = torch.zeros((), dtype=taps.weight.dtype, device=tokens.device)
    for k in range(4):
        share = taps.weight[:, k, None]
        value = tokens[:, taps.index[:, k]].to(total.dtype)
        # A tap of weight 0 may hold anything, an infinity included.
        total = total + torch.where(share > 0, value * share, 0)
    return total


def blend_rows(warped: Tensor, new: Tensor, mask: Tensor, alpha: float) -> Tensor:
    """a (M warped + (1 - M) new) + (1 - a) new, in the type of ``new``.

    Args:
        warped: (B, N, C) in :func:`work_type`.
        new: (B, N, C).
        mask: (N,) bool. Where it is False the result has the bits of ``new``.
        alpha: in [0, 1].
    """
    mixed = alpha * warped + (1 - alpha) * new.to(warped.dtype)
    return torch.where(mask[:, None], mixed.to(new.dtype), new)
