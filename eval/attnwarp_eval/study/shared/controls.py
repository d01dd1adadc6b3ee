"""Controls of studies of edits: features from a wrong source.

If a metric does not separate a method from wrong features, the study cannot judge where features
come from.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Literal

import torch
from torch import Tensor

from attnwarp.warp import FeatureWarp, WarpedView

Control = Literal["mirrored", "displaced", "another scene"]

OTHER_SCENE: Control = "another scene"
"""Control whose features are those of the next scene's source, edited under the same words."""

SCENE_STEP = 1009
"""Offset of a drawn scene's seed from the previous scene's."""

DISPLACEMENT = 1 / 8
"""Share of the source's width by which ``displaced`` shifts the sampled features."""


def moved(xy: Tensor, width: int, control: Control, share: float = DISPLACEMENT) -> Tensor:
    """(H, W, 2) positions in a source of the given width, mirrored left to right or displaced to
    the right by a share of the width; positions wrap around at the border.

    Example:
        >>> xy = torch.tensor([[[0.5, 0.5], [7.5, 0.5]]])
        >>> moved(xy, 8, "mirrored")[0, :, 0].tolist(), moved(xy, 8, "displaced")[0, :, 0].tolist()
        ([7.5, 0.5], [1.5, 0.5])
    """
    x = width - xy[..., 0] if control == "mirrored" else xy[..., 0] + share * width
    return torch.stack([x.remainder(width) if control == "displaced" else x, xy[..., 1]], dim=-1)


@dataclass(frozen=True, eq=False)
class MovedView(WarpedView):
    """A warp whose features come from the wrong place, under the mask of the right one.

    Args:
        control: "mirrored" or "displaced".
        share: share of the source's width, for "displaced".
    """

    control: Control = "mirrored"
    share: float = DISPLACEMENT
    _moved: dict[tuple[int, ...], FeatureWarp] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, view: WarpedView, control: Control, share: float = DISPLACEMENT) -> MovedView:
        """Make the control's warp from a correct one."""
        own = {f.name: getattr(view, f.name) for f in fields(view) if f.init}
        return cls(**own, control=control, share=share)

    def at(
        self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None
    ) -> FeatureWarp:
        """Warp of an (h, w) grid of the target, from the wrong place in the source."""
        key = (*size, *(source_size or ()))
        if key not in self._moved:
            layer = super().at(size, source_size=source_size)
            right = layer.correspondence
            xy = moved(right.xy, right.source.width, self.control, self.share)
            wrong = replace(right, xy=xy)
            self._moved[key] = FeatureWarp(wrong, layer.mask, layer.backend)
        return self._moved[key]
