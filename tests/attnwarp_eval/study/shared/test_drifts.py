"""Planted drift, against pictures of a formula and against the drift that is measured."""

import numpy as np
import pytest
import torch

from attnwarp.drift import drift
from attnwarp.editing.small import load_editor
from attnwarp_eval.study.shared.drifts import DriftPart, drifting, moved
from benchmarks.drift import Formula


@pytest.mark.parametrize(
    "motion", [(3.3, -1.7, 0, 0), (0, 0, 2, 0), (0, 0, 0, -1.5), (8, 2, -1, 1)]
)
def test_a_moved_picture_is_the_formula_at_moved_coordinates(motion):
    formula = Formula(5)
    got, wanted = moved(formula.picture(96), motion), formula.picture(96, motion)
    # Cubic resampling errs at edges, by 0.03 at most; another sign or middle, by 0.05 in the mean.
    assert np.abs(got - wanted)[12:-12, 12:-12].mean() < 0.005


def test_an_editor_moves_each_picture_its_own_way_and_no_other_editor():
    editor = load_editor("small-plain")
    planted = DriftPart(shift=4)
    pictures = [Formula(k).picture(64).astype(np.float32) for k in (0, 1)]
    own = [planted.motion(picture, 0) for picture in pictures]
    assert [np.hypot(*motion[:2]) for motion in own] == pytest.approx([4, 4])
    assert own[0] != own[1] and own[0] == planted.motion(pictures[0], 0)
    tilted = drifting(editor, planted, 0)
    latents = torch.randn(tilted.task(pictures, "red").shape, generator=torch.Generator())
    got = tilted.task(pictures, "red").predict(latents, 500)
    by_hand = [moved(p, m) for p, m in zip(pictures, own, strict=True)]
    torch.testing.assert_close(got, editor.task(by_hand, "red").predict(latents, 500))
    assert drift(pictures[0], by_hand[0]).largest == pytest.approx(4, abs=0.1)
