"""Errors of edited pictures inside and outside the object, against the edit's rendered truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from attnwarp_eval.metrics._pictures import picture, region
from attnwarp_eval.metrics.arrays import Mask
from attnwarp_eval.metrics.image import (
    Distance,
    edit_psnr,
    ms_ssim,
    mse,
    perceptual,
    psnr_of_mse,
    ssim,
)


def fidelity(
    image_srgb: Any,
    truth_srgb: Any,
    mask: Any,
    *,
    original_srgb: Any = None,
    distance: Distance | None = None,
) -> dict[str, float]:
    """The ``fidelity.*`` figures of an edited view against the truth of the edit.

    Figures are of the whole picture, ``.inside`` and ``.outside`` the edited object. Only
    ``.outside`` shows that a method also painted the rest of the picture. Pixels on the object's
    outline, one on each side, count in neither: the mask is of pixel centres, and a pixel shows
    the mean of its area. ``preserved_*`` compares the outside with the picture before the edit. It
    is imperfect for the truth too if an edited object reflects other light, so report
    ``preserved_*`` of the truth with it.

    Args:
        image_srgb: (H, W, 3) sRGB in [0, 1], the edited view.
        truth_srgb: the same view of the truly edited scene
            (:meth:`attnwarp_eval.scene.scene.Scene.edited`).
        mask: (H, W) bool, the edited object (:func:`attnwarp_eval.truth.edits.edit_mask`). All True
            for an edit of the light, which has no outside: ``.outside`` is NaN.
        original_srgb: the view before the edit; without it there are no ``preserved_*`` figures.
        distance: a perceptual distance; without it no ``distance``. Inside and outside are masked
            as :func:`attnwarp_eval.metrics.perceptual` says.

    Returns:
        ``mse``, ``psnr``, ``ssim`` and ``distance`` of the whole picture, ``.inside`` and
        ``.outside``, ``ms_ssim`` whole, the ``preserved_*`` figures, and the counts of pixels. PSNR
        divides by the region's pixels; SSIM counts windows wholly inside the region. NaN where a
        region is empty, such as the inside of an object two pixels wide.

    Raises:
        ValueError: a picture that is not sRGB in [0, 1], pictures of different sizes, a mask that
            is not bool.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> truth, mask = np.full((32, 32, 3), 0.5), np.zeros((32, 32), bool)
        >>> mask[8:24, 8:24] = True
        >>> figures = metrics.fidelity(truth + 0.1 * mask[..., None], truth, mask)
        >>> round(figures["fidelity.psnr.inside"], 9), figures["fidelity.psnr.outside"]
        (20.0, inf)
    """
    image = picture(image_srgb, "image_srgb")
    truth = picture(truth_srgb, "truth_srgb", shape=image.shape)
    inside = region(mask, image.shape)
    parts = {"": np.ones_like(inside), ".inside": _shrunk(inside), ".outside": _shrunk(~inside)}
    figures: dict[str, float] = {}
    for suffix, part in parts.items():
        error = mse(image, truth, part)
        figures[f"fidelity.mse{suffix}"] = error
        figures[f"fidelity.psnr{suffix}"] = psnr_of_mse(error)
        figures[f"fidelity.ssim{suffix}"] = ssim(image, truth, part)
        figures[f"fidelity.pixels{suffix}"] = int(part.sum())
        if distance is not None:
            figures[f"fidelity.distance{suffix}"] = perceptual(image, truth, distance, part)
    figures["fidelity.ms_ssim"] = ms_ssim(image, truth)
    if original_srgb is not None:
        outside = parts[".outside"]
        original = picture(original_srgb, "original_srgb", shape=image.shape)
        error = mse(image, original, outside)
        figures["fidelity.preserved_mse"] = error
        figures["fidelity.preserved_psnr"] = psnr_of_mse(error)
        figures["fidelity.preserved_ssim"] = ssim(image, original, outside)
        if distance is not None:
            figures["fidelity.preserved_distance"] = perceptual(image, original, distance, outside)
    return figures


def nearest_answer(
    images: Mapping[str, Any],
    answers: Mapping[str, Mapping[str, Any]],
    masks: Mapping[str, Any] | None = None,
) -> tuple[str | None, dict[str, float]]:
    """Answer of an ambiguous edit that a method gave: one for all views, with the least mean MSE
    over them.

    One answer for all, since a method may not answer differently from view to view
    (docs/truth/scenes.md).

    Args:
        images: (H, W, 3) sRGB by the view's name, the edited views.
        answers: truth of each answer in the same views, by name.
        masks: (H, W) bool by the view's name, the edited object.

    Returns:
        The answer's name, None if nothing could be measured; and the PSNR in dB, pooled over the
        views, for each answer.

    Raises:
        ValueError: no answers, or one that does not have the views of ``images``.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> black, grey, white = (np.full((4, 4, 3), value) for value in (0.0, 0.4, 1.0))
        >>> answers = {"dark": {"yaw010": black}, "bright": {"yaw010": white}}
        >>> name, psnr = metrics.nearest_answer({"yaw010": grey}, answers)
        >>> name, round(psnr["dark"], 2)
        ('dark', 7.96)
    """
    if not answers:
        raise ValueError("answers: got none, expected the truth of at least one")
    for name, truth in answers.items():
        if set(truth) != set(images):
            raise ValueError(
                f"answers[{name!r}]: got views {sorted(truth)}, expected those of images,"
                f" {sorted(images)}"
            )
    scores = {name: edit_psnr(images, truth, masks).pooled for name, truth in answers.items()}
    defined = {name: value for name, value in scores.items() if not math.isnan(value)}
    return (max(defined, key=defined.__getitem__) if defined else None), scores


def _shrunk(part: Mask) -> Mask:
    """Part without pixels that have a neighbour of eight outside it, but in the picture."""
    from scipy.ndimage import binary_erosion

    inner: Mask = binary_erosion(part, np.ones((3, 3), dtype=bool), border_value=1)
    return inner
