"""Pictures, words and shapes that no recipe may show a network. Oracles: the scenes' own files, counts."""

from pathlib import Path

import numpy as np

import attnwarp_eval
from attnwarp_eval.drawn.assemblies import KINDS
from attnwarp_eval.drawn.objects import RECIPES, body, plain_numbers
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, OBJECTS, Look, held_out
from attnwarp_eval.scene.yaml import read_yaml
from training.worlds import editing_pairs
from training.worlds.assemblies import Assembly
from training.worlds.draw import HELD_OUT_SHAPE, TRAIN_SHAPES, draw_look
from training.worlds.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    PAIR_SPLITS,
    ambiguous_instruction,
    edit_looks,
    edit_world,
    instruction,
    reserved,
)
from training.worlds.recolors import RECOLOR_SPLITS

SHAPE = ("center", "radii", "start", "end", "points", "radius", "height", "size")


def scenes():
    folder = (Path(attnwarp_eval.__file__).parent / "scenes").resolve()
    return [read_yaml(path.read_text())[1] for path in folder.glob("*.yaml")]


def test_no_instruction_of_the_scenes_is_ever_drawn():
    theirs = {e["instruction"].lower() for scene in scenes() for e in scene.get("edits", ())}
    assert len(theirs) >= 30
    assert reserved() == theirs
    rng = np.random.default_rng(0)
    cached = [edit_looks(k, PAIR_SPLITS["edit-train"])[0] for k in range(25)]
    drawn, refused = set(), set()
    for k in range(3000):
        kind = list(GROUPS)[k % len(GROUPS)]
        look = cached[k % 25][int(rng.choice(list(GROUPS[kind])))]
        row = np.array([look.finish, look.color, look.second, look.ground, look.time])
        drawn.add(instruction(kind, k % 25, row, rng).lower())
        refused.add(editing_pairs._draw_instruction(kind, k % 25, row, rng).lower())
        if kind in AMBIGUOUS:
            drawn.add(ambiguous_instruction(kind, k % 25, rng))
    assert not drawn & theirs
    assert len(drawn) > 1000
    assert refused & theirs  # without the check some would have been


def test_worlds_and_shapes_of_training_and_tests_do_not_meet():
    groups = (PAIR_SPLITS, RECOLOR_SPLITS)
    seeds = [set(range(s.first, s.first + s.worlds)) for group in groups for s in group.values()]
    assert len(set.union(*seeds)) == sum(len(s) for s in seeds)
    shapes = [
        {edit_world(k, PAIR_SPLITS[name]).instance for k in range(PAIR_SPLITS[name].worlds)}
        for name in ("edit-train", "edit-test")
    ]
    assert not shapes[0] & shapes[1]


def test_a_pair_of_thing_and_colour_kept_from_training_is_never_drawn():
    rng = np.random.default_rng(0)
    kept = {(t, c) for t in range(len(OBJECTS)) for c in range(len(COLORS)) if held_out(t, c)}
    assert 0.08 < len(kept) / (len(OBJECTS) * len(COLORS)) < 0.12
    for _ in range(300):
        thing = int(rng.integers(len(OBJECTS)))
        seen = draw_look(thing, rng)
        assert not {(thing, seen.color), (thing, seen.second)} & kept


def shape_of(part):
    return str([v for k in SHAPE if (v := part.get(k)) is not None])


def test_no_recipe_repeats_a_scenes_shape_or_texture():
    shapes, palettes = set(), set()
    for scene in scenes():
        for thing in scene["objects"]:
            shapes |= {shape_of(part) for part in thing["shape"].get("parts", ())}
            palettes.add(str(thing.get("texture", {}).get("colors")))
    assert len(shapes) > 50
    drawn = {
        shape_of(part)
        for word in RECIPES
        for instance in (*range(TRAIN_SHAPES), HELD_OUT_SHAPE)
        for part in body(word, instance)["parts"]
    }
    assert len(drawn) > 1000
    for k in range(len(KINDS)):
        for parts in Assembly(k, 3, 5).pieces().values():
            drawn |= {shape_of(part) for part in plain_numbers(parts)}
    assert not drawn & shapes
    for finish in ("plain", "wooden", "stone"):
        surface = Look(FINISHES.index(finish), 0, -1, 0, 3, 11).surface
        assert str(surface.get("texture", {}).get("colors")) not in palettes - {"None"}
