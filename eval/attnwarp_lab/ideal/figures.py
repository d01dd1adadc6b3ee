"""Figures of an edit with answers per part of a thing: seen, through, bleed and dE.

They are read together: ``seen`` alone rewards painting everything.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp_eval.colors import color_difference
from attnwarp_eval.metrics.arrays import share

Image = npt.NDArray[np.float32]
Labels = npt.NDArray[np.int16]
Mask = npt.NDArray[np.bool_]

LEAST_PIXELS = 16
"""Least visible pixels of a part for its answer to count: the area of one token."""

UNKNOWN = -1
"""Answer of a part that is not visible."""


@dataclass(frozen=True, eq=False)
class PartTruth:
    """True pictures of one view.

    Attributes:
        before: (H, W, 3) sRGB in [0, 1] before the edit.
        after: (K, H, W, 3) after the edit, the whole thing in one answer.
        pixels: (H, W) part of each pixel if its token has the same part, else -1.
        outside: (H, W) bool: neither the pixel nor its token shows the thing.
    """

    before: Image
    after: npt.NDArray[np.float32]
    pixels: Labels
    outside: Mask

    @classmethod
    def of(
        cls, before: Image, after: npt.NDArray[np.float32], pixels: Labels, tokens: Labels
    ) -> PartTruth:
        """The truth of a view whose tokens have parts.

        Args:
            before, after: pictures before and after.
            pixels: (H, W) part of each pixel, -1 outside the thing.
            tokens: (h, w) part of each token.
        """
        factor = pixels.shape[0] // tokens.shape[0]
        large = np.repeat(np.repeat(tokens, factor, axis=0), factor, axis=1)
        own = np.where(pixels == large, pixels, -1)
        return cls(before, after, own.astype(np.int16), (pixels < 0) & (large < 0))

    def errors(self, picture: Image) -> npt.NDArray[np.float32]:
        """(K, H, W) squared error of a picture to each answer."""
        return np.square(picture - self.after).sum(axis=-1)


def part_answers(
    picture: Image, truth: PartTruth, parts: int, among: Mask | None = None
) -> npt.NDArray[np.int64]:
    """(P,) nearest answer of each part of a picture; :data:`UNKNOWN` if fewer than
    :data:`LEAST_PIXELS` pixels show the part.

    Args:
        picture: (H, W, 3) sRGB in [0, 1].
        among: (H, W) bool, pixels that count; all if left out.

    Example:
        >>> import numpy as np
        >>> from attnwarp_lab.ideal.figures import PartTruth, part_answers
        >>> after = np.stack([np.full((4, 4, 3), v, np.float32) for v in (0.2, 0.8)])
        >>> truth = PartTruth(after[0], after, np.zeros((4, 4), np.int16), np.zeros((4, 4), bool))
        >>> part_answers(np.full((4, 4, 3), 0.7, np.float32), truth, parts=2).tolist()
        [1, -1]
    """
    counted = truth.pixels >= 0 if among is None else (truth.pixels >= 0) & among
    labels = truth.pixels[counted]
    sums = np.stack(
        [np.bincount(labels, error[counted], minlength=parts) for error in truth.errors(picture)]
    )
    enough = np.bincount(labels, minlength=parts) >= LEAST_PIXELS
    return np.where(enough, sums.argmin(axis=0), UNKNOWN)


def answered(truth: PartTruth, answers: npt.NDArray[np.int64]) -> Image:
    """(H, W, 3) the true picture in which each part has its answer; NaN at the thing's pixels
    without a part or an answer.

    Args:
        answers: (P,) from :func:`part_answers` of the source.
    """
    picture = np.where(truth.outside[..., None], truth.before, np.nan).astype(np.float32)
    own = truth.pixels >= 0
    answer = np.where(own, answers[truth.pixels], UNKNOWN)
    rows, columns = np.nonzero(answer >= 0)
    picture[rows, columns] = truth.after[answer[rows, columns], rows, columns]
    return picture


def fill_figures(
    shown: Mapping[str, npt.NDArray[np.int64]], answers: npt.NDArray[np.int64]
) -> dict[str, dict[str, float]]:
    """Agreement of each view with the other ones on the parts that the source does not show.

    Args:
        shown: (P,) answers of the edited targets, from :func:`part_answers`, by view.
        answers: (P,) of the source.

    Returns:
        By view, ``parts.fill``: of the pairs of its unseen parts with the same part in another
        view, the share with one answer, by chance 1/K; and their number, ``parts.fill_pairs``.

    Example:
        >>> import numpy as np
        >>> shown = {"a": np.array([0, 1, 2]), "b": np.array([1, 1, 0])}
        >>> fill_figures(shown, np.array([3, -1, -1]))["a"]  # the source shows the first part
        {'parts.fill': 0.5, 'parts.fill_pairs': 2}
    """
    table = np.stack([np.where(answers == UNKNOWN, own, UNKNOWN) for own in shown.values()])
    known = table != UNKNOWN
    figures = {}
    for k, name in enumerate(shown):
        pairs = known & known[k]
        pairs[k] = False
        same = int((table == table[k])[pairs].sum())
        count = int(pairs.sum())
        figures[name] = {"parts.fill": share(same, count), "parts.fill_pairs": count}
    return figures


def part_figures(
    picture: Image,
    truth: PartTruth,
    answers: npt.NDArray[np.int64],
    visible: Mask,
    hidden: Mask,
    before_it: Labels,
) -> dict[str, float]:
    """Figures of one target view, given the source's answers.

    Args:
        picture: (H, W, 3) sRGB in [0, 1], edited.
        answers: (P,) of the source, from :func:`part_answers`.
        visible: (H, W) bool, the source certainly shows the pixel's surface.
        hidden: (H, W) bool, the surface is inside the source image and certainly hidden.
        before_it: (H, W) part of the surface that the source shows there instead; -1 for none.

    Returns:
        ``parts.seen``: share of the parts truly seen by the source that show the source's answer;
        ``parts.through``: share of hidden pixels behind another part that show that part's answer,
        by chance 1/K;
        ``parts.bleed``: mean CIEDE2000 to the picture before, outside the thing;
        ``parts.delta_e``: mean CIEDE2000 to the truth of the source's answers, at pixels truly
        seen; and the counts ``parts.seen_parts`` and ``parts.hidden_pixels``. NaN where there is
        nothing to measure.
    """
    parts = len(answers)
    there = part_answers(picture, truth, parts, visible)
    known = (there != UNKNOWN) & (answers != UNKNOWN)
    front = np.where(before_it >= 0, answers[before_it], UNKNOWN)
    asked = hidden & (truth.pixels >= 0) & (front != UNKNOWN) & (before_it != truth.pixels)
    shown = truth.errors(picture).argmin(axis=0)
    source = answered(truth, answers)
    seen = visible & (truth.pixels >= 0) & np.isfinite(source).all(axis=-1)
    edited = np.asarray(picture, dtype=np.float64)
    return {
        "parts.seen": share(int((there == answers)[known].sum()), int(known.sum())),
        "parts.through": share(int((shown == front)[asked].sum()), int(asked.sum())),
        "parts.bleed": color_difference(edited, truth.before.astype(np.float64), truth.outside),
        "parts.delta_e": color_difference(edited, source.astype(np.float64), seen),
        "parts.seen_parts": int(known.sum()),
        "parts.hidden_pixels": int(asked.sum()),
    }
