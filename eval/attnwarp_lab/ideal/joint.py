"""The ideal editor's twin with joint attention on a flow: the same exact posterior mean.

A sequence has a text token for each answer, the picture's tokens, and those of its reference, the
picture before. The block ``pair`` averages evidence over the tokens of a part, the block
``stream`` sums the answers' changes. Features are the first channels of a projection's input, whose
other channels are none. With x = (1 - s) z + s n, the evidence of the ideal editor becomes
((1 - s) <x - (1 - s) z_0, D> - ((1 - s)^2 / 2) |D|^2) / s^2, and the velocity is (x - x_0) / s.

A share of noise s has the ratio of signal to noise of alpha-bar a if s / (1 - s) is
sqrt((1 - a) / a). At such shares the twin takes the first editor's steps and makes its edits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.layers import Call, Layer
from attnwarp.editing.schedule import Flow, Size, Time
from attnwarp_lab.ideal.editor import (
    Answers,
    IdealEditor,
    IdealTask,
    IdealUNet,
    Output,
    part_means,
    schedule,
)


class IdealTransformer(IdealUNet):
    """The network: answers as of :class:`~attnwarp_lab.ideal.editor.IdealUNet`."""

    def __init__(self, views: Sequence[Answers], alphas: Tensor) -> None:
        super().__init__(views, alphas)
        self.pair, self.stream = Output(), Output()

    def forward(self, hidden_states: Tensor, timestep: float, views: Sequence[int]) -> Tensor:
        """(B, n, C) velocity of the first n of (B, 2 n, C) tokens; the others are the picture
        before.
        """
        rows, count = list(views), self.before.shape[1]
        x, before = hidden_states[:, :count], hidden_states[:, count:]
        clear, noise = 1 - timestep, timestep
        change = self.change[rows]
        fit = torch.einsum("bnc,bknc->bnk", x - clear * before, change)
        evidence = (clear * fit - clear**2 / 2 * self.energy[rows].transpose(1, 2)) / noise**2
        evidence = evidence - evidence.mean(dim=-1, keepdim=True)
        shared = part_means(evidence, self.parts[rows])

        answers = shared.shape[-1]
        beside = torch.cat([shared, before[..., :answers]], dim=1)  # rows of the reference
        shared = self.pair(torch.cat([beside, beside], dim=-1))[:, :count, :answers]
        weights = torch.softmax(self.members[rows][..., None] * shared, dim=-1)
        painted = torch.einsum("bnk,bknc->bnc", weights, change)
        painted = torch.where((self.parts[rows] >= 0)[..., None], painted, 0.0)
        text = before.new_ones(len(rows), answers, painted.shape[-1])
        joined = torch.cat([text, painted, before], dim=1)
        joined = self.stream(torch.cat([joined, joined], dim=-1))
        painted = joined[:, answers : answers + count, : painted.shape[-1]]
        return (x - before - painted) / noise


class IdealJointEditor(IdealEditor):
    """An :class:`~attnwarp_lab.ideal.editor.IdealEditor` of joint attention.

    Args:
        views: answers by view.
        share: share of the schedule's signal, :func:`attnwarp_lab.ideal.editor.schedule`.
    """

    def __init__(self, views: Sequence[Answers], share: float = 1.0) -> None:
        super().__init__(views, share)
        clock = schedule(share)

        def spacing(steps: int, size: Size) -> list[float]:
            alphas = clock.alphas[clock.timesteps(steps)].double()
            noise, signal = (1 - alphas).sqrt(), alphas.sqrt()
            return list((noise / (noise + signal)).tolist())

        self.schedule = Flow(spacing)  # type: ignore[assignment]
        self.unet = IdealTransformer(views, clock.alphas)

    def layers(self) -> tuple[Layer, ...]:
        """The two blocks' projections."""
        answers, channels = self.unet.change.shape[1], self.unet.change.shape[-1]
        return (
            Layer("pair", "joint", 0, answers, 0, "input", "image first"),
            Layer("stream", "joint", 0, channels, 1, "input", "after text"),
        )

    def call(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """The pass of a network call."""
        tokens, answers = kwargs["hidden_states"], self.unet.change.shape[1]
        return Call(kwargs["timestep"], self.unet.size, len(tokens), self.branches, answers)

    def task(
        self,
        guides: Sequence[npt.NDArray[Any]],
        prompt: str,
        regions: Sequence[npt.NDArray[Any]] | None = None,
    ) -> IdealJointTask:
        """Edit of the views with the given original pictures."""
        return IdealJointTask(self, super().task(guides, prompt).views)


class IdealJointTask(IdealTask):
    """An edit of some views."""

    def predict(self, latents: Tensor, timestep: Time) -> Tensor:
        """(B, C, h, w) velocity at a share of noise."""
        network = self.editor.unet
        tokens = torch.cat(
            [latents.flatten(2).transpose(1, 2), network.before[list(self.views)]], 1
        )
        velocity: Tensor = network(hidden_states=tokens, timestep=float(timestep), views=self.views)
        return velocity.transpose(1, 2).unflatten(2, latents.shape[2:])
