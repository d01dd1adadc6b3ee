"""Edits of a drawn scene, with one and with several right answers, in words.

Every drawn scene has the same edits by name, so a study names them once for a whole population.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.drawn.assemblies import PART_NOUNS
from attnwarp_eval.drawn.draft import Draft, Thing, index
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    HOURS,
    PLACES,
    STATUES,
    TIMES,
    Look,
    shade,
    with_article,
)
from attnwarp_eval.scene import solids
from attnwarp_eval.scene.bodies import BodySpec

Array = npt.NDArray[np.float64]
Entry = dict[str, Any]

BRIGHT = ("red", "orange", "yellow", "green", "blue", "purple")
"""Answers of the edit ``some_colour``."""

PART_COLORS = ("red", "yellow", "green", "blue")
"""Colours of each part in the edit ``parts``."""

PARTS = 12
"""Parts of the edit ``parts``."""

SMALL_PARTS = ("eyes", "nose", "lips")
"""Parts that keep their appearance when the whole thing is painted."""


def edits(draft: Draft) -> list[Entry]:
    """Edits of a scene, in the format of its file.

    - ``colour``: the first thing in a look that training never shows it in
    - ``material``: it as a statue
    - ``part``: its largest part in one colour; not of a thing in one piece
    - ``ground``, ``light``: another ground, another time of day
    - ``several``: all other things in one colour
    - ``some_colour``: it in any bright colour, six answers
    - ``parts``: :data:`PARTS` parts of it in any of four colours; four answers, in which each part
      has each colour once
    """
    part = [_part(draft)] if len(draft.things[0].objects) > 1 else []
    return [
        _colour(draft), _material(draft), *part, _ground(draft), _light(draft),
        _several(draft), _some_colour(draft), _parts(draft),
    ]  # fmt: skip


def place(ground: int) -> str:
    """Description of a ground as a place."""
    return PLACES[GROUNDS[ground]][0]


def described(thing: Thing) -> str:
    """Description of a thing with its look.

    Example:
        >>> from attnwarp_eval.drawn.scenes import draw
        >>> described(draw(0, seed=7).things[0]).startswith("a ")
        True
    """
    return with_article(f"{_words(thing.look)} {thing.kind}")


def _words(look: Look) -> str:
    finish = FINISHES[look.finish]
    color = COLORS[look.color] if look.color >= 0 else ""
    if finish in ("striped", "checked"):
        return f"{color} and {COLORS[look.second]} {finish}"
    return {"plain": color, "shiny": f"shiny {color}"}.get(finish, finish)


def _edit(draft: Draft, name: str, instruction: str, target: str, **does: Any) -> Entry:
    source = f"a photo of {described(draft.things[0])} {place(draft.ground)}"
    return {"name": name, "instruction": instruction, "source": source, "target": target, **does}


def _over(items: list[Entry], surface: Mapping[str, Any]) -> list[Entry]:
    """Changes that give objects one surface, regardless of their material."""
    material = surface.get("material", {"type": "diffuse"})
    changes = []
    for item in items:
        change: Entry = {"object": item["name"]}
        if "texture" in surface:
            change["texture"] = surface["texture"]
        if material != item.get("material", {"type": "diffuse"}):
            change["material"] = material
        changes.append(change)
    return changes


def _body(thing: Thing) -> list[Entry]:
    """The painted objects of a thing."""
    return [o for o in thing.objects if not o["name"].endswith(SMALL_PARTS)]


def _plain(rng: np.random.Generator, color: str) -> Entry:
    return {
        "texture": {"type": "plain", "color": shade(color, rng), "variation": 0.12, "grain": 0.05}
    }


def _seed(draft: Draft, rng: np.random.Generator) -> int:
    return int(rng.random() * 2**31)


def _colour(draft: Draft) -> Entry:
    """The colour held out of training for this kind; as a pattern if the thing already has it."""
    rng, thing = draft.stream("edit colour"), draft.things[0]
    others = [c for c in draft.colors_of(thing.kind) if c != thing.look.color]
    color = others[0] if others else thing.look.color
    finish, second = "plain", -1
    if color == thing.look.color and thing.look.second < 0:
        finish, second = "striped", draft.other_color(rng, color)
    look = Look(FINISHES.index(finish), color, second, draft.ground, draft.time, _seed(draft, rng))
    words = _words(look)
    return _edit(
        draft,
        "colour",
        f"make the {thing.kind} {words}",
        f"a photo of {with_article(words)} {thing.kind} {place(draft.ground)}",
        changes=_over(_body(thing), draft.surface(look)),
    )


def _material(draft: Draft) -> Entry:
    rng, thing = draft.stream("edit material"), draft.things[0]
    kinds = [name for name in STATUES if name != FINISHES[thing.look.finish]]
    finish = kinds[index(rng, len(kinds))]
    look = Look(FINISHES.index(finish), -1, -1, draft.ground, draft.time, _seed(draft, rng))
    return _edit(
        draft,
        "material",
        f"turn the {thing.kind} into a {finish} statue",
        f"a photo of a {finish} statue of a {thing.kind} {place(draft.ground)}",
        changes=_over(thing.objects, draft.surface(look)),
    )


def _part(draft: Draft) -> Entry:
    """The part with the largest box, in a new colour."""
    rng, thing = draft.stream("edit part"), draft.things[0]
    item = max(_body(thing), key=_size)
    name = item["name"].removeprefix(f"{thing.kind}_").replace("_", " ")
    color = BRIGHT[index(rng, len(BRIGHT))]
    word = PART_NOUNS.get(name, (name,))[0]
    return _edit(
        draft,
        "part",
        f"make the {word} {color}",
        f"a photo of a {thing.kind} with {color} {word} {place(draft.ground)}",
        changes=_over([item], _plain(rng, color)),
    )


def _size(item: Entry) -> float:
    boxes = [solids.reach(part) for part in BodySpec.model_validate(item["shape"]).solid()]
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    return float(np.prod(high - low))


def _ground(draft: Draft) -> Entry:
    rng = draft.stream("edit ground")
    others = [k for k in range(len(GROUNDS)) if k != draft.ground]
    other = others[index(rng, len(others))]
    look = Look(0, 0, -1, other, draft.time, _seed(draft, rng))
    return _edit(
        draft,
        "ground",
        f"make the ground {GROUNDS[other]}",
        f"a photo of {described(draft.things[0])} {place(other)}",
        changes=[{"object": "ground", "texture": look.floor}],
    )


def _light(draft: Draft) -> Entry:
    """Another time of day; an even sky if smooth things would turn a sun into caustics."""
    rng = draft.stream("edit light")
    others = [k for k, name in enumerate(TIMES) if k != draft.time]
    other = others[index(rng, len(others))]
    look = Look(0, 0, -1, draft.ground, other, _seed(draft, rng))
    hour = {"day": "a sunny day", "sunset": "sunset", "night": "night", "cloudy": "cloudy"}
    lights = look.lights if not draft.smooth else [x for x in look.lights if x["type"] == "sky"]
    return _edit(
        draft,
        "light",
        f"make it {hour[TIMES[other]]}",
        f"a photo of {described(draft.things[0])} {place(draft.ground)} {HOURS[TIMES[other]][0]}",
        lights=lights,
    )


def _several(draft: Draft) -> Entry:
    rng, others = draft.stream("edit several"), draft.things[1:]
    color = BRIGHT[index(rng, len(BRIGHT))]
    words = " and ".join(f"the {one.kind}" for one in others)
    changes = [c for one in others for c in _over(one.objects, _plain(rng, color))]
    return _edit(
        draft,
        "several",
        f"make {words} {color}",
        f"a photo of {described(draft.things[0])} {place(draft.ground)} with {color} things",
        changes=changes,
    )


def _some_colour(draft: Draft) -> Entry:
    rng, thing = draft.stream("edit some colour"), draft.things[0]
    word = thing.kind
    answers = [
        {
            "name": color,
            "target": f"a photo of {with_article(color)} {word} {place(draft.ground)}",
            "changes": _over(_body(thing), _plain(rng, color)),
        }
        for color in BRIGHT
    ]
    target = f"a photo of a {word} of one bright color {place(draft.ground)}"
    return _edit(draft, "some_colour", f"make the {word} another color", target, answers=answers)


def _parts(draft: Draft) -> Entry:
    """Parts as cells around centres. All 4^12 pictures are composed of the parts of four."""
    rng, thing = draft.stream("edit parts"), draft.things[0]
    centers = [[round(float(x), 3) for x in row] for row in part_centers(thing, rng)]
    hues = [shade(color, rng) for color in PART_COLORS]
    first = [index(rng, len(hues)) for _ in centers]
    word = thing.kind
    answers = []
    for k in range(len(hues)):
        colors = [hues[(start + k) % len(hues)] for start in first]
        surface = {"texture": {"type": "cells", "centers": centers, "colors": colors}}
        answers.append(
            {
                "name": f"turn{k}",
                "target": f"a photo of a patchwork {word} {place(draft.ground)}",
                "changes": _over(thing.objects, surface),
            }
        )
    target = f"a photo of a patchwork {word} {place(draft.ground)}"
    instruction = f"paint each part of the {word} red, yellow, green or blue"
    return _edit(draft, "parts", instruction, target, answers=answers)


def part_centers(thing: Thing, rng: np.random.Generator) -> Array:
    """(PARTS, 3) centres of parts of a thing's surface: k-means of points near it.

    Cells around centres separate front from back only in a thick body; the ideal editor's parts are
    cells by position only.
    """
    points = np.concatenate(list(_near_surface(thing, rng)))

    def squares(center: Array) -> Array:  # a sum over an axis of 3 takes numpy twice as long
        x, y, z = (points - center).T ** 2
        return x + y + z

    far = [int(rng.random() * len(points))]
    distance = squares(points[far[0]])
    while len(far) < PARTS:
        far.append(int(distance.argmax()))
        distance = np.minimum(distance, squares(points[far[-1]]))
    centers = points[far]
    for _ in range(12):
        own = np.argmin([squares(center) for center in centers], axis=0)
        # A centre without points stays in place.
        centers = np.stack(
            [points[own == k].mean(0) if (own == k).any() else centers[k] for k in range(PARTS)]
        )
    return centers


def _near_surface(thing: Thing, rng: np.random.Generator) -> Iterator[Array]:
    """World points within a twentieth of the height of the surface, per object."""
    for item in thing.objects:
        if item["shape"]["type"] == "mesh":
            yield thing.points + np.array(item["shape"]["position"])
            continue
        spec = BodySpec.model_validate(item["shape"])
        parts = spec.solid()
        boxes = [solids.reach(part) for part in parts if not part.carve]
        low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
        points = low + (high - low) * rng.random((4000, 3))
        near = np.abs(solids.body_distance(parts, spec.blend, points)) < 0.05
        a = np.radians(spec.yaw)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        yield points[near & (points[:, 2] > 0)] * spec.scale @ turn.T + np.array(spec.position)
