"""Which views each stage edits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch

from attnwarp.propagate.pictures import Mask
from attnwarp.propagate.settings import MOST_VIEWS, PropagateSettings


@dataclass(frozen=True)
class Plan:
    """The views of each stage.

    Attributes:
        source: number of the source view.
        stages: numbers of the views that each stage edits, in the order of editing. No view is in
            two of them, and no source in any. Where all views are sources, one stage without views
            is left, which tunes on the sources.
        chain: numbers of the further sources, in the order of editing.

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
    chain: tuple[int, ...] = ()

    @classmethod
    def draw(
        cls, views: int, source: int, settings: PropagateSettings, chain: Sequence[int] = ()
    ) -> Plan:
        """Draw each stage's views at random from those not edited so far.

        Args:
            views: their number.
            source: number of the source view.
            settings: stages, views a stage, seed.
            chain: numbers of the further sources, see :func:`choose_chain`.
        """
        rest = [view for view in range(views) if view not in (source, *chain)]
        each = settings.views_per_stage
        if each is None:
            shares = np.array_split(rest, settings.stages)
            sizes = [min(MOST_VIEWS, len(share)) for share in shares]
        else:
            sizes = [each] * settings.stages
        # Parts of one permutation are draws without replacement.
        generator = torch.Generator().manual_seed(settings.seed)
        order = iter([rest[k] for k in torch.randperm(len(rest), generator=generator).tolist()])
        parts = [tuple(islice(order, size)) for size in sizes]
        return cls(source, tuple(part for part in parts if part) or ((),), tuple(chain))

    @property
    def sources(self) -> tuple[int, ...]:
        """All sources, in the order of editing."""
        return (self.source, *self.chain)

    @property
    def targets(self) -> tuple[int, ...]:
        """Everything edited with features of a source, in the order of editing."""
        return (*self.chain, *(view for stage in self.stages for view in stage))

    @property
    def edited(self) -> tuple[int, ...]:
        """The source and all targets, in the order of editing."""
        return (self.source, *self.targets)

    def training(self, stage: int, choice: str) -> list[int]:
        """Numbers of the views that a stage tunes on, see
        :class:`~attnwarp.propagate.PropagateSettings`. A stage without views tunes on the
        sources."""
        if choice == "all" or not self.stages[stage]:
            return [*self.sources, *(view for part in self.stages[: stage + 1] for view in part)]
        return [*(self.chain if stage == 0 else ()), *self.stages[stage]]


def choose_chain(
    views: int,
    source: int,
    count: int,
    coverage: float,
    seen: Callable[[int, int], tuple[Mask, Mask]],
) -> tuple[int, ...]:
    """Further sources, outward from the first.

    The next source is the least covered view among those with a share of at least ``coverage``. The
    share is that of the view's surface that the sources so far see. If there is no such view, it is
    the most covered one. Of equal views it is the first.

    Args:
        views: their number.
        source: number of the first source.
        count: of sources, the first included; fewer if there are fewer views.
        coverage: see there.
        seen: (H, W) bool of two views, a source and a target: pixels of the target that the source
            sees, and those that show surface.

    Example:
        >>> import numpy as np
        >>> def seen(source, target):  # a ring of six views; each sees half of its neighbours
        ...     steps = abs((target - source + 3) % 6 - 3)
        ...     pixels = np.arange(4) < {0: 4, 1: 2}.get(steps, 0)
        ...     return pixels[None], np.ones((1, 4), bool)
        >>> choose_chain(6, 0, 4, 0.5, seen)
        (1, 2, 3)
    """
    chain: list[int] = []
    seen_by_some: dict[int, Mask] = {}
    last = source
    while len(chain) < min(count, views) - 1:
        shares = {}
        for view in range(views):
            if view in (source, *chain):
                continue
            pixels, surface = seen(last, view)
            seen_by_some[view] = seen_by_some.get(view, np.zeros_like(pixels)) | (pixels & surface)
            shares[view] = float(seen_by_some[view].sum() / max(1, surface.sum()))
        enough = {view: share for view, share in shares.items() if share >= coverage}
        last = (
            min(enough, key=enough.__getitem__) if enough else max(shares, key=shares.__getitem__)
        )
        chain.append(last)
    return tuple(chain)
