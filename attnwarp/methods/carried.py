"""Pictures warped from sources, and initial noise, which may stick to the surface."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from attnwarp.editing.editor import shared_noise
from attnwarp.methods.noise import FRESH, carried, own_seed, unmoved
from attnwarp.methods.settings import AttentionWarpingSettings
from attnwarp.methods.sight import Sight, SourceWarp


def carry(
    own: Tensor, maps: Sequence[Tensor], warps: Sequence[SourceWarp], weight: float
) -> Tensor:
    """Blend the sources' warped (C, h', w') maps into a target's (C, h, w) map."""
    tokens = own.flatten(1).T[None].contiguous()
    for warp, map_ in zip(warps, maps, strict=False):
        h, w = own.shape[1:]
        layer = warp.at((h, w), source_size=(map_.shape[1], map_.shape[2]))
        warped = layer.warp_tokens(map_.flatten(1).T[None].contiguous())
        tokens = torch.lerp(tokens, warped, weight * layer.weight.to(tokens))
    return tokens[0].T.reshape(own.shape)


class Noise:
    """Initial noise of views: shared by all views of a size, fresh for each view, or attached to
    the surface.

    Attributes:
        orders: (h, w) order of each source's noise, if noise sticks to the surface.
    """

    def __init__(self, settings: AttentionWarpingSettings) -> None:
        self.settings = settings
        self.orders: list[Tensor] = []

    def of(
        self, views: Sequence[int], shape: tuple[int, int, int], sights: Sequence[Sight | None]
    ) -> Tensor:
        """Draw (B, C, h, w) noise for views whose latents are (C, h, w)."""
        s = self.settings
        if s.noise == "fresh":
            return torch.cat(
                [shared_noise((1, *shape), own_seed(s.seed, FRESH, view)) for view in views]
            )
        noise = shared_noise((len(views), *shape), s.seed)
        if s.noise == "shared":
            return noise
        rows = []
        for row, sight in zip(noise.flatten(2), sights, strict=True):
            order = self.order(sight, shape[1:])
            rows.append(row[:, order.flatten()].unflatten(1, tuple(order.shape)))
        return torch.stack(rows)

    def order(self, sight: Sight | None, size: tuple[int, ...]) -> Tensor:
        """Compute the (h, w) int64 order of a view's noise; sources of another size are ignored."""
        h, w = size
        if sight is None:
            return unmoved((h, w))
        taken, positions = [], []
        for order, view in zip(self.orders, sight.views, strict=False):
            if tuple(order.shape) != (h, w):
                return unmoved((h, w))
            taken.append(order)
            positions.append(view.at((h, w), source_size=(h, w)).correspondence.xy)
        return carried(taken, positions, sight.choice((h, w)))
