"""Oracle: editors whose answers follow from their guidance."""

from types import SimpleNamespace

import numpy as np

from training.assess import editors as editor_assess
from training.assess import guidance as editor_guidance
from training.assess.card_sections import Kept
from training.assess.guidance import GUIDANCES, figures_of, guidance_report, shown
from training.worlds.editing_pairs import LOOKS, SIZE, VIEWS, Worlds


def test_the_guidance_that_edits_is_told_from_those_that_do_not(monkeypatch, tmp_path):
    n, asked = 3, {}
    # Each look is a grey of its own; the second view of the last world shows nothing of the thing.
    greys = np.arange(LOOKS, dtype=np.uint8)[:, None, None, None] * 8
    images = np.broadcast_to(greys, (n, VIEWS, LOOKS, SIZE, SIZE, 3)).copy()
    ids = np.ones((n, VIEWS, SIZE, SIZE), np.uint8)
    ids[:, :, 32:96, 32:96] = 0
    ids[2, 1] = 1
    looks = np.broadcast_to(np.arange(LOOKS)[:, None], (n, LOOKS, 5)).copy()
    blank = np.zeros(n, np.int64)
    made = Worlds(images, np.ones((n, LOOKS), bool), blank, looks, blank, ids, blank, blank, blank)
    worlds = shown(made)
    assert len(worlds) == 2
    draw = editor_assess.draw_row

    def remember(pairs, world, kind, rng):
        row = draw(pairs, world, kind, rng)
        asked["picture"] = pairs.shown(row, row.target)
        return row

    def answers_of(editor):
        right = editor.text_guidance == 2.5 and editor.image_guidance == 1.0
        return lambda image, text, seed: asked["picture"] if right else image

    monkeypatch.setattr(editor_assess, "draw_row", remember)
    monkeypatch.setattr(editor_assess, "instruction", lambda *_: "change it")
    monkeypatch.setattr(editor_guidance, "answers_of", answers_of)
    editor = SimpleNamespace(text_guidance=1.5, image_guidance=1.0)
    kept = Kept(tmp_path / "kept.json")
    rows = figures_of(editor, worlds, kept, size=64)
    assert (editor.text_guidance, editor.image_guidance) == (1.5, 1.0)
    colors = [row[0].value for row in rows]
    assert colors == [float(guidance == (2.5, 1.0)) for guidance in GUIDANCES]
    monkeypatch.setattr(editor_guidance, "answers_of", None)  # nothing is asked twice
    assert figures_of(editor, worlds, Kept(kept.path), size=64) == rows
    text = guidance_report({"a": rows}, worlds=len(worlds))
    lines = [line for line in text.splitlines() if line.startswith("| `a` | ")]
    assert [line.split(" | ")[1] for line in lines] == [f"{t:g}, {p:g}" for t, p in GUIDANCES]
    assert ["**100 %**" in line.split(" | ")[2] for line in lines] == [bool(c) for c in colors]
