"""Oracles: pixels that an edit of a part cannot reach, the shapes' own bounds, the scenes' files."""

from pathlib import Path

import numpy as np
import pytest

import attnwarp_eval
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS, USUAL
from attnwarp_eval.drawn.objects import RECIPES, body, plain_numbers
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, OBJECTS, Look
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.scene.yaml import read_yaml
from training.worlds.assemblies import WHOLE, WHOLE_NOUNS, Assembly, draw_assembly
from training.worlds.draw import HELD_OUT_SHAPE, TRAIN_SHAPES
from training.worlds.editing_pairs import (
    GROUPS,
    PAIR_SPLITS,
    THING,
    Worlds,
    ambiguous_instruction,
    edit_looks,
    edit_world,
    instruction,
    render_edit_world,
    reserved,
    thing_of,
)
from training.worlds.render import pictures
from training.worlds.words import NOUNS

SHAPE = ("center", "radii", "start", "end", "points", "radius", "height", "size")


@pytest.mark.parametrize("kind", KINDS)
def test_every_thing_with_parts_stands_and_each_part_is_named(kind):
    seen = set()
    for instance in range(5):
        world = Assembly(KINDS.index(kind), instance, 7)
        bounds = []
        for name, parts in world.pieces().items():
            seen.add(name)
            shape = {"type": "body", "parts": plain_numbers(parts), "blend": 0.03, "resolution": 24}
            bounds.append(BodySpec.model_validate(shape).mesh().bounds())
        low, high = (np.array([b[k] for b in bounds]) for k in (0, 1))
        assert -0.5 < low[:, 2].min() < 0.1
        assert 0.4 < high[:, 2].max() < 1.8
        assert max(np.abs(low[:, :2]).max(), np.abs(high[:, :2]).max()) < 1.7
    assert seen <= set(PART_NOUNS)
    assert kind in WHOLE_NOUNS
    assert len(seen) >= 2


def test_the_usual_colours_are_of_parts_and_colours_that_there_are():
    assert set(USUAL) <= set(PART_NOUNS)
    assert {c for colors in USUAL.values() for c in colors} <= set(COLORS)


def look(color, finish="plain", ground=0):
    return Look(FINISHES.index(finish), color, -1, ground, 3, 11)


def test_an_edit_of_a_part_changes_its_own_pixels_alone():
    world = draw_assembly(50_000_002, KINDS.index("plant"))
    assert world.part != WHOLE
    (red, blue), hits = pictures(world, [look(0), look(4)], 64)
    edited = np.isin(hits.object_id, world.edited())
    # Light is direct and the colours matt: no other pixel can differ by more than its reflection.
    glossy = [k for k, s in enumerate(world.surfaces(look(0))) if FINISHES[s.finish] != "plain"]
    other = ~edited & ~np.isin(hits.object_id, glossy)
    assert edited.mean() > 0.004
    assert np.array_equal(red[other], blue[other])
    assert (red[edited, 0].astype(int) > red[edited, 2]).mean() > 0.9
    assert (blue[edited, 2].astype(int) > blue[edited, 0]).mean() > 0.9


def test_parts_and_worlds_of_training_and_tests_do_not_meet_and_every_kind_comes_in_turn():
    train, test = PAIR_SPLITS["parts-train"], PAIR_SPLITS["parts-test"]
    assert train.first + train.worlds <= test.first
    drawn = [edit_world(k, train).kind for k in range(4)]
    assert drawn == list(KINDS[:4])
    assert train.worlds % len(KINDS) == 0
    assert test.worlds % len(KINDS) == 0


def test_pixels_of_the_edited_part_are_the_thing():
    made = render_edit_world(0, PAIR_SPLITS["parts-test"])
    world = edit_world(0, PAIR_SPLITS["parts-test"])
    assert made["things"] == thing_of(world)
    colors = [k for k in GROUPS["color"] if made["valid"][k]]
    first, second = made["images"][0, colors[0]].astype(int), made["images"][0, colors[1]]
    differs = np.abs(first - second).max(axis=-1) > 8
    thing = made["ids"][0] == THING
    assert thing.mean() > 0.003
    assert (differs & ~thing).sum() <= 0.02 * max(differs.sum(), 1) + 5


def test_a_whole_thing_is_edited_from_its_usual_look():
    split = PAIR_SPLITS["parts-train"]
    index = next(k for k in range(60) if edit_world(k, split).part == WHOLE)
    looks, valid, base = edit_looks(index, split)
    assert [k.finish for k in looks].count(-1) == len(GROUPS["ground"]) + len(GROUPS["time"])
    rows = np.array([[k.finish, k.color, k.second, k.ground, k.time] for k in looks])[None]
    blank = np.zeros((1,))
    worlds = Worlds(blank, valid[None], blank, rows, np.array([base]), *[blank] * 4)
    start = int(worlds.sources(0, "material")[-1])
    assert looks[start].finish == -1
    assert looks[start].ground == looks[0].ground
    assert -1 not in rows[0, worlds.sources(0, "material")[:-1], 0]


def test_sentences_name_the_part_and_none_is_a_scenes():
    rng = np.random.default_rng(3)
    split = PAIR_SPLITS["parts-train"]
    for index in range(17):
        world = edit_world(index, split)
        looks, valid, _ = edit_looks(index, split)
        nouns = WHOLE_NOUNS[world.kind] if world.part == WHOLE else PART_NOUNS[world.part]
        for kind in ("color", "material"):
            k = looks[int(rng.choice([k for k in GROUPS[kind] if valid[k]]))]
            row = np.array([k.finish, k.color, k.second, k.ground, k.time])
            for text in (
                instruction(kind, thing_of(world), row, rng),
                ambiguous_instruction(kind, thing_of(world), rng),
            ):
                assert text.lower() not in reserved()
                if world.part != WHOLE:
                    assert any(noun in text for noun in nouns), text
                    assert "statue" not in text
    assert instruction("color", 0, np.array([0, 0, -1, 0, 0]), rng)  # a ball is still one thing
    assert set(NOUNS) == set(OBJECTS)


def shape_of(part):
    numbers = (part.get(k) for k in SHAPE)
    return str([v for v in numbers if v is not None])


def shapes_and_palettes():
    """Shapes and palettes of the scenes' files, as they are written."""
    folder = (Path(attnwarp_eval.__file__).parent / "scenes").resolve()
    shapes, palettes = set(), set()
    for path in folder.glob("*.yaml"):
        for thing in read_yaml(path.read_text())[1]["objects"]:
            shapes |= {shape_of(part) for part in thing["shape"].get("parts", ())}
            palettes.add(str(thing.get("texture", {}).get("colors")))
    assert len(shapes) > 50
    return shapes, palettes


def test_no_thing_that_encoders_learn_from_repeats_a_scenes_shape():
    shapes, _ = shapes_and_palettes()
    drawn = {
        shape_of(part)
        for word in RECIPES
        for instance in (*range(TRAIN_SHAPES), HELD_OUT_SHAPE)
        for part in body(word, instance)["parts"]
    }
    assert len(drawn) > 1000
    assert not drawn & shapes


def test_no_recipe_repeats_a_scenes_shape_or_texture():
    shapes, palettes = shapes_and_palettes()
    for k in range(len(KINDS)):
        world = Assembly(k, 3, 5)
        for parts in world.pieces().values():
            for part in plain_numbers(parts):
                assert shape_of(part) not in shapes
        for finish in ("plain", "wooden", "stone"):
            surface = look(0, finish).surface
            assert str(surface.get("texture", {}).get("colors")) not in palettes - {"None"}
