"""Figures of edits that change shapes: new, uncovered, untouched surface; depth after tuning.

A pixel shows the source's answer of a place if none of the true pictures, nor the picture before,
is nearer to it than the nearest one with that answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.colors import color_difference
from attnwarp_eval.metrics.arrays import share
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import EditSpec
from attnwarp_eval.truth import Geometry, two_view
from attnwarp_eval.truth.shapes import UNCOVERED, UNTOUCHED, ShapeEdit, kept_objects
from attnwarp_lab.ideal.places import NO_EDIT, Places, answers_of, chosen

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

TIE = 1e-6
"""Squared error within which two pictures are equally near, of values in [0, 1]."""

STANDS = 0.02
"""Relative error of depth below which a surface stands where it should."""


def kind_of(name: str) -> str:
    """Kind of an edit, the first word of its name.

    Example:
        >>> kind_of("added-2")
        'added'
    """
    return name.partition("-")[0]


@dataclass(frozen=True, eq=False)
class ShapeView:
    """Truth of one view, given the source's answers.

    Attributes:
        after: (H, W, 3) true picture of the source's answers.
        depth: (H, W) true depth after the edit.
        visible: (H, W) bool, the source certainly shows the pixel's surface after the edit.
        untouched: (H, W) bool.
        new, gone, uncovered: (P, H, W) bool by place. Gone is certain, whatever is now there.
        shows: (P, J, H, W) bool: with a combination, the place's new surface would be there, if it
            alone were edited. Where the source's answers show another place's, none is counted.
    """

    after: Image
    depth: npt.NDArray[np.float64]
    visible: Mask
    untouched: Mask
    new: Mask
    gone: Mask
    uncovered: Mask
    shows: Mask


class ShapeTruth:
    """Truth of all views, given the source's answers.

    Args:
        scene: before the edit.
        answers: (P,) of the source's edit; -1 where it tells none, for which the first stands.

    Attributes:
        after: the scene after the edit.
    """

    def __init__(
        self, scene: Scene, places: Places, answers: npt.NDArray[np.int64], geometry: Geometry
    ) -> None:
        self.places, self.answers = places, answers
        edits, self.choice = places.edits, tuple(int(k) for k in np.maximum(answers, 0))
        self.after = chosen(scene, edits, self.choice)
        self.edit = ShapeEdit(scene, self.after, geometry)
        self.source = scene.source
        alone = [
            [
                chosen(scene, edits, tuple(k if q == p else NO_EDIT for q in range(len(edits))))
                for k in range(answers_of(edit))
            ]
            for p, edit in enumerate(edits)
        ]
        self._alone = [[ShapeEdit(scene, one, geometry) for one in own] for own in alone]
        self._old, self._new = [], []
        for own, choice in zip(alone, self.choice, strict=True):
            kept = kept_objects(scene, own[choice])
            self._old.append(_ids(scene, set(scene.object_names) - kept))
            self._new.append(_ids(self.after, set(own[choice].object_names) - kept))

    def told(self, place: int) -> bool:
        """Return True if the source tells which answer a place has."""
        return not self.places.edits[place].answers or bool(self.answers[place] >= 0)

    def picture(self, name: str) -> Image:
        """(H, W, 3) true picture of a view, of the source's answers."""
        places = self.places
        after, picture = places.after[name], places.before[name].copy()
        for part, group in enumerate(places.groups):
            own = (places.digits[:, group] == np.array(self.choice)[list(group)]).all(axis=1)
            inside = places.labels[name] == part
            picture[inside] = after[np.flatnonzero(own)[0]][inside]
        return picture

    def view(self, camera: Camera) -> ShapeView:
        """Truth of a view."""
        places, labels = self.places, self.edit.labels(camera)
        visible = two_view(self.edit.new, self.source, camera).visible
        new = np.stack([labels.new & np.isin(labels.after.object_id, ids) for ids in self._new])
        old = np.stack([np.isin(labels.before.object_id, ids) for ids in self._old])
        shows = []
        for place, own in enumerate(self._alone):
            masks = np.stack([edit.labels(camera).new for edit in own])
            others = new.any(axis=0) & ~new[place]
            shows.append(masks[places.digits[:, place]] & ~others)
        return ShapeView(
            self.picture(camera.name), labels.after.depth, visible, labels.label == UNTOUCHED, new,
            labels.gone & old, (labels.label == UNCOVERED) & old, np.stack(shows),
        )  # fmt: skip


def _ids(scene: Scene, names: set[str]) -> list[int]:
    return [k for k, name in enumerate(scene.object_names) if name in names]


def shape_figures(
    picture: Image, truth: ShapeTruth, view: ShapeView, name: str, shown: npt.NDArray[np.int64]
) -> dict[str, float]:
    """Figures of one edited target.

    Args:
        picture: (H, W, 3) sRGB in [0, 1], edited.
        name: name of the view.
        shown: (P,) answers of the view.

    Returns:
        Shares by kind of a place whose answer the source tells, and of all places with ``several``
        answers and with ``one``. ``shape.same``: 1 where the view tells the same answer, else 0,
        for places of several answers; ``shape.new``: share of the new surface that the source sees
        which stands there with the source's answer; ``shape.uncovered``: the same of the uncovered
        surface, whatever the source sees; ``shape.overlap``: intersection over union of the
        place's silhouette with the true one. And ``shape.lost``: mean CIEDE2000 to the truth on
        untouched surface.
    """
    places = truth.places
    after, before = places.after[name], places.before[name]
    errors = np.square(picture - after).sum(axis=-1)  # (J, H, W)
    unedited = np.square(picture - before).sum(axis=-1)
    least, nearest = errors.min(axis=0), errors.argmin(axis=0)
    counts = _Counts()
    for place, edit in enumerate(places.edits):
        if not truth.told(place):
            continue
        if edit.answers and shown[place] >= 0:
            counts.add("same", edit, int(shown[place] == truth.choice[place]), 1)
        own = places.digits[:, place] == truth.choice[place]
        right = errors[own].min(axis=0) <= np.minimum(least, unedited) + TIE
        new, uncovered = view.new[place] & view.visible, view.uncovered[place]
        counts.add("new", edit, int(right[new].sum()), int(new.sum()))
        counts.add("uncovered", edit, int(right[uncovered].sum()), int(uncovered.sum()))
        there = np.take_along_axis(view.shows[place], nearest[None], axis=0)[0]
        there &= least < unedited - TIE
        true = view.shows[place][np.flatnonzero(own)[0]]
        counts.add("overlap", edit, int((there & true).sum()), int((there | true).sum()))
    edited = np.asarray(picture, dtype=np.float64)
    lost = color_difference(edited, view.after.astype(np.float64), view.untouched)
    return {**counts.shares(), "shape.lost": lost}


class _Counts(dict[str, tuple[int, int]]):
    """Parts and wholes of shares by figure: of each kind, and of all with one number of answers."""

    def add(self, figure: str, edit: EditSpec, part: int, whole: int) -> None:
        for group in (kind_of(edit.name), "several" if edit.answers else "one"):
            key = f"shape.{figure}.{group}"
            parts, wholes = self.get(key, (0, 0))
            self[key] = parts + part, wholes + whole

    def shares(self) -> dict[str, float]:
        return {key: share(*counts) for key, counts in self.items()}


def depth_figures(
    depth: npt.NDArray[np.float64], truth: ShapeTruth, view: ShapeView
) -> dict[str, float]:
    """Figures of the depth of tuned splats in one view.

    Args:
        depth: (H, W) of the splats; NaN where undefined.

    Returns:
        ``shape.stands``: share of the pixels whose depth is within :data:`STANDS` of the truth
        after the edit, undefined ones not; by kind for surface that is new and where one is gone,
        and for untouched surface.
    """
    error = np.abs(depth - view.depth) / view.depth
    error[~np.isfinite(view.depth)] = np.nan
    stands, counts = error < STANDS, _Counts()
    exact = np.isfinite(view.depth)
    for place, edit in enumerate(truth.places.edits):
        if truth.told(place):
            for region, where in (("new", view.new[place]), ("gone", view.gone[place] & exact)):
                counts.add(f"stands.{region}", edit, int(stands[where].sum()), int(where.sum()))
    own = view.untouched & exact
    return {
        **counts.shares(),
        "shape.stands.untouched": share(int(stands[own].sum()), int(own.sum())),
    }
