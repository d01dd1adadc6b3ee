"""Pictures of random worlds in many looks, two views each, and instructions that lead from one look to another.

The looks of a world differ in one attribute from each other: 19 surfaces on one ground, then grounds and times of day
under one surface. Any two of a group make a pair of an edit. Every instruction that a scene of the package gives
is left out.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS, USUAL
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    HOURS,
    OBJECTS,
    PLACES,
    STATUES,
    TIMES,
    Look,
    held_out,
)
from attnwarp_eval.scene.yaml import read_yaml
from training.worlds.assemblies import WHOLE, WHOLE_NOUNS, Assembly, draw_assembly
from training.worlds.data import render_missing
from training.worlds.draw import TRAIN_SHAPES, World, draw_look, draw_world
from training.worlds.words import HUES, NOUNS, one_of, surface_words

PAIRS_PROTOCOL = 1
"""Raised whenever the same seed would give other pictures."""

SIZE = 128
"""Pixels along a side."""

VIEWS = 2

SURFACES = len(COLORS) + len(STATUES) + 2
LOOKS = SURFACES + len(GROUNDS) + len(TIMES)
"""Looks of a world: surfaces (11 colours, 6 materials, stripes, checks), 7 grounds, 4 times."""

GROUPS = {
    "color": range(0, len(COLORS)),
    "material": range(len(COLORS), len(COLORS) + len(STATUES)),
    "pattern": range(SURFACES - 2, SURFACES),
    "ground": range(SURFACES, SURFACES + len(GROUNDS)),
    "time": range(SURFACES + len(GROUNDS), LOOKS),
}
"""Indices of looks by what an edit of that kind ends in. Colours, materials and patterns share ground and time, so an
edit may lead from any of them to any other."""

THING, GROUND, OTHER, SKY = 0, 1, 2, 255
"""Labels of what a pixel shows."""


@dataclass(frozen=True)
class PairSplit:
    """A set of worlds; seeds of splits do not meet with each other's, nor with those of other recipes."""

    first: int
    worlds: int
    test: bool = False
    parts: bool = False


PAIR_SPLITS = {
    "edit-train": PairSplit(10_000_000, 1800),
    "edit-test": PairSplit(11_000_000, 40, test=True),
    "parts-train": PairSplit(12_000_000, 1190, parts=True),
    "parts-test": PairSplit(13_000_000, 51, test=True, parts=True),
}

PARTS = (WHOLE, *PART_NOUNS)
"""Names of parts. A thing with parts counts from ``len(OBJECTS)``, by what it is and the part that is edited."""


def thing_of(world: World) -> int:
    """The number of what a world's edits change: an object, or a part of a thing."""
    if isinstance(world, Assembly):
        return len(OBJECTS) + world.thing * len(PARTS) + PARTS.index(world.part)
    return world.thing


def noun_of(thing: int, kind: str, rng: np.random.Generator) -> str:
    """Noun for a thing in a sentence: "it", "the mug", "the jacket", "the jacket of the person".

    Of a thing with parts, an edit of the ground or the light names the whole.
    """
    if thing < len(OBJECTS):
        return "it" if rng.uniform() < 0.5 else f"the {one_of(NOUNS[OBJECTS[thing]], rng)}"
    number, index = divmod(thing - len(OBJECTS), len(PARTS))
    whole, part = WHOLE_NOUNS[KINDS[number]], PARTS[index]
    if part == WHOLE or kind in ("ground", "time"):
        return "it" if rng.uniform() < 0.3 else f"the {one_of(whole, rng)}"
    noun = one_of(PART_NOUNS[part], rng)
    if rng.uniform() < 0.2 and " of " not in noun:
        return f"the {noun} of the {min(whole, key=len)}"
    return f"the {noun}"


def is_part(thing: int) -> bool:
    """Return True if an edit changes a part of something, which no sentence calls a statue."""
    return thing >= len(OBJECTS) and (thing - len(OBJECTS)) % len(PARTS) != PARTS.index(WHOLE)


@dataclass(frozen=True, eq=False)
class Worlds:
    """Pictures of a split in memory, and what they show.

    Attributes:
        images: (N, 2, LOOKS, S, S, 3) uint8 sRGB.
        valid: (N, LOOKS) bool; a colour kept from training for a thing has no picture.
        things: (N,) what edits change, see :func:`thing_of`.
        looks: (N, LOOKS, 5): finish, color, second, ground, time of each look.
        ids: (N, 2, 128, 128) uint8, what each pixel shows.
    """

    images: npt.NDArray[np.uint8]
    valid: npt.NDArray[np.bool_]
    things: npt.NDArray[np.int64]
    looks: npt.NDArray[np.int64]
    ids: npt.NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.images)

    def sources(self, world: int, kind: str) -> npt.NDArray[np.int64]:
        """Looks that an edit of a kind may start from: those that share everything else with its results.

        A thing with parts that is edited as a whole has no look of its own surface; the one where each part looks
        as usual stands among its grounds.
        """
        own = sources(kind, self.valid[world])
        looks, grounds = self.looks[world], list(GROUPS["ground"])
        if looks[grounds[0], 0] >= 0 or kind not in ("color", "material", "pattern"):
            return own
        return np.append(own, grounds[int(looks[0, 3])])


def edit_world(index: int, split: PairSplit) -> World:
    """The world of that number; things come in turn, so that every one is seen as often."""
    seed = split.first + index
    if split.parts:
        return draw_assembly(seed, index % len(KINDS), new_shapes=split.test)
    world = draw_world(seed, new_shapes=split.test, thing=index % len(OBJECTS), views=VIEWS)
    return world if split.test else replace(world, instance=TRAIN_SHAPES + index)


def edit_looks(index: int, split: PairSplit) -> tuple[list[Look], npt.NDArray[np.bool_]]:
    """The looks of a world, and which of them may be shown."""
    world = edit_world(index, split)
    thing = thing_of(world)
    rng = np.random.default_rng([split.first + index, 8])
    first = draw_look(thing, rng, pairs="any")
    kind = FINISHES.index("shiny" if rng.uniform() < 0.25 else "plain")
    looks = [replace(first, finish=kind, color=k, second=-1) for k in range(len(COLORS))]
    looks += [replace(first, finish=FINISHES.index(m), color=-1, second=-1) for m in STATUES]
    for pattern in ("striped", "checked"):
        while True:
            drawn = draw_look(thing, rng, pairs="any")
            if FINISHES[drawn.finish] == pattern:
                break
        looks.append(replace(first, finish=drawn.finish, color=drawn.color, second=drawn.second))
    unseen = [
        not split.test and any(held_out(thing, c) for c in (k.color, k.second) if c >= 0)
        for k in looks
    ]
    base = int(rng.choice(np.flatnonzero(~np.array(unseen))))
    before = looks[base]
    if isinstance(world, Assembly):
        if world.part == WHOLE:
            before = replace(before, finish=-1, color=-1, second=-1)
        else:
            usual = [
                COLORS.index(c) for c in USUAL.get(world.part, ()) if not unseen[COLORS.index(c)]
            ]
            base = int(rng.choice(usual)) if usual and rng.uniform() < 0.6 else base
            before = looks[base]
    looks += [replace(before, ground=k) for k in range(len(GROUNDS))]
    looks += [replace(before, time=k) for k in range(len(TIMES))]
    valid = ~np.array([*unseen, *[False] * (LOOKS - SURFACES)])
    return looks, valid


def render_edit_world(index: int, split: PairSplit) -> dict[str, Any]:
    """Everything that :class:`Worlds` holds of one world, at :data:`SIZE`."""
    from training.worlds.render import pictures

    world = edit_world(index, split)
    looks, valid = edit_looks(index, split)
    valid_looks = np.flatnonzero(valid)
    images = np.zeros((VIEWS, LOOKS, SIZE, SIZE, 3), dtype=np.uint8)
    ids = []
    for view in range(VIEWS):
        made, hits = pictures(world, [looks[k] for k in valid_looks], SIZE, view=view)
        images[view, valid_looks] = np.stack(made)
        objects = shown_things(hits.object_id, world)
        ids.append(np.where(hits.valid, objects, SKY).astype(np.uint8))
    return {
        "images": images, "valid": valid, "things": np.int64(thing_of(world)),
        "looks": np.array([(k.finish, k.color, k.second, k.ground, k.time) for k in looks]),
        "ids": np.stack(ids),
    }  # fmt: skip


def shown_things(objects: npt.NDArray[np.integer[Any]], world: World) -> npt.NDArray[np.int64]:
    """Label each pixel with what it shows, from the numbers of a scene's objects: the edited ones,
    the ground, others, the sky.
    """
    edited = world.edited() if isinstance(world, Assembly) else (0,)
    ground = len(world.pieces()) if isinstance(world, Assembly) else 1
    shown = np.where(objects == ground, GROUND, OTHER)
    return np.where(objects < 0, SKY, np.where(np.isin(objects, edited), THING, shown))


def _path(folder: Path, name: str, index: int) -> Path:
    return folder / f"{name}-v{PAIRS_PROTOCOL}-{index:05d}.npz"


def _make(path: Path, index: int, name: str) -> None:
    arrays = render_edit_world(index, PAIR_SPLITS[name])
    write_atomically(path, lambda stream: np.savez(stream, **arrays))


def make_pairs(
    folder: Path, name: str, workers: int = 1, *, count: int | None = None
) -> list[Path]:
    """Render what is missing of a split's first ``count`` worlds (all if left out); their files, in order."""
    folder.mkdir(parents=True, exist_ok=True)
    worlds = PAIR_SPLITS[name].worlds if count is None else count
    files = {_path(folder, name, index): index for index in range(worlds)}
    return render_missing(f"pictures: {name}", files, functools.partial(_make, name=name), workers)


def load_mixed(folder: Path, counts: Mapping[str, int | None], *, workers: int = 1) -> Worlds:
    """The first worlds of several splits, one split after the other; None takes all of one."""
    paths = [
        path
        for name, count in counts.items()
        for path in make_pairs(folder, name, workers, count=count)
    ]
    table: dict[str, npt.NDArray[Any]] = {}
    for index, path in enumerate(paths):
        with np.load(path) as stored:
            for key in stored.files:
                value = stored[key]
                # Stacking at the end would take twice the memory.
                if key not in table:
                    table[key] = np.empty((len(paths), *value.shape), value.dtype)
                table[key][index] = value
    return Worlds(**table)


# Instructions ---------------------------------------------------------------------------------------------------------


@functools.cache
def reserved() -> frozenset[str]:
    """Instructions of the package's scenes, in lower case: no recipe may learn from one."""
    import attnwarp_eval

    folder = (Path(attnwarp_eval.__file__).parent / "scenes").resolve()
    scenes = [read_yaml(path.read_text())[1] for path in sorted(folder.glob("*.yaml"))]
    return frozenset(
        edit["instruction"].lower() for scene in scenes for edit in scene.get("edits", ())
    )


def instruction(
    kind: str, thing: int, look: npt.NDArray[np.int64], rng: np.random.Generator
) -> str:
    """A sentence that asks for a look.

    Args:
        kind: a key of :data:`GROUPS`: what the edit changes.
        thing: index into :data:`attnwarp_eval.drawn.worlds.OBJECTS`.
        look: (5,) finish, color, second, ground, time of the result.
    """
    while True:
        text = _draw_instruction(kind, thing, look, rng)
        if text.lower() not in reserved():
            return text


def _draw_instruction(
    kind: str, thing: int, look: npt.NDArray[np.int64], rng: np.random.Generator
) -> str:
    finish, color, second, ground, time = (int(v) for v in look)
    it = noun_of(thing, kind, rng)
    match kind:
        case "color":
            hue = one_of(HUES[COLORS[color]], rng)
            if FINISHES[finish] == "shiny" and rng.uniform() < 0.3:
                hue = f"shiny {hue}"
            return one_of(
                (
                    f"make {it} {hue}", f"paint {it} {hue}", f"turn {it} {hue}", f"color {it} {hue}",
                    f"change {it} to {hue}", f"{it} should be {hue}", f"dye {it} {hue}",
                ), rng,
            )  # fmt: skip
        case "material" | "pattern":
            words, _ = surface_words(finish, color, second, rng)
            nouns = {
                "golden": "gold", "silver": "silver", "bronze": "bronze", "wooden": "wood", "stone": "stone", "marble": "marble",
            }  # fmt: skip
            noun = nouns.get(FINISHES[finish], "")
            choices = [f"make {it} {words}", f"turn {it} {words}", f"{it} should be {words}"]
            if noun:
                choices += [
                    f"make {it} out of {noun}",
                    f"turn {it} into {noun}",
                    f"make {it} of {noun}",
                ]
                if not is_part(thing):
                    choices += [f"turn {it} into a {words} statue", f"make {it} a {words} statue"]
            else:
                choices += [f"give {it} a {words} pattern", f"paint {it} {words}"]
            return one_of(tuple(choices), rng)
        case "ground":
            place = one_of(PLACES[GROUNDS[ground]], rng)
            name = {"boards": "wooden boards", "earth": "bare earth"}.get(
                GROUNDS[ground], GROUNDS[ground]
            )
            return one_of(
                (
                    f"put {it} {place}", f"move {it} {place}", f"place {it} {place}", f"show {it} {place}",
                    f"make the ground {name}", f"cover the floor with {name}", f"turn the ground into {name}",
                ), rng,
            )  # fmt: skip
    hour = one_of(HOURS[TIMES[time]], rng)
    name = {"cloudy": "cloudy", "day": "a sunny day"}.get(TIMES[time], TIMES[time])
    return one_of(
        (
            f"show {it} {hour}",
            f"make it look as {hour}",
            f"make it {name}",
            f"let it be {name}",
            f"{it} {hour}",
        ),
        rng,
    )


AMBIGUOUS: dict[str, tuple[str, ...]] = {
    "color": (
        "make {} another color", "give {} another color", "change the color of {}", "paint {} in a different color",
        "make {} some other color", "give {} a new color", "change its color", "paint {} in any color",
    ),
    "material": (
        "make {} of another material", "change the material of {}", "make {} out of something else",
        "turn {} into a statue", "give {} another material",
    ),
    "ground": (
        "put {} somewhere else", "move {} to another place", "change the ground", "put {} on another ground",
        "change the floor",
    ),
    "time": ("make it another time of day", "show {} at another time", "change the light", "change the time of day"),
}  # fmt: skip
"""Instructions that have as many answers as the world has looks of that kind."""


def ambiguous_instruction(kind: str, thing: int, rng: np.random.Generator) -> str:
    """A sentence that asks for a change of a kind and leaves open which; kinds are those of :data:`AMBIGUOUS`."""
    while True:
        it = noun_of(thing, kind, rng)
        text = one_of(AMBIGUOUS[kind], rng)
        # Which part "its colour" means, no one could tell.
        open_ended = "{}" not in text or "statue" in text
        if is_part(thing) and kind in ("color", "material") and open_ended:
            continue
        text = text.format(it)
        if text not in reserved():
            return text


def sources(kind: str, valid: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Looks that an edit of a kind may start from: those that share everything else with its results."""
    rows = range(SURFACES) if kind in ("color", "material", "pattern") else GROUPS[kind]
    return np.array([k for k in rows if valid[k]], dtype=np.int64)
