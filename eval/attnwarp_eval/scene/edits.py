"""Edits with truth: an instruction's effect on a scene, which then renders anywhere."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.materials import TEXTURED
from attnwarp_eval.scene.spec import AnswerSpec, EditSpec, ObjectChange, ObjectSpec, SceneSpec
from attnwarp_eval.scene.transport import contradictions

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear sRGB (Rec. 709)."""

WHITE = "#ffffff"


def pick(edit: EditSpec, answer: str | None = None) -> AnswerSpec | None:
    """The named answer, by default the first; None for an edit with one result.

    Raises:
        ValueError: no such answer.
    """
    if answer is None:
        return edit.answers[0] if edit.answers else None
    for one in edit.answers:
        if one.name == answer:
            return one
    names = ", ".join(one.name for one in edit.answers) or "none: its result is the only one"
    raise ValueError(f"edit {edit.name!r}: no answer {answer!r}; it has {names}")


def reshapes(edit: EditSpec, answer: str | None = None) -> bool:
    """Return True if an edit, or one of its answers, changes, adds or removes a shape.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> any(reshapes(edit) for edit in load_scene("bear").edits)
        False
    """
    does = pick(edit, answer) or edit
    return bool(does.add or does.remove or any(change.shape for change in does.changes))


def apply(spec: SceneSpec, edit: EditSpec, answer: AnswerSpec | None = None) -> SceneSpec:
    """Apply an edit; the resulting scene has no edits, and what is added comes last.

    Raises:
        ValueError: the edit changes or removes an unknown object, adds one of a name that is
            taken, or its result is not a valid scene.
    """
    does = answer or edit
    objects = {item.name: item for item in spec.objects}
    for name in (*(change.object for change in does.changes), *does.remove):
        if name not in objects:
            raise ValueError(f"edit {edit.name!r}: there is no object {name!r}")
    for change in does.changes:
        objects[change.object] = changed(objects[change.object], change)
    for name in does.remove:
        objects.pop(name, None)
    for item in does.add:
        if item.name in objects:
            raise ValueError(f"edit {edit.name!r}: adds a second object {item.name!r}; rename it")
        objects[item.name] = item
    if not objects:
        raise ValueError(f"edit {edit.name!r}: removes every object; keep one")
    light = {} if does.bounces is None else {"bounces": does.bounces}
    return spec.model_copy(
        update={
            "name": "-".join([spec.name, edit.name, *([answer.name] if answer else [])]),
            "title": f"{spec.title}: {edit.instruction}",
            "objects": tuple(objects.values()),
            "lights": spec.lights if does.lights is None else does.lights,
            "appearance": spec.appearance.model_copy(update=light),
            "edits": (),
        }
    )


def changed(item: ObjectSpec, change: ObjectChange) -> ObjectSpec:
    """One object after a change.

    Raises:
        ValueError: ``recolor`` or ``keep`` names a colour that the object does not have, or the
            object has no texture to change.
    """
    values = item.model_dump(mode="json", exclude_unset=True)
    if change.shape is not None:
        values["shape"] = change.shape.model_dump(mode="json", exclude_unset=True)
    shows = change.material or item.material
    if (change.paint or change.texture) and (item.emission or not isinstance(shows, TEXTURED)):
        kind = "a lamp" if item.emission else shows.type
        raise ValueError(
            f"{'paint' if change.paint else 'texture'}: {item.name!r} is {kind}, which shows no"
            " texture; use recolor or material"
        )
    if change.recolor:
        met: set[str] = set()
        values = _recolored(values, change.recolor, met)
        missing = sorted(set(change.recolor) - met)
        if missing:
            raise ValueError(
                f"recolor: {item.name!r} has no colour {missing[0]!r}; it has"
                f" {', '.join(_colors(values))}"
            )
    if change.texture is not None:
        values["texture"] = change.texture.model_dump(mode="json")
    if change.paint is not None:
        parts = values["shape"].get("parts", ())
        own = {part.get("color", WHITE) for part in parts}
        missing = sorted(set(change.keep) - own)
        if missing:
            raise ValueError(
                f"keep: no part of {item.name!r} has the colour {missing[0]!r}; they have"
                f" {', '.join(sorted(own)) or 'none'}"
            )
        for part in parts:
            if part.get("color", WHITE) not in change.keep:
                part["color"] = WHITE
        if "texture" in values:
            values["texture"] = _painted(values["texture"], change.paint)
    if change.material is not None:
        values["material"] = change.material.model_dump(mode="json")
        if not isinstance(change.material, TEXTURED):
            values.pop("texture", None)
    return type(item).model_validate(values)


def _recolored(node: Any, colors: dict[str, str], met: set[str]) -> Any:
    if isinstance(node, dict):
        return {key: _recolored(value, colors, met) for key, value in node.items()}
    if isinstance(node, list):
        return [_recolored(value, colors, met) for value in node]
    if isinstance(node, str) and node in colors:
        met.add(node)
        return colors[node]
    return node


def _colors(node: Any) -> list[str]:
    if isinstance(node, dict):
        node = list(node.values())
    if isinstance(node, list):
        return sorted({color for value in node for color in _colors(value)})
    return [node] if isinstance(node, str) and node.startswith("#") else []


def _painted(texture: dict[str, Any], paint: str) -> dict[str, Any]:
    """The texture in shades of one colour; lightness relative to the lightest stays."""
    colors = _colors(texture)
    light = {color: float(LUMINANCE @ np.array(linear_rgb(color))) for color in colors}
    brightest = max(light.values()) or 1.0
    shades = {
        color: _hex(np.array(linear_rgb(paint)) * (light[color] or 1e-3) / brightest)
        for color in colors
    }
    painted: dict[str, Any] = _recolored(texture, shades, set())
    return painted


def _hex(linear: npt.NDArray[np.float64]) -> str:
    return "#" + "".join(f"{round(255 * float(c)):02x}" for c in to_srgb(np.clip(linear, 0, 1)))


def problems(spec: SceneSpec) -> Iterator[tuple[str, tuple[int | str, ...]]]:
    """Faults of a scene's edits: the message, and its place in the file."""
    seen: dict[str, int] = {}
    for k, edit in enumerate(spec.edits):
        if edit.name in seen:
            yield (
                (
                    f"edits[{k}].name: {edit.name!r} is also the name of edits[{seen[edit.name]}];"
                    " rename one"
                ),
                ("edits", k),
            )
        seen[edit.name] = k
        names = [answer.name for answer in edit.answers]
        if len(set(names)) < len(names):
            yield (
                f"edits[{k}].answers: two of them have one name ({', '.join(names)}); rename one",
                ("edits", k),
            )
        for answer in edit.answers or (None,):
            try:
                result = apply(spec, edit, answer)
            except ValidationError as error:
                yield f"edits[{k}]: {error.errors(include_url=False)[0]['msg']}", ("edits", k)
                continue
            except ValueError as error:
                yield (
                    f"edits[{k}]: {error}; objects are {', '.join(o.name for o in spec.objects)}",
                    ("edits", k),
                )
                continue
            for message, _ in contradictions(result):
                yield f"edits[{k}]: makes a scene that contradicts itself: {message}", ("edits", k)
