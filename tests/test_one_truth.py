"""The weight and the blend of Algorithm 1 stand once: what is changed there changes in an edit and in a hard case alike."""

import numpy as np
import pytest
from tiny_scenes import cameras, splats
from torch_threads import on_one_thread

from attnwarp.editing.small import load_editor
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.algorithms.attention_warping import a_t, blend
from attnwarp_eval.stability.cases.editing import CASES

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def edited(editor, **changes):
    settings = preset("attention_warping", stages=1, steps=3, iterations=0, **changes)
    return attention_warping(splats(), cameras(2), None, editor, "red", settings).edited[1]


def hard(level):
    """Error of the hard case of blends at a weight, over what it may be."""
    (case,) = (case for case in CASES if case.name == "blend_weight")
    (way,) = (w for w in case.ways if (w.backend, w.precision) == ("cpu", "float32"))
    return case.measure(level, way) / case.bounds["forward"].at(level)


def halved(t, T, s, kind=None):
    return s.a0 / 2


def warped_away(warp, F_src, F_new, a):
    return F_new


@pytest.mark.parametrize("changed", [halved, warped_away])
def test_a_change_of_the_method_reaches_edits_and_hard_cases(changed, monkeypatch):
    editor = load_editor("small-plain")
    a = 0.45 if changed is halved else 0.0
    expected = edited(editor, a0=a, decay="constant")
    assert hard(0.5) < 1 and (edited(editor) != expected).any()
    method = a_t if changed is halved else blend
    monkeypatch.setattr(method, "__code__", changed.__code__)
    assert np.array_equal(edited(editor), expected)
    assert hard(0.5) > 1e3
