"""Which views each stage edits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from attnwarp.propagate.settings import MOST_VIEWS, PropagateSettings


@dataclass(frozen=True)
class Plan:
    """The views of each stage.

    Attributes:
        source: number of the source view.
        stages: numbers of the views that each stage edits, in the order of editing. No view is in
            two of them, and the source in none.

    Example:
        >>> from attnwarp.propagate import Plan, PropagateSettings
        >>> plan = Plan.draw(7, 0, PropagateSettings(stages=2, views_per_stage=3))
        >>> [len(stage) for stage in plan.stages]
        [3, 3]
        >>> sorted(view for stage in plan.stages for view in stage)
        [1, 2, 3, 4, 5, 6]
    """

    source: int
    stages: tuple[tuple[int, ...], ...]

    @classmethod
    def draw(cls, views: int, source: int, settings: PropagateSettings) -> Plan:
        """Draw each stage's views at random from those not edited so far.

        Args:
            views: their number.
            source: number of the source view.
            settings: stages, views a stage, seed.
        """
        rest = [view for view in range(views) if view != source]
        each = settings.views_per_stage
        if each is None:
            each = max(1, min(MOST_VIEWS, math.ceil(len(rest) / settings.stages)))
        # A prefix of one permutation is a draw without replacement.
        generator = torch.Generator().manual_seed(settings.seed)
        order = [rest[k] for k in torch.randperm(len(rest), generator=generator).tolist()]
        parts = [tuple(order[each * k : each * (k + 1)]) for k in range(settings.stages)]
        return cls(source, tuple(part for part in parts if part))

    @property
    def edited(self) -> tuple[int, ...]:
        """The source and all targets, in the order of editing."""
        return (self.source, *(view for stage in self.stages for view in stage))

    def training(self, stage: int, choice: str) -> list[int]:
        """Numbers of the views that a stage tunes on, see
        :class:`~attnwarp.propagate.PropagateSettings`."""
        if choice == "all":
            return [self.source, *(view for part in self.stages[: stage + 1] for view in part)]
        return list(self.stages[stage])
