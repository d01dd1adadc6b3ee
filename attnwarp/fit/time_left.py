"""Remaining time of a fit, whose iterations slow down as splats are added."""

from __future__ import annotations

import math

import numpy as np

from attnwarp.fit.settings import FitSettings
from attnwarp.reporting import Pace

PIXELS_PER_SPLAT = 5
"""Pixels of a picture whose cost equals one splat's, from 14,000 to 112,000 splats at 256 x
256 px."""


class TimeLeft:
    """Estimator of a fit's remaining seconds from the pace of past iterations.

    An iteration's work is the sum of its splats' and its pixels' work. The estimate assumes that
    refinements keep adding as many splats as before.
    """

    def __init__(self, settings: FitSettings, first: int, pixels: int) -> None:
        self.settings, self.first, self.pixels = settings, first, pixels // PIXELS_PER_SPLAT
        self._pace, self._done = Pace(), 0

    def after(self, iteration: int, splats: int) -> float:
        """Estimate the seconds left after ``iteration`` iterations; NaN while unknown.

        Call this after each iteration.
        """
        self._done += splats + self.pixels
        ahead = self._ahead(iteration, splats)
        left = self._pace.left(self._done, self._done + round(ahead or 1))
        return math.nan if ahead is None or left is None else left

    def expect(self, pace: float, iteration: int, splats: int) -> float:
        """Estimate the seconds from ``iteration`` on at ``pace`` seconds for the next one, if
        refinements add splats evenly up to the limit.
        """
        s = self.settings
        last = int(s.densify_until * s.iterations) if s.densify else 0
        most = max(splats, s.max_splats or 0) if iteration < last else splats
        ahead = np.arange(iteration, s.iterations)
        grown = (ahead - s.densify_from) / max(1, last - s.densify_from)
        counts = splats + (most - splats) * np.clip(grown, 0, 1)
        return pace * float((counts + self.pixels).sum()) / (splats + self.pixels)

    def _ahead(self, iteration: int, splats: int) -> float | None:
        """Estimate the remaining work; None before two refinements show the growth."""
        s = self.settings
        last = int(s.densify_until * s.iterations) if s.densify else 0
        times = np.arange(0, last, s.densify_every)
        times = times[times >= max(1, s.densify_from)]
        past, ahead = times[times < iteration], times[times >= iteration]
        if len(ahead) and len(past) < 2:
            return None
        growth = max(0, splats - self.first) / max(1, len(past))
        counts = splats + growth * np.arange(len(ahead) + 1)
        counts = np.minimum(counts, max(splats, s.max_splats or math.inf))
        return float((np.diff([iteration, *ahead, s.iterations]) * (counts + self.pixels)).sum())
