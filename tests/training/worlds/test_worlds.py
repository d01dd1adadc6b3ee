"""Oracles: Mitsuba's pictures of the same worlds, truth by brute force over words, and what may
never be drawn.
"""

import re

import numpy as np
import pytest

from attnwarp_eval.colors import to_linear
from attnwarp_eval.drawn import worlds
from attnwarp_eval.drawn.objects import RECIPES, body
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, OBJECTS, TIMES, Look, held_out
from attnwarp_eval.truth.mitsuba import render_plan
from attnwarp_eval.truth.plan import plan
from training.editors.depth import reserved_prompts
from training.encoders.clip import make_tokenizer, true_of, wrong
from training.worlds import render, words
from training.worlds.data import SPLITS, looks_of
from training.worlds.draw import HELD_OUT_SHAPE, attributes, change, draw_look, draw_world
from training.worlds.editing_pairs import reserved
from training.worlds.words import captioned, sentence


def _look(rng, **said):
    base = draw_look(0, rng, pairs="any")
    fields = {
        "finish": 0,
        "color": 0,
        "second": -1,
        "ground": base.ground,
        "time": base.time,
        "seed": base.seed,
    }
    return Look(**(fields | said))


@pytest.mark.parametrize("word", RECIPES)
def test_every_thing_stands_on_the_ground_and_is_about_a_unit_wide_or_tall(word):
    from attnwarp_eval.scene.bodies import BodySpec

    for instance in (0, 1, 100_000):
        low, high = BodySpec.model_validate(body(word, instance, resolution=40)).mesh().bounds()
        assert -0.5 < low[2] < 0.1
        assert 0.15 < high[2] < 1.6
        assert np.abs([low[:2], high[:2]]).max() < 1.7
    assert body(word, 3) == body(word, 3)
    assert len({str(body(word, k)) for k in range(12)}) > 5


LEARNT = {
    *(f"a photo of a {c} bear in a garden" for c in ("blue", "green", "red", "violet", "yellow")),
    "a photo of an orange bear in a garden", "a photo of a bronze statue of a bear in a garden",
    *(f"a photo of a {c} stegosaurus" for c in ("blue", "pink", "red", "yellow")),
    "a photo of a green stegosaurus in a clearing", "a photo of a steel sculpture of a stegosaurus in a clearing",
    "a photo of a stone statue of a stegosaurus in a clearing",
    "a photo of a bronze bust of a man", "a photo of a marble bust of a man",
    "a photo of a person in a park", "a photo of a person in a park by day",
    "a photo of a person in a park on a moonlit night", "a photo of a golden statue of a person in a park",
    "a photo of a table in a garden at dusk", "a photo of a table in a garden by day",
    "a photo of a white marble table in a garden", "a photo of a wooden table in a garden",
    "a photo of a tree stump in the snow",
}  # fmt: skip
"""The scenes' sentences that captions of worlds can be, word for word: clip-small and clip-parts may
have learnt from them."""


def captions_pattern():
    """A regular expression of all captions, from the tables of words alone."""

    def one(words):
        return f"(?:{'|'.join(sorted(map(re.escape, words), key=len, reverse=True))})"

    def every(table):
        return one(word for words in table.values() for word in words)

    hue = every(words.HUES)
    surface = (
        f"(?:{hue}|(?:shiny|glossy|polished) {hue}|{hue} plastic|{hue} and {hue}"
        " (?:striped|checked|chequered)|golden|gold|silver|steel|chrome|bronze|copper|wooden|stone"
        "|(?:white )?marble)"
    )
    nouns = f"(?:{every(words.NOUNS)}|thing|object|something|polar bear|grizzly bear)"
    place, hour = every(worlds.PLACES), every(worlds.HOURS)
    return re.compile(
        f"(?:{one(o for o in words.OPENINGS if o)} )?an? (?:{one(words.FILLERS)} )?(?:{surface} )?"
        f"(?:(?:statue|sculpture) of an? )?{nouns}(?: {hour})?(?: {place})?(?: {hour})?"
    )


def test_captions_repeat_no_sentence_of_the_scenes_but_these():
    pattern, rng = captions_pattern(), np.random.default_rng(0)
    for _ in range(2000):
        thing = int(rng.integers(len(OBJECTS)))
        look = draw_look(thing, rng, pairs="any")
        text = sentence(captioned(attributes(thing, look), rng), rng, fillers=True)
        assert pattern.fullmatch(text), text
    theirs = reserved() | reserved_prompts()
    assert len(theirs) > 100
    assert {text for text in theirs if pattern.fullmatch(text)} == LEARNT


def test_a_pair_kept_from_training_is_never_drawn_for_it_and_always_for_its_test():
    rng = np.random.default_rng(0)
    kept = {(t, c) for t in range(len(OBJECTS)) for c in range(len(COLORS)) if held_out(t, c)}
    assert 0.08 < len(kept) / (len(OBJECTS) * len(COLORS)) < 0.12
    for _ in range(300):
        thing = int(rng.integers(len(OBJECTS)))
        seen, new = draw_look(thing, rng), draw_look(thing, rng, pairs="new")
        assert not {(thing, seen.color), (thing, seen.second)} & kept
        assert (thing, new.color) in kept


def test_shapes_and_worlds_of_training_and_tests_do_not_meet():
    seeds = [set(range(s.first, s.first + s.worlds)) for s in SPLITS.values()]
    assert len(set.union(*seeds)) == sum(len(s) for s in seeds)
    for split in SPLITS.values():
        instance = draw_world(split.first, new_shapes=split.new_shapes).instance
        assert (instance >= HELD_OUT_SHAPE) == split.new_shapes


def test_what_a_caption_says_is_true_of_its_picture_and_the_wrong_one_is_not():
    rng = np.random.default_rng(1)
    for _ in range(400):
        thing = int(rng.integers(len(OBJECTS)))
        shown = attributes(thing, draw_look(thing, rng, pairs="any"))
        said = captioned(shown, rng)
        assert true_of(np.array([said]), np.array([shown]))[0, 0]
        false = wrong(said, rng)
        assert false != said
        text = sentence(said, rng)
        if said[0] >= 0:
            assert any(
                noun in text for noun in [*words.NOUNS[OBJECTS[said[0]]], "polar", "grizzly"]
            )
        if said[5] >= 0:
            assert any(hour in text for hour in worlds.HOURS[TIMES[said[5]]])
        if said[4] >= 0:
            assert any(place in text for place in worlds.PLACES[GROUNDS[said[4]]])


def test_two_colours_have_no_order_and_one_colour_is_not_said_of_two():
    red, white = COLORS.index("red"), COLORS.index("white")
    stripes, plain, shiny = (FINISHES.index(f) for f in ("striped", "plain", "shiny"))
    picture = np.array(
        [[3, stripes, red, white, 0, 0], [3, plain, red, -1, 0, 0], [3, shiny, red, -1, 0, 0]]
    )
    captions = np.array(
        [[3, stripes, white, red, -1, -1], [3, -1, red, -1, -1, -1], [3, shiny, red, -1, -1, -1]]
    )
    assert true_of(captions, picture).tolist() == [
        [True, False, False],
        [False, True, False],
        [False, True, True],
    ]


@pytest.mark.parametrize("what", ["surface", "ground", "time"])
def test_a_change_changes_one_attribute_alone(what):
    rng = np.random.default_rng(2)
    columns = {"surface": {1, 2, 3}, "ground": {4}, "time": {5}}[what]
    for _ in range(30):
        look = draw_look(4, rng)
        before, after = attributes(4, look), attributes(4, change(look, what, 4, rng))
        assert {k for k in range(6) if before[k] != after[k]} <= columns
        assert before != after


def test_moved_things_keep_their_surface_and_change_ground_and_time():
    split = SPLITS["train-moved"]
    for seed in range(split.first, split.first + 20):
        a, b = looks_of(seed, 3, split)
        assert (a.finish, a.color, a.second, a.seed) == (b.finish, b.color, b.second, b.seed)
        assert a.ground != b.ground
        assert a.time != b.time


@pytest.mark.parametrize(
    ("finish", "time"), [("plain", "day"), ("striped", "cloudy"), ("marble", "sunset")]
)
def test_the_ray_caster_draws_what_mitsuba_draws(finish, time, monkeypatch):
    from attnwarp_eval.truth.mitsuba import build

    monkeypatch.setattr(build, "TEXELS", 1024)
    rng = np.random.default_rng(5)
    world = draw_world(31, thing=OBJECTS.index("bear"))
    two = COLORS.index("blue") if finish == "striped" else -1
    one = -1 if finish == "marble" else COLORS.index("red")
    look = _look(rng, finish=FINISHES.index(finish), color=one, second=two, time=TIMES.index(time))
    (ours,), hits = render.pictures(world, [look], 64)
    scene = world.scene(look, 64)
    theirs = render_plan(scene, scene.source, plan(scene, 64), 0)
    # Ray-cast pictures have one ray a pixel; blocks of 8 x 8 leave edges and noise little weight.
    blocks = [
        x.reshape(8, 8, 8, 8, 3).mean(axis=(1, 3))
        for x in (to_linear(ours / 255), np.clip(theirs, 0, 1))
    ]
    brightness = blocks[1].mean()
    error = np.abs(blocks[0] - blocks[1]).mean() / brightness
    upside_down = np.abs(blocks[0] - blocks[1][::-1]).mean() / brightness
    assert error < 0.03  # seen: 0.007 to 0.011
    assert upside_down > 3 * error
    assert (hits.object_id == 0).mean() > 0.02


def test_looks_of_a_world_share_their_geometry_and_the_same_seed_gives_the_same_picture():
    rng = np.random.default_rng(7)
    world = draw_world(12, thing=OBJECTS.index("mug"))
    looks = [_look(rng, color=COLORS.index(c), ground=0, time=0, seed=3) for c in ("red", "blue")]
    (red, blue), hits = render.pictures(world, looks, 64)
    again, _ = render.pictures(world, looks[:1], 64)
    assert np.array_equal(red, again[0])
    thing = hits.object_id == 0
    assert np.array_equal(red[~thing], blue[~thing])
    assert red[thing].mean(axis=0).argmax() == 0
    assert blue[thing].mean(axis=0).argmax() == 2


def test_any_text_can_be_written_in_tokens_and_read_back():
    tokenizer = make_tokenizer(3000)
    for text in ("a photo of a red ball", "zyx qwv 42!", "ein Bär", "🐻"):
        code = tokenizer.encode(text)
        assert code.ids[-1] == 1
        assert tokenizer.decode(code.ids).strip() == text.lower()
    assert len(tokenizer.encode("a photo of a red ball").ids) <= 8
    assert len(tokenizer.encode("word " * 300).ids) == 40
