"""Worlds of a thing with parts, one of which an edit changes, or all of them at once (a statue)."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.drawn.assemblies import KINDS, USUAL, Pieces, pieces
from attnwarp_eval.drawn.objects import plain_numbers
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, OBJECTS, Look
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec
from attnwarp_eval.truth import Geometry
from training.worlds.draw import HELD_OUT_SHAPE, World

WHOLE = "whole"
"""Name for all parts together."""

WHOLE_NOUNS: dict[str, tuple[str, ...]] = {
    "person": ("person", "man", "woman", "human figure", "walker"), "bust": ("bust of a man", "bust", "head", "man"),
    "plant": ("plant in a pot", "potted plant", "plant"), "table": ("table with things on it", "table", "laid table"),
    "stump": ("tree stump", "stump", "old stump"), "axe": ("axe", "hatchet"), "shovel": ("shovel", "spade"),
    "dinosaur": ("dinosaur", "stegosaurus"), "bear": ("bear", "teddy bear"), "house": ("house", "cottage"), "car": ("car", "automobile"),
    "snowman": ("snowman",), "chair": ("chair",), "lamp": ("lamp",), "tree": ("tree", "apple tree"),
    "mushroom": ("mushroom", "toadstool"), "bowl": ("bowl of fruit", "fruit bowl"),
}  # fmt: skip


@dataclass(frozen=True)
class Assembly(World):
    """A thing with parts, one of which an edit changes.

    Attributes:
        thing: index into :data:`KINDS`.
        part: name of the part that looks apply to, or :data:`WHOLE`.
    """

    part: str = WHOLE

    @property
    def kind(self) -> str:
        """Name of the thing's kind."""
        return KINDS[self.thing]

    def pieces(self) -> Pieces:
        """The parts' shapes, in their order."""
        return pieces(self.kind, self.instance)

    def surfaces(self, look: Look) -> tuple[Look, ...]:
        """A look for each part: the given one for the edited part, the world's for the others.

        A look without a finish (-1) leaves every part as it was before an edit.
        """
        result = []
        for k, name in enumerate(self.pieces()):
            if self.part in (name, WHOLE) and look.finish >= 0:
                result.append(look)
                continue
            rng = np.random.default_rng([self.seed, 21, k])
            result.append(replace(look, **self.usual(name, rng), second=-1))
        return tuple(result)

    def usual(self, name: str, rng: np.random.Generator) -> dict[str, int]:
        """Finish, colour and seed of a part before an edit."""
        words = USUAL.get(name, COLORS) if rng.uniform() < 0.6 else COLORS
        color = COLORS.index(words[int(rng.integers(len(words)))])
        finish = (
            "shiny"
            if rng.uniform() < 0.2 and name not in ("skin", "hair", "fur", "leaves")
            else "plain"
        )
        return {"finish": FINISHES.index(finish), "color": color, "seed": int(rng.integers(2**31))}

    def edited(self) -> tuple[int, ...]:
        """Indices of the objects that the edit changes."""
        return tuple(k for k, name in enumerate(self.pieces()) if self.part in (name, WHOLE))

    def spec(self, look: Look, size: int, *, statue: bool | None = None) -> dict[str, Any]:
        """The scene in the format of a file: the parts first, then the ground."""
        alone = World(OBJECTS.index("ball"), 0, self.seed, self.views, self.bare)
        base = alone.spec(look, size)
        first, ground, *rest = base["objects"]
        place = {key: first["shape"][key] for key in ("yaw", "scale")}
        objects = []
        for (name, parts), surface in zip(self.pieces().items(), self.surfaces(look), strict=True):
            shape = {
                "type": "body",
                "parts": plain_numbers(parts),
                "blend": 0.03,
                "resolution": 56,
                **place,
            }
            objects.append({"name": name.replace(" ", "_"), "shape": shape, **surface.surface})
        return {**base, "title": self.kind, "objects": [*objects, ground, *rest]}

    def scene(self, look: Look, size: int) -> Scene:
        """The scene."""
        return Scene(SceneSpec.model_validate(self.spec(look, size)))


LEAST_THING, LEAST_PART = 0.03, 0.006
"""Least shares of both pictures covered by the thing, and by the edited part."""


@functools.lru_cache(maxsize=64)
def draw_assembly(seed: int, kind: int, *, new_shapes: bool = False, views: int = 2) -> Assembly:
    """A random thing with parts, with a random edited part; one in five edits changes the whole.

    Cameras that miss the thing, and parts too small to be seen, are redrawn.

    Example:
        >>> draw_assembly(1, KINDS.index("plant")).kind
        'plant'
    """
    for attempt in range(100):
        rng = np.random.default_rng([seed, 22, attempt])
        drawn = seed + 1_000_000_000 * attempt
        whole = Assembly(kind, HELD_OUT_SHAPE + seed if new_shapes else seed, drawn, views)
        names = list(whole.pieces())
        shares = _shares(whole, len(names)).min(axis=0)
        large = [name for name, share in zip(names, shares, strict=True) if share >= LEAST_PART]
        if shares.sum() < LEAST_THING or not large:
            continue
        part = WHOLE if rng.uniform() < 0.2 else large[int(rng.integers(len(large)))]
        return replace(whole, part=part)
    raise RuntimeError(f"seed {seed}: no camera saw the {KINDS[kind]} in 100 attempts")


def _shares(world: Assembly, count: int) -> npt.NDArray[np.float64]:
    """(views, count) share of a small picture that each part covers."""
    look = Look(FINISHES.index("plain"), 0, -1, 0, 0, 0)
    scene = world.scene(look, 48)
    geometry = Geometry(scene)
    ids = [geometry.trace(scene.cameras[view]).object_id for view in range(world.views)]
    return np.array([[(seen == k).mean() for k in range(count)] for seen in ids])
