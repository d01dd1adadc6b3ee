"""Tokens against feature maps sampled by torch, and the formula of the blend in float64."""

import numpy as np
import pytest
import torch
from closed_forms import orbit, sphere

from attnwarp.warp.settings import preset
from attnwarp.warp.view import Surface, warp_surfaces


@pytest.fixture(scope="module")
def layer():
    """A sphere seen from two sides at 64 x 48, warped on grids of 16 x 12."""
    source, target = (orbit(yaw, size=48, width=64, height=h) for yaw, h in ((0, 0.3), (30, 0.0)))
    surfaces = [Surface(*sphere(camera)) for camera in (target, source)]
    return warp_surfaces(source, target, *surfaces, preset("corrected", opaque=None)).at((12, 16))


def tokens_of(maps):
    return maps.flatten(2).transpose(1, 2).contiguous()


def random_maps(layer, *, batch=2, channels=5, dtype=torch.float32, seed=0):
    size = (layer.correspondence.source.height, layer.correspondence.source.width)
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, channels, *size, generator=generator).to(dtype)


def grid_sampled(layer, maps):
    """torch's own sampling in float64; 0 where a pixel has no position."""
    c = layer.correspondence
    grid = 2 * c.xy / torch.tensor([c.source.width, c.source.height]) - 1
    grid = torch.where(c.defined[..., None], grid, 0)[None].expand(len(maps), -1, -1, -1)
    warped = torch.nn.functional.grid_sample(
        maps.double(), grid, padding_mode="border", align_corners=False
    )
    return torch.where(c.defined, warped, 0)


def test_tokens_warp_as_torch_samples_their_maps(layer):
    maps = random_maps(layer)
    warped = layer.warp_tokens(tokens_of(maps))
    assert (warped - tokens_of(grid_sampled(layer, maps))).abs().max() < 1e-5
    assert 0.1 < layer.mask.float().mean() < 0.9


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_the_blend_is_its_formula(layer, alpha):
    maps, own = random_maps(layer), random_maps(layer, seed=1)
    new = tokens_of(own)
    blended = layer.blend_tokens(tokens_of(maps), new, alpha)
    M = layer.mask.reshape(-1, 1).double()
    warped = tokens_of(grid_sampled(layer, maps))
    formula = alpha * (M * warped + (1 - M) * new) + (1 - alpha) * new
    assert (blended - formula).abs().max() < 1e-5
    outside = ~layer.mask.reshape(-1)
    assert torch.equal(blended[:, outside], new[:, outside])
    again = layer.blend_tokens(tokens_of(maps), new, alpha, in_place=True)
    assert again is new
    assert torch.equal(new, blended)
