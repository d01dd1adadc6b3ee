"""Scenes needed to detect a difference. Pure functions: numbers in, numbers out."""

from __future__ import annotations

import math

MOST_SCENES = 1000
"""Number at which :func:`scenes_needed` stops counting."""


def scenes_needed(mean: float, deviation: float, *, power: float = 0.8, level: float = 0.95) -> int:
    """The fewest scenes with which a paired test detects a difference from 0.

    The test is Student's t, two-sided. Its power follows the noncentral t distribution (Cohen 1988,
    Statistical Power Analysis for the Behavioral Sciences, ch. 2).

    Args:
        mean: the true difference.
        deviation: the standard deviation of the scenes' true differences, >= 0.
        power: the probability of detection, in (0, 1).
        level: 1 minus the false positive rate, in (0, 1).

    Returns:
        At least 2; :data:`MOST_SCENES` + 1 if more are needed.

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
    low, high = 2, MOST_SCENES + 1  # power never falls with more scenes
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
