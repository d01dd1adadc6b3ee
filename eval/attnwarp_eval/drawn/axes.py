"""Axes of difficulty of drawn scenes. A scene's position on an axis is drawn, or fixed by a study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from attnwarp.errors import InputError, suggest

FEWEST, MOST = 2, 6
"""Number of things in a drawn scene."""


@dataclass(frozen=True)
class Axes:
    """A scene's position on each axis of difficulty, from 0 to 1; ``things`` is their number.

    Attributes:
        occlusion: nearness and size of the things around the first one.
        thin: number of fences, and thinness of their pickets.
        grazing: lowness of the cameras, which see the ground at a grazing angle.
        texture: number of patterned surfaces, and fineness of the patterns.
        highlights: share of the things that are metal or plastic.
        things: number of things, from 2 to 6.
    """

    occlusion: float
    thin: float
    grazing: float
    texture: float
    highlights: float
    things: int


NAMES = tuple(Axes.__dataclass_fields__)


def drawn_axes(rng: np.random.Generator, fixed: Mapping[str, float]) -> Axes:
    """Axes drawn uniformly, except fixed ones.

    Example:
        >>> drawn_axes(np.random.default_rng(0), {"thin": 0.0, "things": 4}).things
        4
    """
    drawn = {name: float(rng.random()) for name in NAMES}
    values: dict[str, Any] = {
        name: fixed.get(name, round(value, 3)) for name, value in drawn.items() if name != "things"
    }
    number = FEWEST + int(drawn["things"] * (MOST - FEWEST + 1))
    return Axes(**values, things=int(fixed.get("things", number)))


def check_axes(fixed: Mapping[str, Any]) -> None:
    """Refuse unknown axes, and positions out of range.

    Raises:
        InputError: the message has the axis, the given value, and the expected one.

    Example:
        >>> check_axes({"thin": 2})
        Traceback (most recent call last):
        attnwarp.errors.InputError: axes.thin: got 2, expected a number from 0 to 1
    """
    for name in fixed:
        if name not in NAMES:
            raise InputError(
                f"axes: no axis {name!r}{suggest(str(name), NAMES)}; they are {', '.join(NAMES)}"
            )
    for name, value in fixed.items():
        low, high = (FEWEST, MOST) if name == "things" else (0, 1)
        whole = name != "things" or value == int(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not whole:
            raise InputError(f"axes.{name}: got {value!r}, expected a number from {low} to {high}")
        if not low <= value <= high:
            raise InputError(f"axes.{name}: got {value}, expected a number from {low} to {high}")


def to_words(axes: Axes) -> str:
    """A scene's position on each axis, for its description."""
    return ", ".join(f"{name} {value:g}" for name, value in asdict(axes).items())
