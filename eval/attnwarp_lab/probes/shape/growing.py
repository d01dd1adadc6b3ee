"""Attention warping whose tuning clones, splits and removes splats, as a fit does.

The tuning of the paper moves splats and adds none, so nothing can grow where no splat was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.fit import Views
from attnwarp.fit.densify import Density
from attnwarp.gaussians import Gaussians
from attnwarp.methods import AttentionWarpingSettings
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.methods.base import ViewEdit, run
from attnwarp.methods.settings import MethodSettings
from attnwarp.methods.tuning import Tuning
from attnwarp.render import Render
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Job

UNTIL = 0.9
"""Share of the iterations until which splats are added: in every stage."""

MOST = 2.0
"""Most splats, as a multiple of those before the edit."""


class GrowingTuning(Tuning):
    """Tuning with the density control of a fit."""

    def __init__(
        self,
        start: Gaussians,
        cameras: Sequence[Camera],
        settings: MethodSettings,
        iterations: int,
        *rest: Any,
        **named: Any,
    ) -> None:
        super().__init__(start, cameras, settings, iterations, *rest, **named)
        if self.membership is not None:
            raise ValueError("segments: got some, but splats that are added belong to none")
        self.fit = replace(
            self.fit, iterations=max(1, iterations), densify_until=UNTIL,
            max_splats=int(MOST * len(start)),
        )  # fmt: skip
        model = self.model
        middle = np.mean([camera.position for camera in cameras], axis=0) - model.origin
        self.density = Density(self.fit, model.extent, middle, len(start), model.device)
        self._seen: tuple[Camera, Tensor] | None = None

    def loss_of(self, picture: Render, views: Views, index: int) -> Tensor:
        """Compute the loss, and keep what the density control reads of the picture."""
        self._seen = views.cameras[index], picture.weight.detach()
        return super().loss_of(picture, views, index)

    def _step(self, progress: float) -> None:
        assert self._seen is not None
        if self.density.active(self.iteration):
            with torch.no_grad():
                self.density.watch(self.model, self.gaussians(), *self._seen)
        super()._step(progress)
        self.density.refine(self.model, self.iteration, self.random)


class GrowingWarping(AttentionWarping):
    """Attention warping with that tuning."""

    tuning = GrowingTuning


class TrueGrowing(GrowingWarping):
    """The same with the first answer's true pictures for edits: the ceiling."""

    def __init__(self, pictures: Sequence[Any], *rest: Any) -> None:
        self.pictures = pictures
        super().__init__(*rest)

    def edit_source(self, *_: Any) -> list[ViewEdit]:
        """Take the source's true picture."""
        return self.edit_targets(0, [self.source])

    def edit_targets(self, stage: int, batch: Sequence[int], *_: Any) -> list[ViewEdit]:
        """Take the true pictures of some views."""
        return [ViewEdit(self.pictures[view], {"injected": 0.0}) for view in batch]


def _growing(kind: Callable[..., GrowingWarping], job: Job) -> EditedScene:
    result = run(
        "growing",
        lambda work, s: kind(work, s, job.source, None, job.warps, "cpu"),
        AttentionWarpingSettings, job.gaussians, job.cameras, job.images, job.editor,
        job.instruction, AttentionWarpingSettings.from_dict(job.settings), **job.options,
    )  # fmt: skip
    return EditedScene(
        result.gaussians, result.edited, result.seconds, result.counters, result.cut, result.rounds
    )


def _true_growing(job: Job) -> EditedScene:
    return _growing(partial(TrueGrowing, next(iter(job.truth.values()))), job)


_LIKE = EDITING_METHODS["attention_warping"]

EDITING_METHODS["growing"] = replace(_LIKE, run=partial(_growing, GrowingWarping))
EDITING_METHODS["growing true pictures"] = replace(_LIKE, run=_true_growing, needs_truth=True)
