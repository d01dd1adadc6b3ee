"""Correspondence Guidance (Bengtson et al. 2026): edit views one after the other, each guided to
look like the views edited before at the points that both show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, cast

import torch
from torch import Tensor

from attnwarp.editing.schedule import Schedule, Time, following
from attnwarp.encoders import load_encoder
from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, ViewEdit
from attnwarp.methods.by_warps import ByWarps, SourceSettings, checked_source
from attnwarp.methods.doors import door
from attnwarp.methods.geometry import Warps
from attnwarp.methods.settings import (
    LAST_STEP,
)
from attnwarp.methods.tuning import PerceptualLoss
from attnwarp.methods.work import VIEWS, Work
from attnwarp.settings import Count, Number, Range, Weight
from attnwarp.warp import FeatureWarp

PUBLISHED_SIDE = 512
"""Side in px of the published edits, for which the patches' side holds."""

Loss = Callable[[Tensor], Tensor]
"""Loss () of (3, h, w) pixels in [0, 1]."""


@dataclass(frozen=True)
class GuidedSettings(SourceSettings):
    """Settings of :func:`attnwarp.methods.guided`.

    Args:
        batch: unused; views are edited one at a time.
        partners: number of views edited before that guide a view.
        below: timestep of Stable Diffusion below which steps are guided.
        forward: weight of the gradient through the network; 0 takes none.
        backward: number of steps of the predicted picture at each guided step.
        rate: share of Polyak's step that each of them takes.
        points, patches: largest numbers of matched points and patches.
        patch: side of the patches in px of a picture of 512 px; others are scaled alike.
        patch_weight: weight of the patches' perceptual distance against L1.

    Example:
        >>> from attnwarp.methods import GuidedSettings
        >>> GuidedSettings(below=1000)
        Traceback (most recent call last):
        ValueError: below: got 1000, expected a whole number in [0, 999]
    """

    partners: Count = 2
    below: Annotated[int, Range(0, LAST_STEP)] = 700
    forward: Weight = 0.1
    backward: Number = 3
    rate: Weight = 0.3
    points: Count = 50_000
    patches: Count = 1_500
    patch: Count = 64
    patch_weight: Weight = 2.0


class Guided(ByWarps):
    """Edit views in order, each guided by the edited views of most matches, then tune the splats.

    The loss is L1 at matched points plus ``patch_weight`` times the perceptual distance of patches
    around them. Below a timestep each step is guided as in Universal Guidance (Bansal et al. 2024):
    forward by the loss's gradient through the network, backward by steps of the predicted picture.

    No code is released. Matches are the warp's here and RoMa's there. Steps are shares of Polyak's
    here, since theirs are not known. The patches' side scales with the picture. Patches are
    compared side by side in one picture, where a network sees across their borders. Models of flow
    are guided in the same way; the paper optimises their noise.

    Args:
        gaussians, cameras, images, instruction, options: see :func:`by_view`.
        editor: any editor whose passes have gradients. Passes back are not counted as rows.
        settings: :class:`GuidedSettings`; the defaults if omitted.
        source: number of the first view.
        warps: see :func:`attention_warping`.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import GuidedSettings, guided
        >>> from attnwarp.trial import disc, view
        >>> quick = GuidedSettings(steps=2, iterations=1)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = guided(disc(), views, None, editor, "red", quick)
        >>> result.counters["network_rows"]  # two steps of two views, two branches each
        8
    """

    def __init__(
        self, work: Work, settings: GuidedSettings, source: int = 0, warps: Warps | None = None
    ) -> None:
        if settings.start is not None:
            work.starts_at(settings.start[0], "start")
        self.settings, first = settings, checked_source(source, work)
        self.views = [first, *(view for view in range(len(work.sizes)) if view != first)]
        super().__init__(work, settings, warps)
        # Loaded here, not at its first use, which may follow hours of editing.
        device = str(work.editor.network.device)
        encoder = load_encoder(settings.perceptual_encoder, "perceptual", device=device)
        self.perceptual = cast(PerceptualLoss, encoder)
        digest = self.perceptual.about.weights_sha256
        self.inputs = {**self.inputs, "patches": digest}

    def run(self, loop: Loop) -> None:
        """Edit all views in order, then tune."""
        for view in self.views:
            rows = self.settings.steps * self.work.branches()
            loop.edit(0, (view,), partial(self.edit, view), rows=rows)
        loop.tune(0, self.views, self.settings.iterations)

    def edit(self, view: int, model: Gaussians, step: Callable[[], None]) -> list[ViewEdit]:
        """Edit a view, guided by those before that show most of it."""
        work, s, editor = self.work, self.settings, self.work.editor
        before = self.views[: self.views.index(view)]
        matched = [(other, self.of_edits(other, view)) for other in before]
        matched = [pair for pair in matched if bool(pair[1].mask.any())]
        matched.sort(key=lambda pair: -int(pair[1].mask.sum()))
        matched = matched[: s.partners]
        losses = [self.loss(other, warp, view) for other, warp in matched]
        schedule = editor.schedule
        (below,) = schedule.published(s.below, 1)
        start = None if s.start is None else work.timestep(0, view, s.start)

        def loss(clean: Tensor) -> Tensor:
            pixels = editor.pixels(clean)[0].clamp(0, 1)
            return torch.stack([of(pixels) for of in losses]).mean()

        with work.guided(s.text_guidance), torch.no_grad():
            guide, regions = work.guide(view, work.frozen), work.regions([view])
            task = editor.task([guide], work.instruction, regions)
            x, timesteps = self.begin(0, view, start, "even")
            for now, then in following(timesteps):
                if losses and now < below:
                    x = guided_step(
                        schedule, task.predict, loss, x, now, then, s.forward, s.backward, s.rate
                    )
                else:
                    x = schedule.step(task.predict(x, now), x, now, then)
                step()
            (picture,) = editor.decode(x)
        about = {self.names[other]: int(warp.mask.sum()) for other, warp in matched}
        return [ViewEdit(picture, {"start": start, "matches": about})]

    def loss(self, other: int, warp: FeatureWarp, view: int) -> Loss:
        """Prepare the loss of a view's pixels against another view's edit."""
        s, size = self.settings, self.work.sizes[view]
        device = self.work.editor.network.device
        edited = torch.from_numpy(self.kept(0, other)).permute(2, 0, 1).contiguous()
        shown = warp.mask.flatten().nonzero()[:, 0]
        generator = self.work.generator(VIEWS, view, other)
        drawn = shown[torch.randperm(len(shown), generator=generator)]
        points, chosen = drawn[: s.points], drawn[: s.patches]
        side = max(2, round(s.patch * min(size) / PUBLISHED_SIDE))
        colors = warp.warp(edited).flatten(1)[:, points].to(device)
        own = torch.stack([chosen % size[1], chosen // size[1]], dim=-1) + 0.5
        theirs = warp.correspondence.xy.reshape(-1, 2)[chosen]
        with torch.no_grad():
            target = self.perceptual.features(mosaic(edited.to(device), theirs, side))

        def of(pixels: Tensor) -> Tensor:
            difference = (pixels.flatten(1)[:, points.to(device)] - colors).abs().mean()
            patches = self.perceptual.features(mosaic(pixels, own, side))
            return difference + s.patch_weight * self.perceptual.between(patches, target)

        return of


guided = door(
    Guided,
    {
        "default": GuidedSettings(),
        "paper": GuidedSettings(text_guidance=7.5, image_guidance=1.5),
    },
)


def mosaic(picture: Tensor, centers: Tensor, side: int) -> Tensor:
    """Lay square patches around points side by side, (n side, n side, 3), n^2 being at most the
    number of points.

    Args:
        picture: (3, h, w).
        centers: (N, 2) px, centres of pixels at +0.5.
        side: side of a patch in px; beyond the border its value is taken.
    """
    n = int(len(centers) ** 0.5)
    place = torch.arange(side, dtype=torch.float64) - (side - 1) / 2
    x = (centers[: n * n, 0].reshape(n, 1, n, 1) + place).expand(n, side, n, side)
    y = (centers[: n * n, 1].reshape(n, 1, n, 1) + place[:, None, None]).expand(n, side, n, side)
    h, w = picture.shape[1:]
    grid = torch.stack([2 * x / w - 1, 2 * y / h - 1], dim=-1).reshape(1, n * side, n * side, 2)
    cut = torch.nn.functional.grid_sample(
        picture[None], grid.to(picture), padding_mode="border", align_corners=False
    )
    return cut[0].permute(1, 2, 0)


def guided_step(
    schedule: Schedule, predict: Callable[[Tensor, Time], Tensor], loss: Loss, x: Tensor,
    now: Time, then: Time | None, forward: float, backward: int, rate: float,
) -> Tensor:  # fmt: skip
    """Take a denoising step under Universal Guidance.

    The noise becomes e + s sigma p(x_0; x), then the clean latents take ``backward`` steps of
    -``rate`` p, and the noise is the rest of x. With g the gradient of the loss L, p = L g / |g|^2
    is Polyak's step, which ends where a linear loss is 0.

    Args:
        x: (B, C, h, w) latents at ``now``.
        forward: s; 0 takes no gradient of the network.
        backward: number of steps of the clean latents.
        rate: share of a step of the clean latents that is taken.
    """
    with torch.enable_grad():
        x = x.detach().requires_grad_(forward > 0)
        output = predict(x, now)
        clean = schedule.estimate(output, x, now)
        through = _polyak(loss(clean), x) if forward else None
    x, output, clean = x.detach(), output.detach(), clean.detach()
    if through is not None:
        one, none = torch.ones_like(x), torch.zeros_like(x)
        sigma, alpha = schedule.add_noise(none, one, now), schedule.add_noise(one, none, now)
        clean = clean - sigma / alpha * forward * sigma * through
    for _ in range(backward):
        with torch.enable_grad():
            place = clean.detach().requires_grad_()
            clean = clean - rate * _polyak(loss(place), place)
    return schedule.step(output, x, now, then, clean)


def _polyak(loss: Tensor, place: Tensor) -> Tensor:
    (gradient,) = torch.autograd.grad(loss, place)
    return loss.detach() * gradient / gradient.square().sum().clamp_min(1e-20)
