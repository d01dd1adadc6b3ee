"""Looks of drawn things, and their words: surface, ground and time of day."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from attnwarp_eval.drawn.objects import RECIPES

OBJECTS = tuple(RECIPES)
COLORS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey")
FINISHES = ("plain", "shiny", "golden", "silver", "bronze", "wooden", "stone", "marble", "striped", "checked")
GROUNDS = ("grass", "sand", "snow", "boards", "tiles", "road", "earth")
TIMES = ("day", "sunset", "night", "cloudy")
TWO_COLORED = ("striped", "checked")
STATUES = ("golden", "silver", "bronze", "stone", "marble", "wooden")

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
                    "type": "stripes", "colors": [hex_color(light), hex_color(dark), hex_color(light), hex_color(tuple(c * 0.88 for c in light))],
                    "size": round(float(rng.uniform(0.015, 0.035)), 3), "direction": way, "wobble": 1.6, "variation": 0.25, "grain": 0.04,
                }
            }  # fmt: skip
        if finish == "stone":
            base = rng.uniform(0.34, 0.55)
            tones = [hex_color((base * k * 1.02, base * k, base * k * 0.95)) for k in (0.7, 1.0, 1.25)]
            return {"texture": noise_texture(tones, 0.12, 0.5, 0.02, octaves=6)}
        veins = ["#f4f2ee", "#eceae6", "#f8f7f4", "#8b8d92", "#f1efec", "#e6e4e0"]
        size = round(float(rng.uniform(0.35, 0.7)), 2)
        return {"texture": noise_texture(veins, size, 0.05, 0.05, octaves=5)}

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
            return noise_texture(colors, size, variation, 0.05, octaves=5)
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
    return hex_color(colorsys.hsv_to_rgb(hue, float(saturation), float(value)))


def noise_texture(colors: list[str], size: float, variation: float, grain: float, **octaves: int) -> dict[str, Any]:
    """Noise as a texture, in the format of a scene file."""
    return {"type": "noise", "colors": colors, "size": size, **octaves, "variation": variation, "grain": grain}


def hex_color(rgb: tuple[float, ...]) -> str:
    """A colour in [0, 1] as '#rrggbb'; channels beyond are clipped."""
    return "#" + "".join(f"{int(np.clip(round(c * 255), 0, 255)):02x}" for c in rgb)


def _scaled(color: str, factor: float) -> str:
    return hex_color(tuple(int(color[k : k + 2], 16) / 255 * factor for k in (1, 3, 5)))


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
def with_article(words: str) -> str:
    """Words with their indefinite article."""
    return f"{'an' if words[:1] in 'aeiou' else 'a'} {words}"
