"""Agreement of two rankings of the same settings. Pure functions: numbers in, numbers out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def rank_agreement(a: Sequence[float], b: Sequence[float]) -> float:
    """Kendall's tau-b of two rankings (Kendall 1945): 1 where they order every pair of settings
    alike, -1 where they order each the other way.

    Without ties, (1 + tau) / 2 is the share of pairs that both order alike.

    Args:
        a, b: a value for each setting; one that is NaN on either side is left out.

    Returns:
        NaN with fewer than two settings, or where all values of one side are the same.

    Example:
        >>> round(rank_agreement([1, 2, 3, 4], [10, 20, 40, 30]), 6)  # 5 of 6 pairs
        0.666667
    """
    from scipy import stats

    x, y = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() < 2:
        return np.nan
    return float(stats.kendalltau(x[known], y[known]).statistic)
