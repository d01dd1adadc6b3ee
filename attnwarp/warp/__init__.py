"""Warps: correspondences between two views, visibility from the source, and sampling;
see docs/method/warping.md."""

from attnwarp.warp.correspondence import (
    Correspondence,
    correspond,
    correspond_at,
    in_bounds,
    layer_size,
)
from attnwarp.warp.depth import TAP_SPREAD, depth_slope, resize_depth
from attnwarp.warp.features import FeatureWarp
from attnwarp.warp.lifting import LiftedMask, lift_masks
from attnwarp.warp.masks import resize_mask
from attnwarp.warp.piece import piece_around
from attnwarp.warp.rules import (
    EXACT_DEPTH_TOLERANCE,
    RULES,
    Rule,
    angle_between,
    camera_frame,
    depth_agrees,
    depth_tolerance,
    facing,
    gaussian_filter,
    in_front,
    opaque,
    parts_of,
    parts_read,
    photometric,
    source_incidence,
)
from attnwarp.warp.sampling import sample, sample_at, sample_depth
from attnwarp.warp.settings import PRESETS, WarpSettings, preset
from attnwarp.warp.taps import SNAP
from attnwarp.warp.view import (
    Surface,
    WarpedView,
    render_surface,
    warp_surfaces,
    warp_view,
)

__all__ = [
    "EXACT_DEPTH_TOLERANCE",
    "PRESETS",
    "RULES",
    "SNAP",
    "TAP_SPREAD",
    "Correspondence",
    "FeatureWarp",
    "LiftedMask",
    "Rule",
    "Surface",
    "WarpSettings",
    "WarpedView",
    "angle_between",
    "camera_frame",
    "correspond",
    "correspond_at",
    "depth_agrees",
    "depth_slope",
    "depth_tolerance",
    "facing",
    "gaussian_filter",
    "in_bounds",
    "in_front",
    "layer_size",
    "lift_masks",
    "opaque",
    "parts_of",
    "parts_read",
    "photometric",
    "piece_around",
    "preset",
    "render_surface",
    "resize_depth",
    "resize_mask",
    "sample",
    "sample_at",
    "sample_depth",
    "source_incidence",
    "warp_surfaces",
    "warp_view",
]
