"""Oracles: the likelihood by brute force, planted strengths, pairs counted one by one."""

import itertools
import math

import numpy as np
import pytest
from scipy import optimize, special, stats

from attnwarp_lab.userstudy.preferences import agreement, chances, preferences, strengths


def test_strengths_have_the_highest_likelihood():
    rng = np.random.default_rng(0)
    wins = rng.integers(0, 9, size=(5, 5)).astype(float)
    np.fill_diagonal(wins, 0)

    def loss(s):
        return sum(
            wins[i, j] * math.log1p(math.exp(s[j] - s[i]))
            for i, j in itertools.permutations(range(5), 2)
        )

    best = optimize.minimize(loss, np.zeros(5), method="Nelder-Mead",
                             options={"maxiter": 20000, "maxfev": 20000, "xatol": 1e-7, "fatol": 1e-10})  # fmt: skip
    own = strengths(wins)
    assert loss(own) <= best.fun + 1e-6
    np.testing.assert_allclose(own, best.x - best.x.mean(), atol=1e-3)
    # Many at once are each for itself.
    np.testing.assert_allclose(strengths(np.stack([wins, wins.T]))[0], own, atol=1e-9)


def test_a_method_that_always_wins_has_probability_1_and_a_bound_by_people():
    people = {str(k): [("a", "b")] * 5 for k in range(8)}
    share = preferences(people, ["a", "b"]).shares["a"]
    exact = stats.binomtest(8, 8).proportion_ci(0.95, method="exact")
    assert share.value == pytest.approx(1, abs=1e-5)
    assert (share.low, share.high) == pytest.approx((exact.low, exact.high))


@pytest.mark.parametrize("people", [2, 5, 6])
def test_people_with_the_same_share_have_the_exact_interval_of_a_choice_each(people):
    choices = [("a", "b")] * 3 + [("b", "a")] * 2
    share = preferences({str(k): choices for k in range(people)}, ["a", "b"]).pairs["a", "b"]
    assert share.value == pytest.approx(0.6, abs=1e-6)

    # Clopper-Pearson: bounds at which as many choices or more, or fewer, come in 2.5 % of cases.
    # I_p(k, n - k + 1) is that chance for whole k, and continues it to 0.6 n.
    chose = 0.6 * people
    assert special.betainc(chose, people - chose + 1, share.low) == pytest.approx(0.025, abs=1e-6)
    assert special.betainc(chose + 1, people - chose, share.high) == pytest.approx(0.975, abs=1e-6)
    assert share.low < 0.5


def test_one_other_choice_of_many_leaves_a_narrow_interval():
    people = {str(k): [("a", "b")] * 10 for k in range(12)}
    people["0"] = [("a", "b")] * 9 + [("b", "a")]
    share = preferences(people, ["a", "b"]).pairs["a", "b"]
    # The exact interval of a rate, of one event; people may vary more than choices do.
    most = stats.chi2.ppf(0.975, 4) / 2 / 120
    assert 1 - 2 * most < share.low < 1 - 1 / 120 < share.high < 1


def test_two_people_who_flip_five_coins_each_rarely_prefer_a_method():
    rng, runs, wrong = np.random.default_rng(4), 150, 0
    for _ in range(runs):
        made = {
            person: [("a", "b") if coin else ("b", "a") for coin in rng.integers(0, 2, 5)]
            for person in "pq"
        }
        pair = preferences(made, ["a", "b"]).pairs["a", "b"]
        wrong += pair.low > 0.5 or pair.high < 0.5
    assert wrong <= runs - least(runs)


def test_methods_that_nobody_compared_with_the_others_have_no_share():
    choices = [("a", "b"), ("b", "a"), ("c", "d")]
    result = preferences({"p": choices, "q": choices}, ["a", "b", "c", "d"])
    assert result.unconnected == ("c", "d")
    assert result.shares["a"].value == pytest.approx(0.5)
    assert math.isnan(result.shares["c"].value) and math.isnan(result.pairs["a", "c"].value)


def test_people_who_chose_nothing_change_no_interval():
    made = {f"p{k}": [("a", "b")] * 3 + [("b", "a")] * (1 + k % 3) for k in range(6)}
    silent = {f"q{k}": [] for k in range(30)}
    alone, among = preferences(made, ["a", "b"]), preferences({**silent, **made}, ["a", "b"])
    assert among.people == alone.people == 6
    assert (among.shares, among.pairs) == (alone.shares, alone.pairs)
    one = {**silent, "p": made["p0"]}
    assert np.isnan(preferences(one, ["a", "b"]).shares["a"].low)
    with pytest.raises(ValueError, match="choices: got none"):
        preferences(silent, ["a", "b"])


def test_one_person_has_no_interval_and_an_unknown_name_is_refused():
    result = preferences({"p": [("a", "b")]}, ["a", "b"])
    assert math.isnan(result.shares["a"].low)
    with pytest.raises(ValueError, match="got 'c', expected one of"):
        preferences({"p": [("c", "b")]}, ["a", "b"])
    with pytest.raises(ValueError, match="got none"):
        preferences({"p": []}, ["a", "b"])


def least(runs):
    """Hits of a 95 % interval in so many runs, below which chance alone comes once in 10,000."""
    return stats.binom.ppf(1e-4, runs, 0.95)


def test_intervals_cover_the_share_among_people_of_different_tastes():
    rng, runs, hits = np.random.default_rng(1), 40, 0
    for _ in range(runs):
        # Each of ten people prefers x with a probability of their own, 0.75 on average.
        tastes = rng.beta(6, 2, size=10)
        people = {
            str(k): [("x", "y") if draw < taste else ("y", "x") for draw in rng.random(10)]
            for k, taste in enumerate(tastes)
        }
        share = preferences(people, ["x", "y"]).shares["x"]
        hits += share.low <= 0.75 <= share.high
    assert least(runs) <= hits


def planted(rng, people, count, truth):
    names = "wxyz"
    pairs = list(itertools.combinations(range(4), 2))
    made = {}
    for k in range(people):
        made[str(k)] = own = []
        for i, j in itertools.islice(itertools.cycle(pairs), count):
            a, b = (i, j) if rng.random() < truth[i, j] else (j, i)
            own.append((names[a], names[b]))
    return made


@pytest.mark.parametrize(
    "people",
    [12, pytest.param(6, marks=pytest.mark.slow), pytest.param(30, marks=pytest.mark.slow)],
)
def test_planted_strengths_of_four_methods_lie_in_the_intervals_at_the_stated_rate(people):
    rng, runs = np.random.default_rng(2), 15 if people == 12 else 200
    planted_strengths = np.array([0, 0.3, 0.8, 1.5])
    truth = 1 / (1 + np.exp(planted_strengths[None] - planted_strengths[:, None]))
    of_one, of_all = 0, 0
    for _ in range(runs):
        result = preferences(planted(rng, people, 18, truth), list("wxyz"))
        share = result.shares["z"]
        of_one += share.low <= (truth[3].sum() - 0.5) / 3 <= share.high
        of_all += all(
            own.low <= truth["wxyz".index(a), "wxyz".index(b)] <= own.high
            for (a, b), own in result.pairs.items()
        )
    assert of_one >= least(runs)
    assert of_all >= least(runs)  # all six pairs together


def test_chances_of_planted_strengths_are_logistic():
    s = np.array([-1.0, 0.2, 3.0])
    for i, j in itertools.product(range(3), repeat=2):
        assert chances(s)[i, j] == pytest.approx(stats.logistic.cdf(s[i] - s[j]))


def test_agreement_is_that_of_pairs_of_people_one_by_one():
    rng = np.random.default_rng(3)
    chosen = {k: list(rng.choice(["a", "b"], size=rng.integers(1, 7))) for k in range(40)}
    alike = [a == b for names in chosen.values() for a, b in itertools.combinations(names, 2)]
    result = agreement(chosen)
    assert result.share == pytest.approx(np.mean(alike))
    assert result.kappa == pytest.approx((np.mean(alike) - 0.5) / 0.5)
    assert result.comparisons == sum(len(names) > 1 for names in chosen.values())
    assert math.isnan(agreement({"x": ["a"]}).share)
