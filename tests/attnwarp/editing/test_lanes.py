"""Oracles: the parts edited one after the other in one thread, identity of tensors."""

import threading
import time
from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest
import torch

from attnwarp.editing.editor import edit
from attnwarp.editing.lanes import editors_for, parts_for, side_by_side
from attnwarp.editing.small import load_editor


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_parts_side_by_side_have_the_bits_of_parts_in_turn(two_threads):
    editor = load_editor("small-plain")
    views = np.random.default_rng(0).random((3, 32, 32, 3), dtype=np.float32)
    editors, parts = editors_for(editor, 3), parts_for(3, 2)

    def job(one, part, step):
        return edit(one, [*views[part]], "make it red", steps=2, on_step=lambda *_: step()).images

    steps = []
    found = side_by_side([*map(partial, [job] * 2, editors, parts)], lambda: steps.append(1))
    assert len(steps) == 2
    assert torch.get_num_threads() == 2
    torch.set_num_threads(1)
    expected = [*job(editor, slice(0, 2), int), *job(editor, slice(2, 3), int)]
    np.testing.assert_array_equal(found, expected)


def test_copies_share_weights_but_no_hooks(two_threads):
    editor = load_editor("small-plain")
    editor.text_guidance = 3.0
    _, copy = editors_for(editor, 2)
    assert copy.text_guidance == 3.0
    handle = editor.network.register_forward_hook(lambda *_: None)
    assert not copy.network._forward_hooks
    handle.remove()
    for own, other in zip(editor.network.parameters(), copy.network.parameters(), strict=True):
        assert own is other


@pytest.mark.parametrize("change", ["forward", "compiled", "lock", "autocast", "low memory"])
def test_an_editor_that_a_copy_would_not_equal_stays_alone(two_threads, change):
    editor = load_editor("small-plain", low_memory=change == "low memory")
    around = nullcontext()
    if change == "forward":
        forward = editor.unet.forward
        editor.unet.forward = lambda *given, **named: forward(*given, **named)
    elif change == "compiled":
        editor.unet.compile(backend="eager")
    elif change == "lock":
        editor.lock = threading.Lock()
    elif change == "autocast":
        around = torch.autocast("cpu", torch.bfloat16)
    with around:
        assert editors_for(editor, 2) == [editor]


def test_an_interrupted_part_ends_the_others(two_threads):
    ended, began = threading.Event(), threading.Event()

    def endless(step):
        began.set()
        try:
            for _ in range(2000):
                time.sleep(0.005)
                step()
        except InterruptedError:
            ended.set()
            raise

    def interrupted(step):
        began.wait(10)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        side_by_side([interrupted, endless], int)
    assert ended.is_set()
    assert torch.get_num_threads() == 2


def test_the_fault_of_a_part_beside_is_raised(two_threads):
    def faulty(step):
        raise ValueError("guides: too small")

    with pytest.raises(ValueError, match="guides: too small"):
        side_by_side([lambda step: [1], faulty], int)
