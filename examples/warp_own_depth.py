"""Warp a picture into another view by your own depth: python examples/warp_own_depth.py

Here they are of a wall behind a post, in closed form; yours may come from a sensor or a network.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch

from attnwarp import Camera
from attnwarp.warp import PRESETS, Surface, warp_surfaces

WALL, POST = 4.0, 2.0


def depth_of(camera):
    """(H, W) depth of a wall at z = 4 and of a post at z = 2, for cameras that look along +z."""
    rays = camera.directions()
    at_post = camera.position[0] + rays[..., 0] * (POST - camera.position[2])
    return np.where(np.abs(at_post) < 0.2, POST, WALL) - camera.position[2]


K = [[200.0, 0, 128], [0, 200, 96], [0, 0, 1]]
left = Camera(K, np.eye(4), 256, 192)
right = left.moved((0.5, 0.0, 0.0))
picture = np.random.default_rng(0).random((192, 256, 3), dtype=np.float32)
picture[depth_of(left) == POST] = [1, 0.2, 0.1]

settings = replace(PRESETS["corrected"], normal_test="none")  # no normals are given
surfaces = [Surface(depth_of(camera)) for camera in (right, left)]
view = warp_surfaces(left, right, *surfaces, settings)
layer = view.at((192, 256))  # of any size: a feature map's, or the picture's own
warped = layer.warp(torch.from_numpy(picture).permute(2, 0, 1)).permute(1, 2, 0).numpy()
mask = view.mask.numpy()
shown = np.round(255 * np.where(mask[..., None], warped, 0)).astype(np.uint8)
cv2.imwrite("warped.png", shown[..., ::-1])
print(f"warped.png: {mask.mean():.0%} of the right view is shown by the left one")
