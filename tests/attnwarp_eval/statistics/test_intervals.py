"""Oracles: Student's t in closed form, simulation with a known truth, brute force over all
subsets."""

import itertools

import numpy as np
import pytest
from scipy import stats

from attnwarp_eval.statistics.contrasts import contrast, paired
from attnwarp_eval.statistics.intervals import (
    benjamini_hochberg,
    common,
    front,
    interval,
    time_ratio,
    verdict,
)

NAN = float("nan")


@pytest.mark.parametrize(
    ("values", "mean", "scenes", "views", "undefined"),
    [
        ({"many": [1.0] * 90, "few": [3.0] * 2}, 2.0, 2, 92, 0),  # many views do not outvote
        ({"a": [1.0, NAN], "b": [NAN, NAN], "c": [3.0, 3.0]}, 2.0, 2, 3, 3),
        ({"a": [1.0, 2.0, 3.0]}, 2.0, 1, 3, 0),  # one scene has no interval
        ({"a": [NAN]}, NAN, 0, 0, 1),  # and not zero
    ],
)
def test_a_mean_is_over_scenes_and_counts_what_is_undefined(values, mean, scenes, views, undefined):
    result = interval(values)
    assert result.mean == pytest.approx(mean, nan_ok=True)
    assert (result.scenes, result.views, result.undefined) == (scenes, views, undefined)
    assert result.bounded == (scenes > 1)
    assert result.bounded or verdict(result, "higher") == "can't tell"


def test_the_interval_is_students_t_over_the_means_of_the_scenes():
    means = np.array([1.0, 2.0, 4.0, 7.0])
    result = interval({f"s{i}": [m - 0.5, m + 0.5] for i, m in enumerate(means)})
    low, high = stats.t.interval(0.95, len(means) - 1, means.mean(), stats.sem(means))
    assert (result.low, result.high) == pytest.approx((low, high))
    assert result.p == pytest.approx(stats.ttest_1samp(means, 0.0).pvalue)


@pytest.mark.parametrize("scenes", [6, 12, 40])
def test_a_detectable_difference_is_found_at_80_percent(scenes):
    result = interval({f"s{i}": [v] for i, v in enumerate(np.linspace(-1.0, 1.0, scenes))})
    ratio = result.detectable / stats.sem(np.linspace(-1.0, 1.0, scenes))
    power = stats.nct.sf(stats.t.ppf(0.975, scenes - 1), scenes - 1, ratio)
    # Two quantiles of Student's t are added, an approximation for few scenes.
    assert power == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize("scenes", [3, 6])
@pytest.mark.parametrize(("between", "within"), [(1.0, 0.5), (0.3, 1.0)])
def test_intervals_cover_the_true_mean_at_their_stated_rate(scenes, between, within):
    rng = np.random.default_rng(7)
    trials, covered = 1000, 0
    for _ in range(trials):
        effects = rng.normal(0.0, between, scenes)
        result = interval({f"s{i}": e + rng.normal(0.0, within, 7) for i, e in enumerate(effects)})
        covered += result.low <= 0.0 <= result.high
    # Binomial(1000, 0.95) has a standard deviation of 0.7 %; four of them.
    assert covered / trials == pytest.approx(0.95, abs=0.028)


def test_a_paired_difference_cancels_what_the_views_share():
    rng = np.random.default_rng(0)
    a = {f"s{i}": {f"v{j}": 100 * rng.normal() for j in range(6)} for i in range(4)}
    gain = {"s0": 0.1, "s1": 0.11, "s2": 0.1, "s3": 0.09}
    b = {s: {v: x + gain[s] for v, x in views.items()} for s, views in a.items()}
    difference = paired(a, b)
    expected = stats.t.interval(0.95, 3, 0.1, stats.sem([*gain.values()]))
    assert (difference.low, difference.high) == pytest.approx(expected, abs=1e-9)
    assert verdict(difference, "higher") == "better"
    assert verdict(difference, "lower") == "worse"
    assert verdict(difference, "higher", atol=0.2) == "can't tell"


def test_a_huge_value_that_one_side_alone_has_does_not_make_differences_equal():
    gains = [0.010, 0.011, 0.012, 0.013, 0.014, 0.015, 0.016, 0.017]
    a = {f"s{i}": {"v": 1.0} for i in range(8)}
    b = {f"s{i}": {"v": 1.0 + gain} for i, gain in enumerate(gains)}
    b["s0"]["other"] = 1e12
    assert paired(a, b).p == pytest.approx(stats.ttest_1samp(gains, 0).pvalue, rel=1e-9)


@pytest.mark.parametrize("scenes", [2, 5, 6, 9])
@pytest.mark.parametrize("gain", [0.25, -0.1, 1e-4])
def test_equal_differences_have_the_sign_tests_p_value_and_no_bounds_below_six_scenes(scenes, gain):
    # 0.1 + 0.7 and the like: the differences are equal but for rounding.
    a = {f"s{i}": {"v": 0.1 * i + 0.7} for i in range(scenes)}
    b = {s: {v: x + gain for v, x in views.items()} for s, views in a.items()}
    result = paired(a, b)
    assert result.p == stats.binomtest(scenes, scenes).pvalue
    assert np.isnan(result.detectable)
    # The 95 % interval of a median that all values are equal to.
    assert result.bounded == (result.p <= 0.05) == (scenes >= 6)
    if result.bounded:
        assert (result.low, result.high) == pytest.approx((gain, gain), abs=1e-12)
    clear = "better" if gain > 0 else "worse"
    assert verdict(result, "higher", adjusted_p=result.p) == (
        clear if scenes >= 6 else "can't tell"
    )


@pytest.mark.parametrize("scenes", [2, 6])
def test_differences_that_are_all_zero_tell_nothing(scenes):
    values = {f"s{i}": {"v": 0.1 * i} for i in range(scenes)}
    result = paired(values, values)
    assert (result.mean, result.p) == (0.0, 1.0)
    assert verdict(result, "higher", adjusted_p=result.p) == "can't tell"


@pytest.mark.parametrize("scenes", [2, 3, 6])
def test_shares_of_four_views_without_a_true_difference_rarely_give_a_verdict(scenes):
    rng = np.random.default_rng(2)
    trials, wrong = 400, 0
    for _ in range(trials):
        # Both methods are right in each view by the flip of a coin.
        a, b = ({f"s{i}": {"v": x} for i, x in enumerate(rng.binomial(4, 0.5, scenes) / 4)}
                for _ in range(2))  # fmt: skip
        result = paired(a, b)
        wrong += verdict(result, "higher", adjusted_p=result.p) != "can't tell"
    assert wrong <= stats.binom.ppf(0.999, trials, 0.05)


def test_a_view_that_only_one_side_has_counts_as_undefined():
    difference = paired(
        {"s": {"v": 1.0, "w": 2.0}, "t": {"v": 0.0}}, {"s": {"v": 2.0}, "t": {"v": 1.0}}
    )
    assert difference.mean == pytest.approx(1.0)
    assert difference.undefined == 1


def test_the_common_part_of_tables_is_the_brute_force_reading_view_by_view():
    rng = np.random.default_rng(5)
    scenes, views = ("a", "b", "c"), ("v0", "v1", "v2", "v3")
    for _ in range(20):
        # Views that are missing, and views that are undefined.
        tables = [
            {
                s: {v: rng.choice([rng.random(), np.nan]) for v in views if rng.random() < 0.9}
                for s in scenes
            }
            for _ in range(3)
        ]
        for table, reduced in zip(tables, common(tables), strict=True):
            for s in scenes:
                for v in views:
                    everywhere = all(np.isfinite(t[s].get(v, np.nan)) for t in tables)
                    expected = table[s][v] if everywhere else None
                    assert reduced.get(s, {}).get(v) == expected
            assert all(reduced.values())


def test_the_front_is_the_brute_force_set_of_undominated_points():
    rng = np.random.default_rng(3)
    cost, error = rng.integers(0, 12, 40).astype(float), rng.integers(0, 12, 40).astype(float)
    points = list(zip(cost, error, strict=True))
    dominated = {
        i
        for i, j in itertools.permutations(range(40), 2)
        if points[j][0] <= points[i][0] and points[j][1] <= points[i][1] and points[j] != points[i]
    }
    expected = {points[i] for i in range(40) if i not in dominated}
    kept = front(cost, error)
    assert {points[i] for i in kept} == expected
    assert [points[i] for i in kept] == sorted(expected)


def test_a_nan_neither_enters_the_front_nor_evicts_a_good_point():
    assert front([1.0, 0.5, 2.0], [1.0, np.nan, 0.5]) == [0, 2]
    assert front([np.nan, 1.0], [0.0, 1.0]) == [1]
    assert front([], []) == []


def test_adjusted_p_values_are_those_of_the_definition_and_nan_does_not_count():
    p = [0.01, 0.04, 0.03, 0.5, 0.001]
    # Each is the smallest p * 5 / rank of those no smaller: ranks 2, 4, 3, 5, 1.
    adjusted = [0.025, 0.05, 0.05, 0.5, 0.005]
    assert benjamini_hochberg(p) == pytest.approx(adjusted)
    with_nan = benjamini_hochberg([0.01, np.nan, *p[1:]])
    assert np.isnan(with_nan[1])
    assert [with_nan[0], *with_nan[2:]] == pytest.approx(adjusted)
    assert benjamini_hochberg([]) == []
    assert np.isnan(benjamini_hochberg([np.nan])).all()


def test_an_adjusted_p_value_silences_a_verdict():
    clear = interval({f"s{i}": [1.0 + 0.01 * i] for i in range(4)})
    assert verdict(clear, "higher", adjusted_p=0.04) == "better"
    assert verdict(clear, "higher", adjusted_p=0.06) == "can't tell"


def test_ratios_taken_in_turn_see_through_a_machine_that_drifts():
    rng = np.random.default_rng(5)
    # The machine slows down eightfold while the rounds go on; the true ratio is 1.25 throughout.
    drift = np.geomspace(1, 8, 60)
    a = 1.25 * drift * rng.lognormal(0, 0.03, 60)
    b = drift * rng.lognormal(0, 0.03, 60)
    result = time_ratio([a, a], [b, b])
    assert result.low < 1.25 < result.high
    assert result.high / result.low < 1.05
    same = time_ratio([b], [b])
    assert (same.ratio, same.low, same.high) == (1, 1, 1)


def covered(rounds, runs, seed, scenes=1):
    """Share of cases in which the interval holds the true ratio of 1.25, where a tenth of the
    rounds has a hiccup on either side.
    """
    rng = np.random.default_rng(seed)

    def seconds(true):
        hiccups = np.where(rng.random((scenes, rounds)) < 0.1, 3.0, 1.0)
        return true * hiccups * rng.lognormal(0, 0.05, (scenes, rounds))

    results = [time_ratio(seconds(1.25), seconds(1.0)) for _ in range(runs)]
    return sum(result.low < 1.25 < result.high for result in results)


@pytest.mark.parametrize("rounds", [7, 9])
def test_ratios_of_few_rounds_hold_the_truth_as_often_as_they_say(rounds):
    # 0.1 % that an interval with this coverage fails.
    assert covered(rounds, 200, rounds) >= stats.binom.ppf(0.001, 200, 0.95)


@pytest.mark.slow
@pytest.mark.parametrize("scenes", [1, 3])
@pytest.mark.parametrize("rounds", [6, 7, 9])
def test_ratios_hold_the_truth_as_often_as_they_say_over_many_runs(rounds, scenes):
    assert covered(rounds, 2000, rounds, scenes) >= stats.binom.ppf(0.001, 2000, 0.95)


def test_the_interval_of_a_ratio_is_the_sign_tests():
    # A value with so many of 15 rounds below it is not rejected as their median by SciPy's test.
    logs = np.random.default_rng(3).normal(size=15)
    result = time_ratio([np.exp(logs)], [np.ones(15)])
    below = [count for count in range(16) if stats.binomtest(count, 15).pvalue > 0.05]
    expected = np.sort(logs)[[below[0] - 1, below[-1]]]
    assert np.log([result.low, result.high]) == pytest.approx(expected)


@pytest.mark.parametrize("rounds", [1, 3, 5])
def test_few_rounds_have_no_interval(rounds):
    # The range of five rounds holds the median in 1 - 2 / 2**5 = 94 % of cases.
    assert not time_ratio([[2.0] * 6, [2.0] * rounds], [[1.0] * 6, [1.0] * rounds]).bounded
    assert time_ratio([[2.0] * rounds], [[1.0] * rounds]).ratio == pytest.approx(2)
    assert time_ratio([[2.0] * 6], [[1.0] * 6]).bounded


def test_rounds_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="same number of rounds"):
        time_ratio([[1.0, 2.0]], [[1.0]])
    with pytest.raises(ValueError, match="positive"):
        time_ratio([[1.0, 0.0]], [[1.0, 1.0]])


def test_the_spread_over_a_scenes_seeds_is_the_root_of_the_mean_variance_of_their_means():
    rng = np.random.default_rng(2)
    values = rng.normal(0, 1, (4, 3, 2))  # scenes, seeds, views
    tables = [
        {
            f"s{i}": {
                f"{v}/{s}": float(x)
                for s, row in enumerate(own)
                for v, x in zip("ab", row, strict=True)
            }
            for i, own in enumerate(side)
        }
        for side in (np.zeros_like(values), values)
    ]
    variance = values.mean(axis=2).var(axis=1, ddof=1).mean()
    found = contrast(*tables, "plain")
    assert found.over_seeds == pytest.approx(np.sqrt(variance))
    assert found.deviation == pytest.approx(values.mean(axis=(1, 2)).std(ddof=1))
    alone = [
        {s: {k: x for k, x in t.items() if k.endswith("0")} for s, t in e.items()} for e in tables
    ]
    assert np.isnan(contrast(*alone, "plain").over_seeds)
