"""Labels of a thing's parts for ``inspect``: labels carried along a warp, token by token."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from attnwarp.warp import FeatureWarp
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import World
from attnwarp_lab.ideal.labels import carried_labels, label_tokens
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of

KINDS = {
    "right": ("right", "#2ca25f"),
    "wrong": ("wrong", "#e31a1c"),
    "none": ("none, though visible", "#1f78b4"),
    "painted_hidden": ("painted, though hidden", "#ff7f00"),
    "painted_outside": ("painted, outside the thing", "#ffd92f"),
}
"""Text and colour of each kind of token, in order."""

OTHER = ("left alone, or not counted", "#4a4a4a")


@dataclass(frozen=True, eq=False)
class Parts:
    """Parts of a scene's thing, as defined by the probe ``labels`` of a study.

    Attributes:
        world: world of the scene.
        views: names of the views whose surface points are pooled, the source among them.
        objects: names of the thing's objects.
        count: number of parts.
        grids: sides of the token grids.
    """

    world: World
    views: tuple[str, ...]
    objects: tuple[str, ...]
    count: int
    grids: tuple[int, ...]
    legend: ClassVar[tuple[tuple[str, str], ...]] = (*KINDS.values(), OTHER)

    @cached_property
    def labels(self) -> Mapping[str, npt.NDArray[np.int16]]:
        """(H, W) part of each pixel by the view's name, -1 outside the thing."""
        cameras = [self.world.camera(name) for name in self.views]
        return labels_of(self.world.scene, self.world.geometry, cameras, self.objects, self.count)

    def carried(self, layer: FeatureWarp, target: str, truth: TwoView) -> Carried:
        """Labels of a target's tokens, carried along a warp.

        Args:
            layer: the warp of the tokens' grid, (h, w).
        """
        h, w = layer.mask.shape
        views = self.world.source.name, target
        source, own = (token_parts(self.labels[name], (h, w)) for name in views)
        taken = carried_labels(layer, source)
        kinds = label_tokens(taken, own, self.labels[target], truth.visible, truth.unseen)
        return Carried(own, taken, np.select([kinds[k] for k in KINDS], range(len(KINDS)), -1))


@dataclass(frozen=True, eq=False)
class Carried:
    """Labels of a grid's tokens.

    Attributes:
        own: (h, w) true part, -1 outside the thing.
        taken: (h, w) the carried part, -1 for a label outside the thing, -2 for no label.
        kind: (h, w) index into :attr:`Parts.legend`, -1 for :data:`OTHER`.
    """

    own: npt.NDArray[np.int16]
    taken: npt.NDArray[np.int16]
    kind: npt.NDArray[np.int64]

    def text(self, row: int, column: int) -> str:
        """Description of the label at a token.

        Example:
            >>> one = np.ones((1, 1), np.int16)
            >>> Carried(3 * one, 5 * one, np.array([[1]])).text(0, 0)
            'label: part 3 takes part 5: wrong'
        """
        own, taken, kind = (int(grid[row, column]) for grid in (self.own, self.taken, self.kind))
        what = "no part" if own < 0 else f"part {own}"
        takes = {-2: "nothing", -1: "what is no part"}.get(taken, f"part {taken}")
        return f"label: {what} takes {takes}: {Parts.legend[kind][0]}"
