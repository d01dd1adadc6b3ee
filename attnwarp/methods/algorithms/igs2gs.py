"""Instruct-GS2GS (Vachha and Haque 2024): edit all views repeatedly while the splats
are tuned on them, the iterative dataset update of Instruct-NeRF2NeRF.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from attnwarp.editing.schedule import Grid
from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, Method, ViewEdit
from attnwarp.methods.doors import door
from attnwarp.methods.settings import (
    MethodSettings,
    checked_start,
)
from attnwarp.methods.work import Work, parts_of
from attnwarp.settings import Count, Number


@dataclass(frozen=True)
class IGS2GSSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.igs2gs`.

    Args:
        every: number of tuning iterations between two edits of all views.
        start: (lowest, highest) range of the starting timestep, drawn for each edit.
        grid: grid of the steps below the start, :data:`attnwarp.editing.schedule.Grid`.

    Example:
        >>> from attnwarp.methods import IGS2GSSettings
        >>> settings = IGS2GSSettings(iterations=3000)
        >>> settings.start, settings.iterations / settings.every  # a full round and a part
        ((700, 980), 1.2)
    """

    iterations: Number = 7500
    every: Count = 2500
    start: tuple[int, int] = (700, 980)
    grid: Grid = "even"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "start", checked_start(self.start))


class IGS2GS(Method):
    """Edit every view from its noised render, tune the splats, and repeat.

    Each edit draws a timestep T of Stable Diffusion, noises the view's render by the current splats
    to the signal level of T, and denoises the result under the guidance of the original picture.
    All edits of a round use the splats from the beginning of the round; the authors' code instead
    takes one step of tuning between two edits.

    Args:
        gaussians, cameras, images, instruction, options: see :func:`by_view`.
        editor: an InstructPix2Pix.
        settings: :class:`IGS2GSSettings`; the defaults if omitted.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import IGS2GSSettings, igs2gs
        >>> from attnwarp.trial import disc, view
        >>> quick = IGS2GSSettings(steps=1, iterations=4, every=2)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = igs2gs(disc(), views, None, editor, "red", quick)
        >>> result.counters["edits"]  # two rounds of two views
        4
    """

    def __init__(self, work: Work, settings: IGS2GSSettings) -> None:
        work.takes("igs2gs", "picture")
        work.starts_at(settings.start[0], "start")
        self.work, self.settings = work, settings

    def run(self, loop: Loop) -> None:
        """Edit each view from its render, tune on all views, and repeat."""
        work, s = self.work, self.settings
        views = range(len(work.sizes))
        for number, iterations in enumerate(parts_of(s.iterations, s.every)):
            for view in views:
                edit_view = partial(self.edit, number, view)
                loop.edit(number, (view,), edit_view, rows=s.steps * work.branches())
            loop.tune(number, views, iterations)

    def edit(
        self, number: int, view: int, model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Edit a view from its noised render, guided by its original picture."""
        work, start = self.work, self.work.timestep(number, view, self.settings.start)
        pictures = [work.render(view, model)]
        result = work.edit([view], step, number=number, start=start, pictures=pictures)
        return [ViewEdit(result.images[0], {"start": start, "timesteps": result.timesteps})]


_RELEASED = IGS2GSSettings(text_guidance=12.5, image_guidance=1.5, grid="scheduler")

igs2gs = door(
    IGS2GS,
    {
        "default": IGS2GSSettings(),
        "released": _RELEASED,
        "improved": replace(_RELEASED, iterations=3000),
    },
)
