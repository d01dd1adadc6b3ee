"""Exact warps between the two views of a training world, from the depth maps that rays gave."""

from __future__ import annotations

import numpy as np

from attnwarp.camera import Camera
from attnwarp.warp import EXACT_DEPTH_TOLERANCE, Surface, WarpedView, WarpSettings, warp_surfaces
from training.worlds.editing_pairs import SIZE, Worlds

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
