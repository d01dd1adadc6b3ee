"""Epipolar lines between two views, on the grids of feature maps."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera, fundamental
from attnwarp.methods.pictures import Size


def line_distances(view: Camera, key: Camera, size: Size) -> Tensor | None:
    """Compute (L, L) float32 distances, in cells, of each cell of ``key`` from the epipolar line of
    each cell of ``view``; None if both cameras share one centre, so that no line exists.

    Args:
        size: (h, w) of both grids, L = h w. Cell centres are at +0.5.
    """
    h, w = size
    matrix = fundamental(view.resize(w, h), key.resize(w, h))
    if matrix is None:
        return None
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    cells = np.stack([x.ravel(), y.ravel(), np.ones(h * w)], axis=1)
    lines = cells @ matrix.T
    # The epipole has no line; a distance of 0 excludes nothing.
    length = np.hypot(lines[:, 0], lines[:, 1])[:, None]
    lines = np.divide(lines, length, out=np.zeros_like(lines), where=length > 0)
    return torch.from_numpy(np.abs(lines @ cells.T).astype(np.float32))
