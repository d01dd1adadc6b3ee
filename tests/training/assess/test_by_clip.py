"""Oracles: a judge that reads a look off its colour, and editors whose answers are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from attnwarp_eval.drawn.worlds import FINISHES, GROUNDS, TIMES
from training.assess import by_clip as editor_by_clip
from training.assess import editors as editor_assess
from training.assess.by_clip import by_clip_section, description, judgements
from training.assess.card_sections import Kept
from training.worlds.editing_pairs import GROUPS, LOOKS, SIZE, VIEWS, Worlds

ASKED = {}


@pytest.fixture
def worlds(monkeypatch):
    """Two worlds; each look is a grey of its own, and so are its attributes."""
    n = 2
    greys = np.arange(LOOKS, dtype=np.uint8)[:, None, None, None] * 8
    images = np.broadcast_to(greys, (n, VIEWS, LOOKS, SIZE, SIZE, 3)).copy()
    ids = np.ones((n, VIEWS, SIZE, SIZE), np.uint8)
    ids[:, :, 32:96, 32:96] = 0
    looks = np.broadcast_to(np.arange(LOOKS)[:, None], (n, LOOKS, 5)).copy()
    blank = np.zeros(n, np.int64)
    draw = editor_by_clip.draw_row

    def remember(pairs, world, kind, rng):
        ASKED["row"] = draw(pairs, world, kind, rng)
        return ASKED["row"]

    monkeypatch.setattr(editor_by_clip, "draw_row", remember)
    monkeypatch.setattr(editor_by_clip, "description", lambda look, *_: np.eye(LOOKS)[look[1]])
    # Sentences of made-up attributes there are none.
    for module in (editor_by_clip, editor_assess):
        monkeypatch.setattr(module, "instruction", lambda *_: "change it")
    return Worlds(images, np.ones((n, LOOKS), bool), blank, looks, blank, ids, blank, blank, blank)


def look_of(image):
    return round(float(image.mean()) * 255 / 8)


JUDGE = SimpleNamespace(images=lambda images: np.eye(LOOKS)[[look_of(i) for i in images]])
BLIND = SimpleNamespace(images=lambda images: np.ones((len(images), LOOKS)))


def answer(shift):
    """An editor that gives what was asked for, or another answer of its kind."""

    def edited(image, text, seed):
        row = ASKED["row"]
        group = next(group for group in GROUPS.values() if row.target in group)
        look = group[(row.target - group[0] + shift) % len(group)]
        return np.full_like(image, look * 8 / 255)

    return edited


@pytest.mark.parametrize(
    ("editor", "judge", "found", "true", "color"),
    [
        (answer(0), JUDGE, 1, 1, 1),
        (answer(1), JUDGE, 0, 1, 0),
        (lambda image, *_: image, JUDGE, 0, 1, 0),
        (answer(0), BLIND, 0, 0, 1),
    ],
    ids=["knows every answer", "gives another", "changes nothing", "by a judge that sees nothing"],
)
def test_the_editor_and_the_judge_score_what_they_know(
    worlds, tmp_path, editor, judge, found, true, color
):
    results = judgements(editor, worlds, judge, Kept(tmp_path / "a.json"), size=64, draws=1)
    assert [r.editor.what for r in results] == ["finish", "ground", "time of day"]
    for r in results:
        assert (r.editor.value, r.true.value, r.color.value) == (found, true, color)
        assert r.editor.count == 2
    # Of 7 grounds and 4 times one is the picture before.
    assert [r.editor.chance for r in results[1:]] == pytest.approx([1 / 6, 1 / 3])
    section = by_clip_section(results, worlds=2, draws=1)
    assert ("Short of what was asked for: finish; ground; time of day." in section) == (found == 0)


def test_further_draws_are_of_other_pictures_and_the_first_are_those_of_the_card(worlds, tmp_path):
    rows = []

    def note(image, text, seed):
        rows.append(ASKED["row"])
        return image

    judgements(note, worlds, JUDGE, Kept(tmp_path / "a.json"), size=64, draws=3)
    grounds = rows[6:12]
    assert len({(r.source, r.target, r.view, r.corner) for r in grounds[::2]}) == 3
    seen = []
    editor_assess.assess(
        lambda image, text, seed: seen.append(look_of(image)) or image,
        worlds, size=64, noises=0, kinds=("color", "ground"),
    )  # fmt: skip
    assert seen[2:] == [r.source for r in grounds[:2]]


def test_a_description_names_the_thing_and_what_the_edit_changes_alone():
    texts = []
    encoder = SimpleNamespace(texts=lambda t: texts.append(t) or np.eye(len(t)))
    look = np.array([0, FINISHES.index("golden"), -1, -1, GROUNDS.index("snow"), TIMES.index("night")])  # fmt: skip
    for kind in ("material", "ground", "time"):
        description(look, kind, encoder)
    for group, own in zip(texts, ("gold", "snow|winter", "night|moon|dark"), strict=True):
        for text in group:
            named = {word for word in ("gold", "snow|winter", "night|moon|dark") if any(w in text for w in word.split("|"))}  # fmt: skip
            assert named == {own}, text
            assert "ball" in text or "sphere" in text


def test_a_mean_of_sentences_weighs_each_the_same():
    encoder = SimpleNamespace(texts=lambda t: np.diag([1.0, 2.0, 3.0, 4.0]))
    look = np.array([0, 0, 0, -1, 0, 0])
    np.testing.assert_allclose(description(look, "ground", encoder), 0.25)
