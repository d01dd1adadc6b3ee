"""Noise schedules, and the DDIM steps of an editor's own loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp.sampling import work_type

Prediction = Literal["epsilon", "sample", "v_prediction"]

Grid = Literal["even", "scheduler"]
"""Timesteps below a start T: "even" ones from T itself, or those of a "scheduler" that is made anew
for T training steps, as published code has it: from T - T / steps + 1 down to 1, though noise is
added at T.
"""

PUBLISHED_STEPS = 1000
"""Steps of Stable Diffusion, whose numbers publications give."""


@dataclass(frozen=True, eq=False)
class Schedule:
    """Noise schedule that a diffusion model was trained with.

    Steps of half precision are computed in float32 and rounded once: float16 has no number between
    0.9995 and 1, where alpha-bar of the last steps lies, and 1 - alpha-bar would be 0.

    Args:
        alphas: (N,) float32 alpha-bar of the training steps: x_t = sqrt(alpha-bar) x_0 +
            sqrt(1 - alpha-bar) noise.
        prediction: prediction type of the network, in diffusers' words.
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
        if timestep is None:
            return self.alphas.new_tensor(self.final_alpha)
        return self.alphas[timestep]

    def add_noise(self, x: Tensor, noise: Tensor, timestep: int) -> Tensor:
        """sqrt(alpha-bar) x + sqrt(1 - alpha-bar) noise, in the type of ``x``."""
        clean = widened(x)
        a = self.alphas[timestep].to(clean)
        return (a.sqrt() * clean + (1 - a).sqrt() * widened(noise)).to(x.dtype)

    def split(self, output: Tensor, x: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """The predicted x_0 and noise, from a network's output at x; float32 of half precision."""
        x, output = widened(x), widened(output)
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
            output: output of the network at ``x``.
            timestep: timestep of ``x``.
            following: the step that follows, None after the last.
            change: takes the predicted x_0 and returns what stands in its place; the noise is then
                what that x_0 leaves of ``x``.

        Returns:
            What follows, in the type of ``x``.
        """
        before = widened(x)
        now, then = self.alpha(timestep).to(before), self.alpha(following).to(before)
        x0, noise = self.split(output, x, now)
        if change is not None:
            changed = change(x0)
            # By the difference, so that what is unchanged keeps the bits of its noise.
            noise = noise - (now / (1 - now)).sqrt() * (changed - x0)
            x0 = changed
        return (then.sqrt() * x0 + (1 - then).sqrt() * noise).to(x.dtype)

    def sigma(self, timestep: int, following: int | None) -> Tensor:
        """() standard deviation of the noise of a DDIM step with eta 1 (eq. 16)."""
        now, then = self.alpha(timestep), self.alpha(following)
        return ((1 - then) / (1 - now) * (1 - now / then)).clamp_min(0).sqrt()


def widened(x: Tensor) -> Tensor:
    """``x`` in the type that a step is computed in."""
    return x.to(work_type(x.dtype))


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


def stable_diffusion_alphas() -> Tensor:
    """(1000,) float64 alpha-bar of Stable Diffusion 1.

    The products of 1 - beta, whose roots rise evenly from sqrt(0.00085) to sqrt(0.012):
    ``scaled_linear`` in diffusers, ``make_beta_schedule`` in CompVis' code. The last is 0.0047:
    7 % of the signal's amplitude is left.
    """
    roots = torch.linspace(0.00085**0.5, 0.012**0.5, PUBLISHED_STEPS, dtype=torch.float64)
    return torch.cumprod(1 - roots.square(), 0)


def published_steps(start: int, steps: int, grid: Grid = "even") -> list[int]:
    """Timesteps of Stable Diffusion that an edit from ``start`` denoises at.

    Args:
        start: timestep that noise is added at.
        steps: how many.
        grid: see :data:`Grid`.

    Raises:
        ValueError: fewer timesteps than steps.

    Example:
        >>> published_steps(980, 20)[:2], published_steps(980, 20, "scheduler")[:2]
        ([980, 931], [932, 883])
    """
    if grid == "even":
        return steps_from(start, steps)
    if steps < 1 or start < steps:
        raise ValueError(
            f"start, steps: got {start}, {steps}, expected at least one step and start >= steps"
        )
    return [start // steps * k + 1 for k in reversed(range(steps))]


def steps_as_published(
    schedule: Schedule, start: int, steps: int, grid: Grid = "even"
) -> list[int]:
    """The steps of a schedule that stand for steps of Stable Diffusion, as publications give them.

    A method noises a picture to a published timestep T. It relies on the share of the picture that
    is left there, sqrt(alpha-bar), and not on the number T. So each of Stable Diffusion's steps
    (:func:`published_steps`) becomes the step of the nearest alpha-bar. With Stable Diffusion's own
    schedule that is the same step.

    Stable Diffusion's last step still shows some of the picture, and methods rely on it. So it does
    not become the pure noise that another schedule may end in. Where neighbours have the same
    nearest step, each is one below the other, so that no step is taken twice. Of a range, T is
    drawn on Stable Diffusion's clock, and each draw becomes a step here. So shares of signal come
    as often as published.

    Args:
        schedule: schedule of the editor.
        start: Stable Diffusion's first timestep, in [0, 999].
        steps: how many.
        grid: see :data:`Grid`.

    Raises:
        ValueError: no such timestep, or more steps than the schedule has from there.

    Example:
        >>> alphas = stable_diffusion_alphas()
        >>> steps_as_published(Schedule(alphas, "epsilon", 1.0), 980, 4)
        [980, 735, 489, 244]
        >>> clearer = 4 * alphas / (1 + 3 * alphas)  # twice the signal for the same noise
        >>> steps_as_published(Schedule(clearer, "epsilon", 1.0), 700, 4)
        [856, 713, 558, 360]
    """
    check.number(start, 0, PUBLISHED_STEPS - 1, "start", whole=True)
    published = stable_diffusion_alphas()[published_steps(start, steps, grid)]
    own = schedule.alphas.double().cpu()
    result: list[int] = []
    for alpha in published:
        nearest = int((own - alpha).abs().argmin())
        result.append(min(nearest, result[-1] - 1) if result else nearest)
    if result[-1] < 0:
        raise ValueError(
            f"steps: got {steps} from {start}, which is step {result[0]} of this editor's schedule;"
            f" take at most {result[0] + 1}"
        )
    return result


def following(timesteps: list[int]) -> list[tuple[int, int | None]]:
    """Each timestep with the one that follows it; None after the last.

    Example:
        >>> following([999, 499])
        [(999, 499), (499, None)]
    """
    return list(zip(timesteps, [*timesteps[1:], None], strict=True))
