"""Smallest scenes to try functions on, as the examples of the documentation do."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.warp import Surface


def disc(size: float = 0.5) -> Gaussians:
    """Create an opaque grey 2D splat at the origin whose normal is the axis z.

    Args:
        size: standard deviation, in scene units.

    Example:
        >>> disc().normals().tolist()
        [[0.0, 0.0, 1.0]]
    """
    numbers = partial(torch.full, dtype=torch.float32)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float32)
    return Gaussians(
        "2d",
        numbers((1, 3), 0.0),
        quats,
        numbers((1, 2), size),
        numbers((1,), 1.0),
        numbers((1, 1, 3), 0.0),
    )


def view(x: float = 0.0, z: float = 3.0, side: int = 32) -> Camera:
    """Place a camera at (x, 0, z) that looks at the origin, y up, ``side`` x ``side`` px.

    Example:
        >>> view(1).position.round(9).tolist()
        [1.0, 0.0, 3.0]
    """
    return Camera.look_at((x, 0, z), (0, 0, 0), width=side, height=side, fov_y=40, up=(0, 1, 0))


def wall() -> tuple[Camera, Camera, Surface]:
    """Build a source, a target, and a wall at depth 2 that both see, 8 x 8 px each.

    The source stands half a unit to the left, so it sees the wall 8 * 0.5 / 2 = 2 px to the right.

    Example:
        >>> source, target, seen = wall()
        >>> (target.position - source.position).tolist(), seen.depth[0, 0].item()
        ([0.5, 0.0, 0.0], 2.0)
    """
    K, left = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(4)
    left[0, 3] = 0.5
    seen = Surface(np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
    return Camera(K, left, 8, 8), Camera(K, np.eye(4), 8, 8), seen
