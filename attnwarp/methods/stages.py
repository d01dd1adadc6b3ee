"""Views of each stage, and the order in which a stage tunes on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain, islice

import numpy as np
import torch

from attnwarp.methods.attention_settings import MOST_VIEWS, AttentionWarpingSettings

SOURCE_EVERY = 10
"""Interval in steps at which the released code tunes on the source."""


def draw_stages(unedited: Sequence[int], settings: AttentionWarpingSettings) -> list[list[int]]:
    """Draw each stage's views at random from those not edited so far (line 3).

    Without views, one stage without views remains, which tunes on the source. A last
    stage short of views takes some of the earlier views again, if the settings say so.
    """
    s = settings
    if s.views_per_stage is None:
        shares = np.array_split(np.arange(len(unedited)), s.stages)
        sizes = [min(MOST_VIEWS, len(share)) for share in shares]
    else:
        sizes = [s.views_per_stage] * s.stages
    # Parts of one permutation are draws without replacement.
    generator = torch.Generator().manual_seed(s.seed)
    order = iter([unedited[k] for k in torch.randperm(len(unedited), generator=generator).tolist()])
    stages = [views for size in sizes if (views := list(islice(order, size)))]
    if s.fill_last_stage and len(stages) > 1:
        earlier, short = [*chain(*stages[:-1])], sizes[len(stages) - 1] - len(stages[-1])
        again = torch.randperm(len(earlier), generator=generator)[:short].tolist()
        stages[-1] += [earlier[k] for k in again]
    return stages or [[]]


def released_order(views: int) -> Callable[[int], int]:
    """Order of the released code: the source, then view ``step % views``, which misses some."""
    return lambda step: 0 if step % SOURCE_EVERY == 0 else 1 + step % views
