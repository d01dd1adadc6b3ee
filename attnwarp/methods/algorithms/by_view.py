"""View by view: edit each view alone. The baseline that every other method has to beat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any

from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, Method, ViewEdit
from attnwarp.methods.doors import door
from attnwarp.methods.settings import (
    MethodSettings,
    checked_start,
)
from attnwarp.methods.work import Work, chunks
from attnwarp.settings import Count, Number, Weight


@dataclass(frozen=True)
class ByViewSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.by_view`.

    The losses, rates and iterations equal those of
    :class:`attnwarp.methods.AttentionWarpingSettings`, so the two methods differ only in the edits.

    Args:
        start: (lowest, highest) range of the starting timestep, drawn for each edit; None for pure
            noise.
        batch: number of views per network pass; 1 if ``start`` is given and the noise is fresh.
            Results depend on it in the last bits.

    Example:
        >>> from attnwarp.methods import ByViewSettings
        >>> ByViewSettings(batch=0)
        Traceback (most recent call last):
        ValueError: batch: got 0, expected a whole number >= 1
    """

    iterations: Number = 900
    ssim: Weight = 0.0
    perceptual: Weight = 1.0
    normal: Weight = 0.05
    distortion: Weight = 0.01
    color_rate: Weight = 4.0
    start: tuple[int, int] | None = None
    batch: Count = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "start", checked_start(self.start))


class ByView(Method):
    """Edit every view alone, then tune the splats on all of them.

    Args:
        gaussians: the scene before the edit, N splats of either kind.
        cameras: V views, at least one.
        images: V pictures (H, W, 3), sRGB, uint8, uint16 or floating in [0, 1]: the views before
            the edit. None uses renders of ``gaussians``.
        editor: editor of either kind, see :mod:`attnwarp.editing`.
        instruction: instruction or prompt, depending on the editor.
        settings: :class:`ByViewSettings`; the defaults if omitted.
        options: keyword options, see :class:`Options`.

    Raises:
        ValueError: an argument has the wrong size or type; the message names the argument.
        InputError: the folder holds a run of different settings or inputs; the message lists them.
        RuntimeError: tuning diverged; the last checkpoint is kept.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import ByViewSettings, by_view
        >>> from attnwarp.trial import disc, view
        >>> quick = ByViewSettings(steps=1, iterations=1)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = by_view(disc(), views, None, editor, "red", quick)
        >>> result.edited[1].shape, result.counters["edits"]
        ((32, 32, 3), 2)
    """

    def __init__(self, work: Work, settings: ByViewSettings) -> None:
        if settings.start is not None:
            work.starts_at(settings.start[0], "start")
        self.work, self.settings = work, settings

    def run(self, loop: Loop) -> None:
        """Edit all views, batch by batch, then tune."""
        work, s = self.work, self.settings
        views = range(len(work.sizes))
        for batch in self.batches(views):
            rows = len(batch) * s.steps * work.branches()
            loop.edit(0, batch, partial(self.edit, batch), rows=rows)
        loop.tune(0, views, s.iterations)

    def batches(self, views: Sequence[int]) -> list[tuple[int, ...]]:
        """Group views that go through the network together: neighbours of one size."""
        s = self.settings
        # Edits with separately drawn timesteps go through the network one at a time.
        most = 1 if s.start is not None and s.noise == "fresh" else s.batch
        same = groupby(views, key=lambda view: self.work.sizes[view])
        return [batch for _, group in same for batch in chunks([*group], most)]

    def edit(
        self, batch: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Edit views from their guides alone."""
        work, s = self.work, self.settings
        start = None if s.start is None else work.timestep(0, batch[0], s.start)
        result = work.edit(batch, step, start=start)
        about: dict[str, Any] = {"start": start}
        if start is not None:
            about["timesteps"] = result.timesteps
        return [ViewEdit(picture, about) for picture in result.images]


by_view = door(ByView, {"default": ByViewSettings()})
