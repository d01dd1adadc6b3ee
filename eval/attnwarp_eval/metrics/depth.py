"""Accuracy of depth: depth along the optical axis and normals against truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from attnwarp_eval.metrics.arrays import floats, mask, mean, quantile, regions, share


def depth_error(
    depth: Any, true_depth: Any, *, normal: Any = None, true_normal: Any = None, edge: Any = None
) -> dict[str, float]:
    """Compute the errors of a depth map, and of a normal map if both normals are given.

    Args:
        depth: (H, W) depth along the optical axis; NaN, infinite or not positive is undefined.
        true_depth: (H, W), NaN where there is no surface.
        normal, true_normal: (H, W, 3) world normals that face the camera, of any length.
        edge: (H, W) bool, the band around edges; adds every figure for the interior and
            for the band.

    Returns:
        Figures of :data:`attnwarp_eval.metrics.registry.METRICS`. Means are over pixels with a
        surface and a depth. The delta shares are over all pixels with a surface: a pixel without a
        depth is within no threshold. NaN with nothing to measure.

    Raises:
        ValueError: another shape or type, or one of the two normal maps without the other.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> error = metrics.depth_error(np.full((4, 4), 2.2), np.full((4, 4), 2.0))
        >>> round(error["depth.abs_rel"], 9), round(error["depth.bias"], 9)
        (0.1, 0.2)
    """
    truth = floats(true_depth, ("H", "W"), "true_depth")
    estimate = floats(depth, truth.shape, "depth")
    band = None if edge is None else mask(edge, truth.shape, "edge")
    if (normal is None) != (true_normal is None):
        raise ValueError("normal, true_normal: got one of them, expected both or neither")
    angle = None
    if normal is not None:
        # Imported here: torch takes a second, too long for a list of metrics' names.
        import torch

        from attnwarp.warp import angle_between

        ours = floats(normal, (*truth.shape, 3), "normal")
        exact = floats(true_normal, (*truth.shape, 3), "true_normal")
        angle = angle_between(torch.tensor(ours), torch.tensor(exact)).numpy()
    surface = np.isfinite(truth)
    defined = np.isfinite(estimate) & (np.nan_to_num(estimate) > 0)
    figures: dict[str, float] = {}
    for suffix, region in regions(band, truth.shape).items():
        total = int((surface & region).sum())
        among = surface & region & defined
        z, exact_z = estimate[among], truth[among]
        error, ratio = z - exact_z, z / exact_z
        ratio = np.maximum(ratio, 1 / ratio)
        figures |= {
            f"depth.abs_rel{suffix}": mean(np.abs(error) / exact_z),
            f"depth.rmse{suffix}": float(np.sqrt(mean(error**2))),
            f"depth.bias{suffix}": mean(error),
            f"depth.bias_relative{suffix}": mean(error / exact_z),
            f"depth.bias_median{suffix}": quantile(error / exact_z, 0.5),
            f"depth.delta_1_01{suffix}": share(int((ratio < 1.01).sum()), total),
            f"depth.delta_1_25{suffix}": share(int((ratio < 1.25).sum()), total),
            f"depth.coverage{suffix}": share(int(among.sum()), total),
            f"depth.pixels{suffix}": total,
            f"depth.phantom{suffix}": int((~surface & defined & region).sum()),
        }
        if angle is not None:
            degrees = angle[surface & region & np.isfinite(angle)]
            figures[f"depth.normal_mean{suffix}"] = mean(degrees)
            figures[f"depth.normal_median{suffix}"] = quantile(degrees, 0.5)
    return figures
