"""Noise that sticks to the surface: a surface point has the same noise in every view.

All views share the same noise values in different orders. A pixel takes the value of the nearest
pixel of its source; unused values go to pixels without a source. The order follows from the
geometry alone, so a view's noise is exactly as white as the initial draw, with the same mean.
(Interpolated noise is not white: its variance falls and neighbours correlate. Chang et al., "How I
Warped Your Noise", ICLR 2024, subdivide pixels and sum the parts instead.)
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from attnwarp import check

FRESH = 4
"""Purpose of drawing a view's separate noise, in addition to the purposes of
:mod:`attnwarp.methods.work`.
"""


def own_seed(*numbers: int) -> int:
    """Hash several numbers into one seed, such as a run's seed, a purpose and a view.

    Other numbers of the same count, each in [0, 2^32), give another seed. (A final 0 counts as
    absent, and a larger number as two.)

    Example:
        >>> own_seed(0, FRESH, 1) != own_seed(1, FRESH, 0)  # as their sums would be
        True
    """
    entropy = np.random.SeedSequence(numbers)
    return int(entropy.generate_state(1, np.uint64)[0] >> np.uint64(1))


def carried(positions: Tensor, mask: Tensor) -> Tensor:
    """Compute the order of a target's noise from where its pixels lie in the source.

    Of several pixels that claim one value, the pixel nearest to the value's source pixel gets it,
    the first of equally near ones. Each remaining pixel takes the value of its number in order if
    free; the rest take the free values in order.

    Args:
        positions: (h, w, 2) positions in px of the source's grid (centres at +0.5).
        mask: (h, w) bool: pixels that show what the source shows.

    Returns:
        (h, w) int64, a permutation of the numbers of the source's h w pixels in turn.

    Example:
        >>> x = torch.tensor([1.2, 1.6, 2.5, 3.5])  # the first two both fall into pixel 1
        >>> xy = torch.stack([x, torch.full((4,), 0.5)], dim=-1)[None]
        >>> seen = torch.ones(1, 4, dtype=torch.bool)
        >>> carried(xy, seen).tolist()
        [[0, 1, 2, 3]]
        >>> carried(xy + torch.tensor([1.0, 0]), seen).tolist()
        [[0, 2, 3, 1]]
    """
    h, w = mask.shape
    check.shape(positions, (h, w, 2), "positions")
    # False for NaN
    inside = (positions >= 0).all(dim=-1) & (positions[..., 0] <= w) & (positions[..., 1] <= h)
    wanted = (mask & inside).flatten()
    place = positions.reshape(-1, 2)[wanted]
    column, row = place[:, 0].floor().clamp(max=w - 1), place[:, 1].floor().clamp(max=h - 1)
    center = torch.stack([column, row], dim=-1) + 0.5
    distance = (place - center).square().sum(dim=-1).numpy()
    pixel, value = wanted.nonzero()[:, 0].numpy(), (row * w + column).long().numpy()
    ranked = np.lexsort((pixel, distance, value))
    pixel, value = pixel[ranked], value[ranked]
    first = np.ones(len(value), dtype=bool)
    first[1:] = value[1:] != value[:-1]
    result = np.full(h * w, -1)
    result[pixel[first]] = value[first]
    free = np.setdiff1d(np.arange(h * w), value)
    own = free[result[free] < 0]
    result[own] = own
    result[result < 0] = np.setdiff1d(free, own)
    return torch.from_numpy(result.reshape(h, w))
