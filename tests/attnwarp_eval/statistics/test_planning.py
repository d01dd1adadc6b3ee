"""Planning against published sample sizes, simulated tests and variance components drawn at will."""

import math

import numpy as np
import pytest
from scipy import integrate, stats

from attnwarp_eval.statistics.planning import (
    MOST_SCENES,
    effect_interval,
    parts,
    scenes_needed,
)


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


@pytest.mark.parametrize(
    ("effect", "scenes"),
    [
        pytest.param(0.0, 6, marks=pytest.mark.slow),
        (0.3, 3),
        pytest.param(1.0, 6, marks=pytest.mark.slow),
        pytest.param(3.0, 2, marks=pytest.mark.slow),
    ],
)
def test_four_of_five_intervals_of_an_effect_have_it(effect, scenes):
    """Oracle: the effect of which 1,000 studies were drawn; sqrt(0.8 * 0.2 / 1000) is 0.013."""
    drawn = np.random.default_rng(4).normal(effect, 1.0, (1000, scenes))
    bounds = [effect_interval(d.mean(), d.std(ddof=1), scenes) for d in drawn]
    assert np.mean([low <= effect <= high for low, high in bounds]) == pytest.approx(0.8, abs=0.04)


def test_bounds_of_an_effect_are_those_of_an_integral_and_defined_in_far_tails():
    """Oracle: the noncentral t is (normal + shift) / (chi / sqrt(freedom)), integrated over chi."""
    low, high = effect_interval(1.0, 1.0, 6)
    for bound, share in ((low, 0.9), (high, 0.1)):

        def below(chi, bound=bound):
            t = math.sqrt(6) * (chi / math.sqrt(5) - bound)
            return stats.norm.cdf(t) * stats.chi.pdf(chi, 5)

        assert integrate.quad(below, 0, 20)[0] == pytest.approx(share, abs=1e-7)
    low, high = effect_interval(-50.0, 1e-3, 6)
    assert -8e4 < low < -5e4 < high < -2e4


def drawn(scenes, seeds, of_scene, of_seed, random, views=3):
    """Differences whose parts are known: scene -> "view/seed" -> value."""
    table = {}
    for scene in range(scenes):
        here = random.normal(0, of_scene)
        for seed in range(seeds):
            both = here + random.normal(0, of_seed)
            table.setdefault(f"s{scene}", {}).update(
                {f"v{view}/{seed}": both + 0.1 * (view - 1) for view in range(views)}
            )
    return table


def against_zero(table):
    return parts({s: dict.fromkeys(own, 0.0) for s, own in table.items()}, table)


def test_the_share_of_seeds_is_that_which_was_drawn():
    """Oracle: variances of the draw. Of a scene's mean over 2 seeds, 1.5^2 / 2 is of seeds."""
    split = against_zero(drawn(4000, 2, 1.0, 1.5, np.random.default_rng(1)))
    assert split.seeds == 2
    assert split.share == pytest.approx(1.125 / 2.125, abs=0.03)
    assert split.scenes == pytest.approx(math.sqrt(2.125), rel=0.03)


def test_one_seed_has_no_share_and_views_that_one_side_lacks_do_not_count():
    one = against_zero(drawn(3, 1, 1.0, 1.0, np.random.default_rng(3)))
    assert one.seeds == 1
    assert math.isnan(one.share)
    a = {"bear": {"v/0": 0.0, "v/1": 0.0}, "fence": {"v/0": 0.0, "v/1": math.nan}, "gone": {}}
    b = {"bear": {"v/0": 1.0, "v/1": 3.0}, "fence": {"v/0": 4.0, "v/1": 9.0, "w/1": 9.0}}
    split = parts(a, b)
    assert split.scenes == pytest.approx(math.sqrt(2))  # of 2 and 4
    assert split.share == pytest.approx(0.5)  # var(1, 3) / 2 of 2
    assert split.seeds == 1.5
    assert math.isnan(parts({"bear": {"v/0": 0.0}}, {"bear": {"v/0": 1.0}}).scenes)


def test_seeds_that_differ_more_than_scenes_have_all_of_the_spread():
    table = {"bear": {"v/0": 0.0, "v/1": 10.0}, "fence": {"v/0": 1.0, "v/1": 11.0}}
    assert against_zero(table).share == 1.0


def test_seeds_that_agree_have_no_share_where_a_view_of_one_is_undefined():
    agreeing = {"v/0": 0.0, "w/0": 10.0, "v/1": 0.0}
    table = {"bear": agreeing | {"w/1": math.nan}, "fence": {"v/0": 1.0, "v/1": 1.0}}
    assert against_zero(table).share == 0.0
    apart = {"bear": {"v/0": 1.0, "w/1": 2.0}, "fence": {"v/0": 1.0, "w/1": 5.0}}
    assert math.isnan(against_zero(apart).share)


def test_a_spread_of_rounding_is_none():
    """0.3 and 0.1 + 0.2 differ by 5.6e-17, which is no evidence of anything."""
    a = {"bear": {"v/0": 0.3}, "fence": {"v/0": 0.7}, "glass": {"v/0": math.inf}}
    b = {"bear": {"v/0": 0.1 + 0.2}, "fence": {"v/0": 0.7}, "glass": {"v/0": math.inf}}
    assert parts(a, b).scenes == 0.0
    assert parts({"bear": {"v/0": math.inf}, **a}, {"bear": {"v/0": 0.5}, **b}).scenes == 0.0
