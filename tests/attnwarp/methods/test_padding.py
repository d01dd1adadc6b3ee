"""Oracle: torch's grid_sample with zero padding."""

import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.methods.padding import ZeroPadded
from attnwarp.warp import Surface, preset, warp_surfaces

SIZE = 24


def camera(position, size=SIZE):
    return Camera.look_at(position, (0, 0, 0), width=size, height=size, fov_y=40, up=(0, 1, 0))


def on_plane(view):
    """Surface that a camera sees of the plane z = 0."""
    rays = view.directions() @ view.rotation
    depth = -view.position[2] / rays[..., 2]
    return Surface(depth, np.broadcast_to([0.0, 0, 1], (*depth.shape, 3)))


TARGET, SIDE = camera((0, 0.3, 3)), camera((2.5, 0, 1.5))


def warp(source, **changes):
    settings = preset("corrected", **changes)
    return warp_surfaces(source, TARGET, on_plane(TARGET), on_plane(source), settings)


@pytest.mark.parametrize("size", [(SIZE, SIZE), (6, 6)])
def test_zeros_stand_around_the_source_as_padding_has_them(size):
    view = warp(SIDE, in_front=False, opaque=None, depth_agreement=False, normal_test="none")
    view = view.with_mask(view.rules["defined"])
    h, w = size
    features = torch.rand(
        1, h * w, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    layer = ZeroPadded(view).at(size)
    xy = layer.warp.correspondence.xy
    grid = 2 * xy / torch.tensor([w, h]) - 1
    maps = features[0].T.reshape(1, 3, h, w)
    padded = torch.nn.functional.grid_sample(
        maps, grid[None], padding_mode="zeros", align_corners=False
    )
    assert torch.allclose(
        layer.warp_tokens(features), padded[0].flatten(1).T[None], rtol=0, atol=1e-9
    )
    border = view.at(size).warp_tokens(features)
    assert (border - layer.warp_tokens(features)).abs().max() > 0.1
