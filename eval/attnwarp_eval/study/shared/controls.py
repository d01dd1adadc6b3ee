"""Controls of studies of edits: features that a method cannot be right with, and other noise.

A study that does not tell the method from wrong features is blind to where features come from,
whatever it says of two methods. One that tells it from itself with another seed tells too much.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Literal

import torch
from torch import Tensor

from attnwarp.warp import FeatureWarp, WarpedView

Control = Literal["mirrored", "displaced", "another scene", "another seed"]

OTHER_SCENE: Control = "another scene"
"""Control whose features are those of the next scene's source, edited under the same words."""

OTHER_SEED: Control = "another seed"
"""Negative control: the same variant with other noise and other stages."""

SEED_STEP, SCENE_STEP = 1_000_003, 1009
"""Difference of the seed of :data:`OTHER_SEED` from the study's, and of a drawn scene's from
that of the scene before it."""

DISPLACEMENT = 1 / 8
"""Share of the source's width by which ``displaced`` moves what is taken."""


def moved(xy: Tensor, width: int, control: Control, share: float = DISPLACEMENT) -> Tensor:
    """(H, W, 2) positions in a source of some width, mirrored left to right or displaced to the
    right by a share of it; what leaves the picture enters it on the other side.

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
        """The wrong warp of a right one."""
        own = {f.name: getattr(view, f.name) for f in fields(view) if f.init}
        return cls(**own, control=control, share=share)

    def at(
        self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None
    ) -> FeatureWarp:
        """The warp of an (h, w) grid of the target, from the wrong place of the source's."""
        key = (*size, *(source_size or ()))
        if key not in self._moved:
            layer = super().at(size, source_size=source_size)
            right = layer.correspondence
            xy = moved(right.xy, right.source.width, self.control, self.share)
            wrong = replace(right, xy=xy)
            self._moved[key] = FeatureWarp(wrong, layer.mask, layer.backend)
        return self._moved[key]
