"""Tuning of the splats on a baseline's edited views."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from attnwarp import losses
from attnwarp.baselines.settings import BaselineSettings
from attnwarp.camera import Camera
from attnwarp.fit.checkpoint import save
from attnwarp.gaussians import Gaussians
from attnwarp.propagate.settings import PropagateSettings
from attnwarp.propagate.tune import TrainingView, Tuning
from attnwarp.render import Render


class Fitting(Tuning):
    """Tuning with SSIM among its losses, which can be stopped at any iteration.

    Args:
        start: the splats before the edit.
        cameras: of all views; they decide the extent.
        settings: losses, iterations, rates.
        backend: of the renderer.
    """

    def __init__(
        self,
        start: Gaussians,
        cameras: Sequence[Camera],
        settings: BaselineSettings,
        backend: str = "auto",
    ) -> None:
        shared = PropagateSettings(
            seed=settings.seed,
            iterations=settings.iterations,
            training="all",
            l1=settings.l1,
            perceptual=settings.perceptual,
            normal=settings.normal,
            distortion=settings.distortion,
            perceptual_encoder=settings.perceptual_encoder,
            color_rate=settings.color_rate,
            geometry_rate=settings.geometry_rate,
            background=settings.background,
        )
        super().__init__(start, cameras, shared, stages=1, backend=backend)
        self.ssim = settings.ssim
        if self.ssim and settings.iterations:
            self.smallest.append(("SSIM", losses.SSIM_WINDOW, "ssim"))

    def loss_of(self, picture: Render, view: TrainingView) -> Tensor:
        """The weighted sum of the losses; see :class:`attnwarp.propagate.tune.Tuning`."""
        loss = super().loss_of(picture, view)
        if self.ssim:
            image, target = picture.color.float(), torch.from_numpy(view.picture)
            loss = loss + self.ssim * (1 - losses.ssim(image, target.to(image.device)))
        return loss

    def advance(
        self,
        begin: int,
        end: int,
        views: Sequence[TrainingView],
        *,
        checkpoint: Path,
        checkpoint_seconds: float,
        spent: Callable[[], bool],
        watch: Callable[[], None],
        saved: Callable[[], None],
    ) -> None:
        """Tune up to an iteration, or until the budget is spent.

        Args:
            begin, end: iterations of the round.
            views: to tune on, each once before any comes again, in random order.
            checkpoint: file that is written every ``checkpoint_seconds`` and at the end.
            spent: whether no further iteration may begin.
            watch: called after each iteration.
            saved: called after each checkpoint but the last.
        """
        if self.iteration == begin:
            self.queue = []  # of the round before, whose views were others
        written, first = time.perf_counter(), views[0]
        while self.iteration < end and not spent():
            self._iterate(0, views, first)
            watch()
            if self.iteration < end and time.perf_counter() - written >= checkpoint_seconds:
                save(checkpoint, self.state())
                saved()
                written = time.perf_counter()
        save(checkpoint, self.state())
