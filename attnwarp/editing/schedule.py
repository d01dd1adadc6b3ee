"""Noise schedules, and the steps of an editor's denoising loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp.sampling import work_type

Size = tuple[int, int]
T = TypeVar("T")

Prediction = Literal["epsilon", "sample", "v_prediction"]

Grid = Literal["even", "scheduler"]
"""Timesteps below a start T: "even" ones from T down, or those of a "scheduler" built for T
training steps, as in published code: from T - T / steps + 1 down to 1, though noise is added at T.
"""

PUBLISHED_STEPS = 1000
"""Number of Stable Diffusion's training steps, the unit of published timesteps."""


Time = float
"""Time of a step: the number of a training step (DDIM), or the share of noise (flow)."""


class Schedule(Protocol):
    """Path from noise to a picture, and the steps along it: :class:`DDIM` or :class:`Flow`.

    Steps of half precision are computed in float32 and rounded once.
    """

    @property
    def needs_noise(self) -> bool:
        """True if the network gives no noise of a clean picture, so that an inversion must begin at
        a noised picture.
        """
        ...

    def timesteps(self, steps: int, size: Size) -> Sequence[Time]:
        """Compute falling times from pure noise.

        Raises:
            ValueError: more steps than the schedule has.
        """
        ...

    def published(self, start: int, steps: int, grid: Grid = "even") -> Sequence[Time]:
        """Convert published Stable Diffusion timesteps to times of this schedule.

        A method noises a picture to a published timestep T and relies on the remaining share of the
        picture, not on the number T. So each of Stable Diffusion's steps (:func:`published_steps`)
        becomes the time at which the same share of the picture remains under the same noise. If T
        comes from a range, it is drawn on Stable Diffusion's clock and each draw is converted, so
        shares of signal occur as often as published.

        Raises:
            ValueError: the timestep is out of range, or has fewer timesteps below it than steps.
        """
        ...

    def add_noise(self, x: Tensor, noise: Tensor, timestep: Time) -> Tensor:
        """Noise clean latents to a time, in the dtype of ``x``."""
        ...

    def estimate(self, output: Tensor, x: Tensor, timestep: Time) -> Tensor:
        """Predict clean latents from a network's output at ``x``; half precision gives float32."""
        ...

    def step(
        self,
        output: Tensor,
        x: Tensor,
        timestep: Time | None,
        following: Time | None,
        clean: Tensor | None = None,
    ) -> Tensor:
        """Take one deterministic step, in either direction.

        Args:
            timestep: time of ``x``; None for clean latents.
            following: target time; None for clean latents.
            clean: latents that replace the predicted clean ones; the noise is then the rest of
                ``x``.

        Returns:
            Latents at ``following``, in the dtype of ``x``.
        """
        ...

    def noisy_step(
        self, output: Tensor, x: Tensor, timestep: Time, following: Time | None
    ) -> tuple[Tensor, Tensor]:
        """Compute the mean and () standard deviation of the next state; half precision gives
        float32. The deviation is 0 for steps that add no noise.
        """
        ...


@dataclass(frozen=True, eq=False)
class DDIM:
    """Noise schedule of a diffusion model, with the steps of DDIM (Song et al. 2021).

    Alpha-bar is float32: in float16 the last steps' alpha-bar, between 0.9995 and 1, would round to
    1, and 1 - alpha-bar to 0.

    Args:
        alphas: (N,) float32 alpha-bar of the training steps: x_t = sqrt(alpha-bar) x_0 +
            sqrt(1 - alpha-bar) noise.
        prediction: prediction type of the network, as named in diffusers.
        final_alpha: alpha-bar after the last step.
        spacing: function from a number of steps to falling timesteps; evenly spaced if omitted.
    """

    alphas: Tensor
    prediction: Prediction
    final_alpha: float
    spacing: Callable[[int], Sequence[int]] | None = None

    @classmethod
    def of(cls, scheduler: Any) -> DDIM:
        """Convert a diffusers DDIMScheduler, including its spacing."""
        kind = scheduler.config.prediction_type
        check.one_of(kind, ("epsilon", "sample", "v_prediction"), "prediction_type")

        def spacing(steps: int) -> list[int]:
            scheduler.set_timesteps(steps)
            return [int(t) for t in scheduler.timesteps]

        return cls(scheduler.alphas_cumprod, kind, float(scheduler.final_alpha_cumprod), spacing)

    @property
    def needs_noise(self) -> bool:
        """True if the network predicts the picture."""
        return self.prediction == "sample"

    def timesteps(self, steps: int, size: Size | None = None) -> list[int]:
        """Compute steps from pure noise, spaced by the model's scheduler: see :class:`Schedule`."""
        count = len(self.alphas)
        check.number(steps, 1, count, "steps", whole=True)
        if self.spacing is None:
            return steps_from(count - 1, steps)
        timesteps = list(self.spacing(steps))
        if max(timesteps) >= count:  # an offset can push the first timestep beyond the trained ones
            raise ValueError(
                f"steps: got {steps}, the first of which would be timestep {max(timesteps)} of this"
                f" editor's schedule, that ends at {count - 1}; take fewer"
            )
        return timesteps

    def published(self, start: int, steps: int, grid: Grid = "even") -> list[int]:
        """Find the steps of the nearest alpha-bar: see :meth:`Schedule.published`. With Stable
        Diffusion's schedule the steps stay the same.

        Stable Diffusion's last step still shows some of the picture, and methods rely on it. So
        that step does not become the pure noise in which another schedule may end. If neighbours
        have the same nearest step, each goes one below the previous, so that no step is taken
        twice.

        Example:
            >>> alphas = stable_diffusion_alphas()
            >>> DDIM(alphas, "epsilon", 1.0).published(980, 4)
            [980, 735, 489, 244]
            >>> clearer = 4 * alphas / (1 + 3 * alphas)  # twice the signal for the same noise
            >>> DDIM(clearer, "epsilon", 1.0).published(700, 4)
            [856, 713, 558, 360]
        """
        own = self.alphas.double().cpu()
        result: list[int] = []
        for alpha in published_alphas(start, steps, grid):
            nearest = int((own - alpha).abs().argmin())
            result.append(min(nearest, result[-1] - 1) if result else nearest)
        if result[-1] < 0:
            raise ValueError(
                f"steps: got {steps} from {start}, which is step {result[0]} of this editor's"
                f" schedule; take at most {result[0] + 1}"
            )
        return result

    def alpha(self, timestep: Time | None) -> Tensor:
        """Return alpha-bar () of a step; None means after the last step."""
        return torch.tensor(self.final_alpha) if timestep is None else self.alphas[int(timestep)]

    def add_noise(self, x: Tensor, noise: Tensor, timestep: Time) -> Tensor:
        """Compute sqrt(alpha-bar) x + sqrt(1 - alpha-bar) noise, in the dtype of ``x``."""
        clean = widened(x)
        a = self.alpha(timestep).to(clean)
        return (a.sqrt() * clean + (1 - a).sqrt() * widened(noise)).to(x.dtype)

    def split(self, output: Tensor, x: Tensor, timestep: Time | None) -> tuple[Tensor, Tensor]:
        """Predict x_0 and noise from a network's output at x; half precision gives float32."""
        x, output = widened(x), widened(output)
        a = self.alpha(timestep).to(x)
        match self.prediction:
            case "epsilon":
                return (x - (1 - a).sqrt() * output) / a.sqrt(), output
            case "sample":
                return output, (x - a.sqrt() * output) / (1 - a).sqrt()
        return a.sqrt() * x - (1 - a).sqrt() * output, a.sqrt() * output + (1 - a).sqrt() * x

    def estimate(self, output: Tensor, x: Tensor, timestep: Time) -> Tensor:
        """Predict x_0; half precision gives float32."""
        return self.split(output, x, timestep)[0]

    def step(
        self,
        output: Tensor,
        x: Tensor,
        timestep: Time | None,
        following: Time | None,
        clean: Tensor | None = None,
    ) -> Tensor:
        """Take a step with eta 0 (Song et al. 2021, eq. 12): see :meth:`Schedule.step`."""
        before = widened(x)
        now, then = self.alpha(timestep).to(before), self.alpha(following).to(before)
        x0, noise = self.split(output, x, timestep)
        if clean is not None:
            # Computed from the difference, so that unchanged latents keep the bits of their noise.
            noise = noise - (now / (1 - now)).sqrt() * (clean - x0)
            x0 = clean
        return (then.sqrt() * x0 + (1 - then).sqrt() * noise).to(x.dtype)

    def noisy_step(
        self, output: Tensor, x: Tensor, timestep: Time, following: Time | None
    ) -> tuple[Tensor, Tensor]:
        """Take a step with eta 1, as in DDPM (eq. 12 and 16): see :meth:`Schedule.noisy_step`."""
        now, then = self.alpha(timestep), self.alpha(following)
        x0, noise = self.split(output, x, timestep)
        sigma = ((1 - then) / (1 - now) * (1 - now / then)).clamp_min(0).sqrt().to(x0)
        a = then.to(x0)
        return a.sqrt() * x0 + (1 - a - sigma**2).clamp_min(0).sqrt() * noise, sigma


def even_shares(steps: int, size: Size) -> list[float]:
    """Compute falling shares of noise, evenly from 1 to 1 / steps.

    Example:
        >>> even_shares(4, (64, 64))
        [1.0, 0.75, 0.5, 0.25]
    """
    return [(steps - k) / steps for k in range(steps)]


@dataclass(frozen=True, eq=False)
class Flow:
    """Straight path between picture and noise, x_s = (1 - s) x_0 + s noise, for a network that
    predicts the velocity noise - x_0 (Lipman et al. 2023, Liu et al. 2023). Times are the shares s.

    Args:
        spacing: function from a number of steps and the (h, w) of latents to falling shares in
            (0, 1]. Models that shift shares by the number of tokens pass their function.

    Example:
        >>> x, noise = torch.tensor([2.0]), torch.tensor([4.0])
        >>> flow = Flow()
        >>> flow.add_noise(x, noise, 0.25), flow.step(noise - x, noise, 1.0, None)
        (tensor([2.5000]), tensor([2.]))
    """

    spacing: Callable[[int, Size], Sequence[float]] = even_shares
    needs_noise: bool = False

    @classmethod
    def of(
        cls, scheduler: Any, mu: Callable[[Any, int, int], float], token: int, *, even: bool = True
    ) -> Flow:
        """Convert a diffusers FlowMatchEulerDiscreteScheduler, including its shift.

        Args:
            mu: function of the scheduler and the numbers of tokens and steps that returns the
                shift, for a scheduler that shifts by it.
            token: side of a token in latents.
            even: True shifts even shares, as the model's pipeline does; False the scheduler's own.

        Raises:
            ValueError: the scheduler is of another class.
        """
        from diffusers import FlowMatchEulerDiscreteScheduler

        if not isinstance(scheduler, FlowMatchEulerDiscreteScheduler):
            raise ValueError(
                f"scheduler: got {type(scheduler).__name__}, expected a"
                " FlowMatchEulerDiscreteScheduler"
            )

        def spacing(steps: int, size: Size) -> list[float]:
            tokens = (size[0] // token) * (size[1] // token)
            shares = even_shares(steps, size) if even else None
            if shares == [1.0]:  # shifts keep 1; a stretch of the last share would divide by 0
                return shares
            scheduler.set_timesteps(steps, sigmas=shares, mu=mu(scheduler, tokens, steps))
            shifted: list[float] = scheduler.sigmas[:-1].tolist()
            return shifted

        return cls(spacing)

    def timesteps(self, steps: int, size: Size) -> list[float]:
        """Compute shares from pure noise: see :class:`Schedule`."""
        check.number(steps, 1, PUBLISHED_STEPS, "steps", whole=True)
        return list(self.spacing(steps, size))

    def published(self, start: int, steps: int, grid: Grid = "even") -> list[float]:
        """Compute shares that leave as much of the picture: see :meth:`Schedule.published`."""
        alphas = published_alphas(start, steps, grid)
        noise, signal = (1 - alphas).sqrt(), alphas.sqrt()
        return list((noise / (noise + signal)).tolist())

    def add_noise(self, x: Tensor, noise: Tensor, timestep: Time) -> Tensor:
        """Compute (1 - s) x + s noise, in the dtype of ``x``."""
        return ((1 - timestep) * widened(x) + timestep * widened(noise)).to(x.dtype)

    def estimate(self, output: Tensor, x: Tensor, timestep: Time) -> Tensor:
        """Compute x - s velocity; half precision gives float32."""
        return widened(x) - timestep * widened(output)

    def step(
        self,
        output: Tensor,
        x: Tensor,
        timestep: Time | None,
        following: Time | None,
        clean: Tensor | None = None,
    ) -> Tensor:
        """Take an Euler step, x + (s' - s) velocity: see :meth:`Schedule.step`."""
        before, now = widened(x), timestep or 0.0
        velocity = widened(output) if clean is None else (before - clean) / now
        return (before + ((following or 0.0) - now) * velocity).to(x.dtype)

    def noisy_step(
        self, output: Tensor, x: Tensor, timestep: Time, following: Time | None
    ) -> tuple[Tensor, Tensor]:
        """Take an Euler step; it adds no noise."""
        before = widened(x)
        return self.step(output, before, timestep, following), before.new_zeros(())


def widened(x: Tensor) -> Tensor:
    """Convert ``x`` to the dtype in which a step is computed."""
    return x.to(work_type(x.dtype))


def steps_from(start: int, steps: int) -> list[int]:
    """Space ``steps`` timesteps evenly down from ``start``, as "trailing" does from the last."""
    if steps < 1 or start < steps - 1:
        raise ValueError(
            f"start, steps: got {start}, {steps}, expected at least one step and start >= steps - 1"
        )
    return [round((start + 1) * (steps - k) / steps) - 1 for k in range(steps)]


def stable_diffusion_alphas() -> Tensor:
    """(1000,) float64 alpha-bar of Stable Diffusion 1.

    The values are products of 1 - beta, and the roots of beta rise evenly from sqrt(0.00085) to
    sqrt(0.012): ``scaled_linear`` in diffusers, ``make_beta_schedule`` in CompVis' code. The last
    value is 0.0047: 7 % of the signal's amplitude is left.
    """
    roots = torch.linspace(0.00085**0.5, 0.012**0.5, PUBLISHED_STEPS, dtype=torch.float64)
    return torch.cumprod(1 - roots.square(), 0)


def published_steps(start: int, steps: int, grid: Grid = "even") -> list[int]:
    """Compute the Stable Diffusion timesteps at which an edit from ``start`` denoises."""
    if grid == "even":
        return steps_from(start, steps)
    if steps < 1 or start < steps:
        raise ValueError(
            f"start, steps: got {start}, {steps}, expected at least one step and start >= steps"
        )
    return [start // steps * k + 1 for k in reversed(range(steps))]


def published_alphas(start: int, steps: int, grid: Grid) -> Tensor:
    """Return alpha-bar of :func:`published_steps`, (steps,) float64."""
    check.number(start, 0, PUBLISHED_STEPS - 1, "start", whole=True)
    return stable_diffusion_alphas()[published_steps(start, steps, grid)]


def following(timesteps: Sequence[T]) -> list[tuple[T, T | None]]:
    """Pair each timestep with its successor; None after the last."""
    return list(zip(timesteps, [*timesteps[1:], None], strict=True))
