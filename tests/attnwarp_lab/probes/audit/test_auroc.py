"""Areas under ROC curves against torchmetrics and scipy, and the coverage of their intervals."""

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu, norm
from torchmetrics.functional.classification import binary_auroc

from attnwarp_lab.probes.audit.auroc import auroc


def by_scene(values, scenes):
    return {f"s{k}": list(part) for k, part in enumerate(np.array_split(values, scenes))}


def test_it_is_torchmetrics_area_and_mann_whitneys_u_with_ties():
    random = np.random.default_rng(0)
    flawed, right = random.integers(0, 6, 40) / 4 + 0.5, random.integers(0, 6, 60) / 4
    result = auroc([(by_scene(flawed, 8), by_scene(right, 8))])
    scores = np.concatenate([flawed, right])
    area = binary_auroc(torch.from_numpy(scores / scores.max()), torch.tensor([1] * 40 + [0] * 60))
    assert result.value == pytest.approx(float(area), abs=1e-6)
    assert result.value == pytest.approx(mannwhitneyu(flawed, right).statistic / 2400)
    assert result.low < result.value < result.high


def test_groups_are_averaged_and_never_compared_with_one_another():
    low, high = {"a": [1.0], "b": [1.0]}, {"a": [9.0], "b": [9.0]}
    seen = auroc([(high, low), ({"a": [90.0], "b": [90.0]}, high)])
    assert seen.value == 1.0
    assert auroc([(high, low), (low, high)]).value == 0.5


def test_undefined_values_are_left_out():
    result = auroc([({"a": [2.0, np.nan]}, {"a": [1.0, np.nan, 0.0]})])
    assert result.value == 1.0
    assert np.isnan(auroc([({"a": [np.nan]}, {"a": [1.0]})]).value)
    assert np.isnan(result.low)  # one scene says nothing about others


@pytest.mark.slow
def test_the_interval_covers_the_true_area():
    random = np.random.default_rng(1)
    true, covered = float(norm.cdf(1 / np.sqrt(2 * (1 + 1)))), 0
    for seed in range(200):
        own = random.normal(0, 1, 24)  # of a scene, in all of its values
        flawed, right = (
            {f"s{k}": list(own[k] + shift + random.normal(0, 1, 2)) for k in range(24)}
            for shift in (1.0, 0.0)
        )
        result = auroc([(flawed, right)], seed=seed)
        covered += result.low <= true <= result.high
    assert covered >= 176  # of 190 expected, at 3 standard errors of what percentiles reach
