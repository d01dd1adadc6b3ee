"""Oracles: SciPy's tests, closed forms, simulation with a known truth."""

import math

import numpy as np
import pytest
from scipy import stats

from attnwarp_eval.statistics import equivalence


def test_welch_agrees_with_scipy_where_spreads_and_numbers_differ():
    rng = np.random.default_rng(0)
    a, b = rng.normal(1, 0.5, (11, 40)), rng.normal(1.1, 2.0, (17, 40))
    ours, theirs = equivalence.welch(a, b), stats.ttest_ind(b, a, equal_var=False)
    assert np.allclose(ours.p, theirs.pvalue, rtol=1e-9) and np.allclose(
        ours.freedom, theirs.df, rtol=1e-9
    )
    assert np.allclose(ours.difference / ours.error, theirs.statistic, rtol=1e-9)


def test_values_without_noise_are_compared_exactly_up_to_rounding():
    a = np.ones((10, 3))
    b = np.ones((10, 3)) * [1.0, 1 + 1e-7, 1.01]
    assert equivalence.welch(a, b).p.tolist() == [1.0, 1.0, 0.0]


def test_values_that_hardly_vary_are_tested_by_their_own_noise():
    rng = np.random.default_rng(11)
    a, b = 1 + 3e-6 * rng.standard_normal((2, 12, 2000))
    # Twice the rounding apart and with noise of a third of it: the old way to say p = 0.
    close = equivalence.welch(a, b + 1.2e-5)
    assert (close.error < equivalence.ROUNDING).all() and (close.p > 0).all()
    # What is beyond the rounding, 2e-6, is 1.6 standard errors (1.2e-6); scipy knows its p.
    beyond_rounding = b + 1.2e-5 - equivalence.ROUNDING * (b + 1.2e-5).mean(0)
    theirs = stats.ttest_ind(beyond_rounding, a, equal_var=False)
    beyond = close.difference > 1.1e-5
    assert beyond.sum() > 500 and np.allclose(close.p[beyond], theirs.pvalue[beyond], rtol=1e-3)
    # Ten times the rounding apart is light.
    assert equivalence.welch(a, b + 1e-4).p.max() < 1e-9
    assert (equivalence.welch(a, b).p == 1).all()


def test_too_few_samples_are_refused():
    for test in (equivalence.welch, equivalence.welch_interval):
        with pytest.raises(ValueError, match="got 1 and 5 samples, expected at least 2"):
            test(np.ones(1), np.ones(5))
    for a, b in ((np.ones(1), np.zeros(1)), (np.ones(3), np.zeros(1))):
        with pytest.raises(ValueError, match="expected as many, at least 2 pairs"):
            equivalence.paired_test(a, b)  # one pair has no spread, so no p-value


@pytest.mark.parametrize("level", [0.9, 0.95])
def test_the_interval_of_a_difference_is_scipys(level):
    rng = np.random.default_rng(1)
    a, b = rng.normal(1, 0.1, 7), rng.normal(1.3, 0.5, 9)
    theirs = stats.ttest_ind(b, a, equal_var=False).confidence_interval(level)
    difference, low, high = equivalence.welch_interval(a, b, level=level)
    assert difference == pytest.approx(b.mean() - a.mean(), rel=1e-12)
    assert (low, high) == pytest.approx((theirs.low, theirs.high), rel=1e-9)


def test_the_interval_of_samples_without_noise_is_their_difference():
    assert equivalence.welch_interval(np.full(3, 1.0), np.full(4, 1.5)) == (0.5, 0.5, 0.5)
    # Three times 0.1 has a mean beside it.
    assert len(set(equivalence.welch_interval(np.full(3, 0.1), np.full(3, 0.3)))) == 1


def test_small_numbers_have_noise_too():
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 0.1, 7), rng.normal(1.3, 0.5, 9)
    tiny = np.multiply(equivalence.welch_interval(a * 1e-12, b * 1e-12), 1e12)
    assert tiny == pytest.approx(equivalence.welch_interval(a, b), rel=1e-9)
    assert equivalence.welch_interval(np.zeros(3), np.zeros(3)) == (0.0, 0.0, 0.0)


def test_sidak_makes_independent_tests_refuse_together_at_the_level():
    for tests in (1, 3, 1024):
        assert math.isclose(1 - (1 - equivalence.sidak(0.05, tests)) ** tests, 0.05, rel_tol=1e-9)


def test_the_paired_test_agrees_with_scipy():
    rng = np.random.default_rng(9)
    a, b = rng.random((24, 4, 4, 3)), rng.random((24, 4, 4, 3)) + 0.02
    ours, theirs = (
        equivalence.paired_test(a, b),
        stats.ttest_rel(b.mean((1, 2, 3)), a.mean((1, 2, 3))),
    )
    assert math.isclose(ours.p, theirs.pvalue, rel_tol=1e-9)


def test_means_are_called_equal_at_the_stated_rate_where_they_differ_by_the_margin():
    rng = np.random.default_rng(3)
    trials, size, margin = 2000, 200, 0.01
    equal = 0
    for _ in range(trials):
        a, b = 1 + 0.02 * rng.standard_normal((2, size))
        equal += equivalence.equivalence(a + margin, b, margin=margin).equal
    # On the margin 1 % pass; binomial, mean 20, standard deviation 4.4: four of them.
    assert 3 <= equal <= 38
    bound = equivalence.Equivalence(-0.002, 0.001, margin).bound
    assert bound == pytest.approx(0.002 + 2.33 * 0.001, rel=1e-12)
