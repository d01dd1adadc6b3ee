"""Noise that sticks to the surface: a surface point has the same noise in every view.

All views share the same noise values in different orders. A pixel takes the value of the nearest
pixel of its source; unused values go to pixels without a source. The order follows from the
geometry alone, so a view's noise is exactly as white as the initial draw, with the same mean.
(Interpolated noise is not white: its variance falls and neighbours correlate. Chang et al., "How I
Warped Your Noise", ICLR 2024, subdivide pixels and sum the parts instead.)
"""

from __future__ import annotations

from collections.abc import Sequence

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


def unmoved(size: tuple[int, int]) -> Tensor:
    """Return the order of a first source, (h, w) int64: the pixels' numbers in turn."""
    return torch.arange(size[0] * size[1]).reshape(size)


def carried(sources: Sequence[Tensor], positions: Sequence[Tensor], choice: Tensor) -> Tensor:
    """Compute the order of a target's noise.

    Of several pixels that claim one value, the pixel nearest to the value's source pixel gets it,
    the first of equally near ones. Each remaining pixel takes the value of its number in order if
    free; the rest take the free values in order.

    Args:
        sources: (h, w) int64 order of each source: its pixel p has value number ``order[p]``.
        positions: (h, w, 2) positions in px of each source's grid (centres at +0.5).
        choice: (h, w) number of each pixel's source, -1 for none.

    Returns:
        (h, w) int64, a permutation of the h w numbers.

    Example:
        >>> x = torch.tensor([1.2, 1.6, 2.5, 3.5])  # the first two both fall into pixel 1
        >>> xy = torch.stack([x, torch.full((4,), 0.5)], dim=-1)[None]
        >>> source, first = unmoved((1, 4)), torch.zeros(1, 4, dtype=torch.int64)
        >>> carried([source], [xy], first).tolist()
        [[0, 1, 2, 3]]
        >>> carried([source], [xy + torch.tensor([1.0, 0])], first).tolist()
        [[0, 2, 3, 1]]
    """
    h, w = choice.shape
    pixels, values, distances = [], [], []
    for number, (order, xy) in enumerate(zip(sources, positions, strict=True)):
        check.shape(order, (h, w), "sources")
        check.shape(xy, (h, w, 2), "positions")
        inside = (xy >= 0).all(dim=-1) & (xy[..., 0] <= w) & (xy[..., 1] <= h)  # False for NaN
        wanted = ((choice == number) & inside).flatten()
        place = xy.reshape(-1, 2)[wanted]
        column, row = place[:, 0].floor().clamp(max=w - 1), place[:, 1].floor().clamp(max=h - 1)
        pixels.append(wanted.nonzero()[:, 0].numpy())
        values.append(order.flatten()[(row * w + column).long()].numpy())
        center = torch.stack([column, row], dim=-1) + 0.5
        distances.append((place - center).square().sum(dim=-1).numpy())
    pixel, value = np.concatenate(pixels), np.concatenate(values)
    ranked = np.lexsort((pixel, np.concatenate(distances), value))
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
