"""Agreement of rankings. Oracle: every pair by brute force."""

import itertools
import math
import warnings

import numpy as np
import pytest

from attnwarp_eval.statistics.rankings import rank_agreement


def by_pairs(a, b):
    """Tau-b by its definition: (concordant - discordant) / sqrt of the pairs untied on each side."""
    signs = [
        (np.sign(a[i] - a[j]), np.sign(b[i] - b[j]))
        for i, j in itertools.combinations(range(len(a)), 2)
    ]
    untied = [sum(pair[side] != 0 for pair in signs) for side in (0, 1)]
    return sum(x * y for x, y in signs) / math.sqrt(untied[0] * untied[1])


def test_ties_and_order_are_those_of_all_pairs():
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = rng.integers(0, 5, size=(2, 8)).astype(float)
        assert rank_agreement(a, b) == pytest.approx(by_pairs(a, b))


def test_settings_without_a_value_are_left_out_and_nothing_to_rank_is_undefined():
    nan = math.nan
    assert rank_agreement([1, nan, 2, 3, 9], [1, 5, 3, 2, nan]) == pytest.approx(1 / 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for a, b in (([1, 2], [nan, 1]), ([], []), ([1, 1, 1], [1, 2, 3])):
            assert math.isnan(rank_agreement(a, b))
