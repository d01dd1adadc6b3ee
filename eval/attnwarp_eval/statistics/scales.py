"""Scales on which figures are compared: ratios, shares, plain differences."""

from __future__ import annotations

import math
from typing import Literal

Scale = Literal["ratio", "odds", "share", "plain"]

FACTORS: tuple[Scale, ...] = ("ratio", "odds")
"""Scales whose differences are logarithms of factors."""


def compared(
    a: float,
    b: float,
    scale: Scale,
    *,
    floor: float = 0.0,
    counts: tuple[float, float] = (math.nan, math.nan),
) -> float:
    """Difference of two figures on a scale: b against a; NaN if either is undefined.

    - ``ratio``, of errors that are never negative: log(b / a). An error below the floor, given
      by the calibration, counts as the floor; two such errors tie.
    - ``odds``, of shares with their denominators: the difference of empirical
      logits, log((k + 1/2) / (n - k + 1/2)) (Haldane 1956; Cox & Snell 1989, section 2.1.6).
    - ``share`` and ``plain``: b - a. A sign-flip interval of shares never leaves -1 to 1.

    Args:
        floor: smallest meaningful error, above 0, for ``ratio``.
        counts: denominators of the shares, for ``odds``.

    Example:
        >>> round(math.exp(compared(0.2, 0.1, "ratio")), 9)
        0.5
        >>> compared(0.0, 1e-9, "ratio", floor=1e-6)
        0.0
        >>> round(compared(0.0, 1.0, "odds", counts=(9, 9)), 3)  # log(19) twice
        5.889
        >>> compared(30.0, 31.5, "plain")
        1.5
    """
    if not (math.isfinite(a) and math.isfinite(b)):
        return math.nan
    if scale == "ratio":
        low, high = (max(value, floor) for value in (a, b))
        if low == high:
            return 0.0
        return math.log(high / low) if min(low, high) > 0 else math.nan
    if scale == "odds":
        return _logit(b, counts[1]) - _logit(a, counts[0])
    return b - a


def _logit(share: float, count: float) -> float:
    k = share * count
    return math.log((k + 0.5) / (count - k + 0.5))
