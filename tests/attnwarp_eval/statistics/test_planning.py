"""Planning against published sample sizes."""

import math

import pytest

from attnwarp_eval.statistics.planning import MOST_SCENES, scenes_needed


@pytest.mark.parametrize(("effect", "scenes"), [(0.2, 199), (0.5, 34), (0.8, 15)])
def test_the_scenes_needed_are_those_of_cohens_effects(effect, scenes):
    """Oracle: one-sample t test, two-sided 5 %, 80 % power (G*Power; Cohen 1988, table 2.4.1)."""
    assert scenes_needed(effect * 3.0, 3.0) == scenes
    assert scenes_needed(-effect, 1.0) == scenes


def test_what_no_number_of_scenes_tells_and_what_two_do():
    assert scenes_needed(0.0, 1.0) == MOST_SCENES + 1
    assert scenes_needed(1e-6, 1.0) == MOST_SCENES + 1
    assert scenes_needed(1.0, 0.0) == 2
    assert scenes_needed(1.0, 1e-9) == 2
    for bad in [(math.nan, 1.0), (1.0, -1.0), (1.0, math.inf)]:
        with pytest.raises(ValueError, match="expected finite numbers"):
            scenes_needed(*bad)
