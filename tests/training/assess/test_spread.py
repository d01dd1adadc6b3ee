"""Oracles: colours that are known by construction, counts and shares worked out by hand."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from training.assess import spread as editor_spread
from training.assess.card_sections import Kept
from training.assess.spread import NONE, answered, questions, spread_section
from training.worlds.editing_pairs import GROUPS, LOOKS, SIZE, VIEWS, Worlds

RGB = {"red": (220, 30, 30), "orange": (240, 140, 20), "yellow": (230, 220, 40), "green": (30, 180, 40)}  # fmt: skip


@pytest.fixture
def question():
    """About a square of one of four colours on grey; the first world's is too small to be asked about."""
    n = 2
    images = np.full((n, VIEWS, LOOKS, SIZE, SIZE, 3), 128, np.uint8)
    ids = np.ones((n, VIEWS, SIZE, SIZE), np.uint8)
    valid = np.zeros((n, LOOKS), dtype=bool)
    for world, box in enumerate((np.s_[:8, :8], np.s_[32:96, 32:96])):
        ids[world, :, *box] = 0
        for k, color in zip(GROUPS["color"], RGB.values(), strict=False):
            images[world, :, k, *box] = color
            valid[world, k] = True
    looks = np.broadcast_to(np.arange(LOOKS)[:, None], (n, LOOKS, 5)).copy()
    blank = np.zeros(n, np.int64)
    (one,) = questions(
        Worlds(images, valid, blank, looks, blank, ids, blank, blank, blank), 64, ["color"]
    )
    return one


def test_the_right_answers_go_by_their_names_and_the_picture_before_is_none(question):
    assert question.world == 1
    middle = {name: 255 * image[question.mask].mean(axis=0) for name, image in question.answers.items()}  # fmt: skip
    before = 255 * question.before[question.mask].mean(axis=0)
    (source,) = set(RGB) - set(question.answers)
    np.testing.assert_allclose(before, RGB[source], atol=0.01)
    for name, color in middle.items():
        np.testing.assert_allclose(color, RGB[name], atol=0.01)
        assert question.answer(question.answers[name]) == name
    assert question.answer(question.before) == NONE


def test_each_noise_is_counted_once_also_where_the_count_was_stopped(
    question, monkeypatch, tmp_path
):
    """A noise's seed decides the answer: of five in a row one changes nothing."""
    outcomes = [*question.answers.values(), question.answers["green"], question.before]
    first = {
        float(torch.randn((2, 8, 8), generator=torch.Generator().manual_seed(s))[0, 0, 0]): s
        for s in range(50)
    }
    seen = []

    def edit(editor, guides, text, *, steps, noise):
        assert text == question.text and all(g is question.before for g in guides)
        if len(seen) == 20:
            raise KeyboardInterrupt
        seeds = [first[float(one[0, 0, 0])] for one in noise]
        seen.extend(seeds)
        return SimpleNamespace(images=[outcomes[s % 5] for s in seeds])

    monkeypatch.setattr(editor_spread, "edit", edit)
    editor = SimpleNamespace(
        factor=8, vae=SimpleNamespace(config=SimpleNamespace(latent_channels=2))
    )
    with pytest.raises(KeyboardInterrupt):
        answered(editor, question, 50, Kept(tmp_path / "new" / "a.json"))
    seen.append(-1)
    said = []
    kept = Kept(tmp_path / "new" / "a.json", said.append)
    counts = answered(editor, question, 50, kept)
    assert 0 < len(said) < len(kept.results)  # what was kept is not told again
    assert sorted(seen) == list(range(-1, 50))
    others = dict.fromkeys(set(question.answers) - {"green"}, 10)
    assert counts == Counter({"green": 20, NONE: 10, **others})


@pytest.mark.parametrize(
    ("counts", "row"),
    [
        ((8, 8, 77, 0), "c 77.0 %, a 8.0 %, b 8.0 %, d 0.0 % | 7.0 % | 3 | no |"),
        ((8, 8, 60, 16), "c 60.0 %, d 16.0 %, a 8.0 %, b 8.0 % | 8.0 % | 4 | yes |"),
        ((7, 31, 31, 31), "b 31.0 %, c 31.0 %, d 31.0 %, a 7.0 % | 0.0 % | 3 | no |"),
    ],
)
def test_four_answers_of_eight_percent_are_enough_and_none_is_no_answer(counts, row):
    asked = SimpleNamespace(text="change it", world=3, answers=dict.fromkeys("abcd"))
    count = Counter(dict(zip("abcd", counts, strict=True)) | {NONE: 100 - sum(counts)})
    section = spread_section([asked], [count], size=64)
    assert section.splitlines()[-1] == f'| "change it" (3) | {row}'
    assert "100 noises" in section
