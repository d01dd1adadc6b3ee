"""Cost of a scene's plan against a rendering with everything on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.cost import AGAIN, in_turn
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.statistics.equivalence import welch_interval
from attnwarp_eval.statistics.intervals import time_ratio
from attnwarp_eval.truth.llvm import LLVM, variant
from attnwarp_eval.truth.mitsuba import render_plan
from attnwarp_eval.truth.passes import Plan
from attnwarp_eval.truth.plan import bounces_of, everything_on, plan

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Cap:
    """Loss due to a scene's cap on bounces, and cost of everything on.

    Attributes:
        bias: mean light of the plan's pictures over that of everything on without a cap, less 1.
        bias_interval: 95 % interval of ``bias``, by Welch's test on the logarithms of the rounds'
            means; both None for a black picture.
        seconds, variance: seconds and variance of everything on within the cap, as in
            :class:`Cost`.
        faster: time ratio to the plan at equal samples.
        at_equal_error: time ratio at equal noise, which is equal error, since its
            pictures have the plan's mean; infinite if the plan has no noise.
        interval: 95 % interval of ``at_equal_error``; None if the plan has no noise.
    """

    bounces: int
    bias: float | None
    bias_interval: tuple[float, float] | None
    seconds: float
    variance: float
    faster: float
    at_equal_error: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class Cost:
    """Cost of everything on against the plan, measured on one small picture of the source.

    Everything on follows light until roulette ends it. If the scene caps its bounces, the plan
    omits that light and the two pictures have different means: then equal noise is not equal error,
    and ``cap`` has the loss.

    Attributes:
        size, spp: size in px and samples a pixel of the measurement.
        seconds: (plan, everything on) medians.
        faster: time ratio of everything on at equal samples: the median over rounds, in
            each of which both were rendered one after the other.
        variance: (plan, everything on), mean over pixels and channels, relative to the squared
            mean.
        rounds: number of pictures of each, taken in turn.
        interval: 95 % of :attr:`at_equal_noise`, by resampling the rounds; None if the plan has
            no noise.
        again: 95 % interval of the ratio of the plan's seconds between its two runs of a round:
            inside this band nothing is faster or slower. None with too few rounds.
        cap: cap on bounces and its loss; None without a cap.
    """

    size: int
    spp: int
    rounds: int
    seconds: tuple[float, float]
    faster: float
    variance: tuple[float, float]
    interval: tuple[float, float] | None
    again: tuple[float, float] | None
    cap: Cap | None = None

    @property
    def at_equal_noise(self) -> float:
        """Factor by which everything on takes longer at equal noise; infinite without noise."""
        return (
            self.faster * self.variance[1] / self.variance[0]
            if self.variance[0] > 0
            else float("inf")
        )

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON, where infinity is null."""
        fields: dict[str, Any] = without_nan(asdict(self) | {"at_equal_noise": self.at_equal_noise})
        return fields


def measure(
    scene: Scene,
    *,
    size: int | None = None,
    spp: int | None = None,
    rounds: int = 7,
    seed: int = 7000,
) -> Cost:
    """Render plan and everything on in turn and time both, after one unmeasured picture each.

    If the scene caps its bounces, everything on within the cap is a third contestant, unless it
    equals the plan.

    Args:
        size, spp: size in px and samples a pixel of the picture; by default large enough that
            tracing, not starting, takes most of the time.
    """
    size, spp = size or (96 if variant() == LLVM else 48), spp or (64 if variant() == LLVM else 16)
    small = scene.with_size(size, size)
    contestants = [plan(small, spp), everything_on(small, spp, capped=False)]
    bounces = bounces_of(scene)
    within = everything_on(small, spp)
    # In fog the plan is everything on within the cap: the same computation costs the same.
    same = within.identity() == contestants[0].identity()
    if bounces != "unlimited" and not same:
        contestants.append(within)

    def rendered(made: Plan) -> Callable[[int], Any]:
        # Both runs of the plan in a round have one seed: only their seconds are compared.
        return lambda turn: render_plan(small, small.source, made, seed + turn % AGAIN)

    turns = in_turn([rendered(made) for made in contestants], rounds, seed=seed)
    pictures, seconds = turns.results, turns.seconds
    again = time_ratio([turns.again], [seconds[0]])
    scale = float(np.mean(pictures[1])) ** 2 or 1.0  # a black picture has no noise
    taken = [np.array(p, np.float64).reshape(rounds, -1) for p in pictures]
    variance = [float(p.var(0, ddof=1).mean()) / scale for p in taken]
    medians = [float(np.median(s)) for s in seconds]
    interval = _ratio_interval(taken[0], taken[1], seconds[0], seconds[1])
    cap = None
    if bounces != "unlimited":
        bias, between = _cut(taken[0].mean(1), taken[1].mean(1))
        if same:
            cap = Cap(bounces, bias, between, medians[0], variance[0], 1.0, 1.0, (1.0, 1.0))
        else:
            faster = _slower(seconds[0], seconds[2])
            cap = Cap(
                bounces, bias, between, medians[2], variance[2], faster,
                faster * variance[2] / variance[0] if variance[0] > 0 else float("inf"),
                _ratio_interval(taken[0], taken[2], seconds[0], seconds[2]),
            )  # fmt: skip
    faster = _slower(seconds[0], seconds[1])
    return Cost(
        size,
        spp,
        rounds,
        (medians[0], medians[1]),
        faster,
        (variance[0], variance[1]),
        interval,
        (again.low, again.high) if again.bounded else None,
        cap,
    )


def _slower(ours: list[float], other: list[float]) -> float:
    """Median of the ratios of rounds, paired in time as in :func:`_ratio_interval`."""
    return float(np.median(np.array(other) / np.array(ours)))


def _cut(ours: Array, full: Array) -> tuple[float | None, tuple[float, float] | None]:
    """Relative difference of two means, from independent pictures, with its 95 % interval."""
    if min(ours.min(), full.min()) <= 0 or len(ours) < 2:
        return None, None
    # Logarithms, which include the noise of the reference.
    bias, low, high = np.expm1(welch_interval(np.log(full), np.log(ours))).tolist()
    return bias, (low, high)


def _ratio_interval(
    ours: Array, other: Array, ours_seconds: list[float], other_seconds: list[float]
) -> tuple[float, float] | None:
    """95 % of the ratio of variance times time, resampling rounds; None without noise."""
    rounds = len(ours)
    if not ours.var(0).any():
        return None
    # Other load on the machine slows both runs of a round.
    ratio = np.array(other_seconds) / np.array(ours_seconds)
    # Squared distances between rounds: the variance of a resample is the mean over its pairs of
    # different rounds.
    apart = [np.array([[((x - y) ** 2).mean() / 2 for y in p] for x in p]) for p in (ours, other)]
    draws = np.random.default_rng(0).integers(0, rounds, (1000, rounds))
    spread = [np.array([_between(a, d) for d in draws]) for a in apart]
    positive = (spread[0] > 0) & (spread[1] > 0)
    if not positive.any():
        return None
    low, high = np.percentile(
        np.median(ratio[draws], axis=1)[positive] * spread[1][positive] / spread[0][positive],
        [2.5, 97.5],
    )
    return float(low), float(high)


def _between(apart: Array, drawn: npt.NDArray[np.int64]) -> float:
    """Mean of ``apart`` over the pairs of different rounds in the resample."""
    different = drawn[:, None] != drawn[None]
    return float(apart[np.ix_(drawn, drawn)][different].mean()) if different.any() else 0.0
