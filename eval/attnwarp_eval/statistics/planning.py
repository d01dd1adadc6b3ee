"""Measurements needed before a difference can be told: more scenes, or more seeds? Pure functions:
numbers in, numbers out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from attnwarp_eval.statistics.intervals import ROUNDING, ByView

MOST_SCENES = 1000
"""Number at which :func:`scenes_needed` stops counting."""


def scenes_needed(mean: float, deviation: float, *, power: float = 0.8, level: float = 0.95) -> int:
    """The fewest scenes with which a paired test would tell a difference from 0.

    The test is Student's t, two-sided. Its power follows the noncentral t distribution (Cohen 1988,
    Statistical Power Analysis for the Behavioral Sciences, ch. 2).

    Args:
        mean: the true difference.
        deviation: the standard deviation of the scenes' true differences, >= 0.
        power: the probability that the test tells, in (0, 1).
        level: 1 minus the rate at which it tells where nothing is, in (0, 1).

    Returns:
        At least 2; :data:`MOST_SCENES` + 1 where more than those are needed.

    Raises:
        ValueError: a number that is not finite, or a negative deviation.

    Example:
        >>> scenes_needed(0.8, 1.0), scenes_needed(0.5, 1.0)  # Cohen's large and medium effects
        (15, 34)
    """
    if not (math.isfinite(mean) and math.isfinite(deviation) and deviation >= 0):
        raise ValueError(
            f"mean, deviation: got {mean} and {deviation}, expected finite numbers and no negative"
            " deviation"
        )
    low, high = 2, MOST_SCENES + 1  # more scenes never tell less
    while low < high:
        middle = (low + high) // 2
        if _power(abs(mean), deviation, middle, level) >= power:
            high = middle
        else:
            low = middle + 1
    return low


def _power(mean: float, deviation: float, scenes: int, level: float) -> float:
    from scipy import stats

    if deviation == 0:
        return float(mean > 0)
    beyond = float(stats.t.ppf(0.5 + level / 2, scenes - 1))
    return 1 - _noncentral(beyond, scenes - 1, mean / deviation * math.sqrt(scenes))


def _noncentral(t: float, free: int, shift: float) -> float:
    """The distribution function of a noncentral t with ``free`` degrees of freedom."""
    from scipy import special

    value = float(special.nctdtr(free, shift, t))
    # scipy gives NaN in far tails, where the value is 0 or 1.
    return value if math.isfinite(value) else float(t > shift)


def effect_interval(mean: float, deviation: float, scenes: int) -> tuple[float, float]:
    """The 80 % interval of the true mean over the true deviation.

    The noncentral t distributions under which the observed t would be at either end (Steiger &
    Fouladi 1997, "Noncentrality interval estimation and the evaluation of statistical models").

    Args:
        mean, deviation: of the scenes' differences, as observed; the deviation > 0.
        scenes: how many, at least 2.

    Returns:
        The bounds, lower first.

    Example:
        >>> [round(bound, 2) for bound in effect_interval(1.0, 1.0, 6)]
        [0.3, 1.61]
    """
    from scipy import optimize

    observed = mean / deviation * math.sqrt(scenes)
    reach = 10 + 5 * abs(observed)

    def bound(share: float) -> float:
        def missed(shift: float) -> float:
            return _noncentral(observed, scenes - 1, shift) - share

        return float(optimize.brentq(missed, -reach, reach)) / math.sqrt(scenes)

    return bound(0.9), bound(0.1)


@dataclass(frozen=True)
class Parts:
    """Parts of the spread of a difference between scenes.

    Attributes:
        scenes: standard deviation of the scenes' means.
        seeds: how many seeds a scene has, in the mean.
        share: of that deviation's square, what seeds add by being few, in [0, 1]. NaN with one
            seed.
    """

    scenes: float
    seeds: float
    share: float


def parts(a: ByView, b: ByView) -> Parts:
    """Split the spread of b - a between scenes into that of scenes and that of their seeds.

    A scene's mean over few seeds misses its mean over all seeds. The variance of that, estimated
    from the differences between seeds of one scene, is part of what scenes differ by: the usual
    estimate of variance components (Searle, Casella & McCulloch 1992, Variance Components, ch. 3).

    Args:
        a, b: scene -> "view/seed" -> value. Only views that both have count.

    Returns:
        NaN for the deviation of fewer than two scenes, and for the share where no scene has views
        that two seeds share. A deviation that is the rounding of the values is 0.

    Example:
        >>> zero = {s: {"v/0": 0.0, "v/1": 0.0} for s in ("bear", "fence")}
        >>> split = parts(zero, {"bear": {"v/0": 1.0, "v/1": 3.0}, "fence": {"v/0": 5, "v/1": 7}})
        >>> split.seeds, round(split.share, 3)  # 2 / 2 of 8
        (2.0, 0.125)
    """
    scenes = [scene for scene in _differences(a, b) if scene]
    if len(scenes) < 2:
        return Parts(math.nan, math.nan, math.nan)
    means = [np.mean([d for seeds in scene.values() for d in seeds.values()]) for scene in scenes]
    deviation = float(np.std(means, ddof=1))
    values = (v for table in (a, b) for views in table.values() for v in views.values())
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if deviation <= ROUNDING * largest:
        deviation = 0.0
    count = float(np.mean([len(scene) for scene in scenes]))
    variances = [v for scene in scenes if (v := _variance_of_seeds(scene)) is not None]
    if not variances or deviation == 0:
        return Parts(deviation, count, math.nan)
    return Parts(deviation, count, min(1.0, float(np.mean(variances)) / deviation**2))


Seeds = dict[str, dict[str, float]]
"""Seed -> view -> difference."""


def _variance_of_seeds(scene: Seeds) -> float | None:
    """Variance that few seeds add to a scene's mean, from the views that all have."""
    shared = set.intersection(*(set(views) for views in scene.values()))
    if len(scene) < 2 or not shared:
        return None
    means = [np.mean([views[view] for view in sorted(shared)]) for views in scene.values()]
    return float(np.var(means, ddof=1)) / len(means)


def _differences(a: ByView, b: ByView) -> list[Seeds]:
    """Differences of each scene's views, by seed."""
    scenes = []
    for scene in sorted(set(a) & set(b)):
        seeds: Seeds = {}
        for key in sorted(a[scene].keys() & b[scene].keys()):
            difference = b[scene][key] - a[scene][key]
            if math.isfinite(difference):
                view, _, seed = key.rpartition("/")
                seeds.setdefault(seed, {})[view] = difference
        scenes.append(seeds)
    return scenes
