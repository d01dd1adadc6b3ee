"""Axes of difficulty of drawn scenes: their settings, and the quantities that measure them.

A scene's position on an axis is drawn, fixed by a study, or spread evenly over its scenes. The
quantities are measured on the exact geometry and never used to draw: they show that an axis works
as described.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError, suggest
from attnwarp_eval.scene.materials import DiffuseMaterial
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth import Geometry, two_view
from attnwarp_eval.truth.shading import object_albedo
from attnwarp_eval.two_view import HIDDEN, Hits

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


def check_axes(fixed: Mapping[str, Any], stratified: Iterable[str] = ()) -> None:
    """Refuse unknown axes, and positions out of range.

    Raises:
        InputError: the message has the axis, the given value, and the expected one.

    Example:
        >>> check_axes({"thin": 2})
        Traceback (most recent call last):
        attnwarp.errors.InputError: axes.thin: got 2, expected a number from 0 to 1
    """
    for name in (*fixed, *stratified):
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
    for name in stratified:
        if name in fixed:
            raise InputError(f"stratify: {name!r} is fixed under axes; leave out one of the two")


def spread(name: str, count: int, seed: int) -> list[float]:
    """Places on an axis for ``count`` scenes, one in each of ``count`` equal parts, in random
    order.

    Example:
        >>> sorted(spread("occlusion", 4, seed=1))
        [0.125, 0.375, 0.625, 0.875]
        >>> sorted(spread("things", 5, seed=1))
        [2, 3, 4, 5, 6]
    """
    rng = np.random.default_rng([seed, *b"strata", *name.encode()])
    middles = (rng.permutation(count) + 0.5) / count
    if name == "things":
        return [FEWEST + int(value * (MOST - FEWEST + 1)) for value in middles]
    return [round(float(value), 4) for value in middles]


def measured(scene: Scene, groups: Mapping[str, str], *, size: int = 96) -> dict[str, float]:
    """The quantity of each axis, from exact geometry and albedo.

    docs/truth/drawn-scenes.md defines them. "thin" counts the pixels of things and fences
    within 1.5 % of the height of another object, "texture" steps between pixels of one object.

    Args:
        scene: with a target ``yaw060``.
        groups: group of each object by name: "thing 0" and so on, "fence", "around".
        size: size of the traced views, px.
    """
    small = scene.with_size(size, size)
    geometry = Geometry(small)
    source, aside = small.source, small.camera("yaw060")
    hits, pair = geometry.trace(source), two_view(geometry, source, aside)
    names = np.array([groups[name] for name in small.object_names])
    group = np.where(hits.valid, names[np.maximum(hits.object_id, 0)], "around")
    standing, thing = group != "around", np.char.startswith(group.astype(str), "thing")
    shiny = np.array([not isinstance(o.material, DiffuseMaterial) for o in small.spec.objects])
    hidden = float((pair.label == HIDDEN).sum())
    return {
        "occlusion": hidden / max(hidden + float(pair.visible.sum()), 1.0),
        "thin": _near_edges(hits.object_id, standing, round(0.015 * size)),
        "grazing": _share(hits.cosine[hits.valid] < np.cos(np.radians(75))),
        "texture": _steps(small, geometry, hits),
        "highlights": _share(shiny[hits.object_id[thing]]),
        "things": float(len({name for name in names if name.startswith("thing")})),
    }


def _share(chosen: npt.NDArray[np.bool_]) -> float:
    return float(chosen.mean()) if chosen.size else 0.0


def _near_edges(
    object_id: npt.NDArray[np.int32], standing: npt.NDArray[np.bool_], reach: int
) -> float:
    """Share of the things' pixels within ``reach`` px of another object."""
    from scipy import ndimage

    side = 2 * reach + 1
    low, high = (f(object_id, size=side) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    return _share((low != high)[standing])


def _steps(scene: Scene, geometry: Geometry, hits: Hits) -> float:
    """Mean albedo step between neighbouring pixels of one object."""
    color = np.zeros((*hits.valid.shape, 3))
    ids = hits.primitive_id[hits.valid]
    color[hits.valid] = object_albedo(scene, geometry, hits.point[hits.valid], ids)
    step = np.abs(color[:, 1:] - color[:, :-1]).mean(-1)
    same = hits.valid[:, 1:] & (hits.object_id[:, 1:] == hits.object_id[:, :-1])
    return float(step[same].mean())


def to_words(axes: Axes) -> str:
    """A scene's position on each axis, for its description."""
    return ", ".join(f"{name} {value:g}" for name, value in asdict(axes).items())
