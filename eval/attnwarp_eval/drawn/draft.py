"""A scene while it is drawn: its random numbers, its things, the looks they may have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from attnwarp_eval.drawn.axes import drawn_axes
from attnwarp_eval.drawn.worlds import (
    COLORS,
    FINISHES,
    GROUNDS,
    OBJECTS,
    TIMES,
    Look,
    held_out,
)

Array = npt.NDArray[np.float64]

GENERATOR = 1
"""Version; raised when the same seed and number would give another scene."""

SATURATED = ("red", "orange", "yellow", "green", "blue", "purple", "pink")


def unseen_colors(kind: str) -> list[int]:
    """Colours held out of training for this kind.

    Example:
        >>> [COLORS[c] for c in unseen_colors("rabbit")]
        ['yellow']
    """
    return [c for c in range(len(COLORS)) if held_out(OBJECTS.index(kind), c)]


@dataclass(frozen=True)
class Thing:
    """One thing of a drawn scene.

    Attributes:
        kind: a word of :data:`~attnwarp_eval.drawn.worlds.OBJECTS`.
        look: finish and colours; of the first thing, of its first part.
        objects: objects in the format of a scene file.
        reach: radius of the enclosing circle on the ground, and height.
        points: (N, 3) points on a mesh, turned and scaled, before translation.
    """

    kind: str
    instance: int
    look: Look
    objects: list[dict[str, Any]]
    reach: tuple[float, float]
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def names(self) -> list[str]:
        """Names of the thing's objects."""
        return [item["name"] for item in self.objects]


@dataclass
class Draft:
    """A scene while it is drawn."""

    number: int
    seed: int
    fixed: Mapping[str, float]
    things: list[Thing] = field(default_factory=list)
    places: list[tuple[float, float, float]] = field(default_factory=list)
    fences: list[dict[str, Any]] = field(default_factory=list)
    extras: list[dict[str, Any]] = field(default_factory=list)
    files: dict[str, Path] = field(default_factory=dict)
    word: ClassVar[str] = "drawn"

    def stream(self, what: str) -> np.random.Generator:
        """Random numbers for one aspect, independent of other aspects' draws."""
        return np.random.default_rng([GENERATOR, self.seed, self.number, *what.encode()])

    def colors_of(self, kind: str) -> list[int]:
        """Held-out colours of this kind, from which its colour is drawn."""
        return unseen_colors(kind)

    def other_color(self, rng: np.random.Generator, color: int) -> int:
        """The accent of the scene, or a bright colour if the accent is ``color``."""
        second = COLORS.index(self.accent)
        while second == color:
            second = COLORS.index(SATURATED[index(rng, len(SATURATED))])
        return second

    def begin(self) -> None:
        """Draw the position on each axis, the ground and the light."""
        self.axes = drawn_axes(self.stream("axes"), self.fixed)
        rng = self.stream("around")
        self.accent = SATURATED[index(rng, len(SATURATED))]
        self.ground = index(rng, len(GROUNDS))
        smooth, fog = rng.random() < 0.25, rng.random() < 0.08
        time = choice(rng, TIMES, (0.4, 0.2, 0.15, 0.25))
        # Light of a sun that glass or a mirror bends is a caustic, which would double the cost of
        # every picture. Smooth things stand under an even sky.
        self.smooth, self.time = smooth, TIMES.index("cloudy" if smooth else time)
        own = int(rng.integers(2**31))
        self.look = Look(0, 0, -1, self.ground, self.time, own)
        self.lights = [dict(light) for light in self.look.lights]
        self.fog = None
        if fog and not smooth:
            self.fog = {"sigma_t": between(rng, 0.02, 0.06), "albedo": 0.95, "g": 0.4}

    def look_of(self, rng: np.random.Generator, kind: str, shiny: bool, patterned: bool) -> Look:
        """A look held out of training for this kind, or one without a colour."""
        colors = self.colors_of(kind)
        color = colors[index(rng, len(colors))]
        second = self.other_color(rng, color)
        if shiny:
            finish = ("golden", "silver", "bronze")[index(rng, 3)]
            if kind in ("ball", "cube") and rng.random() < 0.7:
                finish = "shiny"
        elif patterned:
            finish = ("striped", "checked", "wooden", "marble")[pick(rng, (3, 3, 1, 1))]
        else:
            finish = "stone" if rng.random() < 0.15 else "plain"
        colored = finish in ("plain", "shiny", "striped", "checked")
        return Look(
            FINISHES.index(finish), color if colored else -1,
            second if finish in ("striped", "checked") else -1,
            self.ground, self.time, int(rng.integers(2**31)),
        )  # fmt: skip

    def surface(self, look: Look) -> dict[str, Any]:
        """A surface in a file's format, with a finer pattern for a higher texture axis."""
        surface = {key: dict(value) for key, value in look.surface.items()}
        texture, material = surface.get("texture"), surface.get("material")
        if material and material["type"] == "metal":
            # Smoother metal reflects specks of the sun, which are noisy at few samples a pixel.
            material["roughness"] = round(0.2 + material["roughness"], 3)
        if texture and look.second >= 0:
            texture["size"] = round(texture["size"] * (1.5 - 0.8 * self.axes.texture), 3)
        if texture:
            texture["variation"] = round(texture["variation"] * (0.3 + self.axes.texture), 3)
        return surface


# Draws that do not depend on NumPy's algorithms for them ---------------------------------------


def index(rng: np.random.Generator, count: int) -> int:
    """An index below ``count``."""
    return min(int(rng.random() * count), count - 1)


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number of that range, to four digits."""
    return round(low + (high - low) * float(rng.random()), 4)


def pick(rng: np.random.Generator, weights: Sequence[float]) -> int:
    """A random index with the given weights."""
    at = rng.random() * sum(weights)
    for k, weight in enumerate(weights):
        at -= weight
        if at < 0:
            return k
    return len(weights) - 1


def choice(rng: np.random.Generator, words: Sequence[str], weights: Sequence[float]) -> str:
    """A random word with the given weights."""
    return words[pick(rng, weights)]


def marks(rng: np.random.Generator, count: int, share: float) -> list[bool]:
    """A random ``share`` of ``count`` things, marked True."""
    order = sorted(range(count), key=lambda k: (rng.random(), k))
    return [order.index(k) < round(share * count) for k in range(count)]
