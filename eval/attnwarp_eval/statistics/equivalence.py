"""Tests of two means: whether they differ, and whether they are equal within a margin. Pure
functions.

A test without a significant difference does not show equality: it may lack samples. Equality is
shown by two one-sided tests (:func:`equivalence`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ROUNDING = 1e-5
"""Relative differences below this come from sums of float32 in another order, not from the data."""

ONE_SIDED = 2.33
"""Normal quantile of 1 %: |d| + 2.33 SE < margin is two one-sided tests at 1 % each."""


@dataclass(frozen=True, eq=False)
class Welch:
    """Welch's test of two means with unequal variances, value by value.

    Attributes:
        difference: mean(b) - mean(a).
        error: standard error of the difference.
        freedom: Satterthwaite's degrees of freedom.
        p: two-sided probability of a difference this large if there were none.
    """

    difference: Array
    error: Array
    freedom: Array
    p: Array


def welch(a: npt.ArrayLike, b: npt.ArrayLike) -> Welch:
    """Test whether two means differ, along the first axis (Welch 1947, "The generalization of
    Student's problem when several different population variances are involved", Biometrika 34).

    Args:
        a, b: (n, ...) and (m, ...) independent samples, n, m >= 2. Values that do not vary at all
            have p = 1 where they are equal within ``ROUNDING`` and 0 elsewhere. Values that vary by
            less than ``ROUNDING``, such as those of a smooth sky, are tested like all others,
            except for the part of their difference that may be rounding.

    Raises:
        ValueError: fewer than two samples on a side.

    Example:
        >>> result = welch([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
        >>> float(result.difference), round(float(result.p), 3)
        (2.0, 0.221)
    """
    from scipy import stats

    first, second = _samples(a, b)
    difference, variance, freedom = _difference(first, second)
    rounding = ROUNDING * np.maximum(np.abs(first).mean(0), np.abs(second).mean(0))
    error = np.sqrt(variance)
    freedom = np.where(variance > 0, freedom, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.where(
            variance > 0,
            2 * stats.t.sf(_beyond(difference, error, rounding) / error, np.minimum(freedom, 1e9)),
            np.where(np.abs(difference) <= rounding, 1.0, 0.0),
        )
    return Welch(difference, error, freedom, p)


def _beyond(difference: Array, error: Array, rounding: Array) -> Array:
    """Part of a difference left to noise: what exceeds rounding if the noise is smaller."""
    return np.where(
        error > rounding, np.abs(difference), np.maximum(np.abs(difference) - rounding, 0.0)
    )


def welch_interval(
    a: npt.ArrayLike, b: npt.ArrayLike, *, level: float = 0.95
) -> tuple[float, float, float]:
    """mean(b) - mean(a) with its interval by Welch's test: (difference, low, high).

    Args:
        a, b: (n,) and (m,) independent samples, n, m >= 2.
        level: coverage of the interval, in (0, 1).

    Raises:
        ValueError: fewer than two samples on a side.

    Example:
        >>> difference, low, high = welch_interval([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
        >>> difference, low < 0 < high  # three samples cannot tell
        (2.0, True)
    """
    from scipy import stats

    test = welch(a, b)
    difference = float(test.difference)
    # Samples without noise: the rest is the rounding of equal numbers, in any unit.
    if test.error <= 1e-12 * max(np.abs(a).max(), np.abs(b).max()):
        return difference, difference, difference
    reach = float(stats.t.ppf(0.5 + level / 2, test.freedom) * test.error)
    return difference, difference - reach, difference + reach


def _samples(a: npt.ArrayLike, b: npt.ArrayLike) -> tuple[Array, Array]:
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if len(first) < 2 or len(second) < 2:
        raise ValueError(
            f"a, b: got {len(first)} and {len(second)} samples, expected at least 2 of each"
        )
    return first, second


def _difference(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Difference of the means, its variance, and its degrees of freedom (Satterthwaite 1946, "An
    approximate distribution of estimates of variance components", Biometrics Bulletin 2).
    """
    va, vb = a.var(0, ddof=1) / len(a), b.var(0, ddof=1) / len(b)
    variance = va + vb
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = variance**2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1))
    return b.mean(0) - a.mean(0), variance, freedom


def sidak(alpha: float, tests: int) -> float:
    """The level of each of ``tests`` independent tests that together refuse a truth with chance
    ``alpha`` (Sidak 1967, "Rectangular confidence regions for the means of multivariate normal
    distributions", JASA 62).

    Example:
        >>> round(sidak(0.05, 10), 6)
        0.005116
    """
    return -math.expm1(math.log1p(-alpha) / max(tests, 1))


@dataclass(frozen=True)
class Equivalence:
    """Two one-sided tests of two means.

    Attributes:
        difference, error: difference of the means, and its standard error, as shares of the mean.
        margin: the share that counts as equal.
    """

    difference: float
    error: float
    margin: float

    @property
    def bound(self) -> float:
        """|difference| + 2.33 standard errors: above the true one with 99 % on either side."""
        return abs(self.difference) + ONE_SIDED * self.error

    @property
    def equal(self) -> bool:
        """True if the means are shown to be equal within the margin."""
        return self.bound < self.margin


def equivalence(a: npt.ArrayLike, b: npt.ArrayLike, *, margin: float) -> Equivalence:
    """Test whether two means are equal within ``margin`` of the mean of ``b``, the reference
    (Schuirmann 1987, "A comparison of the two one-sided tests procedure and the power approach",
    Journal of Pharmacokinetics and Biopharmaceutics 15).

    Args:
        a, b: (n, ...) and (m, ...) independent samples, such as pictures; only means count.
        margin: a share of the mean.

    Example:
        >>> equivalence([1.0, 1.01, 0.99], [1.0, 1.0, 1.0], margin=0.02).equal
        True
    """
    first, second = (_means(x)[:, None] for x in (a, b))
    result, scale = welch(first, second), max(abs(float(second.mean())), 1e-300)
    return Equivalence(float(result.difference[0]) / scale, float(result.error[0]) / scale, margin)


@dataclass(frozen=True)
class PairedTest:
    """A t-test on differences of pairs.

    Attributes:
        difference, error: difference and standard error, as shares of the mean.
    """

    difference: float
    error: float
    p: float
    pairs: int


def paired_test(a: npt.ArrayLike, b: npt.ArrayLike) -> PairedTest:
    """Student's t-test (1908) on mean(b_k) - mean(a_k).

    Args:
        a, b: (n, ...) samples paired by index, such as pictures of one seed, n >=
            2; each is reduced to its mean.

    Raises:
        ValueError: different numbers of samples, or fewer than two.

    Example:
        >>> result = paired_test([1.0, 2.0, 3.0], [1.5, 2.5, 3.6])
        >>> result.difference > 0, result.p < 0.01  # each pair differs by about as much
        (True, True)
    """
    from scipy import stats

    first, second = _means(a), _means(b)
    if len(first) != len(second) or len(first) < 2:
        raise ValueError(
            f"a, b: got {len(first)} and {len(second)} samples, expected as many, at least 2 pairs"
        )
    scale = max(abs(float(second.mean())), 1e-300)
    d = (second - first) / scale
    error = float(d.std(ddof=1) / math.sqrt(len(d)))
    mean = float(d.mean())
    if error > 0:
        beyond = float(_beyond(np.array(mean), np.array(error), np.array(ROUNDING)))
        p = float(2 * stats.t.sf(beyond / error, len(d) - 1))
    else:
        p = float(abs(mean) <= ROUNDING)
    return PairedTest(mean, error, p, len(d))


def _means(samples: npt.ArrayLike) -> Array:
    array = np.asarray(samples, np.float64)
    return np.asarray(array.reshape(len(array), -1).mean(1))
