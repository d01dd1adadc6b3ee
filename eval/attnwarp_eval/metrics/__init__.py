"""Metrics of depth, surfaces, warps, masks and edited views: pure functions, arrays in and figures
out, no I/O.

:data:`attnwarp_eval.metrics.registry.METRICS` has each figure's unit, direction and tolerance.
docs/measuring/metrics.md says which one to use. A figure with nothing to measure is NaN, never 0,
with a count next to it.
"""

from __future__ import annotations

from attnwarp_eval.metrics.consistency import (
    Disagreement,
    Flow,
    cross_view,
    optical_flow,
)
from attnwarp_eval.metrics.depth import depth_error
from attnwarp_eval.metrics.embedding import (
    Similarity,
    clip_similarity,
    direction_consistency,
    directional_similarity,
    image_similarity,
    match_similarity,
)
from attnwarp_eval.metrics.fidelity import fidelity, nearest_answer
from attnwarp_eval.metrics.image import (
    EditPsnr,
    edit_psnr,
    image_error,
    ms_ssim,
    mse,
    perceptual,
    psnr,
    ssim,
    ssim_map,
)
from attnwarp_eval.metrics.known_geometry import (
    disagreement_at,
    edit_agreement,
    feature_consistency,
    perceptual_consistency,
)
from attnwarp_eval.metrics.masks import mask_overlap
from attnwarp_eval.metrics.multiview import (
    above_floor,
    answers_by_view,
    edit_fidelity,
    same_parts,
)
from attnwarp_eval.metrics.occlusion import COUNTS, YawBin, by_yaw, confusion, mask_error, scores
from attnwarp_eval.metrics.reconstruction import Reconstruction, reconstruct
from attnwarp_eval.metrics.registry import METRICS, at_size, metric
from attnwarp_eval.metrics.warp import endpoint_error, feature_error

__all__ = [
    "COUNTS",
    "METRICS",
    "Disagreement",
    "EditPsnr",
    "Flow",
    "Reconstruction",
    "Similarity",
    "YawBin",
    "above_floor",
    "answers_by_view",
    "at_size",
    "by_yaw",
    "clip_similarity",
    "confusion",
    "cross_view",
    "depth_error",
    "direction_consistency",
    "directional_similarity",
    "disagreement_at",
    "edit_agreement",
    "edit_fidelity",
    "edit_psnr",
    "endpoint_error",
    "feature_consistency",
    "feature_error",
    "fidelity",
    "image_error",
    "image_similarity",
    "mask_error",
    "mask_overlap",
    "match_similarity",
    "metric",
    "ms_ssim",
    "mse",
    "nearest_answer",
    "optical_flow",
    "perceptual",
    "perceptual_consistency",
    "psnr",
    "reconstruct",
    "same_parts",
    "scores",
    "ssim",
    "ssim_map",
]
