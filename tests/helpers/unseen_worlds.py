"""Pictures of worlds whose seeds and shapes no recipe of the bundled weights has, with what they show."""

from dataclasses import replace

import numpy as np

from attnwarp_eval.drawn.assemblies import KINDS
from attnwarp_eval.drawn.worlds import GROUNDS, OBJECTS, TIMES
from training.worlds.assemblies import draw_assembly
from training.worlds.draw import draw_look, draw_world
from training.worlds.render import pictures

SIZE = 160


def things(first, count, *, looks=3, bare=False):
    """(N, 2, looks, 160, 160, 3) pictures in [0, 1] of worlds in two views, and their Looks and things by number.

    A bare thing stands alone on grass by day, so nothing but the thing tells it apart.
    """
    images, shown = [], []
    for seed in range(first, first + count):
        thing = seed % len(OBJECTS)
        world = draw_world(seed, new_shapes=True, thing=thing, bare=bare)
        rng = np.random.default_rng([seed, 6])
        drawn = [draw_look(thing, rng, pairs="any") for _ in range(looks)]
        if bare:
            grass, day = GROUNDS.index("grass"), TIMES.index("day")
            drawn = [replace(look, ground=grass, time=day) for look in drawn]
        images.append([pictures(world, drawn, SIZE, view=view)[0] for view in range(2)])
        shown.append((thing, drawn))
    return np.array(images, np.float32) / 255, shown


def part_of(kind, part, *, looks=3):
    """For each of two views of a thing: its pictures in [0, 1] with other surfaces of a part, and the part's pixels."""
    number = KINDS.index(kind)
    world = replace(draw_assembly(92_000_000 + number, number, new_shapes=True), part=part)
    rng = np.random.default_rng(world.seed)
    drawn = [draw_look(0, rng, pairs="any") for _ in range(looks)]
    for view in range(2):
        images, hits = pictures(world, drawn, SIZE, view=view)
        yield np.array(images, np.float32) / 255, hits.object_id == list(world.pieces()).index(part)
