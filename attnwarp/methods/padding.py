"""Zeros around a source's features, as padding gives them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from attnwarp.editing.schedule import Size
from attnwarp.warp import FeatureWarp, WarpedView


@dataclass(frozen=True, eq=False)
class ZeroPadded:
    """Warp to a view that surrounds the source's features with zeros; a
    :class:`attnwarp.editing.injection.LayerWarp`.
    """

    view: WarpedView

    def at(self, size: Size, *, source_size: Size | None = None) -> ZeroPaddedLayer:
        """Build the warp from a grid of the source to an (h, w) grid of the target."""
        return ZeroPaddedLayer(self.view.at(size, source_size=source_size))


@dataclass(frozen=True, eq=False)
class ZeroPaddedLayer:
    """Warp of a layer. A tap beyond the source's border counts 0, so the border's value, which the
    warp returns, is multiplied by the weight of the taps inside.
    """

    warp: FeatureWarp

    @property
    def weight(self) -> Tensor:
        """Weight (h w, 1) float32: 1 inside the mask, 0 elsewhere."""
        return self.warp.weight

    @cached_property
    def inside(self) -> Tensor:
        """Weight of the taps within the source's grid, (h w, 1) float64; 0 without a position."""
        both = self.warp.correspondence
        size = both.xy.new_tensor([both.source.width, both.source.height])
        place = both.xy - 0.5
        share = torch.minimum(place + 1, size - place).clamp(0, 1).prod(dim=-1)
        return torch.nan_to_num(share, nan=0.0).reshape(-1, 1)

    def warp_tokens(self, source: Tensor) -> Tensor:
        """Warp tokens like :meth:`attnwarp.warp.FeatureWarp.warp_tokens`."""
        warped = self.warp.warp_tokens(source)
        return warped * self.inside.to(warped)
