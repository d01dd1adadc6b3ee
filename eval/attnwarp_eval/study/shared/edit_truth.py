"""True pictures of one edit in all views of a cell, and the nearest answer of edited views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval import metrics
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.edits import pick, reshapes
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.truth import appearance
from attnwarp_eval.truth.edits import edit_mask
from attnwarp_eval.truth.shapes import ShapeEdit, ShapeLabels
from attnwarp_eval.world import World, changed, world

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

ONLY = "edited"
"""Name of the answer of an edit with a single answer."""


@dataclass(frozen=True, eq=False)
class EditTruth:
    """An edit's truth.

    Attributes:
        originals: (H, W, 3) sRGB in [0, 1] by view, before the edit.
        answers: the same pictures after the edit, by answer and view.
        masks: (H, W) bool by answer and view, the edited object; all True for an edit of the light.
        union: by view, the union of the answers' masks.
    """

    originals: Mapping[str, Image]
    answers: Mapping[str, Mapping[str, Image]]
    masks: Mapping[str, Mapping[str, Mask]]
    union: Mapping[str, Mask]

    @property
    def ambiguous(self) -> bool:
        """True if several answers are right."""
        return len(self.answers) > 1

    def of(self, views: Sequence[str]) -> EditTruth:
        """Restrict the truth to some of the views."""
        return EditTruth(
            {v: self.originals[v] for v in views},
            {name: {v: pictures[v] for v in views} for name, pictures in self.answers.items()},
            {name: {v: masks[v] for v in views} for name, masks in self.masks.items()},
            {v: self.union[v] for v in views},
        )

    def judge(self, pictures: Mapping[str, Any]) -> Judgement:
        """Judge whether pictures of some views show the edit, and which answer.

        Args:
            pictures: (H, W, 3) sRGB in [0, 1] by view.
        """
        part = self.of(list(pictures))
        name, scores = metrics.nearest_answer(pictures, part.answers, part.union)
        if name is None:
            return Judgement(None, False, math.nan, math.nan, math.nan)
        unedited = metrics.edit_psnr(part.originals, part.answers[name], part.union).pooled
        unchanged = metrics.edit_psnr(pictures, part.originals, part.union).pooled
        psnr = scores[name]
        done = psnr > max(unchanged, unedited)
        return Judgement(name, done, psnr, unedited, unchanged)


@dataclass(frozen=True)
class Judgement:
    """Judgement of edited views.

    Attributes:
        answer: nearest answer; None if none of the object is visible.
        done: whether the pictures are nearer to it than to the unedited ones, and than those are.
        psnr: dB to the answer inside the edited object, pooled over the views.
        unedited: dB of the unedited pictures to the answer.
        unchanged: dB of the pictures to the unedited ones.
    """

    answer: str | None
    done: bool
    psnr: float
    unedited: float
    unchanged: float


def answers_of(scene: Scene, edit: str) -> list[tuple[str, str | None]]:
    """(name, answer in the scene's notation) of an edit's right answers.

    Args:
        edit: name of the edit, or ``name=answer`` for a single answer of an ambiguous edit.

    Raises:
        ValueError: no such answer.
    """
    title, _, answer = edit.partition("=")
    if answer:
        pick(scene.edit(title), answer)  # refuses an unknown answer
        return [(answer, answer)]
    answers = scene.edit(title).answers
    return [(one.name, one.name) for one in answers] or [(ONLY, None)]


Answers = Sequence[Sequence[str]]
"""(name, hash of the edited scene) of each answer, as a cell's spec names them."""


def edit_truth(
    scene: str,
    size: int,
    spp: int,
    edit: str,
    views: tuple[str, ...],
    *,
    planned: Answers | None = None,
) -> EditTruth:
    """The truth of an edit; cached, since all variants of a scene share it.

    Args:
        scene, size: arguments of :func:`attnwarp_eval.world.world`.
        edit: name of the edit, as for :func:`answers_of`.
        views: names, including the source.
        planned: answers of the planned cell; None accepts those of the file.

    Raises:
        InputError: the answers differ from ``planned``.
    """
    of = world(scene, size)
    title = edit.partition("=")[0]
    answers = tuple((n, of.edited_hash(title, one)) for n, one in answers_of(of.scene, edit))
    if planned is not None and answers != tuple((name, content) for name, content in planned):
        raise changed(f"edit {edit!r} of scene {of.scene.name!r}")
    return _edit_truth(of.content_hash, answers, scene, size, spp, edit, views)


def planned_truth(cell: Cell, views: Sequence[str]) -> EditTruth:
    """The truth of the edit that a cell was planned for.

    Raises:
        InputError: the edit in the scene's file has changed.
    """
    spec = cell.spec
    edit = spec["edit"]
    return edit_truth(
        cell.scene_file,
        spec["size"],
        spec["spp"],
        edit["name"],
        tuple(views),
        planned=edit["answers"],
    )


@lru_cache(maxsize=8)
def _edit_truth(
    content: str,
    hashes: tuple[tuple[str, str], ...],
    scene: str,
    size: int,
    spp: int,
    edit: str,
    views: tuple[str, ...],
) -> EditTruth:
    """``content`` and ``hashes``: scene content in the file, before and after the edit."""
    of = world(scene, size)
    answers = answers_of(of.scene, edit)
    title = edit.partition("=")[0]
    # Scene by scene: Mitsuba caches the last one, and loading costs more than rendering.
    originals = {view: of.image(view, spp) for view in views}
    pictures: dict[str, dict[str, Image]] = {}
    new: dict[tuple[str, str], ShapeLabels] = {}
    for name, answer in answers:
        edited = of.scene.edited(title, answer)
        if reshapes(of.scene.edit(title), answer):
            shapes = ShapeEdit(of.scene, edited, of.geometry)
            new |= {(name, view): shapes.labels(of.camera(view)) for view in views}
        pictures[name] = {
            view: to_srgb(appearance(edited, of.camera(view), spp=spp, seed=0)) for view in views
        }
    hits = {view: of.geometry.trace(of.camera(view)) for view in views}
    masks = {
        name: {
            view: edit_mask(of.scene, title, hits[view], answer, new.get((name, view)))
            for view in views
        }
        for name, answer in answers
    }
    union = {
        view: np.logical_or.reduce([masks[name][view] for name, _ in answers]) for view in views
    }
    return EditTruth(originals, pictures, masks, union)


def neighbours(of: World, views: Sequence[str]) -> dict[str, str]:
    """Neighbour of each target: the nearest by yaw of the source and targets nearer to it."""
    yaw = {of.source.name: 0.0, **of.signed_yaw}
    ordered = [of.source.name, *sorted(views, key=lambda view: of.yaw[view])]

    def apart(first: str, second: str) -> float:
        return abs((yaw[first] - yaw[second] + 180) % 360 - 180)

    # Of equally near views the last counts.
    return {
        view: min(reversed(ordered[:k]), key=partial(apart, view))
        for k, view in enumerate(ordered)
        if k
    }
