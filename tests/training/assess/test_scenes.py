"""Oracle: the true results themselves, handed in as an editor's answers."""

import numpy as np
import pytest

from attnwarp_eval.study.edit_truth import edit_truth
from attnwarp_eval.world import world
from training.assess import scenes as editor_scenes
from training.assess.scenes import scene_answers


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(editor_scenes, "VIEWS", 1)
    monkeypatch.setattr(editor_scenes, "SAMPLES", 4)


@pytest.mark.slow
def test_a_true_result_is_right_and_the_view_as_it_is_is_not():
    size = 32
    of = world("bear", size)
    view = next(iter(of.targets))
    edits = {e.instruction: e.name for e in of.scene.spec.edits}

    def oracle(image, sentence, seed):
        truth = edit_truth("bear", size, 4, edits[sentence], (view,))
        assert np.array_equal(image, truth.originals[view])
        return next(iter(truth.answers.values()))[view]

    answers = scene_answers(oracle, size=size, scenes=["bear"])
    assert len(answers.asked) == len(edits)
    assert all(answers.asked)
    # Another edit's truth is that edit's, so never the one that was asked for.
    assert not any(answers.wrong)
    unedited = scene_answers(lambda image, *_: image, size=size, scenes=["bear"])
    assert unedited.asked == unedited.unedited
    # Eleven results, six of them of the open edit.
    assert sorted(set(answers.chance)) == pytest.approx([1 / 11, 6 / 11])
