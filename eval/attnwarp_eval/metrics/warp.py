"""Accuracy of a warp: endpoint error of positions, and error of the features it carries."""

from __future__ import annotations

from typing import Any

import numpy as np

from attnwarp_eval.metrics.arrays import floats, mask, mean, quantiles, regions, share


def endpoint_error(
    xy: Any, true_xy: Any, visible: Any, edge: Any = None, *, image_px: Any = 1.0
) -> dict[str, float]:
    """Distance between a warp's position in the source and the exact one.

    Args:
        xy: (H, W, 2) source positions of the warp, NaN where undefined.
        true_xy: (H, W, 2) exact source positions on the same grid.
        visible: (H, W) bool, pixels truly visible in the source; only these are scored.
        edge: (H, W) bool, the band around edges; adds every figure for the interior and
            for the band.
        image_px: size of one unit of ``xy`` in image pixels, or (x, y) sizes: 8 on the 64 grid of a
            512 image.

    Returns:
        Figures of :data:`attnwarp_eval.metrics.registry.METRICS` in image pixels, and ``_layer``
        ones in the units of ``xy``. The shares are of all visible pixels: a pixel without a
        position is within no threshold. Median, percentile and mean are over pixels with a
        position, with ``coverage`` next to them. NaN with nothing to measure.

    Raises:
        ValueError: another shape or type, or an exact position that is not finite in a visible
            pixel.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> exact = np.zeros((4, 4, 2))
        >>> error = metrics.endpoint_error(exact + [3, 4], exact, np.ones((4, 4), bool))
        >>> error["warp.epe_median"], error["warp.coverage"]
        (5.0, 1.0)
    """
    truth = floats(true_xy, ("H", "W", 2), "true_xy")
    shape = truth.shape[:2]
    estimate = floats(xy, truth.shape, "xy")
    visible_pixels = mask(visible, shape, "visible")
    band = None if edge is None else mask(edge, shape, "edge")
    seen = np.flatnonzero(visible_pixels)
    exact = truth.reshape(-1, 2)[seen]
    if not np.isfinite(exact).all():
        raise ValueError(
            "true_xy: not finite in a visible pixel; positions and labels do not belong together"
        )
    offset = estimate.reshape(-1, 2)[seen] - exact
    layer = np.hypot(offset[:, 0], offset[:, 1])
    unit = np.broadcast_to(np.asarray(image_px, dtype=np.float64), (2,))
    one = bool((unit == 1).all())
    image = layer if one else np.hypot(offset[:, 0] * unit[0], offset[:, 1] * unit[1])
    defined = np.isfinite(layer)
    figures: dict[str, float] = {}
    for suffix, region in regions(band, shape).items():
        inside = region.ravel()[seen]
        total = int(inside.sum())
        among = inside & defined
        px = image[among]
        median, p95 = quantiles(px, (0.5, 0.95))
        layer_quantiles = [median, p95] if one else quantiles(layer[among], (0.5, 0.95))
        figures |= {
            f"warp.epe_median{suffix}": median,
            f"warp.epe_p95{suffix}": p95,
            f"warp.epe_mean{suffix}": mean(px),
            f"warp.epe_median_layer{suffix}": layer_quantiles[0],
            f"warp.epe_p95_layer{suffix}": layer_quantiles[1],
            f"warp.below_half_px{suffix}": share(int((px < 0.5).sum()), total),
            f"warp.below_1px{suffix}": share(int((px < 1).sum()), total),
            f"warp.below_2px{suffix}": share(int((px < 2).sum()), total),
            f"warp.coverage{suffix}": share(int(among.sum()), total),
            f"warp.visible{suffix}": total,
        }
    return figures


def feature_error(
    warped: Any, exact: Any, accepted: Any, visible: Any, edge: Any = None
) -> dict[str, float]:
    """Error of warped features where the exact ones are defined: sqrt(sum (warped - exact)^2 / sum
    exact^2).

    Args:
        warped: (C, h, w) features as warped; values outside ``accepted`` count in
            ``feature_visible`` only.
        exact: (C, h, w) the field at the target's surface points
            (:meth:`attnwarp_eval.truth.features.SolidField.on_grid`).
        accepted: (h, w) bool, the warp's mask.
        visible: (h, w) bool, pixels truly visible in the source.
        edge: (h, w) bool, the band around edges.

    Returns:
        ``feature_accepted`` over accepted and visible pixels, ``feature_visible`` over all visible
        ones, ``feature_all_accepted`` over accepted ones with a surface, visible or not, as
        injected. NaN with nothing to measure.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> exact, all_pixels = np.ones((8, 4, 4)), np.ones((4, 4), bool)
        >>> error = metrics.feature_error(1.5 * exact, exact, all_pixels, all_pixels)
        >>> error["warp.feature_accepted"]
        0.5
    """
    truth = floats(exact, ("C", "H", "W"), "exact")
    shape = truth.shape[1:]
    estimate = floats(warped, truth.shape, "warped")
    passed, visible_pixels = mask(accepted, shape, "accepted"), mask(visible, shape, "visible")
    band = None if edge is None else mask(edge, shape, "edge")
    surface = np.ones(shape, dtype=bool)
    square, power = np.zeros(shape), np.zeros(shape)
    for ours, true in zip(estimate, truth, strict=True):  # by channel, to fit in a cache
        surface &= np.isfinite(true)
        square += (ours - true) ** 2
        power += true**2
    figures: dict[str, float] = {}
    for suffix, region in regions(band, shape).items():
        groups = {
            "accepted": passed & visible_pixels,
            "visible": visible_pixels,
            "all_accepted": passed & surface,
        }
        for name, group in groups.items():
            among = np.flatnonzero(group & region)
            total = float(power.ravel()[among].sum())
            figures[f"warp.feature_{name}{suffix}"] = (
                float(np.sqrt(square.ravel()[among].sum() / total)) if total > 0 else float("nan")
            )
        figures[f"warp.feature_pixels{suffix}"] = int((passed & visible_pixels & region).sum())
    return figures
