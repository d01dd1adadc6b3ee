"""Checks of warp, mask and depth against truth: pure functions, arrays in and figures out.

What each figure is stands in :data:`attnwarp_eval.metric.METRICS`. A figure that is undefined (nothing to measure it
on) is NaN, with the count beside it that says so; it is never 0.
"""

from __future__ import annotations

from collections.abc import Mapping

from attnwarp_eval.checks.depth import depth_error
from attnwarp_eval.checks.occlusion import COUNTS, YawBin, by_yaw, confusion, mask_error, scores
from attnwarp_eval.checks.warp import endpoint_error, feature_error
from attnwarp_eval.metric import METRICS, metric

__all__ = [
    "COUNTS",
    "METRICS",
    "YawBin",
    "at_size",
    "by_yaw",
    "confusion",
    "depth_error",
    "endpoint_error",
    "feature_error",
    "mask_error",
    "metric",
    "scores",
]


def at_size(figures: Mapping[str, float], size: int) -> dict[str, float]:
    """The same figures, named for a feature size: ``warp.epe_median`` becomes ``warp.epe_median.64``."""
    return {f"{name}.{size}": value for name, value in figures.items()}
