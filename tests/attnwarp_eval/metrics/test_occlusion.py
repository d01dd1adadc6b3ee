"""Scores of masks by hand, against a loop over pixels, and the undefined cases."""

import math

import numpy as np
import pytest

from attnwarp_eval import metrics
from attnwarp_eval.metrics.occlusion import COUNTS
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, NONE, VISIBLE


def case(seed=0, shape=(40, 50)):
    rng = np.random.default_rng(seed)
    label = rng.integers(0, 4, shape)
    surface = (label != NONE) | (rng.random(shape) < 0.5)
    behind = (label == NONE) & surface & (rng.random(shape) < 0.5)
    return rng.random(shape) < 0.5, label, surface, behind, rng.random(shape) < 0.3


def test_counts_agree_with_a_loop_over_pixels():
    accepted, label, surface, behind, edge = case()
    expected = dict.fromkeys(COUNTS, 0)
    for i in range(label.shape[0]):
        for j in range(label.shape[1]):
            if not edge[i, j]:
                continue
            verb = "accepted" if accepted[i, j] else "rejected"
            name = {VISIBLE: "visible", HIDDEN: "hidden", AMBIGUOUS: "ambiguous"}.get(label[i, j])
            if name is None:
                name = "outside" if surface[i, j] else "empty"
            if f"{name}_{verb}" in expected:
                expected[f"{name}_{verb}"] += 1
            if behind[i, j]:
                expected[f"behind_{verb}"] += 1
    assert metrics.confusion(accepted, label, surface, behind, edge) == expected


def test_scores_of_a_case_by_hand():
    label = np.array(
        [[VISIBLE, VISIBLE, VISIBLE, VISIBLE, HIDDEN, HIDDEN, NONE, NONE, NONE, AMBIGUOUS]]
    )
    surface = np.array([[True] * 8 + [False, True]])
    behind = np.array([[False] * 7 + [True, False, False]])
    accepted = np.array([[True, True, True, False, True, False, False, True, True, True]])
    got = metrics.mask_error(accepted, label, surface, behind)
    # Accepted and scored: 3 visible, 1 hidden, 1 outside and behind, 1 empty.
    assert got["occlusion.precision"] == 3 / 6
    assert got["occlusion.recall"] == 3 / 4
    assert got["occlusion.f1"] == pytest.approx(2 * 3 / (2 * 3 + 3 + 1))
    assert got["occlusion.false_positive_rate"] == 2 / 4
    assert got["occlusion.false_negative_rate"] == 1 / 4
    assert got["occlusion.behind_share"] == 1 / 6
    assert got["occlusion.hidden_share"] == 1 / 6
    assert got["occlusion.ambiguous_accepted"] == 1
    assert got["occlusion.outside_accepted"] == 1


def test_interior_and_edge_add_up_to_the_whole():
    accepted, label, surface, behind, edge = case(2)
    got = metrics.mask_error(accepted, label, surface, behind, edge)
    for name in COUNTS:
        parts = got[f"occlusion.{name}.interior"] + got[f"occlusion.{name}.edge"]
        assert got[f"occlusion.{name}"] == parts


def test_a_view_that_shows_nothing_of_the_source_has_no_score():
    # Hard cases 8 and 35: never 0 for something that cannot be measured.
    label = np.full((4, 4), HIDDEN)
    surface = np.ones((4, 4), bool)
    empty = metrics.mask_error(np.zeros((4, 4), bool), label, surface)
    for name in ("precision", "recall", "f1", "false_negative_rate", "behind_share"):
        assert math.isnan(empty[f"occlusion.{name}"])
    assert empty["occlusion.false_positive_rate"] == 0
    wrong = metrics.mask_error(np.ones((4, 4), bool), label, surface)
    assert (
        wrong["occlusion.precision"] == 0
    )  # what was accepted can be judged, and all of it is wrong
    assert wrong["occlusion.false_positive_rate"] == 1
    assert math.isnan(wrong["occlusion.f1"])
    assert math.isnan(wrong["occlusion.recall"])
    background = metrics.mask_error(np.zeros((4, 4), bool), np.zeros((4, 4), int), ~surface)
    assert all(
        math.isnan(v)
        for k, v in background.items()
        if k in metrics.METRICS and not isinstance(v, int)
    )


def test_yaw_bins_sum_counts_before_they_score():
    few = dict.fromkeys(COUNTS, 0) | {"visible_accepted": 1, "visible_rejected": 1}
    many = dict.fromkeys(COUNTS, 0) | {"visible_accepted": 98, "hidden_accepted": 49}
    got = metrics.by_yaw(
        [(-10, few), (350, many), (15, many), (180, few), (-180, few)], edges=(0, 15, 90, 180)
    )
    assert [(b.low, b.high, b.views) for b in got] == [(0, 15, 2), (15, 90, 1), (90, 180, 2)]
    assert got[0].counts["visible_accepted"] == 99
    assert got[0].scores["occlusion.recall"] == 99 / 100  # and not the mean of 1/2 and 1
    assert got[1].scores["occlusion.precision"] == 98 / 147
    nothing = metrics.by_yaw([])
    assert [b.views for b in nothing] == [0] * 7
    assert all(math.isnan(v) for b in nothing for v in b.scores.values())


def test_bad_input_is_refused_by_name():
    accepted, label, surface, _, _ = case()
    strange = np.concatenate([label[:-1], np.full((1, 50), 9)])
    with pytest.raises(ValueError, match=r"label: got values \[0, 1, 2, 3, 9\], expected 0 to 3"):
        metrics.confusion(accepted, strange, surface)
    with pytest.raises(ValueError, match="accepted: got uint8, expected bool"):
        metrics.confusion(accepted.astype(np.uint8), label, surface)
    with pytest.raises(ValueError, match="edges: got"):
        metrics.by_yaw([], edges=(0, 90))
