"""Planning against published sample sizes and simulated tests."""

import math

import numpy as np
import pytest
from scipy import stats

from attnwarp_eval.statistics.planning import MOST_SCENES, scenes_needed


@pytest.mark.parametrize(("effect", "scenes"), [(0.2, 199), (0.5, 34), (0.8, 15)])
def test_the_scenes_needed_are_those_of_cohens_effects(effect, scenes):
    """Oracle: one-sample t test, two-sided 5 %, 80 % power (G*Power; Cohen 1988, table 2.4.1)."""
    assert scenes_needed(effect * 3.0, 3.0) == scenes
    assert scenes_needed(-effect, 1.0) == scenes


@pytest.mark.parametrize(("mean", "deviation"), [(1.0, 0.6), (1.0, 1.5)])
def test_with_the_scenes_needed_a_simulated_test_tells_in_four_of_five(mean, deviation):
    """Oracle: scipy's t test of 20,000 drawn studies; one scene less tells in fewer than 80 %."""
    random, needed = np.random.default_rng(0), scenes_needed(mean, deviation)

    def told(scenes):
        drawn = random.normal(mean, deviation, (20_000, scenes))
        return (stats.ttest_1samp(drawn, 0, axis=1).pvalue < 0.05).mean()

    assert told(needed) > 0.79
    assert told(needed - 1) < 0.81


def test_what_no_number_of_scenes_tells_and_what_two_do():
    assert scenes_needed(0.0, 1.0) == MOST_SCENES + 1
    assert scenes_needed(1e-6, 1.0) == MOST_SCENES + 1
    assert scenes_needed(1.0, 0.0) == 2
    assert scenes_needed(1.0, 1e-9) == 2
    for bad in [(math.nan, 1.0), (1.0, -1.0), (1.0, math.inf)]:
        with pytest.raises(ValueError, match="expected finite numbers"):
            scenes_needed(*bad)
