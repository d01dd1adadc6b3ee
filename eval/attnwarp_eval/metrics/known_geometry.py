"""Agreement of two edited views at correspondences from a depth map, exact or rendered.

Such correspondences need splats or depth but no truth: :func:`attnwarp.warp.warp_view` gives them
for each target pixel, with a mask. Pictures are sRGB in [0, 1]; positions are px of the source,
pixel centres at +0.5.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from attnwarp import check
from attnwarp_eval.colors import to_linear, to_srgb
from attnwarp_eval.metrics._pictures import picture, region
from attnwarp_eval.metrics.arrays import Array, Mask, floats, mask, mean, quantile
from attnwarp_eval.metrics.consistency import Disagreement, disagreement, has_taps, sampled
from attnwarp_eval.metrics.embedding import Similarity, unit_rows
from attnwarp_eval.metrics.image import Distance, perceptual

CHANGED = 2.0
"""dE00 between a view before and after the edit above which a pixel counts as changed: twice the
just noticeable difference, and above the noise of 8 bits."""

GRID = (slice(None, None, 2), slice(None, None, 2))
"""Step of the rows and columns compared: 2 takes a quarter of the time for nearly equal means."""


def disagreement_at(
    source_srgb: Any, target_srgb: Any, xy: Any, accepted: Any, *, within: Any = None
) -> Disagreement:
    """Compare two pictures at given positions.

    Args:
        source_srgb, target_srgb: (h, w, 3) and (H, W, 3) sRGB in [0, 1].
        xy: (H, W, 2) px of the source for each target pixel; NaN where there is none.
        accepted: (H, W) bool, target pixels whose position is trusted.
        within: (H, W) bool of the target, pixels to compare; all if left out.

    Raises:
        ValueError: a picture that is not sRGB in [0, 1], or positions of another size.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> y, x = np.mgrid[:8, :8] + 0.5
        >>> grey = np.full((8, 8, 3), 0.5)
        >>> accepted = np.ones((8, 8), bool)
        >>> result = metrics.disagreement_at(grey, grey, np.stack([x, y], -1), accepted)
        >>> result.figures("rendered_")["consistency.rendered_delta_e"]
        0.0
    """
    source, target = picture(source_srgb, "source_srgb"), picture(target_srgb, "target_srgb")
    positions, trusted = _positions(xy, accepted, target)
    pixels = trusted & region(within, target.shape, "within")
    return disagreement(source, target, positions, pixels, int(pixels.sum()))


def edit_agreement(
    before: tuple[Any, Any], after: tuple[Any, Any], xy: Any, accepted: Any
) -> dict[str, float]:
    """Measure the disagreement added by an edit, at pixels changed in either view.

    Differences between the two views before the edit, such as highlights, wrong depth and
    resampling, are subtracted pixel by pixel. So neither truth nor a mask of the object is needed.

    Args:
        before, after: source and target, (h, w, 3) and (H, W, 3) sRGB in [0, 1].
        xy, accepted: as for :func:`disagreement_at`.

    Returns:
        ``consistency.edit_delta_e``, the mean over the changed pixels of dE00 after the edit minus
        dE00 before it, which may be negative; ``consistency.edit_delta_e_p90``, its 90th
        percentile; and ``consistency.edit_pixels``, their number. NaN if nothing changed. A
        pixel counts as changed from :data:`CHANGED` on.

    Raises:
        ValueError: a picture that is not sRGB in [0, 1], or sizes that differ.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> y, x = np.mgrid[:8, :8] + 0.5
        >>> xy, accepted = np.stack([x, y], -1), np.ones((8, 8), bool)
        >>> grey, white = np.full((8, 8, 3), 0.5), np.ones((8, 8, 3))
        >>> both = metrics.edit_agreement((grey, grey), (white, white), xy, accepted)
        >>> one = metrics.edit_agreement((grey, grey), (white, grey), xy, accepted)
        >>> both["consistency.edit_delta_e"], one["consistency.edit_delta_e"] > 30
        (0.0, True)
    """
    from skimage.color import deltaE_ciede2000, rgb2lab

    names = ("source", "target")
    old = [picture(value, f"before's {name}") for value, name in zip(before, names, strict=True)]
    new = [
        picture(value, f"after's {name}", shape=was.shape)
        for value, name, was in zip(after, names, old, strict=True)
    ]
    positions, trusted = _positions(xy, accepted, new[1])
    counted = trusted & has_taps(positions, new[0].shape)
    (source_old, target_old), (source_new, target_new) = (
        (rgb2lab(to_srgb(sampled(to_linear(one), positions[counted]))), rgb2lab(other[counted]))
        for one, other in (old, new)
    )
    changes = deltaE_ciede2000(source_old, source_new), deltaE_ciede2000(target_old, target_new)
    touched = np.maximum(*changes) >= CHANGED
    added = deltaE_ciede2000(source_new[touched], target_new[touched]) - deltaE_ciede2000(
        source_old[touched], target_old[touched]
    )
    return {
        "consistency.edit_delta_e": mean(added),
        "consistency.edit_delta_e_p90": quantile(added, 0.9),
        "consistency.edit_pixels": int(touched.sum()),
    }


def feature_consistency(
    source_tokens: Any,
    target_tokens: Any,
    xy: Any,
    accepted: Any,
    size: tuple[int, int],
    *,
    seen: float = 1.0,
) -> Similarity:
    """Cosines of two views' features at the same surface points: MEt3R's scheme, with a known
    geometry in place of the predicted one.

    Args:
        source_tokens, target_tokens: (h, w, D) features of the patches of the central square of a
            picture, an encoder's ``tokens`` of one picture each. The source's are sampled
            bilinearly.
        xy, accepted: (H, W, 2) and (H, W) as for :func:`disagreement_at`; read at the centres of
            the target's patches.
        size: (height, width) of the source in px.
        seen: share of the shorter side inside the encoder's crop, in (0, 1]: 224 / 256 for a crop
            of 224 px from a picture resized to 256 px.

    Returns:
        One cosine for each patch of the target with a trusted centre and a point in the source's
        square, in row order. ``1 - mean`` is ``consistency.features``, 0 for equal
        features. Empty without trusted patches.

    Raises:
        ValueError: other shapes, or features that are NaN or infinite.

    Source: M. Asim et al., "MEt3R: Measuring Multi-View Consistency in Generated Images",
        CVPR 2025.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> y, x = np.mgrid[:32, :32] + 0.5
        >>> tokens = np.random.default_rng(0).random((4, 4, 6))
        >>> xy, accepted = np.stack([x, y], -1), np.ones((32, 32), bool)
        >>> round(metrics.feature_consistency(tokens, tokens, xy, accepted, (32, 32)).mean, 2)
        1.0
    """
    source = floats(source_tokens, ("h", "w", "D"), "source_tokens")
    target = floats(target_tokens, ("H", "W", source.shape[2]), "target_tokens")
    for value, name in ((source, "source_tokens"), (target, "target_tokens")):
        check.finite(value, name)
    trusted = mask(accepted, ("H", "W"), "accepted")
    positions = floats(xy, (*trusted.shape, 2), "xy")
    grid = np.array(target.shape[1::-1])
    corner, side = _square(trusted.shape, seen)
    j, i = np.meshgrid(*(np.arange(n) + 0.5 for n in grid))
    column, row = np.floor(corner + np.stack([j, i], -1) * side / grid).astype(int).T
    at, kept = positions[row.T, column.T], trusted[row.T, column.T]
    corner, side = _square(size, seen)
    own = np.array(source.shape[1::-1])
    at = (at - corner) * own / side
    with np.errstate(invalid="ignore"):
        kept &= ((at >= 0) & (at <= own)).all(axis=-1)
    # Within half a patch of the border, positions are clamped to the nearest patch's centre.
    held = np.clip(at[kept], 0.5, own - 0.5)
    a, b = unit_rows(sampled(source, held)), unit_rows(target[kept])
    return Similarity(np.clip((a * b).sum(axis=1), -1, 1))


def _square(size: tuple[int, ...], seen: float) -> tuple[Array, float]:
    """Upper left corner (x, y) and side in px of the encoder's central crop."""
    side = min(size[:2]) * seen
    return (np.array(size[1::-1]) - side) / 2, side


def perceptual_consistency(
    source_srgb: Any, target_srgb: Any, xy: Any, accepted: Any, distance: Distance
) -> float:
    """Perceptual distance of a target from the source warped to it, over the trusted pixels; NaN
    without any.

    Args:
        source_srgb, target_srgb, xy, accepted: as for :func:`disagreement_at`.
        distance: as for :func:`attnwarp_eval.metrics.perceptual`, which describes the mask.

    Raises:
        ValueError: as :func:`disagreement_at`.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> y, x = np.mgrid[:8, :8] + 0.5
        >>> xy, accepted = np.stack([x, y], -1), np.ones((8, 8), bool)
        >>> picture = np.random.default_rng(0).random((8, 8, 3))
        >>> l1 = lambda a, b: float(np.abs(a - b).mean())
        >>> metrics.perceptual_consistency(picture, picture, xy, accepted, l1)
        0.0
    """
    source, target = picture(source_srgb, "source_srgb"), picture(target_srgb, "target_srgb")
    positions, trusted = _positions(xy, accepted, target)
    counted = trusted & has_taps(positions, source.shape)
    warped = target.copy()
    warped[counted] = sampled(source, positions[counted])
    return perceptual(warped, target, distance, counted)


def _positions(xy: Any, accepted: Any, target: Array) -> tuple[Array, Mask]:
    positions = floats(xy, (*target.shape[:2], 2), "xy")
    return positions, mask(accepted, target.shape[:2], "accepted")
