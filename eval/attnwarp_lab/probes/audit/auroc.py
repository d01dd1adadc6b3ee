"""Area under the ROC curve of a metric as a detector of flawed results, with an interval
over scenes. Pure functions: numbers in, numbers out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

Values = Mapping[str, Sequence[float]]
"""Scene -> values; NaN where undefined. Larger values mean more flawed."""

RESAMPLES = 1000
"""Draws of scenes for an interval; its ends then vary by about a hundredth."""


@dataclass(frozen=True)
class Auroc:
    """Probability that a flawed result has a larger value than a right one; ties are half.

    Attributes:
        value: 1 for perfect separation, 0.5 for none; NaN if nothing is defined.
        low, high: 95 % interval over scenes, by percentiles of a bootstrap; NaN with fewer than
            six scenes.

    Example:
        >>> auroc([({"bear": [3.0], "fence": [4.0]}, {"bear": [1.0], "fence": [3.0]})]).value
        0.875
    """

    value: float
    low: float
    high: float


def auroc(groups: Sequence[tuple[Values, Values]], *, seed: int = 0) -> Auroc:
    """Mean over groups of the area under the ROC curve of each.

    Scenes are resampled, identically in all groups, since results of one scene are correlated. A
    group without a value of either kind is left out.

    Args:
        groups: (flawed, right) of each group, such as each yaw; results are compared only within
            their group.

    Example:
        >>> flawed, right = {"bear": [2.0, float("nan")]}, {"bear": [1.0]}
        >>> auroc([(flawed, right)]).value
        1.0
    """
    scenes = sorted({scene for pair in groups for values in pair for scene in values})
    rng = np.random.default_rng(seed)
    draws = rng.multinomial(len(scenes), np.full(len(scenes), 1 / max(1, len(scenes))), RESAMPLES)
    weights = np.vstack([np.ones(len(scenes)), draws])
    areas, used = [], set()
    for pair in groups:
        positive, negative = (_defined(values, scenes) for values in pair)
        counts = np.outer(list(map(len, positive)), list(map(len, negative))).astype(float)
        if not counts.sum():
            continue
        won = np.einsum("ki,ij,kj->k", weights, _wins(positive, negative), weights)
        of = np.einsum("ki,ij,kj->k", weights, counts, weights)
        areas.append(np.divide(won, of, out=np.full_like(won, np.nan), where=of > 0))
        used |= set(np.flatnonzero(np.diag(counts)))
    if not areas:
        return Auroc(np.nan, np.nan, np.nan)
    table = np.stack(areas)
    known = np.isfinite(table)
    means = np.divide(
        np.where(known, table, 0).sum(axis=0),
        known.sum(axis=0),
        out=np.full(table.shape[1], np.nan),
        where=known.any(axis=0),
    )
    low, high = np.nanquantile(means[1:], [0.025, 0.975]) if len(used) >= 6 else (np.nan, np.nan)
    return Auroc(float(means[0]), float(low), float(high))


def _defined(values: Values, scenes: Sequence[str]) -> list[FloatArray]:
    """Defined values by scene."""
    rows = [np.asarray(values.get(scene, ()), dtype=np.float64) for scene in scenes]
    return [row[np.isfinite(row)] for row in rows]


def _wins(positive: Sequence[FloatArray], negative: Sequence[FloatArray]) -> FloatArray:
    """(S, S) pairs of values of two scenes in which the first is larger; ties are half."""
    of_positive, of_negative = (
        np.repeat(np.eye(len(rows)), list(map(len, rows)), axis=1) for rows in (positive, negative)
    )
    above = _above(np.concatenate(positive)[:, None], np.concatenate(negative)[None])
    return np.asarray(of_positive @ above @ of_negative.T)


def _above(a: FloatArray, b: Any) -> FloatArray:
    return np.asarray((a > b) + 0.5 * (a == b), dtype=np.float64)
