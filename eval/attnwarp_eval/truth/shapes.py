"""Labels of a view before and after an edit of shapes: new, gone, uncovered, untouched."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Shape
from attnwarp_eval.truth.correspondence import as_corners, corner_hits
from attnwarp_eval.truth.raycast import Geometry
from attnwarp_eval.two_view import AMBIGUOUS, Hits

Mask = npt.NDArray[np.bool_]
Ids = npt.NDArray[np.int32]

UNTOUCHED, NEW, UNCOVERED = 0, 1, 2
"""Labels of a pixel after an edit; :class:`ShapeLabels` defines them, and AMBIGUOUS."""

GONE = 4
"""Added to a label within :meth:`ShapeEdit.labels` where what stood before is gone."""


@dataclass(frozen=True, eq=False)
class ShapeLabels:
    """One view before and after an edit of shapes.

    Attributes:
        before, after: hits of the view; object ids are those of the scene of that time.
        label: (H, W) uint8.
            0 UNTOUCHED: the pixel shows the same surface as before, or none as before.
            1 NEW: it shows an object that was not there, or not in this shape and place.
            2 UNCOVERED: it shows an untouched surface, or none, where a surface stood that is gone.
            3 AMBIGUOUS: the four corners of the pixel do not have the answer of its centre.
        gone: (H, W) bool: before the edit the pixel certainly shows a surface that is not there
            after it. Behind it something is new or uncovered.
    """

    before: Hits
    after: Hits
    label: npt.NDArray[np.uint8]
    gone: Mask

    @property
    def new(self) -> Mask:
        """(H, W) bool: the pixel certainly shows a new surface."""
        return self.label == NEW


def kept_objects(before: Scene, after: Scene) -> set[str]:
    """Names of the objects with the same surface in both scenes, whatever its colour.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> scene = load_scene("spheres")
        >>> kept_objects(scene, scene.with_size(8, 8)) == set(scene.object_names)
        True
    """
    first, second = _surfaces(before), _surfaces(after)
    return {
        name
        for name in first.keys() & second.keys()
        if len(first[name]) == len(second[name]) and all(map(_same, first[name], second[name]))
    }


def _surfaces(scene: Scene) -> dict[str, list[Shape]]:
    own: dict[str, list[Shape]] = {name: [] for name in scene.object_names}
    for shape in scene.shapes():
        own[scene.object_names[shape.object_id]].append(shape)
    return own


def _same(a: Shape, b: Shape) -> bool:
    names = [field.name for field in fields(a) if field.name not in ("object_id", "tint")]
    return type(a) is type(b) and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in names
    )


class ShapeEdit:
    """A scene before and after an edit that changes shapes.

    Surfaces correspond by name: an object with the same name, shape and place in both is one
    surface. A moved, grown or replaced one is gone in its old place and new in its new one.

    Args:
        before, after: the scenes, with the same cameras.
        geometry: geometry of ``before``, if already made.

    Attributes:
        old, new: geometry before and after.

    Example:
        >>> from attnwarp_eval.scene.edits import apply
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.scene.scene import Scene
        >>> from attnwarp_eval.scene.spec import EditSpec
        >>> scene = load_scene("spheres").with_size(32, 32)
        >>> edit = EditSpec(name="less", instruction="Remove the melon", source="", target="",
        ...                 remove=("melon",))
        >>> labels = ShapeEdit(scene, Scene(apply(scene.spec, edit))).labels(scene.source)
        >>> bool(labels.new.any()), bool(labels.gone.any())
        (False, True)
    """

    def __init__(self, before: Scene, after: Scene, geometry: Geometry | None = None) -> None:
        self.old = Geometry(before) if geometry is None else geometry
        self.new = Geometry(after)
        kept = kept_objects(before, after)
        # The last entry is that of the id -1, no surface.
        self._gone = np.array([*(name not in kept for name in before.object_names), False])
        self._new = np.array([*(name not in kept for name in after.object_names), False])

    def labels(self, camera: Camera) -> ShapeLabels:
        """Label the pixels of a view."""
        before, after = self.old.trace(camera), self.new.trace(camera)
        center = self._told(before.object_id, after.object_id)
        corners = [corner_hits(g, camera).object_id for g in (self.old, self.new)]
        corner = self._told(*corners).reshape(camera.height + 1, camera.width + 1)
        sure = as_corners(center, corner)
        label = np.where(sure, center % GONE, AMBIGUOUS).astype(np.uint8)
        return ShapeLabels(before, after, label, sure & (center >= GONE))

    def _told(self, before: Ids, after: Ids) -> npt.NDArray[np.int64]:
        gone, new = self._gone[before], self._new[after]
        label = np.where(new, NEW, np.where(gone, UNCOVERED, UNTOUCHED))
        return np.asarray(label + GONE * gone)
