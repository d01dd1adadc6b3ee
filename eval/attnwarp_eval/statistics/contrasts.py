"""Contrast of two arms over scenes on a metric's own scale, with the test that decides it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from attnwarp_eval.statistics.intervals import ROUNDING, ByView, Interval, interval
from attnwarp_eval.statistics.scales import Scale, compared
from attnwarp_eval.statistics.signflips import FEWEST, SignFlips

Verdict = Literal["better", "worse", "equal", "can't tell"]


@dataclass(frozen=True, eq=False)
class Contrast:
    """Difference of two arms, scene by scene, on one scale.

    Attributes:
        by_scene: mean over a scene's views; scenes without a pair are left out.
        scale: of the differences; those of ``ratio`` are logarithms.
        undefined: views that one side alone has, or where it is undefined.
        flips: the sign-flip test of ``by_scene``.
        student: Student's t beside it, on the same scale.

    Example:
        >>> ours = {f"s{k}": {"v": 1.0 + k} for k in range(6)}
        >>> theirs = {f"s{k}": {"v": 2.0 + 2 * k} for k in range(6)}
        >>> value = contrast(theirs, ours, "ratio")
        >>> value.flips.p, [round(bound, 3) for bound in value.shown()]
        (0.03125, [0.5, 0.5, 0.5])
        >>> value.verdict("lower"), value.verdict("higher")
        ('better', 'worse')
    """

    by_scene: Mapping[str, float]
    scale: Scale
    undefined: int
    flips: SignFlips
    student: Interval

    def shown(self, level: float = 0.95) -> tuple[float, float, float]:
        """Mean and bounds as a reader is shown them: of ``ratio`` b / a, else b - a.

        0 (or a ratio of 1) lies inside exactly if the test at that level cannot tell.
        """
        values = (self.flips.mean, *self.flips.interval(level))
        if self.scale == "ratio":
            return tuple(math.exp(value) for value in values)  # type: ignore[return-value]
        return values

    def level(self, adjusted_p: float) -> float:
        """Level that adjusting for other tests leaves: its interval agrees with the verdict."""
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
        """Verdict in general, for scenes like these.

        Args:
            direction: which values are better.
            adjusted_p: the p-value adjusted for other tests; that of this one if left out.
            bound: differences up to which arms are equal, on the scale; none are if left out.
        """
        p = self.flips.p if adjusted_p is None else adjusted_p
        if len(self.by_scene) < FEWEST:
            return "can't tell"
        if bound is not None and self.flips.equal(bound):
            return "equal"
        if not p <= 0.05:
            return "can't tell"
        return "better" if (self.flips.mean > 0) == (direction == "higher") else "worse"


def contrast(
    a: ByView,
    b: ByView,
    scale: Scale,
    *,
    floor: float = 0.0,
    counts: Mapping[str, Mapping[str, int]] | None = None,
) -> Contrast:
    """Compare b with a, paired on scene and view.

    Args:
        a, b: scene -> view (and seed) -> value, NaN where undefined.
        scale, floor: see :func:`~attnwarp_eval.statistics.scales.compared`.
        counts: things that each share is of, for empirical logits.
    """
    by_scene: dict[str, float] = {}
    undefined, largest, each = 0, 0.0, {}
    for scene in sorted(set(a) | set(b)):
        left, right = a.get(scene, {}), b.get(scene, {})
        found = []
        for view in sorted({*left, *right}):
            pair = left.get(view, math.nan), right.get(view, math.nan)
            count = None if counts is None else counts.get(scene, {}).get(view)
            found.append(compared(*pair, scale, floor=floor, count=count))
            if math.isfinite(found[-1]):
                largest = max(largest, *map(abs, pair))
        defined = [value for value in found if math.isfinite(value)]
        undefined += len(found) - len(defined)
        if defined:
            by_scene[scene], each[scene] = float(np.mean(defined)), defined
    rounding = ROUNDING * (1.0 if scale == "ratio" else largest)
    flips = SignFlips(np.array(list(by_scene.values())), rounding)
    return Contrast(by_scene, scale, undefined, flips, interval(each))
