"""A scene that a tiny random editor can edit in a moment: coloured discs before a wall, and cameras in a row."""

import numpy as np
import torch

from attnwarp import Camera, Gaussians
from attnwarp.render import render

SIZE = 32


def splats(count=60, seed=0):
    """Discs in a plane that faces the cameras, at depth 3 of the middle one."""
    random = torch.Generator().manual_seed(seed)
    means = torch.cat([2 * torch.rand((count, 2), generator=random) - 1, torch.zeros(count, 1)], 1)
    return Gaussians(
        "2d",
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 2), 0.25),
        torch.full((count,), 0.9),
        Gaussians.sh_from_rgb(torch.rand((count, 3), generator=random)),
    )


def cameras(count=5, size=SIZE):
    view = {"width": size, "height": size, "fov_y": 40, "up": (0, 1, 0)}
    steps = [k - count // 2 for k in range(count)]
    return [
        Camera.look_at((0.4 * step, 0, 3), (0.2 * step, 0, 0), name=f"v{k}.png", **view)
        for k, step in enumerate(steps)
    ]


def pictures(scene, views):
    return [render(scene, camera).color.clamp(0, 1).numpy().astype(np.float32) for camera in views]
