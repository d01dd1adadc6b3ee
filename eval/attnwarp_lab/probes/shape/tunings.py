"""Attention warping whose tuning adds splats.

The tuning of the paper moves splats and adds none, so nothing can stand where no splat was.
``growing`` clones, splits and removes them as a fit does; ``seeded`` puts new ones where no new
colour of the old surface explains the edit.
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
from attnwarp.fit import Views, from_points
from attnwarp.fit.densify import Density
from attnwarp.fit.model import Model
from attnwarp.gaussians import Gaussians
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.methods.settings import MethodSettings
from attnwarp.methods.tuning import Tuning, target_of
from attnwarp.methods.work import Work
from attnwarp.render import Render
from attnwarp.warp import WarpSettings, render_surface
from attnwarp_eval.study.shared.editing_methods import (
    EDITING_METHODS,
    run_warping,
    true_pictures,
)
from attnwarp_lab.probes.shape.seeds import EditedViews

UNTIL = 0.9
"""Share of the iterations until which splats are added: in every stage."""

MOST = 2.0
"""Most splats, as a multiple of those before the edit."""

LEAST_SEEDS = 4
"""Fewer new splats have no gaps between them by which to size them."""


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


class SeededTuning(Tuning):
    """Tuning that begins each stage with splats on the surface that the edit adds.

    Args:
        originals: all views before the edit.
    """

    def __init__(self, *rest: Any, originals: Views, **named: Any) -> None:
        super().__init__(*rest, **named)
        if self.membership is not None:
            raise ValueError("segments: got some, but splats that are added belong to none")
        self.originals = originals

    def advance(
        self, begin: int, end: int, views: Views, numbers: Sequence[int], *rest: Any, **named: Any
    ) -> None:
        """Tune a stage, which begins with new splats."""
        if self.iteration == begin < end:
            self._seed(views, numbers)
        super().advance(begin, end, views, numbers, *rest, **named)

    def _seed(self, views: Views, numbers: Sequence[int]) -> None:
        model, now, device = self.model, self.gaussians(), torch.device("cpu")
        near = self.fit.near * model.extent
        with torch.no_grad():
            depths = [
                np.asarray(render_surface(now, camera, WarpSettings(), near=near).depth)
                for camera in views.cameras
            ]
        edited = EditedViews(
            views.cameras,
            np.stack([self.originals.picture(number) for number in numbers]),
            np.stack([target_of(views, k, device).numpy() for k in range(len(views))]),
            np.stack([np.where(depth > 0, depth, np.inf) for depth in depths]),
        )
        places, colors = edited.seeds()
        if len(places) < LEAST_SEEDS:
            return
        start = from_points(places, colors, kind=self.fit.kind, sh_degree=self.fit.sh_degree)
        # A place far from others would get a splat as large as the gap, before much else.
        pixel = [c.project(start.world_means())[1] / c.K[0, 0] for c in views.cameras]
        size = torch.from_numpy(np.where(np.array(pixel) > 0, pixel, np.inf).min(axis=0)).float()
        start = start.unchecked(scales=size[:, None].expand_as(start.scales).contiguous())
        new = Model(start, self.fit, model.extent)
        added = {name: tensor.detach() for name, tensor in new.tensors.items()}
        added["means"] = added["means"] + torch.from_numpy(new.origin - model.origin).float()
        model.replace(torch.arange(len(model)), added)


class GrowingWarping(AttentionWarping):
    """Attention warping with the tuning that grows."""

    tuning = GrowingTuning


class SeededWarping(AttentionWarping):
    """Attention warping with the tuning that seeds."""

    def __init__(self, work: Work, *rest: Any) -> None:
        super().__init__(work, *rest)
        self.tuning = partial(SeededTuning, originals=work.views)  # type: ignore[assignment]


_KINDS: dict[str, type[AttentionWarping]] = {"growing": GrowingWarping, "seeded": SeededWarping}

for _name, _kind in _KINDS.items():
    EDITING_METHODS[_name] = replace(
        EDITING_METHODS["attention_warping"], run=partial(run_warping, kind=_kind)
    )
    EDITING_METHODS[f"{_name} true pictures"] = replace(
        EDITING_METHODS["true pictures"], run=partial(true_pictures, base=_kind)
    )
