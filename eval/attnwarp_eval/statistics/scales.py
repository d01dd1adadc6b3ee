"""Scales on which figures are compared: ratios, shares, plain differences."""

from __future__ import annotations

import math
from typing import Literal

Scale = Literal["ratio", "share", "plain"]


def compared(
    a: float, b: float, scale: Scale, *, floor: float = 0.0, count: int | None = None
) -> float:
    """Difference of two figures on a scale: b against a; NaN where either is undefined.

    - ``ratio``, of errors that are never negative: log(b / a). An error below the floor, which is
      that of the calibration, is as large as the floor; two such are a tie.
    - ``share``, with the number of things that it is a share of: the difference of empirical
      logits, log((k + 1/2) / (n - k + 1/2)) (Haldane 1956; Cox & Snell 1989, section 2.1.6).
      Without their number, the plain difference, whose sign-flip interval never leaves -1 to 1.
    - ``plain``: b - a.

    Args:
        a, b: the figures.
        scale: of their metric.
        floor: smallest error that means anything, above 0, for ``ratio``.
        count: things that a share is of.

    Example:
        >>> round(math.exp(compared(0.2, 0.1, "ratio")), 9)
        0.5
        >>> compared(0.0, 1e-9, "ratio", floor=1e-6)
        0.0
        >>> round(compared(0.0, 1.0, "share", count=9), 3)  # log(19) twice
        5.889
        >>> compared(30.0, 31.5, "plain")
        1.5
    """
    if not (math.isfinite(a) and math.isfinite(b)):
        return math.nan
    if scale == "plain" or (scale == "share" and count is None):
        return b - a
    if scale == "ratio":
        low, high = (max(value, floor) for value in (a, b))
        if low == high:
            return 0.0
        return math.log(high / low) if min(low, high) > 0 else math.nan
    assert count is not None
    return _logit(b, count) - _logit(a, count)


def _logit(share: float, count: int) -> float:
    k = share * count
    return math.log((k + 0.5) / (count - k + 0.5))
