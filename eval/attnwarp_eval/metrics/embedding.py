"""Metrics of embeddings of pictures and texts. Pure: arrays in, arrays out; no network,
no file.

Every figure is a cosine, so embeddings may have any length. The encoder decides the meaning of the
figures: keep its :class:`attnwarp.encoders.EncoderInfo` with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

TINY_NORM = 1e-6
"""An embedding shorter than this has no direction: encoders compute in float32 with features of
order 1 and give lengths of 1 to 100; this is their rounding error."""

TINY_DISPLACEMENT = 1e-5
"""Two unit embeddings closer than this count as equal. The same picture in another batch, with
other threads or in float64 moved its unit embedding by up to 1.2e-6 (ViT-B/32 and ViT-S/14 of
random weights), and the direction of such a step means nothing."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Cosines, one per view.

    Attributes:
        values: (N,) float64 in [-1, 1]; NaN where undefined.
    """

    values: npt.NDArray[np.float64]

    @property
    def undefined(self) -> int:
        """Number of views without a value."""
        return int(np.isnan(self.values).sum())

    @property
    def defined(self) -> int:
        """Number of views with a value."""
        return len(self.values) - self.undefined

    @property
    def mean(self) -> float:
        """Mean over the views that have a value; NaN without any."""
        return float(np.nanmean(self.values)) if self.defined else float("nan")


def clip_similarity(images: npt.ArrayLike, text: npt.ArrayLike) -> Similarity:
    """Cosine of each picture with the prompt.

    Args:
        images: (N, D) embeddings of the renders.
        text: (D,) or (1, D) embedding of one prompt, or (N, D), one for each picture.

    Returns:
        One value for each picture, undefined if an embedding is shorter than TINY_NORM. It is the
        plain
        cosine: neither multiplied by 100 nor clipped at 0, as in some definitions of CLIP score.

    Raises:
        ValueError: other shapes, or embeddings that are NaN or infinite.

    Source: A. Radford et al., "Learning Transferable Visual Models From Natural Language
        Supervision", ICML 2021.

    Example:
        >>> from attnwarp_eval import metrics
        >>> metrics.clip_similarity([[1.0, 0.0], [0.0, 3.0]], [2.0, 0.0]).values.tolist()
        [1.0, 0.0]
    """
    pictures = _embeddings(images, "images")
    return Similarity(_cosine(unit_rows(pictures), unit_rows(_matching(text, pictures, "text"))))


def directional_similarity(
    images_before: npt.ArrayLike,
    images_after: npt.ArrayLike,
    text_before: npt.ArrayLike,
    text_after: npt.ArrayLike,
) -> Similarity:
    """Cosine of the change of each picture with the change of the prompt.

    Args:
        images_before, images_after: (N, D) embeddings, pairs of one view: the original and its
            edited render.
        text_before, text_after: (D,), (1, D) or (N, D) embeddings of their prompts.

    Returns:
        cos(I1 - I0, T1 - T0) of embeddings first normalized to unit length, one per pair. Undefined
        if an embedding is shorter than TINY_NORM, or a change smaller than TINY_DISPLACEMENT:
        without a change, 0 would mean a change in a wrong direction.

    Raises:
        ValueError: other shapes, or embeddings that are NaN or infinite.

    Source: R. Gal et al., "StyleGAN-NADA: CLIP-Guided Domain Adaptation of Image Generators",
        SIGGRAPH 2022; as a
    metric of edits, T. Brooks, A. Holynski, A. A. Efros, "InstructPix2Pix", CVPR 2023.

    Example:
        >>> from attnwarp_eval import metrics
        >>> before, after = [[1.0, 0.0]], [[0.0, 1.0]]  # the picture changed as the prompt did
        >>> round(metrics.directional_similarity(before, after, [1.0, 0.0], [0.0, 1.0]).mean, 9)
        1.0
    """
    after = _embeddings(images_after, "images_after")
    change = _change(images_before, after)
    wanted = unit_rows(_matching(text_after, after, "text_after")) - unit_rows(
        _matching(text_before, after, "text_before")
    )
    return Similarity(
        _cosine(unit_rows(change, TINY_DISPLACEMENT), unit_rows(wanted, TINY_DISPLACEMENT))
    )


def direction_consistency(images_before: npt.ArrayLike, images_after: npt.ArrayLike) -> Similarity:
    """Cosine of the changes of neighbouring views: 1 if the edit moves both in the same direction.

    The changes are those of :func:`directional_similarity`. Higher is better; a cosine has no unit.

    Args:
        images_before, images_after: (N, D) embeddings of N views in the order of their path, before
            and after the edit. Any encoder's ``images`` gives them.

    Returns:
        One value for each of the N - 1 pairs of neighbours; none for one view. Undefined where
        either change is smaller than TINY_DISPLACEMENT, or an embedding shorter than TINY_NORM.

    Raises:
        ValueError: other shapes, or embeddings that are NaN or infinite.

    Source: A. Haque et al., "Instruct-NeRF2NeRF: Editing 3D Scenes with Instructions", ICCV 2023
        ("CLIP direction consistency").

    Example:
        >>> from attnwarp_eval import metrics
        >>> before = [[1.0, 0.0, 0.0]] * 3
        >>> after = [[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]  # the last goes elsewhere
        >>> metrics.direction_consistency(before, after).values.round(9).tolist()
        [1.0, 0.5]
    """
    change = unit_rows(_change(images_before, images_after), TINY_DISPLACEMENT)
    return Similarity(_cosine(change[:-1], change[1:]))


def match_similarity(
    source_before: npt.ArrayLike,
    target_before: npt.ArrayLike,
    source_after: npt.ArrayLike,
    target_after: npt.ArrayLike,
) -> Similarity:
    """Cosine, after the edit, of patches of two views that matched before the edit.

    Two patches match if each has the highest cosine with the other among all patches of its view,
    before the edit. Of equally near patches the first counts. Higher is better; a cosine has
    no unit.

    Args:
        source_before, source_after: (P, D) features of the source's patches before and after the
            edit, in one order: an encoder's ``tokens`` of one picture, reshaped.
        target_before, target_after: (Q, D) features of the target's patches.

    Returns:
        One value per match, in the order of the source's patches; undefined where the edit left a
        feature shorter than TINY_NORM. Without a match, no value and a NaN mean. A feature
        shorter than TINY_NORM before the edit matches nothing. A black picture also has features
        if an encoder adds the position of a patch: its matches are by position only.

    Raises:
        ValueError: other shapes, or features that are NaN or infinite.

    Example:
        >>> from attnwarp_eval import metrics
        >>> before = [[1.0, 0.0], [0.0, 1.0]]
        >>> turned = [[1.0, 1.0], [0.0, 1.0]]  # the edit changed patch 0 in the source alone
        >>> metrics.match_similarity(before, before, turned, before).values.round(3).tolist()
        [0.707, 1.0]
    """
    source, target = (
        _embeddings(value, name)
        for value, name in ((source_before, "source_before"), (target_before, "target_before"))
    )
    if source.shape[1] != target.shape[1]:
        raise ValueError(
            f"target_before: got {target.shape[1]} features a patch, expected {source.shape[1]}, as"
            " source_before; both must come from one encoder"
        )
    after = []
    for value, name, before in (
        (source_after, "source_after", source),
        (target_after, "target_after", target),
    ):
        array = _embeddings(value, name)
        if array.shape != before.shape:
            raise ValueError(
                f"{name}: got shape {array.shape}, expected {before.shape}, as before the edit"
            )
        after.append(unit_rows(array))
    if not (len(source) and len(target)):
        return Similarity(np.zeros(0))
    cosines = np.nan_to_num(unit_rows(source) @ unit_rows(target).T, nan=-np.inf)
    nearest = cosines.argmax(axis=1)
    rows = np.arange(len(source))
    mutual = (cosines.argmax(axis=0)[nearest] == rows) & np.isfinite(cosines[rows, nearest])
    return Similarity(_cosine(after[0][mutual], after[1][nearest[mutual]]))


def image_similarity(source_edit: npt.ArrayLike, renders: npt.ArrayLike) -> Similarity:
    """Cosine of each render with the edited source view: how closely the scene follows the edited
    picture.

    Args:
        source_edit: (D,) or (1, D) embedding of the edited source view.
        renders: (N, D) embeddings of the renders.

    Returns:
        One value for each render, undefined if an embedding is shorter than TINY_NORM. DINO's class
        token gives the DINO, CLIP's picture embedding the CLIP single-image similarity.

    Raises:
        ValueError: other shapes, or embeddings that are NaN or infinite.

    Example:
        >>> from attnwarp_eval import metrics
        >>> metrics.image_similarity([1.0, 0.0], [[2.0, 0.0], [0.0, 1.0]]).values.tolist()
        [1.0, 0.0]
    """
    pictures = _embeddings(renders, "renders")
    source = _matching(source_edit, pictures, "source_edit")
    return Similarity(_cosine(unit_rows(pictures), unit_rows(source)))


def _change(before: npt.ArrayLike, after: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(N, D) difference of embeddings normalized to unit length, pair by pair."""
    second, first = _embeddings(after, "images_after"), _embeddings(before, "images_before")
    if first.shape != second.shape:
        raise ValueError(
            f"images_before: got shape {first.shape}, expected {second.shape}, as images_after"
        )
    return unit_rows(second) - unit_rows(first)


def _embeddings(value: npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
    """(N, D) in float64, so that lengths of float16 embeddings do not overflow."""
    array = np.asarray(value)
    if array.ndim != 2 or array.shape[1] == 0:
        raise ValueError(f"{name}: got shape {array.shape}, expected (N, D)")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: got {array.dtype}, expected real numbers")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{name}: {int(bad.sum())} of {len(array)} embeddings are NaN or infinite, row"
            f" {int(bad.argmax())} first; an encoder that computes in float16 overflows: let it"
            " compute in float32"
        )
    return array.astype(np.float64)


def _matching(
    value: npt.ArrayLike, pictures: npt.NDArray[np.float64], name: str
) -> npt.NDArray[np.float64]:
    """Validate one embedding for all pictures, or one for each."""
    array = np.asarray(value)
    array = _embeddings(array[None] if array.ndim == 1 else array, name)
    if array.shape[1] != pictures.shape[1] or len(array) not in (1, len(pictures)):
        raise ValueError(
            f"{name}: got shape {array.shape}, expected ({pictures.shape[1]},), (1,"
            f" {pictures.shape[1]}) or {pictures.shape}; both must come from one encoder"
        )
    return array


def unit_rows(rows: npt.NDArray[np.float64], tiny: float = TINY_NORM) -> npt.NDArray[np.float64]:
    """Rows of length 1, and NaN where a row is shorter than ``tiny``."""
    # Scale first: the square of a float64 above 1e154 overflows.
    largest = np.abs(rows).max(axis=1, initial=0, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    defined = largest >= tiny / np.maximum(length, 1)
    return np.divide(scaled, length, out=np.full_like(rows, np.nan), where=defined & (length > 0))


def _cosine(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Cosines of unit rows; a single row is broadcast. Rounding past 1 is clipped, NaN stays."""
    return np.asarray(np.clip((a * b).sum(axis=1), -1, 1))
