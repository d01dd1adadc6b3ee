"""Epipolar lines between two views, on the grids of feature maps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.methods.pictures import Size

Array = npt.NDArray[np.float64]

ROUNDING = 1e-12
"""Share of two centres' coordinates below which their distance is rounding."""


def fundamental(view: Camera, key: Camera) -> Array:
    """(3, 3) float64 F with y^T F x = 0 for pixels x of ``view`` and y of ``key`` that see one
    point.

    F = K_key^-T [t]_x R K_view^-1 with the motion (R, t) from ``view`` to ``key`` (Hartley and
    Zisserman 2004, section 9.2). Its scale is that of t.

    Example:
        >>> from attnwarp import Camera
        >>> view = dict(width=8, height=8, fov_y=60, up=(0, 1, 0))
        >>> left = Camera.look_at((0, 0, 3), (0, 0, 0), **view)
        >>> right = Camera.look_at((1, 0, 3), (1, 0, 0), **view)
        >>> line = fundamental(left, right) @ [2.5, 3.5, 1.0]  # a row of pixels
        >>> bool(abs(line[0]) < 1e-12), round(float(-line[2] / line[1]), 9)
        (True, 3.5)
    """
    pose = key.relative_to(view)
    x, y, z = pose[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ pose[:3, :3]
    return np.asarray(np.linalg.inv(key.K).T @ essential @ np.linalg.inv(view.K))


def line_distances(view: Camera, key: Camera, size: Size) -> Tensor | None:
    """(L, L) float32 distances of each cell of ``key`` from the epipolar line of each cell of
    ``view``, in cells; None where the centres of projection coincide and there is no line.

    Args:
        view, key: cameras.
        size: (h, w) of both grids, L = h w. A cell's centre is at +0.5.

    Example:
        >>> from attnwarp import Camera
        >>> view = dict(width=8, height=8, fov_y=60, up=(0, 1, 0))
        >>> left = Camera.look_at((0, 0, 3), (0, 0, 0), **view)
        >>> right = Camera.look_at((1, 0, 3), (1, 0, 0), **view)
        >>> line_distances(left, right, (3, 2))[0].reshape(3, 2)[:, 0].tolist()  # from row 0
        [0.0, 1.0, 2.0]
    """
    h, w = size
    scale = np.linalg.norm(view.position) + np.linalg.norm(key.position)
    if np.linalg.norm(view.position - key.position) <= ROUNDING * scale:
        return None
    matrix = fundamental(view.resize(w, h), key.resize(w, h))
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    cells = np.stack([x.ravel(), y.ravel(), np.ones(h * w)], axis=1)
    lines = cells @ matrix.T
    # At the epipole there is no line; 0 excludes nothing.
    length = np.hypot(lines[:, 0], lines[:, 1])[:, None]
    lines = np.divide(lines, length, out=np.zeros_like(lines), where=length > 0)
    return torch.from_numpy(np.abs(lines @ cells.T).astype(np.float32))
