"""View by view: each view is edited alone. What every other method has to beat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, Unpack

import numpy.typing as npt

from attnwarp.baselines.run import Baseline, Kind, Options, run
from attnwarp.baselines.settings import ByViewSettings
from attnwarp.baselines.work import Round, ViewEdit, Work, chunks
from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor, edit
from attnwarp.gaussians import Gaussians


def by_view(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: ByViewSettings | None = None,
    **options: Unpack[Options],
) -> Baseline:
    """Edit every view alone, then tune the splats on all of them.

    Args:
        gaussians: the scene before the edit, N splats of either kind.
        cameras: V views, at least one.
        images: V pictures (H, W, 3), sRGB, uint8, uint16 or floating in [0, 1]: the views before
            the edit. None takes renders of ``gaussians``.
        editor: of either kind, see :mod:`attnwarp.editing`.
        instruction: an instruction or a prompt, as the editor takes it.
        settings: :class:`ByViewSettings`, its defaults if left out.
        options: see :class:`Options`.

    Raises:
        ValueError: an argument of another size or type; the message names it.
        InputError: the folder holds a run of other settings or inputs; the message names them.
        RuntimeError: tuning diverged; the last checkpoint stays.

    Example:
        >>> import torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp.baselines import ByViewSettings, by_view
        >>> from attnwarp.editing.small import load_editor
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=32, height=32, fov_y=40, up=(0, 1, 0))
        >>> cameras = [Camera.look_at((x, 0, 3), (0, 0, 0), **view) for x in (0, 1)]
        >>> quick = ByViewSettings(steps=1, iterations=1)
        >>> result = by_view(disc, cameras, None, load_editor("small-plain"), "red", quick)
        >>> result.edited[1].shape, result.counters["edits"]
        ((32, 32, 3), 2)
    """
    kind = Kind("by_view", ByViewSettings, _ByView)
    return run(kind, gaussians, cameras, images, editor, instruction, settings, **options)


class _ByView:
    def __init__(self, work: Work, settings: ByViewSettings) -> None:
        if settings.start is not None:
            work.starts_at(settings.start[0], "start")
        self.work, self.settings = work, settings
        alone = settings.start is not None and settings.noise == "fresh"
        views = range(len(work.sizes))
        groups = tuple(
            group
            for _, same in groupby(views, key=lambda view: work.sizes[view])
            for group in chunks(list(same), 1 if alone else settings.batch)
        )
        self.rounds = [Round(groups, tuple(views), settings.iterations)]

    def rows(self, number: int, group: Sequence[int]) -> int:
        return len(group) * self.settings.steps * self.work.branches()

    def edit(
        self, number: int, group: Sequence[int], model: Gaussians, watch: Callable[[], None]
    ) -> list[ViewEdit]:
        work, s = self.work, self.settings
        start = None if s.start is None else work.timestep(number, group[0], s.start)
        with work.guided():
            result = edit(
                work.editor,
                [work.guide(view) for view in group],
                work.instruction,
                steps=s.steps,
                start=start,
                pictures=None if start is None else [work.picture(view) for view in group],
                noise=work.noise(number, group),
                watch=lambda step, steps, latents: watch(),
            )
        about: dict[str, Any] = {"start": start}
        if start is not None:
            about["timesteps"] = result.timesteps
        return [ViewEdit(picture, about) for picture in result.images]
