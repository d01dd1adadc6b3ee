"""Noise schedules, and the DDIM steps of an editor's own loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from attnwarp import check

Prediction = Literal["epsilon", "sample", "v_prediction"]


@dataclass(frozen=True, eq=False)
class Schedule:
    """What a diffusion model was trained with.

    Args:
        alphas: (N,) float32 alpha-bar of the training steps: x_t = sqrt(alpha-bar) x_0 +
            sqrt(1 - alpha-bar) noise.
        prediction: what the network gives, in diffusers' words.
        final_alpha: alpha-bar after the last step.
    """

    alphas: Tensor
    prediction: Prediction
    final_alpha: float

    @classmethod
    def of(cls, scheduler: Any) -> Schedule:
        """The schedule of a diffusers DDIMScheduler."""
        kind = scheduler.config.prediction_type
        check.one_of(kind, ("epsilon", "sample", "v_prediction"), "prediction_type")
        return cls(scheduler.alphas_cumprod, kind, float(scheduler.final_alpha_cumprod))

    def alpha(self, timestep: int | None) -> Tensor:
        """() alpha-bar of a step; None is what comes after the last."""
        return torch.tensor(self.final_alpha) if timestep is None else self.alphas[timestep]

    def add_noise(self, x: Tensor, noise: Tensor, timestep: int) -> Tensor:
        """sqrt(alpha-bar) x + sqrt(1 - alpha-bar) noise."""
        a = self.alphas[timestep].to(x)
        return a.sqrt() * x + (1 - a).sqrt() * noise

    def split(self, output: Tensor, x: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """The predicted x_0 and noise, from a network's output at x."""
        a = alpha.to(x)
        match self.prediction:
            case "epsilon":
                return (x - (1 - a).sqrt() * output) / a.sqrt(), output
            case "sample":
                return output, (x - a.sqrt() * output) / (1 - a).sqrt()
        return a.sqrt() * x - (1 - a).sqrt() * output, a.sqrt() * output + (1 - a).sqrt() * x

    def step(
        self,
        output: Tensor,
        x: Tensor,
        timestep: int,
        following: int | None,
        change: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """One deterministic DDIM step (Song et al. 2021, eq. 12 with eta 0).

        Args:
            output: of the network at ``x``.
            timestep: of ``x``.
            following: the step that follows, None after the last.
            change: takes the predicted x_0 and returns what stands in its place; the noise is then
                what that x_0 leaves of ``x``.
        """
        now = self.alpha(timestep)
        x0, noise = self.split(output, x, now)
        if change is not None:
            changed = change(x0)
            if changed is not x0:
                x0, noise = changed, (x - now.to(x).sqrt() * changed) / (1 - now.to(x)).sqrt()
        a = self.alpha(following).to(x)
        return a.sqrt() * x0 + (1 - a).sqrt() * noise

    def sigma(self, timestep: int, following: int | None) -> Tensor:
        """() standard deviation of the noise of a DDIM step with eta 1 (eq. 16)."""
        now, then = self.alpha(timestep), self.alpha(following)
        return ((1 - then) / (1 - now) * (1 - now / then)).clamp_min(0).sqrt()


def steps_from(start: int, steps: int) -> list[int]:
    """``steps`` timesteps that fall evenly from ``start``, as "trailing" ones do from the last.

    Args:
        start: first timestep, at least ``steps`` - 1.
        steps: how many.

    Example:
        >>> steps_from(999, 4)
        [999, 749, 499, 249]
        >>> steps_from(700, 4)
        [700, 525, 349, 174]
    """
    if steps < 1 or start < steps - 1:
        raise ValueError(
            f"start, steps: got {start}, {steps}, expected at least one step and start >= steps - 1"
        )
    return [round((start + 1) * (steps - k) / steps) - 1 for k in range(steps)]


def following(timesteps: list[int]) -> list[tuple[int, int | None]]:
    """Each timestep with the one that follows it; None after the last.

    Example:
        >>> following([999, 499])
        [(999, 499), (499, None)]
    """
    return list(zip(timesteps, [*timesteps[1:], None], strict=True))
