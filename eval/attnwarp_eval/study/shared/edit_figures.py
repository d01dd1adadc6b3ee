"""Figures of edited views of one scene against the truth of the edit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval import metrics
from attnwarp_eval.study.shared.edit_truth import EditTruth, Judgement
from attnwarp_eval.study.shared.edits import LEAST_PIXELS
from attnwarp_eval.world import World

Image = npt.NDArray[np.float32]

FIDELITY = ("psnr", "mse", "ssim")
"""Figures of :func:`attnwarp_eval.metrics.fidelity` in a row, of the whole picture and inside the
edited object."""

PRESERVED = ("preserved_psnr", "preserved_mse")
AGREEMENT = ("delta_e", "delta_e_floor", "delta_e_above")


@dataclass(frozen=True, eq=False)
class EditFigures:
    """Figures of a scene's edited views, or of renders of its edited splats.

    Attributes:
        world: the scene.
        pictures: (H, W, 3) sRGB in [0, 1] by view.
        judged: judgement of the source's edit; without an edit there is nothing to agree with.
        kind: end of the figures' names.
    """

    world: World
    truth: EditTruth
    source: str
    pictures: Mapping[str, Image]
    judged: Judgement
    kind: str = "edit"

    @cached_property
    def nearest(self) -> dict[str, str | None]:
        """Nearest answer of each view alone."""
        part = self.truth.of(list(self.pictures))
        return metrics.answers_by_view(self.pictures, part.answers, part.union)

    @cached_property
    def fidelity(self) -> tuple[str | None, dict[str, dict[str, float]]]:
        """Nearest answer of all views, and each view's fidelity to it."""
        part = self.truth.of(list(self.pictures))
        return metrics.edit_fidelity(
            self.pictures, part.answers, part.masks, originals=part.originals
        )

    def row(self, name: str) -> dict[str, float]:
        """Return a target's fidelity, and its agreement with the source."""
        figures = self.fidelity[1].get(name, {})
        whole = {f"fidelity.{key}.{self.kind}": key for key in (*FIDELITY, *PRESERVED)}
        inside = {f"fidelity.{key}.{self.kind}_inside": f"{key}.inside" for key in FIDELITY}
        row = {
            title: figures.get(f"fidelity.{key}", math.nan)
            for title, key in (whole | inside).items()
        }
        return row | self._agreement(name)

    def _agreement(self, name: str) -> dict[str, float]:
        """Agreement of a target with the source; NaN if either lacks a successful edit."""
        kind, answer, truth = self.kind, self.fidelity[0], self.truth
        row = dict.fromkeys(
            [
                *(f"multiview.same_answer.{kind}{end}" for end in ("", "_seen")),
                *(f"multiview.{k}.{kind}{end}" for k in AGREEMENT for end in ("", "_inside")),
            ],
            math.nan,
        )
        if not self.judged.done or answer is None or name not in self.pictures:
            return row
        if truth.ambiguous:
            row[f"multiview.same_answer.{kind}"] = _equal(self.nearest[name], self.judged.answer)
            part = truth.of([name])
            seen = {name: truth.union[name] & self.world.between(self.source, name).visible}
            if seen[name].sum() >= LEAST_PIXELS:
                picture = {name: self.pictures[name]}
                there = metrics.answers_by_view(picture, part.answers, seen)[name]
                row[f"multiview.same_answer.{kind}_seen"] = _equal(there, self.judged.answer)
        for end, mask in (("", None), ("_inside", truth.masks[answer][name])):
            figures = self.above(self.source, name, mask)
            row |= {f"multiview.{k}.{kind}{end}": figures[f"multiview.{k}"] for k in AGREEMENT}
        return row

    def next_to(self, other: str, name: str) -> float:
        """A target's disagreement with a view inside the object; NaN without either edit."""
        answer = self.fidelity[0]
        both = other in self.pictures and name in self.pictures
        if not self.judged.done or answer is None or not both:
            return math.nan
        mask = self.truth.masks[answer][name]
        return self.above(other, name, mask)["multiview.delta_e_above"]

    def above(self, first: str, second: str, mask: Any) -> dict[str, float]:
        """Disagreement of two views above its floor; NaN below :data:`LEAST_PIXELS`."""
        answer = self.fidelity[0]
        assert answer is not None
        true = self.truth.answers[answer]
        figures = metrics.above_floor(
            (self.pictures[first], self.pictures[second]),
            (true[first], true[second]),
            self.world.between(first, second),
            mask=mask,
        )
        few = figures["multiview.pixels"] < LEAST_PIXELS
        return dict.fromkeys(figures, math.nan) if few else figures


def full_size(original: Image, edited: npt.NDArray[np.uint8]) -> Image:
    """Return an edited view at the size of the original."""
    from attnwarp.methods.pictures import enlarged_change

    return enlarged_change(original, edited.astype(np.float32) / np.float32(255))


def _equal(answer: str | None, expected: str | None) -> float:
    return math.nan if answer is None else float(answer == expected)
