"""Elements of every part of a scene file: the base of its models, colours, vectors."""

from __future__ import annotations

import warnings
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
)

from attnwarp.errors import InputWarning
from attnwarp_eval.colors import to_linear

FARTHEST = 1e9
"""Largest coordinate or length, in scene units. Float64 resolves 1e-7 there; the squares and
products of much larger values overflow float32 renderers."""


class SceneNotice(InputWarning):
    """Notice on a scene that is still usable."""


def silence_notices() -> None:
    """Silence :class:`SceneNotice` warnings in this process, for callers that report them.

    The filter is set once: each change makes Python print every other warning again.
    """
    if not any(
        action == "ignore" and kind is SceneNotice for action, _, kind, *_ in warnings.filters
    ):
        warnings.simplefilter("ignore", SceneNotice)


def _no_truth(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError(f"got {str(value).lower()}, expected a number")
    return value


Number = Annotated[float, BeforeValidator(_no_truth)]
"""A number; booleans are refused."""

Seed = Annotated[int, Field(ge=-(2**62), le=2**62)]
"""Seed of the noise's hash: a 64-bit number, minus the range of octaves."""

Coordinate = Annotated[Number, Field(ge=-FARTHEST, le=FARTHEST)]

Vector = tuple[Coordinate, Coordinate, Coordinate]

Positive = Annotated[Number, Field(gt=0, le=FARTHEST)]

Length = Annotated[Number, Field(ge=0, le=FARTHEST)]


def _hex(value: Any) -> str:
    if value is None:
        raise ValueError(
            "got nothing; an unquoted # starts a YAML comment, so write the colour in quotes:"
            " '#c08040'"
        )
    text = str(value)
    if len(text) != 7 or text[0] != "#" or any(c not in "0123456789abcdefABCDEF" for c in text[1:]):
        raise ValueError(f"got {value!r}, expected an sRGB colour in quotes such as '#c08040'")
    return text.lower()


def _direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(value):
        raise ValueError("got [0, 0, 0], expected a direction")
    return value


Direction = Annotated[Vector, AfterValidator(_direction)]
"""A vector of any length but zero."""

Color = Annotated[str, BeforeValidator(_hex)]


def linear_rgb(color: str) -> tuple[float, float, float]:
    """Linear RGB of an sRGB colour written '#rrggbb'."""
    r, g, b = to_linear(np.array([int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)]))
    return float(r), float(g), float(b)


class Spec(BaseModel):
    """Base of all models of a scene file: unknown keys and infinite numbers are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True
    )
