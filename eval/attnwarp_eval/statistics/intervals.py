"""Intervals and paired tests over scenes and views. Pure functions: numbers in, numbers out.

Views of one scene are correlated, so the scene is the unit of evidence: an interval is Student's t
over the means of the scenes. The views are a designed set (the same yaws for every scene and
variant), not a sample, so they are not resampled. reports/statistics/coverage.md has the measured
coverage of this interval and of two bootstraps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

Verdict = Literal["better", "worse", "can't tell"]


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % interval.

    Attributes:
        mean: mean over scenes of the mean over views; NaN if nothing is defined.
        low, high: the interval; NaN with fewer than two scenes.
        undefined: number of NaN values, which are left out.
        detectable: the smallest difference with a power of 80 % at 5 %; NaN with under two
            scenes.
        p: two-sided probability of a mean this far from 0 if the true mean is 0 (Student's t); NaN
            with fewer than two scenes.
        least, most: the lowest and the highest scene; NaN if nothing is defined.
    """

    mean: float
    low: float
    high: float
    scenes: int
    views: int
    undefined: int
    detectable: float
    p: float
    least: float = np.nan
    most: float = np.nan

    @property
    def bounded(self) -> bool:
        """True if both bounds are finite: one scene or few equal differences give none."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))


Table = Mapping[str, Sequence[float]]
"""Values by scene: one number per view (and seed), NaN if the metric is undefined."""

ByView = Mapping[str, Mapping[str, float]]
"""Scene -> view (and seed) -> value, for paired comparisons."""


def interval(values: Table, *, level: float = 0.95) -> Interval:
    """Mean over scenes of the mean over views, with Student's t interval over the scenes.

    Args:
        values: scene -> values of its views; NaN values are left out and counted.
        level: coverage of the interval, in (0, 1).

    Example:
        >>> value = interval({"bear": [1.0, 3.0], "fence": [4.0], "glass": [float("nan")]})
        >>> value.mean, value.undefined  # mean of 2 and 4
        (3.0, 1)
        >>> interval({"bear": [1.0, 3.0]}).low  # one scene says nothing about others
        nan
    """
    from scipy import stats

    defined = {
        scene: np.asarray(v, dtype=np.float64)[np.isfinite(v)]
        for scene, v in sorted(values.items())
    }
    undefined = sum(len(v) for v in values.values()) - sum(len(v) for v in defined.values())
    groups = [v for v in defined.values() if len(v)]
    views = sum(len(v) for v in groups)
    if not groups:
        return Interval(np.nan, np.nan, np.nan, 0, 0, undefined, np.nan, np.nan)
    means = np.array([v.mean() for v in groups])
    mean, count = float(means.mean()), len(groups)
    if count < 2:
        return Interval(mean, np.nan, np.nan, count, views, undefined, np.nan, np.nan, mean, mean)
    error = float(means.std(ddof=1) / np.sqrt(count))
    if error <= 1e-13 * abs(mean):
        error = 0.0  # rounding of equal means, not spread
    half = error * float(stats.t.ppf(0.5 + level / 2, count - 1))
    p = float(2 * stats.t.sf(abs(mean) / error, count - 1)) if error > 0 else float(mean == 0)
    # Two-sided 5 %, and 80 % power.
    detectable = error * float(stats.t.ppf(0.975, count - 1) + stats.t.ppf(0.8, count - 1))
    return Interval(
        mean, mean - half, mean + half, count, views, undefined, detectable, p,
        float(means.min()), float(means.max()),
    )  # fmt: skip


def over_scenes(table: ByView) -> Interval:
    """The :func:`interval` of a table by scene and view.

    Example:
        >>> over_scenes({"bear": {"yaw030": 1.0, "yaw060": 3.0}}).mean
        2.0
    """
    return interval({scene: list(views.values()) for scene, views in table.items()})


ROUNDING = 2e-14
"""Relative spread below which differences vary only by rounding."""


def common(tables: Sequence[ByView]) -> list[dict[str, dict[str, float]]]:
    """Each table over the views in which all tables are defined; scenes without any are left out.

    Example:
        >>> ours = {"bear": {"yaw010": 1.0, "yaw020": 2.0}, "fence": {"yaw010": 3.0}}
        >>> theirs = {"bear": {"yaw010": float("nan"), "yaw020": 4.0}}
        >>> common([ours, theirs])
        [{'bear': {'yaw020': 2.0}}, {'bear': {'yaw020': 4.0}}]
    """
    keys = [
        {(s, v) for s, views in table.items() for v, value in views.items() if np.isfinite(value)}
        for table in tables
    ]
    shared = set.intersection(*keys) if keys else set()
    return [
        {
            scene: own
            for scene, views in table.items()
            if (own := {view: x for view, x in views.items() if (scene, view) in shared})
        }
        for table in tables
    ]


@dataclass(frozen=True)
class Ratio:
    """Ratio of two contestants' times.

    Attributes:
        ratio: median over rounds of the ratio within a round, geometric mean over groups (scenes).
        low, high: 95 % interval; NaN if a group has fewer than :data:`FEWEST_ROUNDS`.
    """

    ratio: float
    low: float
    high: float

    @property
    def bounded(self) -> bool:
        """True if there is an interval."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))


FEWEST_ROUNDS = 6
"""The median lies outside the range of n rounds with a probability of 2 / 2**n: 6 % for five."""

RATIO_INTERVAL = (
    "the interval is that of the median at 95 %, by order statistics, and needs"
    f" {FEWEST_ROUNDS} rounds."
)
"""Description of :func:`time_ratio` for a report."""


def time_ratio(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]]) -> Ratio:
    """Seconds of ``a`` over those of ``b``, taken in turn: one sequence of rounds per group, paired
    round by round.

    The interval is that of the median by order statistics, for any distribution of seconds.
    Over several groups the distances of their medians to their bounds add as squares (Zou &
    Donner 2008).

    Args:
        a, b: groups of rounds, seconds > 0.

    Raises:
        ValueError: different numbers of groups or rounds, or seconds that are not positive.

    Example:
        >>> slow = [[2.0, 4.0, 60.0], [8.0, 8.0, 8.0]]  # two scenes, one hiccup
        >>> round(time_ratio(slow, [[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]]).ratio, 9)  # sqrt(2 * 8)
        4.0
    """
    medians, below, above = [], [], []
    for left, right in zip(a, b, strict=True):
        x, y = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
        if x.shape != y.shape or not ((x > 0).all() and (y > 0).all()):
            raise ValueError(
                "a, b: expected the same number of rounds on both sides, all of them positive"
                " seconds"
            )
        logs = np.log(x / y)
        low, high = _bounds_of_median(logs)
        medians.append(float(np.median(logs)))
        below.append(medians[-1] - low)
        above.append(high - medians[-1])
    middle = float(np.mean(medians))
    low = middle - float(np.linalg.norm(below)) / len(medians)
    high = middle + float(np.linalg.norm(above)) / len(medians)
    return Ratio(float(np.exp(middle)), float(np.exp(low)), float(np.exp(high)))


def _bounds_of_median(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    """95 % interval of a median by the sign test; NaN below :data:`FEWEST_ROUNDS`."""
    from scipy import stats

    if len(values) < FEWEST_ROUNDS:
        return np.nan, np.nan
    left_out = int(stats.binom.ppf(0.025, len(values), 0.5)) - 1  # on each side
    ordered = np.sort(values)
    return float(ordered[left_out]), float(ordered[-1 - left_out])


def benjamini_hochberg(p: Sequence[float]) -> list[float]:
    """p-values adjusted for the false discovery rate (Benjamini & Hochberg 1995); NaN stays NaN and
    does not count.

    Example:
        >>> [round(p, 6) for p in benjamini_hochberg([0.01, 0.04, 0.03, float("nan")])]
        [0.03, 0.04, 0.04, nan]
    """
    from scipy import stats

    adjusted = np.array(p, dtype=np.float64)
    defined = np.isfinite(adjusted)
    adjusted[defined] = stats.false_discovery_control(adjusted[defined])
    return [float(v) for v in adjusted]


def verdict(
    difference: Interval,
    direction: Literal["higher", "lower"],
    *,
    atol: float = 0.0,
    adjusted_p: float | None = None,
) -> Verdict:
    """Verdict on a paired difference (ours - theirs): better, worse, or can't tell; never "equal".

    Args:
        difference: result of :func:`~attnwarp_eval.statistics.contrasts.paired`.
        direction: which values of the metric are better.
        atol: an interval that reaches into [-atol, atol] gives "can't tell".
        adjusted_p: the difference's p-value adjusted for the other tests of its table; above 0.05
            the verdict is "can't tell".

    Example:
        >>> difference = interval({"bear": [1.0], "fence": [1.1], "glass": [0.9]})
        >>> verdict(difference, "lower"), verdict(difference, "lower", atol=2.0)
        ('worse', "can't tell")
    """
    if not difference.bounded or (adjusted_p is not None and not adjusted_p <= 0.05):
        return "can't tell"
    sign = 1.0 if direction == "higher" else -1.0
    low, high = sorted((sign * difference.low, sign * difference.high))
    if low > atol:
        return "better"
    if high < -atol:
        return "worse"
    return "can't tell"


def front(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of the Pareto front, cheapest first: a point stays when its error strictly improves.

    Args:
        cost: cost of each point, such as seconds.
        error: error of each point; less is better. Points that are not finite are left out.

    Example:
        >>> front([1.0, 2.0, 3.0], [0.5, 0.6, 0.1])  # the second costs more and errs more
        [0, 2]
    """
    c, e = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
    order = [int(i) for i in np.lexsort((e, c)) if np.isfinite(c[i]) and np.isfinite(e[i])]
    indices: list[int] = []
    best = np.inf
    for i in order:
        if e[i] < best:
            indices.append(i)
            best = float(e[i])
    return indices
