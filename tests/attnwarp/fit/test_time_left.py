"""The time left of a fit whose iterations grow dearer. Oracle: the clock of fits that were run."""

import math

import numpy as np
import pytest

from attnwarp.fit import FitSettings
from attnwarp.fit.time_left import TimeLeft

PHOTOGRAPHS = [
    (20, 0.0, 13918), (100, 4.3, 13918), (300, 14.1, 13918), (500, 22.8, 13918),
    (600, 27.5, 15631), (700, 33.4, 21652), (800, 40.5, 29273), (900, 49.1, 36210),
    (1000, 57.1, 45408), (1100, 67.3, 56045), (1200, 79.8, 68048), (1300, 94.7, 81665),
    (1400, 111.5, 96948), (1500, 130.0, 112562), (2000, 228.7, 112562), (2500, 332.4, 112562),
    (3000, 434.8, 112562),
]  # fmt: skip
"""Iteration, CPU seconds and splats of a fit to eleven photographs of 256 x 256 px."""


def told(clock, rows, settings, pixels):
    """(iteration, seconds told, seconds that it took from there) after each iteration."""
    steps, seconds, splats = np.array(rows).T
    left = TimeLeft(settings, int(splats[0]), pixels)
    for iteration in range(1, int(steps[-1])):
        clock.seconds = float(np.interp(iteration, steps, seconds))
        count = int(splats[np.searchsorted(steps, iteration)])
        yield iteration, left.after(iteration, count), seconds[-1] - clock.seconds


def test_the_first_time_that_is_told_is_within_a_factor_of_two(clock):
    said = list(told(clock, PHOTOGRAPHS, FitSettings(iterations=3000), 256 * 256))
    known = [(step, left, true) for step, left, true in said if not math.isnan(left)]
    assert known[0][0] <= 700  # while splats double and double again, until 1500
    # The last seconds are those of a few iterations.
    assert all(0.5 < left / true < 2 for _, left, true in known if true > 5)


def test_without_refinements_the_time_left_follows_from_the_pace(clock):
    rows = [(0, 0.0, 500), (100, 20.0, 500), (800, 160.0, 500)]
    for settings in (FitSettings(iterations=800), FitSettings(iterations=800, densify=False)):
        clock.seconds = 0.0
        said = list(told(clock, rows, settings, 64 * 64))
        assert all(left == pytest.approx(true) for _, left, true in said if not math.isnan(left))
        assert not math.isnan(said[26][1])  # 5 s after the first


def test_growth_ends_at_the_limit_of_splats(clock):
    """1000 splats, 500 more with each of the refinements at 500, 600 ... until 2500 of them."""
    settings = FitSettings(iterations=3000, max_splats=2500)
    rows, seconds, count = [(0, 0.0, 1000)], 0.0, 1000
    for step in range(100, 3001, 100):
        seconds += 100 * count * 1e-4
        rows.append((step, seconds, count))
        count = min(2500, count + 500) if 500 <= step < 1500 else count
    said = [row for row in told(clock, rows, settings, 0) if not math.isnan(row[1])]
    assert said[0][0] == 601
    assert all(left == pytest.approx(true, rel=0.02) for _, left, true in said)


def test_the_time_told_before_a_fit_is_that_of_a_real_one():
    """From the pace of its first iterations and the limit of its splats."""
    _, seconds, splats = np.array(PHOTOGRAPHS).T
    settings = FitSettings(iterations=3000, max_splats=int(splats[-1]))
    told = TimeLeft(settings, int(splats[0]), 256 * 256).expect(seconds[3] / 500, 0, int(splats[0]))
    assert told == pytest.approx(seconds[-1], rel=0.25)
