"""Contrast of two arms over scenes on a metric's scale, with the test that decides it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from attnwarp_eval.statistics.intervals import ROUNDING, ByView, Interval, interval
from attnwarp_eval.statistics.planning import scenes_needed
from attnwarp_eval.statistics.scales import FACTORS, Scale, compared
from attnwarp_eval.statistics.signflips import FEWEST, SignFlips

Verdict = Literal["better", "worse", "within", "equal", "can't tell"]
"""Outcome of a test; "within": there is a difference, smaller than the bound of equality."""

EQUAL_LEVEL = 0.9
"""Level of the interval for equality within a bound: two one-sided tests at 5 %."""


@dataclass(frozen=True, eq=False)
class Contrast:
    """Difference of two arms, scene by scene, on one scale.

    Attributes:
        scale: scale of the differences; those of ``ratio`` and ``odds`` are logarithms.
        undefined: number of views present or defined on only one side.
        by_scene: mean over a scene's views; scenes without a pair are left out.
        flips: the sign-flip test of ``by_scene``.
        student: Student's t on the same scale.
        plain: the sign-flip test of plain differences, the scale of bounds of shares.
        over_seeds: standard deviation of a scene's difference over its seeds, on the scale; NaN
            with one seed.
    """

    scale: Scale
    views: int
    undefined: int
    by_scene: dict[str, float]
    flips: SignFlips
    student: Interval
    plain: SignFlips
    over_seeds: float = math.nan

    @property
    def scenes(self) -> int:
        """Number of scenes that have a pair of views."""
        return len(self.by_scene)

    @property
    def deviation(self) -> float:
        """Standard deviation of the scenes' differences, on the scale; NaN below two scenes."""
        values = list(self.by_scene.values())
        return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan

    def without(self, scene: str) -> Contrast:
        """The contrast of the other scenes; its ``student`` stays that of all."""
        kept = np.array([name != scene for name in self.by_scene])
        return replace(
            self,
            by_scene={name: value for name, value in self.by_scene.items() if name != scene},
            flips=replace(self.flips, differences=self.flips.differences[kept]),
            plain=replace(self.plain, differences=self.plain.differences[kept]),
        )

    def shown(self, level: float = 0.95) -> tuple[float, float, float]:
        """Mean and bounds for display: b / a for ``ratio`` and ``odds``, else b - a.

        The bounds contain 0 (or a factor of 1) exactly if the test at that level can't tell.
        """
        return self._read((self.flips.mean, *self.flips.interval(level)))

    def range(self) -> tuple[float, float, float]:
        """Mean, lowest and highest scene, as :meth:`shown` has them."""
        values = list(self.by_scene.values())
        return self._read((self.flips.mean, min(values), max(values)))

    def _read(self, values: tuple[float, float, float]) -> tuple[float, float, float]:
        if self.scale in FACTORS:
            return tuple(math.exp(value) for value in values)  # type: ignore[return-value]
        return values

    def level(self, adjusted_p: float) -> float:
        """Level after adjustment for other tests: its interval agrees with the verdict."""
        if not (0 < self.flips.p < adjusted_p):
            return 0.95
        return 1 - 0.05 * self.flips.p / adjusted_p

    def verdict(
        self,
        direction: Literal["higher", "lower"],
        *,
        adjusted_p: float | None = None,
        bound: float | None = None,
    ) -> Verdict:
        """Verdict for the population of scenes.

        Arms that are equal to the last digit were one computation: can't tell.

        Args:
            direction: which values are better.
            adjusted_p: the p-value adjusted for other tests; by default unadjusted.
            bound: differences up to which arms are equal, on the scale, for ``odds`` as a share;
                by default none.
        """
        p = self.flips.p if adjusted_p is None else adjusted_p
        if self.scenes < FEWEST or not any(self.by_scene.values()):
            return "can't tell"
        if bound is not None and self._bounded.equal(bound, EQUAL_LEVEL):
            low, high = self.flips.interval(EQUAL_LEVEL)
            # A difference that the test has not told, and yet not 0, is none of the two.
            return "within" if p <= 0.05 else "equal" if low <= 0 <= high else "can't tell"
        if not p <= 0.05:
            return "can't tell"
        return "better" if (self.flips.mean > 0) == (direction == "higher") else "worse"

    @property
    def _bounded(self) -> SignFlips:
        """Test on the scale of a bound of equality."""
        return self.plain if self.scale == "odds" else self.flips

    def needed(self, adjusted_p: float, bound: float | None = None) -> int:
        """Scenes that would give a verdict in 80 % of studies if the true difference and
        its spread were those seen here: on a difference, or on equality within a bound.
        Arguments are those of :meth:`verdict`.
        """
        level = self.level(adjusted_p)
        # With fewer scenes no sign pattern is rare enough for the level: p is at least 2 / 2**n.
        fewest = math.ceil(1 - math.log2(1 - level))
        by = [max(fewest, scenes_needed(self.flips.mean, self.deviation, level=level))]
        own = self._bounded
        if bound is not None and abs(own.mean) < bound:
            spread = float(np.std(own.differences, ddof=1))
            by.append(scenes_needed(bound - abs(own.mean), spread, level=EQUAL_LEVEL))
        return max(FEWEST, self.scenes + 1, min(by))


def contrast(
    a: ByView,
    b: ByView,
    scale: Scale,
    *,
    floor: float = 0.0,
    counts: tuple[ByView, ByView] | None = None,
) -> Contrast:
    """Compare b with a, paired on scene and view.

    Args:
        a, b: scene -> view, or view/seed -> value, NaN where undefined.
        scale, floor: as for :func:`~attnwarp_eval.statistics.scales.compared`.
        counts: denominators of the shares of a and of b; shares are then compared by their odds.
    """
    if scale == "share" and counts is not None:
        scale = "odds"
    by_scene: dict[str, float] = {}
    plain: list[float] = []
    variances: list[float] = []
    undefined, largest, each = 0, 0.0, {}
    for scene in sorted(set(a) | set(b)):
        found, differences = [], []
        seeds = defaultdict(list)
        for view, pair, number in _pairs(scene, a, b, counts):
            value = compared(*pair, scale, floor=floor, counts=number)
            if math.isfinite(value):
                found.append(value)
                seeds[view.partition("/")[1] and view.rpartition("/")[2]].append(value)
                differences.append(pair[1] - pair[0])
                largest = max(largest, *map(abs, pair))
            else:
                undefined += 1
        if found:
            by_scene[scene], each[scene] = float(np.mean(found)), found
            plain.append(float(np.mean(differences)))
            if len(seeds) > 1:
                variances.append(float(np.var([np.mean(own) for own in seeds.values()], ddof=1)))
    rounding = ROUNDING * (1.0 if scale in FACTORS else largest)
    return Contrast(
        scale,
        sum(map(len, each.values())),
        undefined,
        by_scene,
        SignFlips(np.array(list(by_scene.values())), rounding),
        interval(each),
        SignFlips(np.array(plain), ROUNDING * largest),
        float(np.sqrt(np.mean(variances))) if variances else math.nan,
    )


def paired(a: ByView, b: ByView) -> Interval:
    """Interval of b - a over the shared views.

    Student's t needs a spread, and shares often differ by exactly as much in every scene. The
    p-value and the interval are then those of the sign test; below six scenes it has no bounds at
    95 %.

    Args:
        a, b: scene -> view key -> value. Views that only one side has, or where one side is NaN,
            count as undefined.

    Example:
        >>> ours = {"bear": {"yaw010": 1.0}, "fence": {"yaw010": 2.0}}
        >>> theirs = {"bear": {"yaw010": 2.0}, "fence": {"yaw010": 4.0, "yaw020": 9.0}}
        >>> value = paired(ours, theirs)
        >>> value.mean, value.undefined
        (1.5, 1)
        >>> equal = paired(ours, {"bear": {"yaw010": 2.0}, "fence": {"yaw010": 3.0}})
        >>> equal.p, equal.bounded  # 2 / 2**2
        (0.5, False)
    """
    value = contrast(a, b, "plain")
    result, rounding = replace(value.student, undefined=value.undefined), value.flips.rounding
    if not result.detectable <= rounding:
        return result
    if abs(result.mean) <= rounding:
        return replace(result, p=1.0)  # the same values
    sign_test = 2 * 0.5**result.scenes
    bound = result.mean if sign_test <= 0.05 else math.nan
    return replace(result, low=bound, high=bound, detectable=math.nan, p=sign_test)


def _pairs(
    scene: str, a: ByView, b: ByView, counts: tuple[ByView, ByView] | None
) -> Iterator[tuple[str, tuple[float, float], tuple[float, float]]]:
    """Key of each view of a scene, its figures, and their denominators."""
    sides = (a, b, *(counts or ({}, {})))
    left, right, *of = (side.get(scene, {}) for side in sides)
    for view in sorted({*left, *right}):
        first, second, *number = (side.get(view, math.nan) for side in (left, right, *of))
        yield view, (first, second), (number[0], number[1])
