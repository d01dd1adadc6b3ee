"""Random scenes with true captions: objects, their looks and places.

A :class:`World` is a shape, its surroundings and its cameras; a :class:`Look` is its appearance:
surface, ground and time of day. One world has many looks, which gives pictures that differ in only
one attribute.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from attnwarp_eval.drawn.objects import RECIPES, body
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec

OBJECTS = tuple(RECIPES)
COLORS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey")
FINISHES = ("plain", "shiny", "golden", "silver", "bronze", "wooden", "stone", "marble", "striped", "checked")
GROUNDS = ("grass", "sand", "snow", "boards", "tiles", "road", "earth")
TIMES = ("day", "sunset", "night", "cloudy")
COLORED = ("plain", "shiny", "striped", "checked")
TWO_COLORED = ("striped", "checked")
STATUES = ("golden", "silver", "bronze", "stone", "marble", "wooden")

ATTRIBUTES = ("object", "finish", "color", "second", "ground", "time")
"""Attributes of a picture, indices into their words; -1 if absent or not mentioned."""

HSV: dict[str, tuple[float, float, float]] = {
    "red": (2, 0.82, 0.78), "orange": (25, 0.88, 0.93), "yellow": (51, 0.80, 0.94), "green": (122, 0.60, 0.55),
    "blue": (218, 0.74, 0.74), "purple": (276, 0.58, 0.58), "pink": (337, 0.42, 0.95), "brown": (24, 0.62, 0.42),
    "black": (0, 0.05, 0.10), "white": (40, 0.03, 0.95), "grey": (0, 0.02, 0.50),
}  # fmt: skip

Range = tuple[float, float]

SUNS: dict[str, tuple[Range, Range, str]] = {
    "day": ((30, 65), (2.4, 3.2), "#fff1dc"), "sunset": ((8, 20), (2.8, 4.2), "#ff9a4a"), "night": ((30, 55), (0.7, 1.3), "#9fb8f0"),
}  # fmt: skip
"""Elevation in degrees, irradiance and colour of the sun by the time of day; none if cloudy."""

SKIES: dict[str, tuple[str, str, Range]] = {
    "day": ("#d6e2ee", "#6c9fdb", (0.7, 1.0)), "sunset": ("#f0a878", "#5a6fb0", (0.6, 1.0)),
    "night": ("#34466e", "#141d3c", (0.8, 1.3)), "cloudy": ("#d4d8dc", "#aeb6c0", (0.8, 1.1)),
}  # fmt: skip
"""Horizon, zenith and radiance of the sky by the time of day."""

TRAIN_SHAPES = 40
"""Training instances of each object; held-out ones count from :data:`HELD_OUT_SHAPE`."""
HELD_OUT_SHAPE = 100_000


def held_out(thing: int, color: int) -> bool:
    """Return True for the pairs of object and colour kept from training: one of ten."""
    return (3 * thing + 7 * color) % 10 == 4


@dataclass(frozen=True)
class Look:
    """Appearance of a world: indices into attributes' words, and a seed of shades and light."""

    finish: int
    color: int
    second: int
    ground: int
    time: int
    seed: int

    @property
    def statue(self) -> bool:
        """True if the details have no separate colours."""
        return FINISHES[self.finish] in STATUES

    @cached_property
    def surface(self) -> dict[str, Any]:
        """``texture`` or ``material`` of the object, in the format of a scene file."""
        rng = np.random.default_rng([self.seed, 1])
        finish = FINISHES[self.finish]
        grain = {"variation": round(float(rng.uniform(0.05, 0.3)), 3), "grain": round(float(rng.uniform(0.03, 0.1)), 3)}
        if finish in ("plain", "shiny"):
            texture = {"type": "plain", "color": shade(COLORS[self.color], rng), **grain}
            if finish == "plain":
                return {"texture": texture}
            rough = round(float(rng.uniform(0.03, 0.12)), 3)
            return {"texture": {**texture, "variation": 0.05}, "material": {"type": "plastic", "roughness": rough}}
        if finish in TWO_COLORED:
            pair = [shade(COLORS[self.color], rng), shade(COLORS[self.second], rng)]
            size = round(float(rng.uniform(0.07, 0.16)), 3)
            if finish == "checked":
                return {"texture": {"type": "checker", "colors": pair, "size": size, **grain}}
            way = rng.normal(size=3) + np.array([0, 0, 1])
            direction = [round(float(v), 2) or 0.1 for v in way]
            wobble = round(float(rng.uniform(0, 0.5)), 2)
            return {
                "texture": {
                    "type": "stripes",
                    "colors": pair,
                    "size": size,
                    "direction": direction,
                    "wobble": wobble,
                    **grain,
                }
            }
        if finish in ("golden", "silver", "bronze"):
            metal = {"golden": "Au", "silver": "Ag", "bronze": "Cu"}[finish]
            tint = {"golden": "#ffffff", "silver": "#f2f4f8", "bronze": "#c9a878"}[finish]
            rough = round(float(rng.uniform(0.08, 0.3)), 3)
            return {"material": {"type": "metal", "metal": metal, "roughness": rough, "tint": tint}}
        if finish == "wooden":
            light = colorsys.hsv_to_rgb(rng.uniform(25, 34) / 360, rng.uniform(0.45, 0.62), rng.uniform(0.6, 0.85))
            dark = tuple(c * rng.uniform(0.6, 0.75) for c in light)
            way = [round(float(v), 2) or 0.1 for v in rng.normal(size=3) * [1, 1, 0.3]]
            return {
                "texture": {
                    "type": "stripes", "colors": [_hex(light), _hex(dark), _hex(light), _hex(tuple(c * 0.88 for c in light))],
                    "size": round(float(rng.uniform(0.015, 0.035)), 3), "direction": way, "wobble": 1.6, "variation": 0.25, "grain": 0.04,
                }
            }  # fmt: skip
        if finish == "stone":
            base = rng.uniform(0.34, 0.55)
            tones = [_hex((base * k * 1.02, base * k, base * k * 0.95)) for k in (0.7, 1.0, 1.25)]
            return {"texture": _noise(tones, 0.12, 0.5, 0.02, octaves=6)}
        veins = ["#f4f2ee", "#eceae6", "#f8f7f4", "#8b8d92", "#f1efec", "#e6e4e0"]
        size = round(float(rng.uniform(0.35, 0.7)), 2)
        return {"texture": _noise(veins, size, 0.05, 0.05, octaves=5)}

    @cached_property
    def floor(self) -> dict[str, Any]:
        """The ground's texture, in the format of a scene file."""
        rng = np.random.default_rng([self.seed, 2])
        kind = GROUNDS[self.ground]
        bright = rng.uniform(0.85, 1.1)
        tones = {
            "grass": ["#3f4f23", "#6f8a3d", "#87a04a", "#5b7434"], "sand": ["#c8ab74", "#dcc393", "#e6d3a8", "#cdb182"],
            "snow": ["#cfdae6", "#e8eef5", "#ffffff", "#dfe8f1"], "road": ["#3c3d40", "#4a4b4e", "#58595c", "#434447"],
            "earth": ["#3a2a1b", "#5d4630", "#76593b", "#4a3a26"],
        }  # fmt: skip
        if kind in tones:
            colors = [_scaled(c, bright) for c in tones[kind]]
            variation = {"snow": 0.1, "road": 0.45}.get(kind, 0.4)
            size = round(float(rng.uniform(0.4, 0.9)), 2)
            return _noise(colors, size, variation, 0.05, octaves=5)
        if kind == "boards":
            colors = [_scaled(c, bright) for c in ("#b98a58", "#a97a4a", "#c29664", "#9c6f42")]
            angle = rng.uniform(0, np.pi)
            way = [round(float(np.cos(angle)), 2), round(float(np.sin(angle)), 2), 0.0]
            return {
                "type": "stripes",
                "colors": colors,
                "size": round(float(rng.uniform(0.15, 0.3)), 2),
                "direction": way,
                "variation": 0.3,
                "grain": 0.05,
            }
        dark = _scaled("#ffffff", rng.uniform(0.35, 0.7))
        return {
            "type": "checker",
            "colors": [dark, "#e8e6e0"],
            "size": round(float(rng.uniform(0.35, 0.6)), 2),
            "variation": 0.08,
            "grain": 0.05,
        }

    @cached_property
    def lights(self) -> list[dict[str, Any]]:
        """Sun and sky of the time of day, in the format of a scene file."""
        rng = np.random.default_rng([self.seed, 3])
        azimuth = round(float(rng.uniform(0, 360)), 1)
        time = TIMES[self.time]
        lights: list[dict[str, Any]] = []
        if time in SUNS:
            elevation, irradiance, color = SUNS[time]
            lights.append({
                "type": "sun", "elevation": round(float(rng.uniform(*elevation)), 1), "azimuth": azimuth,
                "irradiance": round(float(rng.uniform(*irradiance)), 2), "color": color,
            })  # fmt: skip
        horizon, zenith, radiance = SKIES[time]
        radiance_drawn = round(float(rng.uniform(*radiance)), 2)
        lights.append({"type": "sky", "horizon": horizon, "zenith": zenith, "radiance": radiance_drawn})
        return lights


def shade(color: str, rng: np.random.Generator) -> str:
    """A shade of a colour of :data:`COLORS`, as '#rrggbb'."""
    hue, saturation, value = HSV[color]
    spread = 4 if color in ("orange", "brown", "yellow") else 7
    hue = (hue + rng.uniform(-spread, spread)) / 360 % 1
    saturation = np.clip(saturation * rng.uniform(0.88, 1.12), 0, 1)
    value = np.clip(value * rng.uniform(0.88, 1.1), 0, 1)
    return _hex(colorsys.hsv_to_rgb(hue, float(saturation), float(value)))


def _noise(colors: list[str], size: float, variation: float, grain: float, **octaves: int) -> dict[str, Any]:
    """Noise as a texture, in the format of a scene file."""
    return {"type": "noise", "colors": colors, "size": size, **octaves, "variation": variation, "grain": grain}


def _hex(rgb: tuple[float, ...]) -> str:
    return "#" + "".join(f"{int(np.clip(round(c * 255), 0, 255)):02x}" for c in rgb)


def _scaled(color: str, factor: float) -> str:
    return _hex(tuple(int(color[k : k + 2], 16) / 255 * factor for k in (1, 3, 5)))


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
                    "height": round(float(0.45 + radius * np.tan(np.radians(rng.uniform(4, 38)))), 2),
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
            place = [round(float(far * np.cos(angle)), 2), round(float(far * np.sin(angle)), 2), 0.0]
            kind = rng.choice(["rock", "tree", "ball", "cube", "stump"])
            tone = colorsys.hsv_to_rgb(rng.uniform(0, 1), rng.uniform(0.05, 0.35), rng.uniform(0.25, 0.75))
            texture = {"type": "plain", "color": _hex(tone), "variation": 0.4, "grain": 0.06}
            if kind == OBJECTS[self.thing] or kind == "rock":
                radii = [round(float(rng.uniform(0.15, 0.5)), 2) for _ in range(3)]
                shape = {
                    "type": "body",
                    "parts": [{"type": "ellipsoid", "center": [0, 0, 0.1], "radii": radii}],
                    "relief": {"depth": 0.08, "size": 0.3, "seed": int(rng.integers(20))},
                    "resolution": 32,
                }
                tone = colorsys.hsv_to_rgb(0.09, 0.12, rng.uniform(0.35, 0.6))
                texture = {"type": "plain", "color": _hex(tone), "variation": 0.5, "grain": 0.06}
            else:
                shape = body(str(kind), int(rng.integers(8)), resolution=40)
                if kind == "tree":
                    texture = _noise(["#2f4a1c", "#5c7a34", "#7d9648"], 0.15, 0.4, 0.05)
                    place = [round(1.4 * place[0], 2), round(1.4 * place[1], 2), 0.0]
            scale = round(float(rng.uniform(2.0, 3.5) if kind == "tree" else rng.uniform(0.35, 0.7)), 2)
            items.append(
                {"name": f"clutter{k}", "shape": {**shape, "position": place, "scale": scale}, "texture": texture}
            )
        for k in range(int(rng.integers(0, 3))):
            angle = rng.uniform(0, 2 * np.pi)
            far, high = rng.uniform(5, 9), rng.uniform(0.8, 3.5)
            box = {
                "type": "box", "center": [round(float(far * np.cos(angle)), 2), round(float(far * np.sin(angle)), 2), round(float(high / 2), 2)],
                "size": [round(float(rng.uniform(2, 8)), 2), 0.6, round(float(high), 2)], "yaw": round(float(np.degrees(angle)) + 90, 1),
            }  # fmt: skip
            if rng.uniform() < 0.6:
                texture = _noise(["#24391a", "#46652c", "#5f7f3a"], 0.3, 0.5, 0.08)
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
    seed: int, *, new_shapes: bool = False, thing: int | None = None, views: int = 2, bare: bool = False
) -> World:
    """A random world; ``new_shapes`` draws a shape that training never sees, ``bare`` leaves out all else."""
    rng = np.random.default_rng([seed, 5])
    drawn = int(rng.integers(len(OBJECTS)))
    instance = HELD_OUT_SHAPE + seed if new_shapes else int(rng.integers(TRAIN_SHAPES))
    return World(drawn if thing is None else thing, instance, seed, views, bare)


def draw_look(thing: int, rng: np.random.Generator, *, pairs: str = "seen") -> Look:
    """A random look for an object.

    Args:
        pairs: "seen" (colours shown in training), "new" (held-out ones; always a coloured finish of
            one colour) or "any".
    """
    weights = np.array([6, 3, 1.2, 1.2, 1.2, 1.4, 1.2, 1.2, 1.6, 1.6])
    while True:
        finish = int(rng.choice(len(FINISHES), p=weights / weights.sum()))
        color, second = int(rng.integers(len(COLORS))), int(rng.integers(len(COLORS)))
        kind = FINISHES[finish]
        if pairs == "new" and kind not in ("plain", "shiny"):
            continue
        if kind in TWO_COLORED and (
            color == second or {COLORS[color], COLORS[second]} <= {"black", "brown", "grey", "purple"}
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
        if (pairs == "seen" and unseen) or (pairs == "new" and not unseen):
            continue
        return Look(
            finish, color if kind in COLORED else -1, second if kind in TWO_COLORED else -1,
            int(rng.integers(len(GROUNDS))), int(rng.choice(len(TIMES), p=[0.4, 0.2, 0.2, 0.2])), int(rng.integers(2**31)),
        )  # fmt: skip


def change(look: Look, what: str, thing: int, rng: np.random.Generator, *, pairs: str = "seen") -> Look:
    """The look with one attribute changed: "surface" (finish and colours), "ground" or "time"; all else the same."""
    while True:
        other = draw_look(thing, rng, pairs=pairs)
        match what:
            case "surface":
                new = replace(look, finish=other.finish, color=other.color, second=other.second)
            case "ground":
                new = replace(look, ground=other.ground)
            case "time":
                new = replace(look, time=other.time)
            case _:
                raise ValueError(f"what: got {what!r}, expected surface, ground or time")
        if attributes(thing, new) != attributes(thing, look):
            return new


def attributes(thing: int, look: Look) -> tuple[int, ...]:
    """Attributes of a picture, in the order of :data:`ATTRIBUTES`."""
    return (thing, look.finish, look.color, look.second, look.ground, look.time)


# Sentences -----------------------------------------------------------------------------------------------------------

NOUNS: dict[str, tuple[str, ...]] = {
    "ball": ("ball", "sphere"), "cube": ("cube", "box", "block"), "cone": ("cone",), "cylinder": ("cylinder", "drum"),
    "ring": ("ring", "torus", "donut"), "mug": ("mug", "cup"), "bottle": ("bottle",), "vase": ("vase",), "chair": ("chair", "seat"),
    "table": ("table", "desk"), "lamp": ("lamp",), "tree": ("tree",), "mushroom": ("mushroom", "toadstool"), "cactus": ("cactus",),
    "house": ("house", "cottage", "hut"), "car": ("car", "automobile"), "bear": ("bear", "teddy bear"), "dinosaur": ("dinosaur", "stegosaurus"),
    "person": ("person", "man", "human figure"), "bust": ("bust of a man", "bust", "head of a man", "face"), "rabbit": ("rabbit", "bunny"),
    "duck": ("duck", "bird"), "snowman": ("snowman",), "stump": ("tree stump", "stump"), "plant": ("plant in a pot", "potted plant", "plant"),
}  # fmt: skip
HUES: dict[str, tuple[str, ...]] = {
    "red": ("red", "crimson", "scarlet"), "orange": ("orange",), "yellow": ("yellow",), "green": ("green",), "blue": ("blue",),
    "purple": ("purple", "violet"), "pink": ("pink",), "brown": ("brown",), "black": ("black",), "white": ("white",), "grey": ("grey", "gray"),
}  # fmt: skip
PLACES: dict[str, tuple[str, ...]] = {
    "grass": ("on grass", "in a garden", "on a lawn", "in a park", "in a meadow"), "sand": ("on sand", "on a beach", "in the desert"),
    "snow": ("in the snow", "on snow", "on snowy ground", "in winter"), "boards": ("on a wooden floor", "on wooden boards"),
    "tiles": ("on a tiled floor", "on checkered tiles"), "road": ("on the road", "on asphalt", "on the road side"),
    "earth": ("on bare earth", "on soil", "in a clearing", "on the forest floor"),
}  # fmt: skip
HOURS: dict[str, tuple[str, ...]] = {
    "day": ("by day", "in daylight", "on a sunny day", "in the sun"), "sunset": ("at sunset", "in the evening", "at dusk", "in warm evening light"),
    "night": ("at night", "on a moonlit night", "in the moonlight"), "cloudy": ("on a cloudy day", "under a grey sky", "on an overcast day"),
}  # fmt: skip
OPENINGS = ("a photo of", "a picture of", "a rendering of", "an image of", "a close view of", "")
FILLERS = (
    "nice", "old", "new", "small", "large", "little", "pretty", "strange", "lovely", "simple", "single", "typical", "famous", "real", "tiny",
    "heavy", "clean", "fine", "good", "great", "funny", "quiet", "lonely", "standing", "detailed", "beautiful", "ordinary", "interesting",
)  # fmt: skip


def surface_words(finish: int, color: int, second: int, rng: np.random.Generator) -> tuple[str, bool]:
    """The adjective of a surface, and whether it names a statue ("bronze statue of a bear")."""
    kind = FINISHES[finish]
    hue = one_of(HUES[COLORS[color]], rng) if color >= 0 else ""
    match kind:
        case "plain":
            return hue, False
        case "shiny":
            return one_of((f"shiny {hue}", f"glossy {hue}", f"{hue} plastic", f"polished {hue}"), rng), False
        case "striped" | "checked":
            other = one_of(HUES[COLORS[second]], rng)
            one, two = (hue, other) if rng.uniform() < 0.5 else (other, hue)
            word = {"striped": "striped", "checked": one_of(("checked", "chequered"), rng)}[kind]
            return f"{one} and {two} {word}", False
    words = {
        "golden": ("golden", "gold"), "silver": ("silver", "steel", "chrome"), "bronze": ("bronze", "copper"),
        "wooden": ("wooden",), "stone": ("stone",), "marble": ("marble", "white marble"),
    }[kind]  # fmt: skip
    return one_of(words, rng), bool(rng.uniform() < 0.4)


def sentence(values: tuple[int, ...], rng: np.random.Generator, *, fillers: bool = False) -> str:
    """A caption of the attributes that are not -1; ``values`` in the order of :func:`attributes`."""
    thing, finish, color, second, ground, time = values
    noun = one_of(NOUNS[OBJECTS[thing]], rng) if thing >= 0 else one_of(("thing", "object", "something"), rng)
    statue = False
    words = ""
    if finish >= 0:
        words, statue = surface_words(finish, color, second, rng)
    elif color >= 0:
        words = one_of(HUES[COLORS[color]], rng)
    if fillers and rng.uniform() < 0.35:
        words = f"{one_of(FILLERS, rng)} {words}"
    if statue:
        described = f"{words} {one_of(('statue', 'sculpture'), rng)} of {with_article(noun)}"
    elif noun in ("bust of a man", "head of a man"):
        described = f"{words} {noun}"
    else:
        described = f"{words} {noun}"
    if noun == "bear" and not statue and rng.uniform() < 0.5 and color >= 0 and finish in (-1, 0):
        named = {"white": "polar bear", "brown": "grizzly bear"}.get(COLORS[color])
        described = named or described
    parts = [one_of(OPENINGS, rng), with_article(" ".join(described.split()))]
    tail = [one_of(PLACES[GROUNDS[ground]], rng)] if ground >= 0 else []
    if time >= 0:
        tail.insert(int(rng.uniform() < 0.8) * len(tail), one_of(HOURS[TIMES[time]], rng))
    return " ".join(" ".join(parts + tail).split())


def captioned(pictured: tuple[int, ...], rng: np.random.Generator) -> tuple[int, ...]:
    """Attributes that a caption names: object and surface nearly always, ground and time half of the time."""
    thing, finish, color, second, ground, time = pictured
    if rng.uniform() < 0.2:
        return thing, -1, -1, -1, -1, -1
    if rng.uniform() < 0.06:
        thing = -1
    if rng.uniform() < 0.15:
        finish = color = second = -1
    elif FINISHES[finish] == "plain" or (FINISHES[finish] == "shiny" and rng.uniform() < 0.25):
        finish = -1  # "a red ball" is true of matte and of shiny ones
    if rng.uniform() < 0.5:
        ground = -1
    if rng.uniform() < 0.5:
        time = -1
    return thing, finish, color, second, ground, time


def one_of(choices: Sequence[str], rng: np.random.Generator) -> str:
    """One of some words, each as likely."""
    return choices[int(rng.integers(len(choices)))]


def with_article(words: str) -> str:
    """Words with their indefinite article."""
    return f"{'an' if words[:1] in 'aeiou' else 'a'} {words}"
