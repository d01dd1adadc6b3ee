"""Random worlds to train on: an object, its surroundings and cameras, in many looks.

One :class:`World` has many looks, which gives pictures that differ in only one attribute.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Any

import numpy as np

from attnwarp_eval.drawn.objects import body
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    OBJECTS,
    TIMES,
    TWO_COLORED,
    Look,
    held_out,
    hex_color,
    noise_texture,
)
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec

COLORED = ("plain", "shiny", "striped", "checked")

TRAIN_SHAPES = 40
"""Training instances of each object; held-out ones count from :data:`HELD_OUT_SHAPE`."""
HELD_OUT_SHAPE = 100_000


@dataclass(frozen=True)
class World:
    """An object with its surroundings and cameras; ``seed`` decides everything but the shape."""

    thing: int
    instance: int
    seed: int
    views: int = 2
    bare: bool = False

    def surfaces(self, look: Look) -> tuple[Look, ...]:
        """The looks of the objects before the ground: here of the one object."""
        return (look,)

    def spec(self, look: Look, size: int, *, statue: bool | None = None) -> dict[str, Any]:
        """The scene in the format of a file; the object is object 0, the ground object 1."""
        rng = np.random.default_rng([self.seed, 4])
        statue = look.statue if statue is None else statue
        shape = body(OBJECTS[self.thing], self.instance, plain=statue)
        # A body on its side or askew is still the same thing; small turns only: it must stand.
        shape["yaw"] = round(float(rng.uniform(0, 360)), 1)
        shape["scale"] = round(float(rng.uniform(0.85, 1.2)), 3)
        objects = [
            {"name": "thing", "shape": shape, **look.surface},
            {
                "name": "ground",
                "shape": {"type": "rectangle", "center": [0, 0, 0], "size": [24, 24]},
                "texture": look.floor,
            },
            *([] if self.bare else self._clutter(rng)),
        ]
        middle = [round(float(rng.uniform(-0.12, 0.12)), 3) for _ in range(2)]
        turn, radius = rng.uniform(0, 360), rng.uniform(2.1, 3.8)
        cameras = []
        for _ in range(self.views):
            cameras.append(
                {
                    "yaw": round(float(turn % 360), 1),
                    "height": round(
                        float(0.45 + radius * np.tan(np.radians(rng.uniform(4, 38)))), 2
                    ),
                }
            )
            turn += rng.uniform(25, 110) * (1 if rng.uniform() < 0.5 else -1)
        return {
            "name": f"world-{self.seed}",
            "title": OBJECTS[self.thing],
            "objects": objects,
            "lights": look.lights,
            # Direct light, independent of a scene's default: bundled weights were trained on it.
            "appearance": {"bounces": 1},
            "cameras": {
                "look_at": [*middle, round(float(rng.uniform(0.38, 0.6)), 2)], "radius": round(float(radius), 2),
                "fov": round(float(rng.uniform(28, 42)), 1), "size": [size, size],
                "source": cameras[0], "targets": cameras[1:] or [{**cameras[0], "name": "again"}],
            },
        }  # fmt: skip

    def _clutter(self, rng: np.random.Generator) -> list[dict[str, Any]]:
        """Small muted things around, never of the object's kind, and sometimes a wall or a hedge."""
        items = []
        for k in range(int(rng.integers(0, 5))):
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 4.0)
            place = [
                round(float(far * np.cos(angle)), 2),
                round(float(far * np.sin(angle)), 2),
                0.0,
            ]
            kind = rng.choice(["rock", "tree", "ball", "cube", "stump"])
            tone = colorsys.hsv_to_rgb(
                rng.uniform(0, 1), rng.uniform(0.05, 0.35), rng.uniform(0.25, 0.75)
            )
            texture = {"type": "plain", "color": hex_color(tone), "variation": 0.4, "grain": 0.06}
            if kind == OBJECTS[self.thing] or kind == "rock":
                radii = [round(float(rng.uniform(0.15, 0.5)), 2) for _ in range(3)]
                shape = {
                    "type": "body",
                    "parts": [{"type": "ellipsoid", "center": [0, 0, 0.1], "radii": radii}],
                    "relief": {"depth": 0.08, "size": 0.3, "seed": int(rng.integers(20))},
                    "resolution": 32,
                }
                tone = colorsys.hsv_to_rgb(0.09, 0.12, rng.uniform(0.35, 0.6))
                texture = {
                    "type": "plain",
                    "color": hex_color(tone),
                    "variation": 0.5,
                    "grain": 0.06,
                }
            else:
                shape = body(str(kind), int(rng.integers(8)), resolution=40)
                if kind == "tree":
                    texture = noise_texture(["#2f4a1c", "#5c7a34", "#7d9648"], 0.15, 0.4, 0.05)
                    place = [round(1.4 * place[0], 2), round(1.4 * place[1], 2), 0.0]
            scale = round(
                float(rng.uniform(2.0, 3.5) if kind == "tree" else rng.uniform(0.35, 0.7)), 2
            )
            items.append(
                {
                    "name": f"clutter{k}",
                    "shape": {**shape, "position": place, "scale": scale},
                    "texture": texture,
                }
            )
        for k in range(int(rng.integers(0, 3))):
            angle = rng.uniform(0, 2 * np.pi)
            far, high = rng.uniform(5, 9), rng.uniform(0.8, 3.5)
            box = {
                "type": "box", "center": [round(float(far * np.cos(angle)), 2), round(float(far * np.sin(angle)), 2), round(float(high / 2), 2)],
                "size": [round(float(rng.uniform(2, 8)), 2), 0.6, round(float(high), 2)], "yaw": round(float(np.degrees(angle)) + 90, 1),
            }  # fmt: skip
            if rng.uniform() < 0.6:
                texture = noise_texture(["#24391a", "#46652c", "#5f7f3a"], 0.3, 0.5, 0.08)
            else:
                texture = {
                    "type": "bricks",
                    "colors": ["#8d5a45", "#a06a50", "#7c4d3c"],
                    "mortar": "#b5aa9c",
                    "size": [0.5, 0.2],
                }
            items.append({"name": f"wall{k}", "shape": box, "texture": texture})
        return items

    def scene(self, look: Look, size: int) -> Scene:
        """The scene, which Mitsuba renders with its real materials."""
        return Scene(SceneSpec.model_validate(self.spec(look, size)))


def draw_world(
    seed: int,
    *,
    new_shapes: bool = False,
    thing: int | None = None,
    views: int = 2,
    bare: bool = False,
) -> World:
    """A random world; ``new_shapes`` draws a shape that training never sees, ``bare`` leaves out all else."""
    rng = np.random.default_rng([seed, 5])
    drawn = int(rng.integers(len(OBJECTS)))
    instance = HELD_OUT_SHAPE + seed if new_shapes else int(rng.integers(TRAIN_SHAPES))
    return World(drawn if thing is None else thing, instance, seed, views, bare)


def draw_look(thing: int, rng: np.random.Generator, *, pairs: str = "seen") -> Look:
    """A random look for an object.

    Args:
        pairs: "seen" (colours shown in training) or "any".
    """
    weights = np.array([6, 3, 1.2, 1.2, 1.2, 1.4, 1.2, 1.2, 1.6, 1.6])
    while True:
        finish = int(rng.choice(len(FINISHES), p=weights / weights.sum()))
        color, second = int(rng.integers(len(COLORS))), int(rng.integers(len(COLORS)))
        kind = FINISHES[finish]
        if kind in TWO_COLORED and (
            color == second
            or {COLORS[color], COLORS[second]} <= {"black", "brown", "grey", "purple"}
        ):
            continue
        # White checks on white snow are no trouble, but two checks of one named colour are.
        if kind in TWO_COLORED and {COLORS[color], COLORS[second]} in (
            {"red", "orange"},
            {"red", "brown"},
            {"orange", "yellow"},
            {"grey", "white"},
            {"pink", "purple"},
            {"orange", "brown"},
            {"red", "pink"},
        ):
            continue
        used = [color, second] if kind in TWO_COLORED else [color] if kind in COLORED else []
        unseen = any(held_out(thing, c) for c in used)
        if pairs == "seen" and unseen:
            continue
        return Look(
            finish, color if kind in COLORED else -1, second if kind in TWO_COLORED else -1,
            int(rng.integers(len(GROUNDS))), int(rng.choice(len(TIMES), p=[0.4, 0.2, 0.2, 0.2])), int(rng.integers(2**31)),
        )  # fmt: skip
