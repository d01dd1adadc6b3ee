"""Instruct-GS2GS (Vachha and Haque 2024): all views are edited again and again while the splats
are tuned on them, the iterative dataset update of Instruct-NeRF2NeRF.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Unpack

import numpy.typing as npt

from attnwarp.baselines.run import Baseline, Kind, Options, run
from attnwarp.baselines.settings import IGS2GSSettings
from attnwarp.baselines.work import Round, ViewEdit, Work, chunks, parts_of
from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor, edit
from attnwarp.gaussians import Gaussians


def igs2gs(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: IGS2GSSettings | None = None,
    **options: Unpack[Options],
) -> Baseline:
    """Edit every view from its noised render, tune the splats, and begin again.

    Each edit draws a timestep T of Stable Diffusion. It noises the view's render by the current
    splats to the share of signal that T stands for. It then denoises it under the guidance of the
    original picture. Views of a round see the splats as they were at its beginning; the authors'
    code also takes one step of tuning between two edits.

    Args:
        gaussians, cameras, images, instruction, options: see :func:`by_view`.
        editor: an InstructPix2Pix.
        settings: :class:`IGS2GSSettings`, its defaults if left out.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> import torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp.baselines import IGS2GSSettings, igs2gs
        >>> from attnwarp.editing.small import load_editor
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=32, height=32, fov_y=40, up=(0, 1, 0))
        >>> cameras = [Camera.look_at((x, 0, 3), (0, 0, 0), **view) for x in (0, 1)]
        >>> quick = IGS2GSSettings(steps=1, iterations=4, every=2)
        >>> result = igs2gs(disc, cameras, None, load_editor("small-plain"), "red", quick)
        >>> result.counters["edits"]  # two rounds of two views
        4
    """
    kind = Kind("igs2gs", IGS2GSSettings, _IGS2GS)
    return run(kind, gaussians, cameras, images, editor, instruction, settings, **options)


class _IGS2GS:
    def __init__(self, work: Work, settings: IGS2GSSettings) -> None:
        work.takes("igs2gs", "picture")
        work.starts_at(settings.start[0], "start")
        self.work, self.settings = work, settings
        views = tuple(range(len(work.sizes)))
        # Each edit has a timestep of its own, so none shares a pass with another.
        self.rounds = [
            Round(chunks(views, 1), views, iterations)
            for iterations in parts_of(settings.iterations, settings.every)
        ]

    def rows(self, number: int, group: Sequence[int]) -> int:
        return len(group) * self.settings.steps * self.work.branches()

    def edit(
        self, number: int, group: Sequence[int], model: Gaussians, watch: Callable[[], None]
    ) -> list[ViewEdit]:
        work, s = self.work, self.settings
        (view,) = group
        start = work.timestep(number, view, s.start)
        with work.guided():
            result = edit(
                work.editor,
                [work.picture(view)],
                work.instruction,
                steps=s.steps,
                start=start,
                pictures=[work.render(view, model)],
                noise=work.noise(number, group),
                watch=lambda step, steps, latents: watch(),
            )
        return [ViewEdit(result.images[0], {"start": start, "timesteps": result.timesteps})]
