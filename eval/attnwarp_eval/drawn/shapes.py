"""Edits of a drawn scene that change its shapes: each thing with five edits, one of each kind.

``added-K``, ``replaced-K`` and ``moved-K`` of thing K have four right answers, ``removed-K`` and
``grown-K`` one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np

from attnwarp_eval.drawn.draft import Draft, Thing
from attnwarp_eval.drawn.worlds import shade
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Mesh, Shape
from attnwarp_eval.scene.spec import SceneSpec

Entry = dict[str, Any]
Array = np.ndarray

KINDS = ("added", "replaced", "moved", "removed", "grown")
"""Kinds of edits, the first word of their names."""

GROWTH = 1.2
"""Factor of a thing that grows: larger by a fifth, standing where it stood."""

SIDES = {"right": (1.0, 0.0), "left": (-1.0, 0.0), "back": (0.0, 1.0), "front": (0.0, -1.0)}
"""Directions (x, y) of the answers, by name."""


def shape_edits(draft: Draft, data: Mapping[str, Any]) -> list[Entry]:
    """Edits of a scene, in the format of its file.

    Args:
        data: the scene so far, in that format.
    """
    shapes = Scene(SceneSpec.model_validate(data)).shapes()
    names = [item["name"] for item in data["objects"]]
    edits = []
    for number, thing in enumerate(draft.things):
        own = [shape for shape in shapes if names[shape.object_id] in thing.names]
        edits += _edits(number, thing, own, shade(draft.accent, draft.stream("shapes")))
    return edits


def _edits(number: int, thing: Thing, shapes: Sequence[Shape], color: str) -> list[Entry]:
    bounds = np.stack([shape.bounds() for shape in shapes])
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    foot = np.array([*(low + high)[:2] / 2, low[2]])
    r, h = float((high - low)[:2].max() / 2), float(high[2] - low[2])
    word = thing.kind
    top = _top(shapes)

    def put(shape: Entry, name: str) -> list[Entry]:
        texture = {"type": "plain", "color": color, "variation": 0.1}
        return [{"name": f"{name}_{number}", "shape": shape, "texture": texture}]

    def changes(changed: Any) -> list[Entry]:
        return [
            {"object": item["name"], "shape": changed(deepcopy(item["shape"]))}
            for item in thing.objects
        ]

    does: dict[str, list[Entry]] = {
        "added": [
            {"name": name, "add": put(shape, "on")}
            for name, shape in _hats(top, float(np.clip(0.6 * r, 0.2, 0.4))).items()
        ],
        "replaced": [
            {"name": name, "remove": thing.names, "add": put(shape, "instead")}
            for name, shape in _others(foot, r, h).items()
        ],
        "moved": [
            {"name": name, "changes": changes(lambda s, way=way: _moved(s, r * np.array(way)))}
            for name, way in SIDES.items()
        ],
        "removed": [{"remove": thing.names}],
        "grown": [{"changes": changes(lambda s: _grown(s, foot))}],
    }
    says = {
        "added": f"put something on the {word}",
        "replaced": f"replace the {word} by something else",
        "moved": f"move the {word}",
        "removed": f"remove the {word}",
        "grown": f"make the {word} larger by a fifth",
    }
    edits = []
    for kind, answers in does.items():
        # Editors that want two prompts are not told which answer.
        target = f"a photo of a {word}, after the request: {says[kind]}"
        edit = {"name": f"{kind}-{number}", "instruction": says[kind], "target": target}
        edit["source"] = f"a photo of a {word}"
        several = [{**answer, "target": target} for answer in answers]
        edits.append(edit | ({"answers": several} if len(answers) > 1 else answers[0]))
    return edits


def _top(shapes: Sequence[Shape]) -> Array:
    """(3,) middle of a thing's highest surface."""
    shape = max(shapes, key=lambda one: float(one.bounds()[1, 2]))
    if isinstance(shape, Mesh):
        high = shape.vertices[:, 2]
        near = shape.vertices[high >= high.max() - 0.05 * np.ptp(high)]
        return np.array([*near[:, :2].mean(0), high.max()])
    middle = shape.bounds().mean(0)
    return np.array([*middle[:2], shape.bounds()[1, 2]])


def _hats(top: Array, s: float) -> dict[str, Entry]:
    """Four things to put on a thing, of size ``s``, each toward another side."""
    at = [
        [*(top[:2] + 0.5 * s * np.array(way)), top[2] + rise * s]
        for way, rise in zip(SIDES.values(), (0.9, 0.7, 0.0, 0.0), strict=True)
    ]
    disc = {"type": "disc", "round": 0.05 * s}
    hat = [
        {**disc, "center": [0, 0, 0.1 * s], "radius": 1.4 * s, "height": 0.3 * s},
        {**disc, "center": [0, 0, 0.7 * s], "radius": 0.8 * s, "height": 1.2 * s},
    ]
    post = [{"type": "capsule", "start": [0, 0, 0], "end": [0, 0, 2.4 * s], "radii": [0.5 * s] * 2}]
    return {
        "ball": {"type": "sphere", "center": at[0], "radius": s},
        "crate": {"type": "box", "center": at[1], "size": [1.7 * s, 1.7 * s, 1.5 * s], "yaw": 30},
        "hat": {"type": "body", "parts": hat, "resolution": 32, "position": at[2]},
        "post": {"type": "body", "parts": post, "resolution": 32, "position": at[3]},
    }


def _others(foot: Array, r: float, h: float) -> dict[str, Entry]:
    """Four things to stand in a thing's place, within its radius and height."""
    x, y, z = foot
    ball = min(r, h / 2)
    disc = {"type": "disc", "center": [0, 0, h / 2], "radius": 0.5 * r, "height": h, "round": 0.02}
    ring = {"type": "torus", "center": [0, 0, 0.75 * r], "radii": [0.5 * r, 0.2 * r], "roll": 90}
    body = {"type": "body", "resolution": 32, "position": [x, y, z]}
    return {
        "ball": {"type": "sphere", "center": [x, y, z + ball], "radius": ball},
        "crate": {
            "type": "box", "center": [x, y, z + 0.35 * h], "size": [1.3 * r, 1.3 * r, 0.7 * h],
        },
        "pillar": {**body, "parts": [disc]},
        "wheel": {**body, "parts": [ring]},
    }  # fmt: skip


def _moved(shape: Entry, by: Array) -> Entry:
    key = "position" if "position" in shape else "center"
    x, y, z = shape[key]
    return shape | {key: [x + by[0], y + by[1], z]}


def _grown(shape: Entry, foot: Array) -> Entry:
    """The shape, larger about a thing's foot."""
    key = "position" if "position" in shape else "center"
    grown = shape | {key: list(foot + GROWTH * (np.array(shape[key]) - foot))}
    if key == "position":
        return grown | {"scale": GROWTH * shape.get("scale", 1.0)}
    if shape["type"] == "sphere":
        return grown | {"radius": GROWTH * shape["radius"]}
    return grown | {"size": [GROWTH * side for side in shape["size"]]}
