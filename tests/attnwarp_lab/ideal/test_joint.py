"""Oracles: every picture of all answers by Bayes' rule in float64, and the first ideal editor."""

import itertools

import numpy as np
import pytest
import torch

from attnwarp.editing.editor import drawn, edit
from attnwarp.editing.layers import hooked
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.methods.algorithms.attention_warping import inject
from attnwarp_lab.ideal.editor import Answers, IdealEditor, tokens_of
from attnwarp_lab.ideal.joint import IdealJointEditor

PARTS = [0, 1, -1, 1, 0, 1, 1, 0, 0]


def view(seed=0, answers=3):
    """A view of 12 x 12 px, 3 x 3 tokens."""
    random = np.random.default_rng(seed)
    before = random.random((12, 12, 3)).astype(np.float32)
    after = random.random((answers, 12, 12, 3)).astype(np.float32)
    return Answers(before, after, np.array(PARTS).reshape(3, 3))


def tokens(picture):
    return tokens_of(torch.from_numpy(picture).permute(2, 0, 1)[None]).double()


def test_the_velocity_is_that_of_the_posterior_mean_over_all_pictures():
    own, s = view(), 0.8
    editor = IdealJointEditor([own])
    editor.unet.double()
    noise = torch.randn(9, 48, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x = (1 - s) * tokens(own.after[1]) + 3 * s * noise
    mean, total = torch.zeros_like(x), 0.0
    pictures, logs = [], []
    for answers in itertools.product(range(3), repeat=2):
        picture = tokens(own.before)
        for token, part in enumerate(PARTS):
            if part >= 0:
                picture[token] = tokens(own.after[answers[part]])[token]
        pictures.append(picture)
        logs.append(-float((x - (1 - s) * picture).square().sum()) / (2 * s**2))
    for picture, log in zip(pictures, logs, strict=True):
        weight = np.exp(log - max(logs))
        mean, total = mean + weight * picture, total + weight
    task = editor.task([own.before], "")
    latents = x.T.reshape(1, 48, 3, 3)
    clean = editor.schedule.estimate(task.predict(latents, s), latents, s)
    assert (clean[0].flatten(1).T - mean / total).abs().max() < 1e-6


@pytest.mark.parametrize("injected", [False, True], ids=["alone", "injected"])
def test_it_edits_as_the_first_ideal_editor_does(injected):
    """A flow and a diffusion of one ratio of signal to noise take the same steps."""
    views = [view(0), view(1)]
    noise, pictures = drawn((1, 48, 3, 3), 4), []
    for editor in (IdealEditor(views, 0.02), IdealJointEditor(views, 0.02)):
        plan = RecordingPlan(editor.layers(), (3, 3), ("text",), 6)
        with record(editor, plan) as recording:
            first = edit(editor, [views[0].before], "red", steps=6, noise=noise)
        if not injected:
            pictures.append(first.images[0])
            continue
        with inject(editor, recording, weight=lambda t, T: 0.6 * (T - t) / T):
            pictures.append(edit(editor, [views[1].before], "red", steps=6, noise=-noise).images[0])
    np.testing.assert_allclose(pictures[0], pictures[1], atol=1e-4)  # float32 over six steps


def test_text_and_reference_keep_their_bits():
    editor, own, seen = IdealJointEditor([view()]), view(), {}
    handles = [
        editor.network.get_submodule(name).register_forward_hook(
            lambda m, a, out, n=name: seen.setdefault(n, []).append(out)
        )
        for name in ("pair", "stream")
    ]
    for hook in (lambda *_: None, lambda layer, tokens, call: 0 * tokens):
        with hooked(editor, editor.layers(), hook):
            edit(editor, [own.before], "red", steps=1, noise=drawn((1, 48, 3, 3), 4))
    for handle in handles:
        handle.remove()
    (plain, zeros), (line, empty) = seen["pair"], seen["stream"]
    assert (zeros[:, :9, :3] == 0).all()
    assert torch.equal(zeros[:, 9:], plain[:, 9:])
    assert torch.equal(empty[:, :3], line[:, :3])
    assert torch.equal(empty[:, 12:], line[:, 12:])
    assert (empty[:, 3:12, :48] == 0).all()
