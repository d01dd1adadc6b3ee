"""Noise that sticks to the surface: a point has the same noise in every view that shows it.

Every pixel of every view has a white value of its own. A target's pixel takes the value of the
nearest pixel of its source instead, unless another pixel of the target takes that very value. So the
pixels of a view hold different values, chosen by geometry alone: their noise is white, exactly.
(Interpolated noise is not: its variance falls and neighbours correlate. Chang et al., "How I Warped
Your Noise", ICLR 2024, sum the parts of subdivided pixels instead.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from attnwarp import check


@dataclass(frozen=True, eq=False)
class NoiseField:
    """The noise of a view.

    Attributes:
        values: (C, h, w), white with unit variance.
        origin: (h, w) int64: view and pixel whose own value it is; equal numbers, equal values.
    """

    values: Tensor
    origin: Tensor

    @classmethod
    def own(cls, values: Tensor, view: int) -> NoiseField:
        """A field that carries nothing.

        Args:
            values: (C, h, w) white noise of the view's own.
            view: its number.

        Example:
            >>> NoiseField.own(torch.zeros(4, 2, 3), 1).origin[1].tolist()
            [4294967299, 4294967300, 4294967301]
        """
        check.shape(values, ("C", "h", "w"), "values")
        h, w = values.shape[1:]
        return cls(values, (view << 32) + torch.arange(h * w).reshape(h, w))


def carried(
    own: NoiseField, sources: Sequence[NoiseField], positions: Sequence[Tensor], choice: Tensor
) -> NoiseField:
    """A target's noise: its source's where it sees one, its own elsewhere.

    Of pixels that would take the same value, the one nearest to the value's pixel gets it, the
    first of equally near ones.

    Args:
        own: of the target, (C, h, w).
        sources: fields of the sources, of any size.
        positions: (h, w, 2) px of each source's grid (centres at +0.5).
        choice: (h, w) number of the source that a pixel takes, -1 for none.

    Example:
        >>> source = NoiseField.own(torch.arange(4.0).reshape(1, 1, 4), 0)
        >>> target = NoiseField.own(-torch.ones(1, 1, 4), 1)
        >>> x = torch.tensor([1.2, 1.6, 2.5, 3.5])  # the first two both fall into pixel 1
        >>> xy = torch.stack([x, torch.full((4,), 0.5)], dim=-1)[None]
        >>> carried(target, [source], [xy], torch.zeros(1, 4, dtype=torch.int64)).values
        tensor([[[-1.,  1.,  2.,  3.]]])
    """
    shape = tuple(own.origin.shape)
    check.shape(choice, shape, "choice")
    values, origin = own.values.flatten(1).clone(), own.origin.flatten().clone()
    pixels, taken, distances = [], [], []
    for number, (source, xy) in enumerate(zip(sources, positions, strict=True)):
        check.shape(xy, (*shape, 2), "positions")
        h, w = source.origin.shape
        wanted = ((choice == number) & torch.isfinite(xy).all(dim=-1)).flatten()
        place = xy.reshape(-1, 2)[wanted]
        column, row = place[:, 0].floor().clamp(0, w - 1), place[:, 1].floor().clamp(0, h - 1)
        index = (row * w + column).long()
        pixels.append(wanted.nonzero()[:, 0])
        taken.append(source.origin.flatten()[index])
        offset = place - torch.stack([column, row], dim=-1) - 0.5
        distances.append(offset.square().sum(dim=-1))
        values[:, wanted] = source.values.flatten(1)[:, index].to(values)
    pixel, value = torch.cat(pixels), torch.cat(taken)
    order = np.lexsort((pixel.numpy(), torch.cat(distances).numpy(), value.numpy()))
    sorted_values = value.numpy()[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = sorted_values[1:] != sorted_values[:-1]
    winners = pixel[torch.from_numpy(order[first])]
    lost = torch.ones(origin.shape, dtype=torch.bool)
    lost[winners] = False
    origin[pixel] = value
    values[:, lost] = own.values.flatten(1)[:, lost]
    origin[lost] = own.origin.flatten()[lost]
    return NoiseField(values.reshape(own.values.shape), origin.reshape(shape))
