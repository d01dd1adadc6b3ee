"""Places: edits of a scene's shapes that vary independently, for the ideal editor.

docs/measuring/ideal-editor.md has the posterior. A place is an edit of the scene with one or K
answers. Places whose tokens meet in a view are one part, with all combinations of their answers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import binary_dilation

from attnwarp.camera import Camera
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.edits import apply
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import EditSpec
from attnwarp_eval.truth import Geometry, appearance
from attnwarp_eval.truth.shapes import kept_objects
from attnwarp_lab.ideal.editor import FACTOR
from attnwarp_lab.ideal.share import Grams
from attnwarp_lab.ideal.thing import Thing

Mask = npt.NDArray[np.bool_]
Image = npt.NDArray[np.float32]
Choice = tuple[int, ...]
"""An answer of each place; :data:`NO_EDIT` for none."""

NO_EDIT = -1

CHANGED = 0.05
"""Root mean square change of a token's values in [0, 1] from which it counts as changed: above the
noise that a distant thing's reflected light adds to pictures of 16 samples a pixel."""

MOST_ANSWERS = 256
"""Combinations of a part: four places of four answers."""


def answers_of(edit: EditSpec) -> int:
    """Number of right answers of an edit."""
    return max(1, len(edit.answers))


def chosen(scene: Scene, edits: Sequence[EditSpec], choice: Choice) -> Scene:
    """The scene after several edits.

    Args:
        choice: answer of each edit, from 0; :data:`NO_EDIT` leaves an edit out.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> bear = load_scene("bear")
        >>> chosen(bear, [bear.edit("polar"), bear.edit("some_colour")], (0, 2)).name
        'bear-polar-some_colour-yellow'
    """
    spec = scene.spec
    for edit, answer in zip(edits, choice, strict=True):
        if answer != NO_EDIT:
            spec = apply(spec, edit, edit.answers[answer] if edit.answers else None)
    return Scene(spec, scene.path)


@dataclass(frozen=True, eq=False)
class Places(Thing):
    """Places in parts. ``labels`` are the parts by token, ``after`` the parts' combinations.

    Attributes:
        edits: edit of each place.
        groups: numbers of the places of each part.
        told: by view, (P,) whether any two answers of a place differ there.
    """

    edits: tuple[EditSpec, ...]
    groups: tuple[tuple[int, ...], ...]
    told: Mapping[str, Mask]

    @classmethod
    def of_edits(
        cls,
        scene: Scene,
        cameras: Sequence[Camera],
        edits: Sequence[EditSpec],
        spp: int,
    ) -> Places:
        """Render every combination that a part has.

        Args:
            cameras: cameras of the views; the source comes first.
            edits: with one answer each, or K.

        Raises:
            ValueError: other numbers of answers, or too many combinations.
        """
        counts = [answers_of(edit) for edit in edits]
        if len({1, *counts}) > 2:
            raise ValueError(f"edits: got {counts} answers, expected one or one number of several")
        pictures = _Pictures(scene, edits, cameras, spp)
        reach = _reach(scene, cameras, edits)
        none = (NO_EDIT,) * len(edits)
        groups: list[tuple[int, ...]] = [(p,) for p in range(len(edits))]
        while True:
            tokens = [
                pictures.changed(pictures.of(group)) | np.any([reach[p] for p in group], axis=0)
                for group in groups
            ]
            meets = [
                (a, b)
                for a, b in combinations(range(len(groups)), 2)
                if (tokens[a] & tokens[b]).any()
            ]
            if not meets:
                break
            a, b = meets[0]
            groups[a] = tuple(sorted(groups[a] + groups.pop(b)))
            number = int(np.prod([counts[p] for p in groups[a]]))
            if number > MOST_ANSWERS:
                raise ValueError(
                    f"edits: {', '.join(edits[p].name for p in groups[a])} meet in a view and have"
                    f" {number} combinations, expected at most {MOST_ANSWERS}; take fewer of them"
                )
        digits = _digits(counts, groups)
        before = pictures[none]
        after = np.repeat(before[:, None], len(digits), axis=1)  # (V, J, H, W, 3)
        labels = np.full(before.shape[:3], -1, np.int16)
        for number, (group, own) in enumerate(zip(groups, tokens, strict=True)):
            where = _pixels(own)
            labels[where] = number
            for j, choice in enumerate(digits):
                after[:, j][where] = pictures[_only(choice, group)][where]
        alone = [[pictures[_only((k,) * len(edits), (p,))] for k in range(counts[p])]
                 for p in range(len(edits))]  # fmt: skip
        told = [_differ(own) for own in alone]
        names = [camera.name for camera in cameras]
        return cls(
            dict(zip(names, labels, strict=True)),
            dict(zip(names, before, strict=True)),
            dict(zip(names, after, strict=True)),
            len(groups),
            tuple(edits),
            tuple(groups),
            dict(zip(names, np.array(told).T, strict=True)),
        )

    @cached_property
    def digits(self) -> npt.NDArray[np.int64]:
        """(J, P) answer of each place in each combination."""
        return np.array(_digits([answers_of(edit) for edit in self.edits], self.groups))

    @cached_property
    def part_of(self) -> npt.NDArray[np.int64]:
        """(P,) part of each place."""
        owner = {place: number for number, group in enumerate(self.groups) for place in group}
        return np.array([owner[place] for place in range(len(self.edits))])

    @cached_property
    def grams(self) -> Grams:
        """Gram matrices of the parts, of which places with several answers are counted.

        Raises:
            ValueError: no place has several answers.
        """
        parts, names = Grams.of(self.views), list(self.before)
        rows, counted = [], []
        for row, (view, part) in enumerate(zip(parts.view, parts.part, strict=True)):
            for place in self.groups[part]:
                if self.told[names[view]][place]:
                    rows.append(row)
                    counted.append(place)
        if not rows:
            raise ValueError("edits: got none with several answers that a view tells apart")
        answer = torch.from_numpy(self.digits.T[counted])
        return replace(
            parts, view=parts.view[rows], part=np.array(counted), row=torch.tensor(rows),
            answer=answer,
        )  # fmt: skip

    def answers(self, view: str, parts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(P,) answer of each place in a view; -1 where the view does not tell its answers apart.

        Args:
            parts: (G,) combination that each part shows, :func:`.figures.part_answers`.
        """
        shown = np.array(
            [self.digits[parts[g], p] if parts[g] >= 0 else -1 for p, g in enumerate(self.part_of)]
        )
        return np.where(self.told[view], shown, -1)


def _digits(counts: Sequence[int], groups: Iterable[Sequence[int]]) -> list[Choice]:
    """Answers of all places in each of the J combinations: a part's places count through them as
    digits do, and a part with fewer places repeats its combinations equally often.
    """
    several = [[p for p in group if counts[p] > 1] for group in groups]
    longest, base = max(map(len, several)), max(counts)
    place_digit = {p: i for group in several for i, p in enumerate(group)}
    return [
        tuple(
            j // base ** place_digit[p] % base if p in place_digit else 0
            for p in range(len(counts))
        )
        for j in range(base**longest)
    ]


def _only(choice: Choice, group: Sequence[int]) -> Choice:
    return tuple(k if p in group else NO_EDIT for p, k in enumerate(choice))


class _Pictures(dict[Choice, Image]):
    """(V, H, W, 3) true pictures of all views by choice, rendered at first use."""

    def __init__(
        self, scene: Scene, edits: Sequence[EditSpec], cameras: Sequence[Camera], spp: int
    ) -> None:
        self.scene, self.edits, self.cameras, self.spp = scene, edits, cameras, spp

    def __missing__(self, choice: Choice) -> Image:
        # An answer that an edit with fewer of them repeats is one scene.
        own = tuple(
            k if k == NO_EDIT else k % answers_of(e)
            for k, e in zip(choice, self.edits, strict=True)
        )
        if own != choice:
            return self[own]
        after = chosen(self.scene, self.edits, choice)
        self[choice] = np.stack(
            [to_srgb(appearance(after, camera, spp=self.spp, seed=0)) for camera in self.cameras]
        )
        return self[choice]

    def of(self, group: Sequence[int]) -> list[Image]:
        """Pictures of every combination of a part's answers."""
        ranges = [
            range(answers_of(e)) if p in group else [NO_EDIT] for p, e in enumerate(self.edits)
        ]
        return [self[choice] for choice in product(*ranges)]

    def changed(self, pictures: Sequence[Image]) -> Mask:
        """(V, h, w) tokens in which any of the pictures differs from those before."""
        before = self[(NO_EDIT,) * len(self.edits)]
        return np.any([_change(one, before) for one in pictures], axis=0)


def _change(first: Image, second: Image) -> Mask:
    """(V, h, w) tokens that differ."""
    squares = np.square(first - second).mean(axis=-1)
    V, H, W = squares.shape
    cells = squares.reshape(V, H // FACTOR, FACTOR, W // FACTOR, FACTOR)
    return np.asarray(cells.mean(axis=(2, 4)) > CHANGED**2)


def _differ(pictures: Sequence[Image]) -> Mask:
    """(V,) whether each two of several pictures differ in some token of the view."""
    if len(pictures) < 2:
        return np.zeros(len(pictures[0]), dtype=bool)
    return np.all([_change(a, b).any(axis=(1, 2)) for a, b in combinations(pictures, 2)], axis=0)


def _pixels(tokens: Mask) -> Mask:
    return tokens.repeat(FACTOR, axis=1).repeat(FACTOR, axis=2)


def _reach(scene: Scene, cameras: Sequence[Camera], edits: Sequence[EditSpec]) -> list[Mask]:
    """By place, (V, h, w) tokens that its old and new surfaces reach without the other places."""
    after = []
    for p, edit in enumerate(edits):
        choices = [_only((k,) * len(edits), (p,)) for k in range(answers_of(edit))]
        after.append([chosen(scene, edits, choice) for choice in choices])
    kept = [[kept_objects(scene, one) for one in own] for own in after]
    still = set(scene.object_names).intersection(*(names for own in kept for names in own))
    reach = []
    for own, names in zip(after, kept, strict=True):
        old = {name for name in scene.object_names if any(name not in same for same in names)}
        seen = [_seen(scene, old, still, cameras)]
        for one, same in zip(own, names, strict=True):
            seen.append(_seen(one, set(one.object_names) - same, still, cameras))
        reach.append(np.any(seen, axis=0))
    return reach


def _seen(scene: Scene, own: set[str], still: set[str], cameras: Sequence[Camera]) -> Mask:
    """(V, h, w) tokens that show some objects, if only they and what never changes is there."""
    names = scene.object_names
    ids = [k for k, name in enumerate(names) if name in own]
    shapes = [shape for shape in scene.shapes() if names[shape.object_id] in own | still]
    geometry = Geometry(shapes)
    hit = np.stack([np.isin(geometry.trace(camera).object_id, ids) for camera in cameras])
    # A pixel beside them may show some of them, though its centre does not.
    hit = binary_dilation(hit, np.ones((1, 3, 3)))
    V, H, W = hit.shape
    tokens = hit.reshape(V, H // FACTOR, FACTOR, W // FACTOR, FACTOR).any(axis=(2, 4))
    return np.asarray(tokens)
