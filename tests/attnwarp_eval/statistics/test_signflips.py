"""Oracles: every sign pattern by brute force, SciPy's permutation test, its binomial test, and
simulated studies whose truth is known.
"""

import itertools
import math

import numpy as np
import pytest
from further import further
from scipy import stats

from attnwarp_eval.statistics.contrasts import contrast
from attnwarp_eval.statistics.scales import compared
from attnwarp_eval.statistics.signflips import DRAWS, SignFlips


def brute_force(differences):
    """The two-sided p-value from the definition."""
    total = abs(sum(differences))
    patterns = itertools.product([1, -1], repeat=len(differences))
    sums = [abs(sum(s * d for s, d in zip(p, differences, strict=True))) for p in patterns]
    return float(np.mean(np.array(sums) >= total - 1e-9))


def skewed(rng, count):
    """Differences with a heavy tail on one side, some of them equal."""
    return np.round(rng.exponential(1.0, count) ** 1.5 - rng.uniform(0, 1.5), 1)


@pytest.mark.parametrize("count", [2, 3, 6, 9])
def test_the_p_value_is_the_share_of_all_sign_patterns_and_scipys(count):
    rng = np.random.default_rng(count)
    for _ in range(20):
        d = skewed(rng, count)
        assert SignFlips(d).p == pytest.approx(brute_force(d))
    d = rng.normal(0.4, 1, count)
    theirs = stats.permutation_test(
        (d,), np.mean, permutation_type="samples", n_resamples=np.inf
    ).pvalue  # fmt: skip
    assert SignFlips(d).p == pytest.approx(min(theirs, 1.0))


def test_the_interval_holds_just_those_means_that_the_test_does_not_refuse():
    rng = np.random.default_rng(5)
    for count in (6, 8, 10):
        d = rng.normal(0.5, 1.0, count)
        low, high = SignFlips(d).interval(0.9)
        for mean in (low, high):
            assert brute_force(d - mean) > 0.1
        assert brute_force(d - (low - 1e-6)) <= 0.1 and brute_force(d - (high + 1e-6)) <= 0.1


@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_the_interval_never_disagrees_with_the_verdict(level):
    rng = np.random.default_rng(11)
    seen = set()
    for count in (*range(2, 13), 24):
        for _ in range(12 if count > 20 else 60):
            test = SignFlips(skewed(rng, count) + rng.choice([0.0, 0.6]))
            low, high = test.interval(level)
            told = test.p <= 1 - level
            outside = not math.isnan(low) and not low <= 0 <= high
            assert told == outside, (count, test.p, low, high)
            seen.add(told)
    assert seen == {True, False}


@pytest.mark.parametrize("scenes", further(12, 6, 24))
def test_of_200_studies_of_equal_arms_no_more_fail_than_the_stated_rate(scenes):
    rng = np.random.default_rng(scenes)
    told = covered = 0
    for _ in range(200):
        test = SignFlips(rng.standard_t(2, scenes))
        told += test.p <= 0.05
        low, high = test.interval()
        covered += low <= 0 <= high
    # 0.1 % that a test of that size fails more often; six scenes can only reach 2 / 64.
    assert told <= stats.binom.ppf(0.999, 200, 0.05) and covered == 200 - told
    if scenes > 6:
        assert told >= stats.binom.ppf(0.001, 200, 0.04)


@pytest.mark.parametrize("scenes", [2, 5, 6, 9])
def test_equal_differences_have_the_sign_tests_p_value_and_no_bounds_below_six(scenes):
    test = SignFlips(np.full(scenes, 0.25))
    assert test.p == stats.binomtest(scenes, scenes).pvalue
    low, high = test.interval()
    assert (low, high) == (0.25, 0.25) if scenes >= 6 else math.isnan(low)


def test_more_than_twenty_scenes_are_drawn_the_same_way_each_time_and_near_the_truth():
    d = np.random.default_rng(3).normal(0.35, 1, 24)
    first, again = SignFlips(d), SignFlips(d)
    assert first.p == again.p and first.interval() == again.interval()
    assert (first.p * (1 + DRAWS)) == pytest.approx(round(first.p * (1 + DRAWS)))
    # All 2^24 patterns, half of them by symmetry: the sum's distribution by halves.
    halves = [np.zeros(1), np.zeros(1)]
    for k, value in enumerate(d):
        halves[k % 2] = np.concatenate([halves[k % 2] + value, halves[k % 2] - value])
    left, right = np.sort(halves[0]), halves[1]
    beyond = (len(left) - np.searchsorted(left, abs(d.sum()) - right - 1e-12)).sum()
    assert first.p == pytest.approx(2 * beyond / 2**24, abs=4 * math.sqrt(0.1 / DRAWS))
    # Refused means are those whose own draws refuse them.
    low, high = first.interval()
    assert low < d.mean() < high


def test_a_bound_of_equality_needs_the_whole_interval_inside():
    d = np.linspace(-0.1, 0.12, 10)
    low, high = SignFlips(d).interval(0.9)
    assert SignFlips(d).equal(1.01 * max(-low, high)) and not SignFlips(d).equal(
        0.99 * max(-low, high)
    )
    # "Can't tell" is not "equal": five scenes have no interval.
    assert not SignFlips(d[:3]).equal(100.0)


def test_scales_are_those_of_their_closed_forms():
    assert compared(0.5, 0.25, "ratio") == pytest.approx(math.log(0.5))
    assert compared(1e-9, 0.0, "ratio", floor=1e-6) == 0.0
    assert compared(1e-3, 0.0, "ratio", floor=1e-6) == pytest.approx(math.log(1e-3))
    assert math.isnan(compared(0.0, 1.0, "ratio"))
    # SciPy's logit of (k + 1/2) / (n + 1).
    logit = [float(np.log(p / (1 - p))) for p in (3.5 / 11, 20.5 / 21)]
    assert compared(0.3, 1.0, "odds", counts=(10, 20)) == pytest.approx(logit[1] - logit[0])
    assert compared(0.3, 1.0, "share") == pytest.approx(0.7)
    assert compared(31.0, 30.0, "plain") == -1.0
    assert math.isnan(compared(math.nan, 1.0, "plain"))


def test_a_contrast_pairs_views_first_and_leaves_an_interval_of_shares_within_their_range():
    rng = np.random.default_rng(6)
    a = {f"s{k}": {f"v{j}": rng.uniform(0, 0.3) for j in range(4)} for k in range(8)}
    b = {s: {v: min(1.0, x + 0.75) for v, x in views.items()} for s, views in a.items()}
    b["s0"]["v0"] = math.nan
    value = contrast(a, b, "share")
    assert value.undefined == 1 and len(value.by_scene) == 8
    expected = np.mean([b["s0"][v] - a["s0"][v] for v in ("v1", "v2", "v3")])
    assert value.by_scene["s0"] == pytest.approx(expected)
    assert all(-1 <= bound <= 1 for bound in value.shown())
    few = contrast(dict(list(a.items())[:5]), dict(list(b.items())[:5]), "share")
    assert few.verdict("higher") == "can't tell" and value.verdict("higher") == "better"


def test_an_adjusted_interval_agrees_with_the_adjusted_verdict():
    rng = np.random.default_rng(8)
    for _ in range(60):
        d = rng.normal(0.6, 1.0, 9)
        value = contrast(
            {f"s{k}": {"v": 0.0} for k in range(9)},
            {f"s{k}": {"v": x} for k, x in enumerate(d)},
            "plain",
        )
        for factor in (1.0, 1.7, 4.0):
            adjusted = min(1.0, factor * value.flips.p)
            _, low, high = value.shown(value.level(adjusted))
            told = value.verdict("higher", adjusted_p=adjusted) != "can't tell"
            assert told == (not math.isnan(low) and not low <= 0 <= high)


@pytest.mark.parametrize(("adjusted", "scenes"), [(2 / 64, 7), (4 / 64, 7), (8 / 64, 8)])
def test_no_fewer_scenes_are_asked_for_than_the_test_can_ever_tell_with(adjusted, scenes):
    """Oracle: of n scenes' flips only two, all as seen and all turned, are so far out, so p is at
    least 2 / 2**n. An adjustment by 2 asks for p <= 1 / 40, one by 4 for 1 / 80.
    """
    table = {f"s{k}": {"v": 1.0 + 0.01 * k} for k in range(6)}
    nothing = {scene: {"v": 0.0} for scene in table}
    value = contrast(nothing, table, "plain")
    assert value.flips.p == 2 / 64
    assert value.needed(adjusted) == scenes
