"""Oracles: worlds and editors whose answers are known by construction, NumPy's own roll."""

import numpy as np
import pytest
import torch

from attnwarp.editing.injection import Identity
from attnwarp.editing.small import load_editor
from training.assess import carries as editor_carries
from training.assess.card_sections import Kept
from training.assess.carries import (
    Displaced,
    Swap,
    Within,
    carried_section,
    cases_of,
    swap_figures,
    warped_figure,
)
from training.worlds.editing_pairs import GROUPS, LOOKS, SIZE, VIEWS, Worlds

COLORS = np.array([[220, 30, 30], [30, 30, 220], [30, 180, 40], [230, 220, 40]], np.uint8)


@pytest.fixture
def worlds():
    """Three worlds, seen twice from one camera: a square of a colour on grey, at one depth."""
    n = 3
    images = np.full((n, VIEWS, LOOKS, SIZE, SIZE, 3), 128, np.uint8)
    ids = np.ones((n, VIEWS, SIZE, SIZE), np.uint8)
    box = np.s_[32:96, 32:96]
    ids[:, :, *box] = 0
    valid = np.zeros((n, LOOKS), dtype=bool)
    for k, color in zip(GROUPS["color"], COLORS, strict=False):
        images[:, :, k, *box] = color
        valid[:, k] = True
    K = np.array([[128.0, 0, 64], [0, 128, 64], [0, 0, 1]])
    return Worlds(
        images, valid, np.zeros(n, np.int64), np.zeros((n, LOOKS, 5), np.int64), np.zeros(n, np.int64), ids,
        np.full((n, VIEWS, SIZE, SIZE), 2.0, np.float32), np.broadcast_to(K, (n, VIEWS, 3, 3)).copy(),
        np.broadcast_to(np.eye(4), (n, VIEWS, 4, 4)).copy(),
    )  # fmt: skip


class Scripted:
    """Stands where an editor's runs stand: paints the thing in colours that its seed picks.

    Args:
        obeys: effect of injected features: "carry" them where they go, "ignore" them, or paint their colour
            "anywhere".
    """

    def __init__(self, obeys):
        self.obeys = obeys

    def noise(self, seeds, before):
        return torch.tensor([[float(s % 2)] for s in seeds])

    def answers(self, cases, noise):
        # Every odd noise answers another colour than every even one.
        return [case.answers[1 + int(v)] for case, v in zip(cases, noise[:, 0], strict=True)]

    def run(self, cases, noise):
        return self.answers(cases, noise)

    def recorded(self, cases, noise):
        return self.answers(cases, noise), (cases, noise)

    def injected(self, recording, cases, noise, *, warp=None, weight=None):
        own, given = self.answers(cases, noise), self.answers(*recording)
        if self.obeys == "ignore":
            return own
        mask = np.ones(own[0].shape[:2], bool)
        if isinstance(warp, Within) and self.obeys != "anywhere":
            mask = warp.mask.numpy()
        if isinstance(warp, Displaced):
            given = [np.roll(g, 8, axis=1) for g in given]
        return [np.where(mask[:, :, None], g, o) for g, o in zip(given, own, strict=True)]


@pytest.mark.parametrize(
    ("obeys", "same", "follows", "keeps"),
    [("carry", 1, 1, 1), ("ignore", 0, 0, 1), ("anywhere", 1, 1, 0)],
)
def test_features_that_carry_the_answer_and_where_score_so(
    worlds, monkeypatch, obeys, same, follows, keeps
):
    cases = cases_of(worlds, 64)
    monkeypatch.setattr(editor_carries, "cases_of", lambda worlds, size, number=0: cases)
    monkeypatch.setattr(editor_carries, "Swap", lambda editor: Scripted(obeys))
    figures = swap_figures(None, worlds, size=64, pairs=2)
    assert [f.value for f in figures[:4]] == [same, same, follows, keeps]


def test_rounds_of_other_pictures_go_on_until_every_question_has_as_many_pairs_as_asked(
    worlds, monkeypatch, tmp_path
):
    """Six pictures answer two colours in each round; a stopped run takes up its rounds again."""
    drawn = {n: cases_of(worlds, 64, n) for n in range(5)}
    befores = {tuple(tuple(c.before[32, 32]) for c in cases) for cases in drawn.values()}
    assert len(befores) == 5
    monkeypatch.setattr(editor_carries, "cases_of", lambda worlds, size, number: drawn[number])
    ran = []

    class Counted(Scripted):
        def recorded(self, cases, noise):
            ran.append(len(cases))
            if len(ran) == 2:
                raise KeyboardInterrupt
            return super().recorded(cases, noise)

    monkeypatch.setattr(editor_carries, "Swap", lambda editor: Counted("carry"))
    path = tmp_path / "kept.json"
    with pytest.raises(KeyboardInterrupt):
        swap_figures(None, worlds, size=64, pairs=8, kept=Kept(path))
    figures = swap_figures(None, worlds, size=64, pairs=8, kept=Kept(path))
    counts = {f.what: f.count for f in figures}
    assert min(counts.values()) >= 8
    rounds = len(ran) - 1
    assert counts["features of the same picture make it their colour"] == 6 * rounds
    # One round less would not have been enough; features of another picture are asked about least.
    least = min(counts.values())
    assert least - 6 < 8
    section = carried_section(figures, 8)
    assert "At least 8 swaps" in section and f"| {least} |" in section


def test_an_editor_that_never_answers_comes_to_an_end(worlds, monkeypatch):
    class Silent(Scripted):
        def answers(self, cases, noise):
            return [case.before for case in cases]

    cases = cases_of(worlds, 64)[:2]
    monkeypatch.setattr(editor_carries, "cases_of", lambda worlds, size, number: cases)
    monkeypatch.setattr(editor_carries, "MOST_ROUNDS", 2)
    monkeypatch.setattr(editor_carries, "Swap", lambda editor: Silent("carry"))
    assert swap_figures(None, worlds, size=64, pairs=5) == []


@pytest.mark.parametrize(("obeys", "clear"), [("carry", 1), ("ignore", 0)])
def test_a_warp_that_is_displaced_is_told_from_the_true_one(worlds, monkeypatch, obeys, clear):
    cases = cases_of(worlds, 64)
    monkeypatch.setattr(editor_carries, "cases_of", lambda worlds, size, number=0: cases)
    monkeypatch.setattr(editor_carries, "Swap", lambda editor: Scripted(obeys))
    figure = warped_figure(None, worlds, size=64, noises=3)
    assert (figure.value, figure.count) == (clear, 3)


def test_the_noise_draws_an_answer_over_the_thing_alone(worlds):
    """Noise outside the things draws nothing: what it is there, the pooled noise is the same."""
    editor = load_editor("small-plain")
    pooled, draw = [], editor.unet.draw
    width = editor.vae.config.latent_channels
    draw.register_forward_pre_hook(lambda _, given: pooled.append(given[0][:, :width].clone()))
    swap, cases = Swap(editor), cases_of(worlds, 64)[:2]
    noise = swap.noise([1, 2], cases[0].before)
    other = noise.clone()
    other[:, :, :4] += 1  # the thing is a square of 32 px in the middle of 64
    swap.run(cases, noise)
    first = pooled[0]
    pooled.clear()
    swap.run(cases, other)
    assert torch.allclose(pooled[0], first, atol=1e-5)
    inside = noise[:, :, 4:12, 4:12].sum((2, 3)) / 8
    assert torch.allclose(first[:2], inside, atol=1e-4)


def test_a_displaced_warp_reads_an_eighth_to_the_left():
    grid = np.random.default_rng(1).normal(size=(1, 8, 16, 3)).astype(np.float32)
    tokens = torch.from_numpy(grid.reshape(1, 128, 3))
    moved = Displaced(Identity()).at((8, 16)).warp_tokens(tokens)
    assert np.array_equal(moved.numpy().reshape(grid.shape), np.roll(grid, 2, axis=2))


def test_things_that_are_too_small_are_left_out(worlds):
    worlds.ids[1] = 1
    worlds.ids[1, 0, :4, :4] = 0
    assert {(c.world, c.view) for c in cases_of(worlds, 64)} == {(0, 0), (0, 1), (2, 0), (2, 1)}
