"""Bilinear sampling as a matrix of long doubles: the oracle of warped features and of their
gradients.

Written from the definition as a product of two hat functions, one for each axis; it shares no code
with the taps of the library, of which it takes one declared constant.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.warp.taps import SNAP

Extended = npt.NDArray[Any]
"""Array of type ``numpy.longdouble``."""


def extended(values: torch.Tensor) -> Extended:
    """Convert to long doubles: float64 is among the types under test."""
    return values.detach().double().numpy().astype(np.longdouble)


def sampling_matrix(xy: Extended, height: int, width: int) -> Extended:
    """(N, h w) weight of each pixel of an h x w grid at each position.

    Args:
        xy: (..., 2) positions in pixels of the grid; beyond the border the border's value is taken,
            and NaN reads nothing.

    Example:
        >>> xy = np.array([[1.0, 0.5], [np.nan, 0.5]], np.longdouble)
        >>> sampling_matrix(xy, 1, 2).astype(float).tolist()
        [[0.5, 0.5], [0.0, 0.0]]
    """
    places = xy.reshape(-1, 2)
    columns, rows = (_hats(places[:, k], length) for k, length in ((0, width), (1, height)))
    return (rows[:, :, None] * columns[:, None, :]).reshape(len(places), -1)


def _hats(positions: Extended, length: int) -> Extended:
    """(N, length) max(0, 1 - distance) of each position from the centres of an axis."""
    places = np.clip(positions - np.longdouble(0.5), 0, length - 1)
    nearest = np.rint(places)
    places = np.where(np.abs(places - nearest) < SNAP, nearest, places)
    hats = np.maximum(1 - np.abs(places[:, None] - np.arange(length)), 0)
    return np.where(np.isnan(positions)[:, None], np.longdouble(0), hats)
