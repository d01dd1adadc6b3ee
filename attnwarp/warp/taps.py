"""Bilinear taps: the pixels read by a position, and their weights."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

SNAP = 1e-7
"""Distance in px below which coordinates snap to a tap, so that a view warped onto itself keeps its
bits.
"""


def clamp_index(value: Tensor, length: int) -> Tensor:
    """Clamp values to integer indices of an axis of ``length`` pixels."""
    return value.clamp(0, length - 1).long()


def bilinear_taps(xy: Tensor, h: int, w: int) -> tuple[list[Tensor], Tensor]:
    """Compute flat indices (four of (H, W)) and weights (4, H, W) of bilinear sampling at finite
    positions, borders clamped.
    """
    low: list[Tensor] = []
    share: list[Tensor] = []
    for position, length in ((xy[..., 0], w), (xy[..., 1], h)):
        index = (position - 0.5).clamp(-1, length)
        nearest = torch.round(index)
        index = torch.where((index - nearest).abs() < SNAP, nearest, index)
        floor = torch.floor(index)
        low.append(floor)
        share.append(index - floor)
    x0, x1 = clamp_index(low[0], w), clamp_index(low[0] + 1, w)
    y0, y1 = clamp_index(low[1], h), clamp_index(low[1] + 1, h)
    fx, fy = share
    taps = [y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1]
    weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    return taps, weight


@dataclass(frozen=True, eq=False)
class Taps:
    """Four taps of N positions on one grid of pixels.

    Args:
        index: (4, N) int64 or int32, flat indices into the grid's pixels, row by row.
        weight: (4, N) float64 or float32, in [0, 1]; 0 for an unread tap. An undefined position
            has four unread taps.
    """

    index: Tensor
    weight: Tensor

    @functools.cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ``index`` as uint32 and ``weight``, for the kernels."""
        index = self.index.to(device="cpu", dtype=torch.int32).numpy()
        return index.view(np.uint32), self.weight.cpu().numpy()


def taps_of(xy: Tensor, h: int, w: int) -> Taps:
    """Compute the taps of positions on an h x w grid, weights in float64.

    Args:
        xy: (H, W, 2) float64 positions in pixels of the grid (centres at +0.5); NaN reads no tap.
    """
    # NaN is masked before it reaches an index.
    defined = torch.isfinite(xy).all(dim=-1)
    index, weight = bilinear_taps(torch.where(defined[..., None], xy, 0.5), h, w)
    return Taps(torch.stack(index).flatten(1), torch.where(defined, weight, 0).flatten(1))
