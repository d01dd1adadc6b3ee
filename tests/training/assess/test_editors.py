"""Oracles: pictures whose answer is known by construction, a closed form, an editor that knows every answer."""

import numpy as np
import pytest
from small_trainings import draw_pairs

from training.assess import editors as editor_assess
from training.assess.editors import assess, editor_card, unedited
from training.assess.judge import nearest, outside_psnr
from training.worlds.editing_pairs import GROUPS, load_pairs


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    folder = draw_pairs(tmp_path_factory.mktemp("pairs"), "edit-test")
    return load_pairs(folder, "edit-test", count=2)


def flat(*rgb):
    return np.broadcast_to(np.array(rgb, np.float32), (8, 8, 3)).copy()


def test_the_nearest_picture_is_judged_in_the_mask_alone():
    mask = np.zeros((8, 8), dtype=bool)
    mask[2:5, 2:6] = True
    answers = [flat(0.8, 0.1, 0.1), flat(0.1, 0.1, 0.8), flat(0.9, 0.9, 0.1)]
    for right, answer in enumerate(answers):
        image = answers[(right + 1) % 3].copy()  # another answer outside
        noise = np.random.default_rng(right).normal(0, 0.02, (8, 8, 3))
        image[mask] = np.clip(answer + noise, 0, 1)[mask]
        assert nearest(image, answers, mask) == right


def test_the_distance_outside_is_the_closed_form():
    mask = np.zeros((8, 8), dtype=bool)
    mask[:4] = True
    image = flat(0.5, 0.5, 0.5)
    image[mask] = 0
    image[~mask] += 0.1
    assert outside_psnr(image, flat(0.5, 0.5, 0.5), mask) == pytest.approx(20, abs=1e-4)


def test_an_editor_that_knows_every_answer_gets_all_and_one_that_changes_nothing_none_of_the_colours(
    worlds, monkeypatch
):
    asked = {}
    draw = editor_assess.draw_row

    def remember(pairs, world, kind, rng):
        row = draw(pairs, world, kind, rng)
        asked["pairs"], asked["row"] = pairs, row
        return row

    monkeypatch.setattr(editor_assess, "draw_row", remember)

    def knows(image, text, seed):
        row = asked["row"]
        assert np.allclose(image, asked["pairs"].shown(row, row.source))
        return asked["pairs"].shown(row, row.target)

    figures = {f.what: f for f in assess(knows, worlds, size=64, noises=2)}
    for what, found in figures.items():
        # Two looks of a held-out world may be of one colour only where the open instruction's source is the target.
        if what.startswith("nearest") or "26 dB" in what:
            assert found.value == 1, what
    control = {f.what: f for f in assess(unedited, worlds, size=64, noises=2)}
    assert control["nearest true color is the one asked for"].value == 0
    assert control["at least 26 dB to the picture before, outside the thing"].value == 1
    assert [v.value for k, v in control.items() if k.startswith("another colour")] == [0]
    facts = {
        "unet": 3.2, "text": 0.4, "size": 64, "steps": 10, "planned": 100, "batch": 8, "minutes": 5.0, "state": "Unfinished.",
        "injection": "none", "worlds": 2, "parts": 0, "before": 0, "large": 0, "device": "one CPU core", "tested": 2, "text_guidance": 1.5, "image_guidance": 1.0,
    }  # fmt: skip
    card = editor_card("small-plain", list(control.values()), list(control.values()), facts)
    assert "10 of 100 planned steps" in card
    both = editor_card(
        "small",
        list(figures.values()),
        list(control.values()),
        facts | {"parts": 3, "before": 1200, "large": 128},
    )
    assert "parts of those of" in both
    assert "after 1,200 of the stages before" in both and "and of 128 x 128 px" in both
    assert "of the stages before" not in card and "128" not in card
    assert "parts of those of" not in card
    assert "Short of what was asked for: nearest true color" in card
    assert set(GROUPS) >= {"color", "material", "ground", "time"}
