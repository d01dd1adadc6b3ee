"""View by view: edit each view alone. The baseline that every other method has to beat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from typing import Any, Unpack

import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor
from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, Method, Options, Result, ViewEdit, run
from attnwarp.methods.settings import ByViewSettings
from attnwarp.methods.work import Work, chunks


def by_view(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: ByViewSettings | None = None,
    **options: Unpack[Options],
) -> Result:
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
    return run(
        "by_view", ByView, ByViewSettings,
        gaussians, cameras, images, editor, instruction, settings, **options,
    )  # fmt: skip


class ByView(Method):
    """Method that edits every view alone and tunes the splats on all views."""

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
