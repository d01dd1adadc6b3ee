"""Oracles: one batch of source and view under GaussCtrl's alignment, a mask counted by a loop."""

from contextlib import ExitStack

import numpy as np
import pytest
import torch
from edit_folders import Watched

from attnwarp.editing.editor import edit
from attnwarp.editing.layers import choose_layers
from attnwarp.editing.small import load_editor
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.attention import aligned, self_attention
from attnwarp.methods.unseen import attending, kept_tokens, unseen_of
from attnwarp.warp import Surface, warp_surfaces

STEPS = 2


@pytest.fixture(scope="module")
def editor():
    return load_editor("small-plain")  # trained, so that it does not amplify rounding


def edited(editor, views, *contexts):
    with ExitStack() as stack:
        made = [stack.enter_context(context) for context in contexts]
        return made, edit(editor, views, "a bear", steps=STEPS, seed=3).latents


@pytest.fixture(scope="module")
def of_source(scene, editor):
    """The pictures of three views, the chosen layers, and the first view's kept tokens."""
    pictures = [scene[2][k] for k in range(3)]
    layers = choose_layers(editor.layers(), kinds=("self",))
    (kept,), latents = edited(
        editor, pictures[:1], kept_tokens(editor.network, layers, torch.float32, range(STEPS))
    )
    assert torch.equal(latents, edited(editor, pictures[:1])[1])  # keeping changes no bit
    return pictures, layers, kept


def attended(editor, of_source, shares):
    pictures, layers, kept = of_source
    size = editor.noise_shape(pictures[0].shape[:2])[1:]
    unseen = [lambda size, share=share: torch.full(size, share) for share in shares]
    context = attending(editor.network, layers, size, kept, unseen, range(STEPS))
    return edited(editor, pictures[1 : 1 + len(shares)], context)[1]


def test_nothing_unseen_changes_no_bit(editor, of_source):
    plain = edited(editor, of_source[0][1:])[1]
    assert torch.equal(attended(editor, of_source, [0.0, 0.0]), plain)


def test_all_unseen_equals_the_alignment_of_gaussctrl_with_one_reference(editor, of_source):
    pictures, layers, _ = of_source
    names, rule = {layer.name for layer in layers}, aligned(1, 0.0, len(editor.branches))

    def chosen(name, tokens, attend):
        return rule(name, tokens, attend) if name in names else attend(tokens, None)

    expected = edited(editor, pictures, self_attention(editor.network, chosen))[1][1:]
    got = attended(editor, of_source, [1.0, 1.0])
    plain = edited(editor, pictures[1:])[1]
    assert (got - expected).abs().max() < 1e-4 < (got - plain).abs().max()


def test_a_view_that_sees_all_stays_beside_one_that_does_not(editor, of_source):
    both = attended(editor, of_source, [0.0, 1.0])
    plain, all_unseen = edited(editor, of_source[0][1:])[1], attended(editor, of_source, [1.0, 1.0])
    assert (both[0] - plain[0]).abs().max() < 1e-5
    assert (both[1] - all_unseen[1]).abs().max() < 1e-5


def test_tokens_are_unseen_where_no_warp_reaches_the_marked_part(scene):
    _, cameras, _ = scene
    shape = cameras[0].height, cameras[0].width
    flat = Surface(np.full(shape, 3.0), np.broadcast_to([0.0, 0, 1], (*shape, 3)))
    warp, draw = warp_surfaces(cameras[0], cameras[2], flat, flat), np.random.default_rng(0)
    reached, marked = draw.random(shape) < 0.3, draw.random(shape) < 0.5
    got = unseen_of(warp.with_mask(torch.from_numpy(reached)), marked)(shape)
    defined = warp.correspondence.defined.numpy()
    assert np.array_equal(got.numpy(), marked & ~(reached & defined))


def test_an_edit_attends_only_if_something_is_marked(scene, editor):
    model, cameras, pictures = scene
    settings = preset("attention_warping", stages=1, steps=STEPS, iterations=0)
    marks = [np.ones(picture.shape[:2], bool) for picture in pictures]

    def result(unseen, segments):
        changed = settings.changed(unseen=unseen, composite="none")
        return attention_warping(
            model, cameras, pictures, editor, "a bear", changed, segments=segments
        ).edited

    free, attend = result("free", marks), result("attend", marks)
    assert np.array_equal(free[0], attend[0])  # the source attends to itself anyway
    assert any(not np.array_equal(free[k], attend[k]) for k in free)
    unmarked = result("free", None), result("attend", None)
    assert all(np.array_equal(unmarked[0][k], unmarked[1][k]) for k in free)


def test_without_self_attention_unseen_parts_stay_free_and_that_is_said(scene, editor):
    model, cameras, pictures = scene
    told, edits = [], []
    marks = [np.ones(picture.shape[:2], bool) for picture in pictures]
    for unseen in ("free", "attend"):
        settings = preset(
            "attention_warping", stages=1, steps=1, iterations=0, kinds=("cross",), unseen=unseen
        )
        edits.append(
            attention_warping(
                model, cameras, pictures, editor, "a bear", settings, segments=marks,
                report=Watched(log=told.append),
            ).edited
        )  # fmt: skip
    assert all(np.array_equal(edits[0][k], edits[1][k]) for k in edits[0])
    assert sum(line.startswith("unseen: marked parts") for line in told) == 1
