"""Sign-flip test of paired differences over scenes, and the interval that inverts it.

If two arms are equal, the difference of each scene has either sign with equal chance. The
p-value is the share of sign patterns whose sum is at least as far from 0 as the one seen (Fisher
1935, The Design of Experiments, section 21; Lehmann & Romano 2005, Testing Statistical Hypotheses,
section 5.8). Beyond symmetry it assumes no distribution, so one scene with a huge difference does
not hide that all scenes agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ENUMERATED = 20
"""Scenes up to which all sign patterns are counted; beyond, :data:`DRAWS` are drawn."""

DRAWS = 100_000

SEED = 1

FEWEST = 6
"""Number of scenes below which no pattern is rarer than 5 %: the interval has no bounds."""


@dataclass(frozen=True, eq=False)
class SignFlips:
    """Test and intervals of the mean of paired differences.

    Attributes:
        differences: (n,) one per scene.
        rounding: size up to which differences count as 0.
    """

    differences: Array
    rounding: float = 0.0

    @property
    def mean(self) -> float:
        """The mean difference; NaN without any."""
        return float(self._clean.mean()) if len(self._clean) else math.nan

    @cached_property
    def _clean(self) -> Array:
        values = np.asarray(self.differences, dtype=np.float64)
        return np.where(np.abs(values) <= self.rounding, 0.0, values)

    @cached_property
    def _crossings(self) -> tuple[Array, Array]:
        """(B,) sorted shifts at which each pattern, other than the one seen, counts against it.

        Take the true mean to be m. A pattern that turns the signs of a set of scenes has a sum at
        least as far from 0 as that of the differences less m if m is no smaller than the lower, and
        no larger than the higher, of the means over the set and over the other scenes.
        """
        values = self._clean
        low, high = _means_of_parts(values)
        zero = 1e-12 * float(np.abs(values).max(initial=0.0)) + self.rounding
        low, high = (np.where(np.abs(side) <= zero, 0.0, side) for side in (low, high))
        return np.sort(low), np.sort(high)

    @property
    def p(self) -> float:
        """Two-sided probability of a mean this far from 0 for equal arms; NaN below two scenes."""
        if len(self._clean) < 2:
            return math.nan
        if self.mean == 0:
            return 1.0
        low, high = self._crossings
        if self.mean > 0:
            beyond = int(np.searchsorted(low, 0.0, side="right"))
        else:
            beyond = len(high) - int(np.searchsorted(high, 0.0, side="left"))
        return (1 + beyond) / (1 + len(low))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Means that the test does not refuse; NaN if it can refuse none.

        The interval contains 0 exactly if ``p`` is above 1 - ``level``.
        """
        if len(self._clean) < 2:
            return math.nan, math.nan
        low, high = self._crossings
        # p = (1 + count) / (1 + B) is above the rate from this count on.
        count = math.floor((1 - level) * (1 + len(low)) + 1e-9)
        if count < 1:
            return math.nan, math.nan
        return float(low[count - 1]), float(high[-count])

    def equal(self, bound: float, level: float = 0.9) -> bool:
        """True if the mean is shown to lie within ``bound`` of 0: two one-sided tests at 5 %.

        Example:
            >>> differences = np.linspace(-0.1, 0.1, 8)
            >>> [SignFlips(differences).equal(bound) for bound in (0.2, 0.01)]
            [True, False]
        """
        low, high = self.interval(level)
        return bool(-bound < low and high < bound)


def _means_of_parts(values: Array) -> tuple[Array, Array]:
    """(B,) lower and higher mean of the two parts of every split of the values into two.

    All splits of up to :data:`ENUMERATED` values; of more, :data:`DRAWS` drawn at random.
    """
    count, total = len(values), float(values.sum())
    if count <= ENUMERATED:
        # The first value stays in the second part, as a split and its mirror image are one.
        sums, sizes = np.zeros(1), np.zeros(1)
        for value in values[1:]:
            sums = np.concatenate([sums, sums + value])
            sizes = np.concatenate([sizes, sizes + 1])
        sums, sizes = sums[1:], sizes[1:]  # without the split that flips no sign
    else:
        sums, sizes = np.empty(DRAWS), np.empty(DRAWS)
        at = 0
        for turned in _drawn(count):
            sums[at : at + len(turned)] = turned @ values
            sizes[at : at + len(turned)] = turned.sum(axis=1)
            at += len(turned)
        whole = (sizes == 0) | (sizes == count)
        # Such a pattern equals the observed one for any true mean.
        sums, sizes = np.where(whole, np.nan, sums), np.where(whole, 1, sizes)
    first, second = sums / sizes, (total - sums) / (count - sizes)
    low, high = np.minimum(first, second), np.maximum(first, second)
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _drawn(count: int) -> Iterable[npt.NDArray[np.bool_]]:
    """(B, count) patterns of turned signs, in parts; those of few values are kept."""
    return _kept(count) if count < 100 else _patterns(count)


@lru_cache(maxsize=4)
def _kept(count: int) -> list[npt.NDArray[np.bool_]]:
    return list(_patterns(count))


def _patterns(count: int) -> Iterator[npt.NDArray[np.bool_]]:
    rng = np.random.default_rng(SEED)
    step = max(1, 10_000_000 // count)
    for start in range(0, DRAWS, step):
        yield rng.random((min(step, DRAWS - start), count)) < 0.5
