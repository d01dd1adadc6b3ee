"""Masks on the grids of feature maps."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp.settings import MaskResize


def resize_mask(mask: check.Array, size: tuple[int, int], mode: MaskResize = "area") -> Tensor:
    """Resize a mask to another grid; a pixel covered by more than half is True.

    Args:
        mask: (H, W) bool mask.
        size: (h, w) of the new grid.
        mode: "area" weighs every mask pixel by its overlap with the new pixel; "bilinear" reads the
            4 pixels around the new centre; "nearest" the pixel that contains the new centre.

    Returns:
        (h, w) bool.

    Raises:
        ValueError: the mask has a wrong shape or type, the size is not a pair of positive integers,
            or the mode is unknown.

    Example:
        >>> import torch
        >>> from attnwarp.warp import resize_mask
        >>> resize_mask(torch.tensor([[True, True, True, False, False, False]]), (1, 2)).tolist()
        [[True, False]]
    """
    check.one_of(mode, get_args(MaskResize), "mode")
    mask = check.tensor(mask, "mask")
    if mask.dtype != torch.bool:
        raise ValueError(f"mask: got {mask.dtype}, expected bool")
    check.shape(mask, ("H", "W"), "mask")
    h, w = check.size(size, "size")
    rows = axis_weights(h, mask.shape[0], mode)
    columns = axis_weights(w, mask.shape[1], mode)
    share = rows @ mask.double().cpu() @ columns.T
    # Exactly half of a pixel must not count, even if the sum's rounding exceeds a half.
    return (share > 0.5 + 1e-9).to(mask.device)


@functools.lru_cache(maxsize=32)
def axis_weights(new: int, old: int, mode: MaskResize) -> Tensor:
    """Compute the share of each old pixel in each new one, (new, old) float64; read-only."""
    weigh: Callable[[int, int], Tensor] = {
        "area": _area_weights,
        "bilinear": _linear_weights,
        "nearest": _nearest,
    }[mode]
    return weigh(new, old)


def _area_weights(new: int, old: int) -> Tensor:
    low = torch.arange(new, dtype=torch.float64)[:, None] * (old / new)
    high = low + old / new
    pixel = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(high, pixel + 1) - torch.maximum(low, pixel)
    return overlap.clamp_min(0) * (new / old)


def _linear_weights(new: int, old: int) -> Tensor:
    index = (torch.arange(new, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    index = index.clamp(0, old - 1)
    return (1 - (index[:, None] - torch.arange(old, dtype=torch.float64)).abs()).clamp_min(0)


def _nearest(new: int, old: int) -> Tensor:
    index = (
        torch.floor((torch.arange(new, dtype=torch.float64) + 0.5) * (old / new))
        .long()
        .clamp(0, old - 1)
    )
    return torch.nn.functional.one_hot(index, old).double()
