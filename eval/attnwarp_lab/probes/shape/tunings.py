"""Attention warping whose tuning clones, splits and removes splats, as a fit does.

The tuning of the paper moves splats and adds none, so nothing can grow where no splat was.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.methods.settings import MethodSettings
from attnwarp.methods.tuning import Tuning
from attnwarp.render import Render
from attnwarp_eval.study.shared.editing_methods import (
    EDITING_METHODS,
    run_warping,
    true_pictures,
)

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


EDITING_METHODS["growing"] = replace(
    EDITING_METHODS["attention_warping"], run=partial(run_warping, kind=GrowingWarping)
)
EDITING_METHODS["growing true pictures"] = replace(
    EDITING_METHODS["true pictures"], run=partial(true_pictures, base=GrowingWarping)
)
