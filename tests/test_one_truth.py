"""The weight and the blend of Algorithm 1 stand once: what is changed there changes in an edit, in a card of an editor and
in a hard case alike.
"""

import numpy as np
import pytest
from tiny_scenes import cameras, splats
from torch_threads import on_one_thread

from attnwarp.editing.small import load_editor
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.algorithms.attention_warping import a_t, blend
from attnwarp_eval.stability.cases.editing import CASES
from training.assess import carries

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def edited(editor, **changes):
    settings = preset("attention_warping", stages=1, steps=3, iterations=0, **changes)
    return attention_warping(splats(), cameras(2), None, editor, "red", settings).edited[1]


def carded(editor, **how):
    """A picture with features of itself in other colours, as a card of the editor asks."""
    rng = np.random.default_rng(0)
    pictures = rng.random((2, 32, 32, 3)).astype(np.float32)
    thing = np.ones((32, 32), bool)
    first, second = (carries.Case(0, 0, picture, [picture], thing) for picture in pictures)
    swap = carries.Swap(editor)
    noise = swap.noise([1, 2], pictures[0])
    _, recording = swap.recorded([first], noise[:1])
    return swap.injected(recording, [second], noise[1:], **how)[0]


def hard(level):
    """Error of the hard case of blends at a weight, over what it may be."""
    (case,) = (case for case in CASES if case.name == "blend_weight")
    (way,) = (w for w in case.ways if (w.backend, w.precision) == ("cpu", "float32"))
    return case.measure(level, way) / case.bounds["forward"].at(level)


def halved(t, T, s):
    return s.a0 / 2


def warped_away(warp, F_src, F_new, a):
    return F_new


@pytest.mark.parametrize("changed", [halved, warped_away])
def test_a_change_of_the_method_reaches_edits_cards_and_hard_cases(changed, monkeypatch):
    editor = load_editor("small-plain")
    monkeypatch.setattr(carries, "STEPS", 2)
    a = 0.45 if changed is halved else 0.0
    expected = edited(editor, a0=a, decay="constant"), carded(editor, weight=lambda t, T: a)
    assert hard(0.5) < 1 and (edited(editor) != expected[0]).any()
    method = a_t if changed is halved else blend
    monkeypatch.setattr(method, "__code__", changed.__code__)
    assert np.array_equal(edited(editor), expected[0])
    assert np.array_equal(carded(editor), expected[1])
    assert hard(0.5) > 1e3
