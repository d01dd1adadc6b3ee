"""Pictures warped from the source, and initial noise, which may stick to the surface."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from attnwarp.editing.editor import shared_noise
from attnwarp.methods.attention_settings import AttentionWarpingSettings
from attnwarp.methods.noise import FRESH, carried, own_seed
from attnwarp.warp import WarpedView


def carry(own: Tensor, source: Tensor, warp: WarpedView) -> Tensor:
    """Put the source's warped (C, h', w') map where a target's (C, h, w) map shows the same."""
    tokens = own.flatten(1).T[None].contiguous()
    layer = warp.at((own.shape[1], own.shape[2]), source_size=(source.shape[1], source.shape[2]))
    warped = layer.warp_tokens(source.flatten(1).T[None].contiguous())
    tokens = torch.lerp(tokens, warped, layer.weight.to(tokens))
    return tokens[0].T.reshape(own.shape)


def initial_noise(
    settings: AttentionWarpingSettings,
    views: Sequence[int],
    shape: tuple[int, int, int],
    source_size: tuple[int, int],
    warps: Sequence[WarpedView | None],
) -> Tensor:
    """Draw (B, C, h, w) noise for views whose latents are (C, h, w): shared by all views of a size,
    fresh for each view, or attached to the surface.

    Args:
        source_size: (h, w) of the source's latents; views of another size share the noise.
        warps: each view's warp from the source; None for the source itself.
    """
    s = settings
    if s.noise == "fresh":
        return torch.cat(
            [shared_noise((1, *shape), own_seed(s.seed, FRESH, view)) for view in views]
        )
    noise = shared_noise((len(views), *shape), s.seed)
    if s.noise == "shared" or shape[1:] != source_size:
        return noise
    rows = []
    for row, warp in zip(noise, warps, strict=True):
        if warp is not None:
            layer = warp.at(source_size, source_size=source_size)
            order = carried(layer.correspondence.xy, layer.mask)
            row = row.flatten(1)[:, order.flatten()].unflatten(1, source_size)
        rows.append(row)
    return torch.stack(rows)
