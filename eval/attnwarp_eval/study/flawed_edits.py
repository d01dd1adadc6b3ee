"""Right results of an edit, and results with one known flaw each.

A scene's edit has a true result, so both the right picture and wrong ones can be rendered: an edit
too weak, of a wrong colour, of a wrong object, another in each view, blurred, noisy or misplaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from attnwarp_eval.colors import to_srgb
from attnwarp_eval.metrics.arrays import Array, Mask
from attnwarp_eval.scene.edits import pick
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import AnswerSpec, EditSpec
from attnwarp_eval.truth import appearance
from attnwarp_eval.truth.edits import edit_mask, touched
from attnwarp_eval.world import World, changed

ANSWERS = 3
"""Number of rendered answers, from the first, of an edit with several right ones: one right, one
wrong, and a third for views that do not agree.
"""

RIGHT_ANSWERS = 2
"""Number of these that are the right one in turn: more would only repeat what these show."""

STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Strengths of the edit, as a blend of the pictures before and after in linear light."""

UNEVEN = (0.5, 0.75)
"""Strengths that the views of an inconsistent result take in turn, where the edit has one answer
alone.
"""

SATURATION = 0.75
"""Saturation of a wrong colour (HSV): enough to be one on white marble too."""

BLUR = 2.0 / 256
"""Standard deviation of the blur, of the picture's side."""

NOISE = 0.05
"""Standard deviation of the noise, in sRGB of 1."""

SHIFT = 2
"""Pixels to the right by which a misplaced result lies off."""


@dataclass(frozen=True)
class Task:
    """One right result of one edit, and the other results that are wrong in its place.

    Attributes:
        edit, answer: which; ``answer`` is None for an edit with one result.
        source, target: the prompts, before and after.
        content: hash of the scene after the edit.
        others: (answer, hash) of other answers of the same edit.
        elsewhere: (edit, answer, hash) of an edit of other objects; None where the scene has none.
    """

    edit: str
    answer: str | None
    source: str
    target: str
    content: str
    others: tuple[tuple[str, str], ...] = ()
    elsewhere: tuple[str, str | None, str] | None = None

    @property
    def name(self) -> str:
        """``edit`` or ``edit-answer``."""
        return self.edit if self.answer is None else f"{self.edit}-{self.answer}"

    def to_dict(self) -> dict[str, Any]:
        """Fields for JSON."""
        return {
            **asdict(self),
            "others": [list(o) for o in self.others],
            "elsewhere": self.elsewhere and [*self.elsewhere],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Task:
        """Rebuild from what :meth:`to_dict` gave."""
        others = tuple((name, content) for name, content in data["others"])
        return cls(
            **{
                **data,
                "others": others,
                "elsewhere": data["elsewhere"] and tuple(data["elsewhere"]),
            }
        )


def tasks(scene: Scene, names: Sequence[str] = ()) -> list[Task]:
    """Each right result of each edit of a scene.

    Args:
        scene: with its edits.
        names: names of the edits; all of the scene's if empty. Names that the scene lacks are
            passed over.
    """
    results = []
    for place, edit in enumerate(scene.edits):
        if names and edit.name not in names:
            continue
        answers: list[AnswerSpec | None] = list(edit.answers[:ANSWERS]) or [None]
        for answer in answers[:RIGHT_ANSWERS]:
            own = set(touched(scene, edit.name, answer.name if answer else None))
            others = [o.name for o in answers if o is not None and o is not answer]
            elsewhere = next(
                (
                    other.name
                    for other in (*scene.edits[place + 1 :], *scene.edits[:place])
                    if _objects(scene, other) and not own & _objects(scene, other)
                ),
                None,
            )
            results.append(
                Task(
                    edit.name,
                    answer.name if answer else None,
                    edit.source,
                    answer.target if answer else edit.target,
                    _content(scene, edit.name, answer.name if answer else None),
                    tuple((name, _content(scene, edit.name, name)) for name in others),
                    (
                        None
                        if elsewhere is None
                        else (elsewhere, None, _content(scene, elsewhere, None))
                    ),
                )
            )
    return results


def _objects(scene: Scene, edit: EditSpec) -> set[int]:
    """Objects whose surfaces an edit (its first answer) changes; none for an edit of the light."""
    return set() if (pick(edit) or edit).lights is not None else set(touched(scene, edit.name))


def _content(scene: Scene, edit: str, answer: str | None) -> str:
    return scene.edited(edit, answer).content_hash


@dataclass(frozen=True, eq=False)
class Shot:
    """One view before the edit, after it, and after edits that would be wrong.

    Attributes:
        index: 0 for the source view, then the targets by their order.
        before, after: (H, W, 3) linear light in [0, 1].
        mask: (H, W) bool, the edited objects.
        hue: (3,) RGB of the wrong colour, its largest channel 1 and its smallest 0; the same in all
            views of a task.
        others: (H, W, 3) the results of other answers.
        elsewhere: (H, W, 3) the result of an edit of other objects.
    """

    index: int
    before: Array
    after: Array
    mask: Mask
    hue: Array
    others: tuple[Array, ...] = ()
    elsewhere: Array | None = None

    def blend(self, strength: float) -> Array:
        """(H, W, 3) linear light: the edit at part of its strength."""
        return (1 - strength) * self.before + strength * self.after

    def wrong_colour(self) -> Array:
        """Another answer, where the edit has several; else the edited object in the opposite hue,
        as light as it is.
        """
        if self.others:
            return self.others[0]
        value = self.after.max(axis=-1, keepdims=True)
        return np.where(self.mask[..., None], value * (1 - SATURATION * (1 - self.hue)), self.after)

    def inconsistent(self) -> Array:
        """Another answer in each view, or another strength."""
        if self.others:
            return self.others[self.index % len(self.others)]
        return self.blend(UNEVEN[self.index % len(UNEVEN)])

    def blurred(self) -> Array:
        """The right result out of focus."""
        sigma = BLUR * self.after.shape[0]
        return np.asarray(gaussian_filter(self.after, (sigma, sigma, 0), mode="nearest"))

    def misplaced(self) -> Array:
        """The right result moved to the right; the left border is repeated."""
        return np.concatenate(
            [np.repeat(self.after[:, :1], SHIFT, axis=1), self.after[:, :-SHIFT]], axis=1
        )


@dataclass(frozen=True)
class Condition:
    """Result that a method may have given for a view.

    Attributes:
        name: the last part of a figure's key.
        title: for people, short.
        make: the picture in linear light; None where the edit has no such flaw.
        source: whether the source view has the flaw as well. Where it has, all views have it alike,
            and a metric that compares views with one another has nothing to find.
        noise: standard deviation of noise that is added to sRGB values, of its own in each view.
    """

    name: str
    title: str
    make: Callable[[Shot], Array | None]
    source: bool = True
    noise: float = 0.0

    def picture(self, shot: Shot, seed: int) -> Array | None:
        """(H, W, 3) sRGB of a view in [0, 1]."""
        linear = shot.after if shot.index == 0 and not self.source else self.make(shot)
        if linear is None or not self.noise:
            return None if linear is None else to_srgb(linear)
        rng = np.random.default_rng([seed, shot.index])
        return np.clip(to_srgb(linear) + rng.normal(0, self.noise, linear.shape), 0, 1)


def _strength(strength: float) -> Condition:
    return Condition(
        f"strength_{100 * strength:03.0f}",
        f"strength {strength:g}",
        lambda shot: shot.blend(strength),
    )


CONDITIONS = (
    *map(_strength, STRENGTHS),
    Condition("wrong_colour", "wrong colour", Shot.wrong_colour),
    Condition("wrong_object", "wrong object", lambda shot: shot.elsewhere),
    Condition("inconsistent", "inconsistent views", Shot.inconsistent, source=False),
    Condition("blurred", "blurred", Shot.blurred),
    Condition("noisy", "noisy", lambda shot: shot.after, noise=NOISE),
    Condition("misplaced", f"misplaced by {SHIFT} px", Shot.misplaced, source=False),
)
"""Every condition; the right result is that of full strength."""

RIGHT = f"strength_{100 * STRENGTHS[-1]:03.0f}"


def shots_of(world: World, task: Task, spec: Mapping[str, Any]) -> dict[str, Shot]:
    """The source and every target of a cell's spec, by name.

    Raises:
        InputError: an edit is not what the task was planned for.
    """
    names = [world.source.name, *spec["views"]]
    scenes = [world.scene]
    others = [(task.edit, answer, content) for answer, content in task.others]
    elsewhere = [] if task.elsewhere is None else [task.elsewhere]
    for edit, answer, content in [(task.edit, task.answer, task.content), *others, *elsewhere]:
        if world.edited_hash(edit, answer) != content:
            raise changed(f"edit {edit!r} of scene {world.scene.name!r}")
        scenes.append(world.scene.edited(edit, answer))
    # Scene by scene: Mitsuba caches the last one, and loading costs more than rendering.
    images: dict[str, list[Array]] = {name: [] for name in names}
    for scene in scenes:
        for name in names:
            images[name].append(
                np.clip(appearance(scene, world.camera(name), spp=spec["spp"], seed=0), 0, 1)
            )
    masks = {
        name: edit_mask(
            world.scene, task.edit, world.geometry.trace(world.camera(name)), task.answer
        )
        for name in names
    }
    total = np.sum(
        [images[name][1][masks[name]].sum(axis=0, dtype=np.float64) for name in names], axis=0
    )
    hue = opposite_hue(total)
    last = 2 + len(task.others)
    return {
        name: Shot(
            index, images[name][0], images[name][1], masks[name], hue, tuple(images[name][2:last]),
            images[name][last] if task.elsewhere is not None else None,
        )
        for index, name in enumerate(names)
    }  # fmt: skip


def opposite_hue(color: Array) -> Array:
    """(3,) RGB of the hue half a circle from that of a colour, fully saturated (HSV); red for
    grey."""
    spread = color.max() - color.min()
    return np.array([1.0, 0, 0]) if spread <= 1e-9 * color.max() else (color.max() - color) / spread
