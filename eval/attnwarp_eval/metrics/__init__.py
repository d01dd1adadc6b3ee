"""Metrics of edited views: pure functions, pictures in and figures out, nothing read or written.

What each figure is stands in :data:`attnwarp_eval.metric.METRICS`, and at length in docs/metrics.md. A figure that is
undefined (nothing to measure it on) is NaN, never 0, with a count beside it.
"""

from __future__ import annotations

from attnwarp_eval.metrics.consistency import (
    Disagreement,
    Flow,
    approximation_error,
    cross_view,
    flow_consistency,
    flow_error,
    optical_flow,
    view_dependent,
)
from attnwarp_eval.metrics.embedding import Similarity, clip_similarity, directional_similarity, image_similarity
from attnwarp_eval.metrics.fidelity import fidelity, nearest_answer
from attnwarp_eval.metrics.image import EditPsnr, edit_psnr, image_error, ms_ssim, mse, perceptual, psnr, ssim, ssim_map

__all__ = [
    "Disagreement",
    "EditPsnr",
    "Flow",
    "Similarity",
    "approximation_error",
    "clip_similarity",
    "cross_view",
    "directional_similarity",
    "edit_psnr",
    "fidelity",
    "flow_consistency",
    "flow_error",
    "image_error",
    "image_similarity",
    "ms_ssim",
    "mse",
    "nearest_answer",
    "optical_flow",
    "perceptual",
    "psnr",
    "ssim",
    "ssim_map",
    "view_dependent",
]
