"""Exact warps between the two views of a training world, from the depth maps that rays gave."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.editing.latents import BLOCK
from attnwarp.warp import EXACT_DEPTH_TOLERANCE, Surface, WarpedView, WarpSettings, warp_surfaces
from training.worlds.editing_pairs import SIZE, VIEWS, Worlds

EXACT = WarpSettings(opaque=None, normal_test="none", depth_relative=EXACT_DEPTH_TOLERANCE)


def view_warp(worlds: Worlds, world: int, target: int) -> WarpedView:
    """The exact warp to a view of a world from its other one, of the whole picture."""

    def camera(view: int) -> Camera:
        return Camera(worlds.K[world, view], worlds.world_to_camera[world, view], SIZE, SIZE)

    def surface(view: int) -> Surface:
        return Surface(worlds.depth[world, view].astype(np.float64))

    source = 1 - target
    return warp_surfaces(
        camera(source), camera(target), surface(target), surface(source), EXACT, warn_empty=False
    )


def view_moves(worlds: Worlds, size: int) -> tuple[Tensor, Tensor]:
    """(N, 2, cells^2) index into the other view's cells, and mask, for whole pictures of that size."""
    cells = size // BLOCK
    index = np.zeros((len(worlds), VIEWS, cells**2), dtype=np.int16)
    mask = np.zeros(index.shape, dtype=bool)
    for world in range(len(worlds)):
        for target in range(VIEWS):
            warp = view_warp(worlds, world, target).at((cells, cells))
            xy = np.clip(np.nan_to_num(warp.correspondence.xy.numpy()), 0, cells - 1e-6)
            index[world, target] = (xy.astype(np.int64) @ [1, cells]).ravel()
            mask[world, target] = warp.mask.numpy().ravel()
    return torch.from_numpy(index), torch.from_numpy(mask)
