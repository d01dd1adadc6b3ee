"""Pictures of things with parts, and sentences about them. Oracles: the pixels that a part covers, the words read back."""

import re

import numpy as np
import pytest

from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    OBJECTS,
    STATUES,
    TIMES,
    TWO_COLORED,
    held_out,
)
from training.worlds.assemblies import WHOLE_NOUNS
from training.worlds.draw import HELD_OUT_SHAPE
from training.worlds.editing_pairs import PAIR_SPLITS, reserved
from training.worlds.part_captions import (
    Caption,
    caption_of,
    sentence,
    true_of,
    with_article,
    wrong,
)
from training.worlds.part_pictures import (
    GROUND,
    LOOKS,
    OTHER,
    PART_SPLITS,
    PARTS,
    SKY,
    PartPictures,
    PartSplit,
    dresses,
    load,
    part_world,
    render_part_world,
)
from training.worlds.words import HUES

SPLIT = PartSplit(95_000_000, 17)
"""Seeds that no recipe uses."""


@pytest.fixture(scope="module")
def made():
    return {k: render_part_world(k, SPLIT) for k in (KINDS.index("plant"), KINDS.index("house"))}


def test_only_the_pixels_of_a_changed_part_change(made):
    for k, row in made.items():
        names = list(part_world(k, SPLIT).pieces())
        for look in (1, 2):
            (changed,) = np.flatnonzero((row["surfaces"][0] != row["surfaces"][look]).any(axis=1))
            assert PARTS[changed] in names
            for view in range(2):
                differ = (row["images"][view, 0] != row["images"][view, look]).any(axis=-1)
                assert not differ[row["ids"][view] != changed].any()
        assert any((row["images"][v, 0] != row["images"][v, 1]).any() for v in range(2))


def test_what_pixels_show_are_parts_of_the_thing_the_ground_or_the_sky(made):
    for k, row in made.items():
        own = {PARTS.index(name) for name in part_world(k, SPLIT).pieces()}
        assert set(np.unique(row["ids"])) <= own | {GROUND, OTHER, SKY}
        assert own & set(np.unique(row["ids"]))
        known = row["surfaces"][:, sorted(own)]
        assert (known[..., 0] >= 0).all()
        assert (np.delete(row["surfaces"], sorted(own), axis=1) == -2).all()


@pytest.mark.parametrize("index", range(0, 60, 7))
def test_looks_differ_as_they_say_and_keep_colours_back(index):
    world = part_world(index, SPLIT)
    looks = dresses(world)
    assert len(looks) == LOOKS
    words = [[(p.finish, p.color, p.second) for p in look.parts] for look in looks]
    for k in (1, 2):
        assert sum(a != b for a, b in zip(words[0], words[k], strict=True)) == 1
        assert (looks[k].ground, looks[k].time) == (looks[0].ground, looks[0].time)
    assert len(set(words[3])) == 1
    assert words[4] == words[0]
    assert looks[4].ground == looks[0].ground or looks[4].time == looks[0].time
    assert dresses(world) == looks
    if world.kind in OBJECTS:
        thing = OBJECTS.index(world.kind)
        drawn = {c for look in words for surface in look for c in surface[1:] if c >= 0}
        assert not any(held_out(thing, c) for c in drawn)


def test_seeds_and_shapes_of_tests_are_not_those_of_any_training():
    spans = [
        range(s.first, s.first + s.worlds) for s in (*PART_SPLITS.values(), *PAIR_SPLITS.values())
    ]
    for k, one in enumerate(spans):
        for other in spans[k + 1 :]:
            assert one[-1] < other[0] or other[-1] < one[0]
    test, train = PART_SPLITS["parts-test"], PART_SPLITS["parts-train"]
    assert part_world(3, test).instance >= HELD_OUT_SHAPE + test.first
    assert part_world(3, train).instance < HELD_OUT_SHAPE + test.first


def test_a_split_is_rendered_once_and_read_again(tmp_path, monkeypatch):
    from training.worlds import data, part_pictures

    rows = {k: render_part_world(3, SPLIT) for k in range(2)}
    monkeypatch.setattr(part_pictures, "SHARD", 2)
    monkeypatch.setitem(PART_SPLITS, "tried", PartSplit(SPLIT.first, 2))
    monkeypatch.setattr(data, "ProcessPoolExecutor", _Here)
    monkeypatch.setattr(data, "as_completed", list)
    monkeypatch.setattr(part_pictures, "render_part_world", lambda k, _: rows[k])
    loaded = load(tmp_path, "tried")
    assert len(loaded) == 2 * 2 * LOOKS
    at = np.flatnonzero((loaded.world == 1) & (loaded.view == 1) & (loaded.look == 4))
    assert (loaded.images[at[0]] == rows[1]["images"][1, 4]).all()
    assert (loaded.ids[loaded.place[at[0]]] == rows[1]["ids"][1]).all()
    assert (loaded.surfaces[at[0]] == rows[1]["surfaces"][4]).all()
    share = (rows[1]["ids"][1] == PARTS.index("bark")).mean()
    assert loaded.shares[loaded.place[at[0]], PARTS.index("bark")] == pytest.approx(share)
    monkeypatch.setattr(part_pictures, "render_part_world", None)
    assert (load(tmp_path, "tried").images == loaded.images).all()


class _Here:
    """A pool that works in this process."""

    def __init__(self, _):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return False

    def submit(self, work, *given):
        value = work(*given)
        return type("Done", (), {"result": lambda _: value})()


# Sentences


def drawn(count, seed=0):
    """Pictures without pixels: random parts with random surfaces."""
    rng = np.random.default_rng(seed)
    surfaces = np.full((count, len(PARTS), 3), -2)
    for row in range(count):
        for part in rng.choice(len(PARTS), 4, replace=False):
            finish = int(rng.integers(len(FINISHES)))
            one, two = (int(c) for c in rng.choice(len(COLORS), 2, replace=False))
            name = FINISHES[finish]
            colored = name in ("plain", "shiny") or name in TWO_COLORED
            surfaces[row, part] = (
                finish,
                one if colored else -1,
                two if name in TWO_COLORED else -1,
            )
    zeros = np.zeros(count, dtype=np.int64)
    return PartPictures(
        np.zeros((count, 2, 2, 3), np.uint8), surfaces, rng.integers(len(KINDS), size=count), rng.integers(len(GROUNDS), size=count),
        rng.integers(len(TIMES), size=count), np.arange(count), zeros, zeros, np.arange(count), np.zeros((count, 2, 2), np.uint8),
        np.full((count, len(PARTS)), 0.1),
    )  # fmt: skip


def says(caption, kind, ground, time, surfaces):
    """Return True if a caption is true, read one condition at a time."""

    def is_like(said, shown):
        finish, color, second = (int(v) for v in shown)
        if said[0] == -1:
            return FINISHES[finish] in ("plain", "shiny") and color == said[1]
        return finish == said[0] and {color, second} == {said[1], said[2]}

    shown = {PARTS[p]: s for p, s in enumerate(surfaces) if s[0] >= 0}
    if (
        caption.kind not in (-1, kind)
        or caption.ground not in (-1, ground)
        or caption.time not in (-1, time)
    ):
        return False
    if caption.whole is not None and not all(is_like(caption.whole, s) for s in shown.values()):
        return False
    for part, said in caption.parts:
        names = set(PART_NOUNS[PARTS[part]])
        if not any(names & set(PART_NOUNS[name]) and is_like(said, s) for name, s in shown.items()):
            return False
    return True


def test_captions_are_true_of_their_pictures_and_changed_ones_as_the_loop_says():
    pictures = drawn(40)
    rng = np.random.default_rng(1)
    captions = [caption_of(pictures, row, pictures.shares[row], rng) for row in range(40)]
    captions += [wrong(c, rng) for c in captions]
    rows = np.arange(40)
    found = true_of(captions, pictures, rows)
    assert found[:, :40].diagonal().all()
    for row in rows:
        facts = (int(v[row]) for v in (pictures.kind, pictures.ground, pictures.time))
        facts = tuple(facts)
        expected = [says(c, *facts, pictures.surfaces[row]) for c in captions]
        assert found[row].tolist() == expected
    assert found[:, 40:].diagonal().mean() < 0.1


def test_a_part_that_is_hardly_seen_is_not_named():
    pictures = drawn(30)
    rng = np.random.default_rng(2)
    for row in range(30):
        shares = np.zeros(len(PARTS))
        seen = int(np.flatnonzero(pictures.surfaces[row, :, 0] >= 0)[0])
        shares[seen] = 0.3
        for _ in range(5):
            assert {p for p, _ in caption_of(pictures, row, shares, rng).parts} <= {seen}


def test_words_of_a_sentence_say_what_the_caption_says():
    rng = np.random.default_rng(3)
    for part in range(len(PARTS)):
        for color in range(len(COLORS)):
            caption = Caption(KINDS.index("car"), None, ((part, (-1, color, -1)),), 2, 1)
            text = sentence(caption, rng)
            assert any(re.search(rf"\b{n}\b", text) for n in PART_NOUNS[PARTS[part]])
            hues = (*HUES[COLORS[color]], "blond", "orange autumn")
            assert any(re.search(rf"\b{h}\b", text) for h in hues)
            assert any(n in text for n in WHOLE_NOUNS["car"])
            assert "snow" in text or "winter" in text
            assert "sunset" in text or "evening" in text or "dusk" in text


@pytest.mark.parametrize(
    ("noun", "adjective", "text"),
    [
        ("jacket", "red", "a red jacket"), ("jacket", "orange", "an orange jacket"), ("hair", "brown", "brown hair"),
        ("trousers", "", "trousers"), ("axe", "", "an axe"), ("mushrooms", "blue", "blue mushrooms"),
    ],
)  # fmt: skip
def test_articles(noun, adjective, text):
    assert with_article(noun, adjective) == text


def test_statues_are_of_every_material_and_no_sentence_is_one_of_the_scenes():
    rng = np.random.default_rng(4)
    texts = []
    for name in STATUES:
        surface = (FINISHES.index(name), -1, -1)
        texts += [sentence(Caption(k, surface), rng) for k in range(len(KINDS)) for _ in range(5)]
    assert any(" statue of a" in t for t in texts) and any(" sculpture of a" in t for t in texts)
    pictures = drawn(300, seed=5)
    texts += [sentence(caption_of(pictures, k, pictures.shares[k], rng), rng) for k in range(300)]
    assert not reserved() & {t.lower() for t in texts}
