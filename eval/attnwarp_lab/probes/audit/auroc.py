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
        scenes: number of scenes with both kinds of results.
        undefined: share of the values that were NaN, which are left out.
        paired: share of the flawed results with a value above the mean of the right ones of
            the same scene; ties are half.

    Example:
        >>> auroc([({"bear": [3.0], "fence": [4.0]}, {"bear": [1.0], "fence": [3.0]})]).value
        0.875
    """

    value: float
    low: float
    high: float
    scenes: int
    undefined: float
    paired: float


def auroc(groups: Sequence[tuple[Values, Values]], *, seed: int = 0) -> Auroc:
    """Mean over groups of the area under the ROC curve of each.

    Scenes are resampled, identically in all groups, since results of one scene are correlated. A
    group without a value of either kind is left out.

    Args:
        groups: (flawed, right) of each group, such as each yaw; results are compared only within
            their group.

    Example:
        >>> flawed, right = {"bear": [2.0, float("nan")]}, {"bear": [1.0]}
        >>> auroc([(flawed, right)]).undefined
        0.3333333333333333
    """
    scenes = sorted({scene for pair in groups for values in pair for scene in values})
    rng = np.random.default_rng(seed)
    draws = rng.multinomial(len(scenes), np.full(len(scenes), 1 / max(1, len(scenes))), RESAMPLES)
    weights = np.vstack([np.ones(len(scenes)), draws])
    areas, within, total, missing, used = [], [], 0, 0, set()
    for flawed, right in groups:
        rows = [_split(values, scenes) for values in (flawed, right)]
        for defined, undefined in rows:
            total += sum(map(len, defined)) + undefined
            missing += undefined
        (positive, _), (negative, _) = rows
        wins = _wins(positive, negative)
        counts = np.outer(list(map(len, positive)), list(map(len, negative))).astype(float)
        if not counts.sum():
            continue
        won = np.einsum("ki,ij,kj->k", weights, wins, weights)
        of = np.einsum("ki,ij,kj->k", weights, counts, weights)
        areas.append(np.divide(won, of, out=np.full_like(won, np.nan), where=of > 0))
        for scene, p, n in zip(scenes, positive, negative, strict=True):
            if len(p) and len(n):
                used.add(scene)
                within.append(float(_above(p, n.mean()).mean()))
    if not areas:
        return Auroc(np.nan, np.nan, np.nan, 0, missing / total if total else np.nan, np.nan)
    table = np.stack(areas)
    known = np.isfinite(table)
    means = np.divide(
        np.where(known, table, 0).sum(axis=0),
        known.sum(axis=0),
        out=np.full(table.shape[1], np.nan),
        where=known.any(axis=0),
    )
    low, high = np.nanquantile(means[1:], [0.025, 0.975]) if len(used) >= 6 else (np.nan, np.nan)
    return Auroc(
        float(means[0]), float(low), float(high), len(used), missing / total,
        float(np.mean(within)) if within else np.nan,
    )  # fmt: skip


def _split(values: Values, scenes: Sequence[str]) -> tuple[list[FloatArray], int]:
    """Defined values by scene, and the number of undefined ones."""
    rows = [np.asarray(values.get(scene, ()), dtype=np.float64) for scene in scenes]
    defined = [row[np.isfinite(row)] for row in rows]
    return defined, sum(map(len, rows)) - sum(map(len, defined))


def _wins(positive: Sequence[FloatArray], negative: Sequence[FloatArray]) -> FloatArray:
    """(S, S) pairs of values of two scenes in which the first is larger; ties are half."""
    of_positive, of_negative = (
        np.repeat(np.eye(len(rows)), list(map(len, rows)), axis=1) for rows in (positive, negative)
    )
    above = _above(np.concatenate(positive)[:, None], np.concatenate(negative)[None])
    return np.asarray(of_positive @ above @ of_negative.T)


def _above(a: FloatArray, b: Any) -> FloatArray:
    return np.asarray((a > b) + 0.5 * (a == b), dtype=np.float64)
