"""Objects and pixels that a scene's edits change, and descriptions of the edits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from attnwarp_eval.scene.edits import pick
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import CHANGES, ObjectChange
from attnwarp_eval.truth import Hits
from attnwarp_eval.truth.shapes import ShapeLabels


def touched(scene: Scene, name: str, answer: str | None = None) -> list[int]:
    """Ids of objects that an edit changes or removes; others change only in their light."""
    edit = scene.edit(name)
    does = pick(edit, answer) or edit
    names = [*(change.object for change in does.changes), *does.remove]
    return [scene.object_names.index(name) for name in names]


def edit_mask(
    scene: Scene,
    name: str,
    hits: Hits,
    answer: str | None = None,
    after: ShapeLabels | None = None,
) -> npt.NDArray[np.bool_]:
    """(H, W) bool: pixels of a view that show an edited object; all of them for an edit of the
    light.

    Args:
        after: labels of the view, for an edit that changes shapes: what is new counts too.
    """
    edit = scene.edit(name)
    if (pick(edit, answer) or edit).lights is not None:
        return np.ones(hits.object_id.shape, dtype=bool)
    mask = np.isin(hits.object_id, touched(scene, name, answer))
    return mask if after is None else mask | after.new


def describe(scene: Scene) -> str:
    """Description of a scene's edits."""
    if not scene.edits:
        return f"{scene.name} names no edits"
    lines = [f"{scene.name}: {scene.title}"]
    for edit in scene.edits:
        lines += [
            "",
            f"{edit.name}: {edit.instruction}",
            f"  from  {edit.source}",
            f"  to    {edit.target}",
        ]
        for does in edit.answers or (edit,):
            what = [f"{change.object} ({', '.join(_kinds(change))})" for change in does.changes]
            what += [f"{item.name} (added)" for item in does.add]
            what += [f"{name} (removed)" for name in does.remove]
            if does.lights is not None:
                what.append("the light")
            label = f"answer {does.name}" if edit.ambiguous else "changes"
            lines.append(f"  {label}: {', '.join(what)}")
    return "\n".join(lines)


def _kinds(change: ObjectChange) -> Iterator[str]:
    for name in CHANGES:
        if getattr(change, name):
            yield name
