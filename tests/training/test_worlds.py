"""Things that worlds are drawn of, and their pictures. Oracles: the shapes' own bounds, Mitsuba's pictures of the same worlds."""

from dataclasses import replace

import numpy as np
import pytest

from attnwarp_eval.colors import to_linear
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS, USUAL
from attnwarp_eval.drawn.objects import RECIPES, body, plain_numbers
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, OBJECTS, TIMES
from attnwarp_eval.scene.bodies import BodySpec
from attnwarp_eval.truth.mitsuba import build, render_plan
from attnwarp_eval.truth.plan import plan
from training.worlds import render
from training.worlds.assemblies import WHOLE_NOUNS, Assembly
from training.worlds.draw import draw_look, draw_world


@pytest.mark.parametrize("word", RECIPES)
def test_every_thing_stands_on_the_ground_and_is_about_a_unit_wide_or_tall(word):
    for instance in (0, 1, 100_000):
        low, high = BodySpec.model_validate(body(word, instance, resolution=40)).mesh().bounds()
        assert -0.5 < low[2] < 0.1
        assert 0.15 < high[2] < 1.6
        assert np.abs([low[:2], high[:2]]).max() < 1.7
    assert body(word, 3) == body(word, 3)
    assert len({str(body(word, k)) for k in range(12)}) > 5


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


@pytest.mark.parametrize(
    ("finish", "time"), [("plain", "day"), ("striped", "cloudy"), ("marble", "sunset")]
)
def test_the_ray_caster_draws_what_mitsuba_draws(finish, time, monkeypatch):
    monkeypatch.setattr(build, "TEXELS", 1024)
    rng = np.random.default_rng(5)
    world = draw_world(31, thing=OBJECTS.index("bear"))
    two = COLORS.index("blue") if finish == "striped" else -1
    one = -1 if finish == "marble" else COLORS.index("red")
    surface = {"finish": FINISHES.index(finish), "color": one, "second": two}
    look = replace(draw_look(0, rng, pairs="any"), **surface, time=TIMES.index(time))
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
