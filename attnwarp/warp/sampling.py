"""Sampling of features and depth at the positions of a correspondence."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp.correspondence import Correspondence, in_bounds, positions_in
from attnwarp.warp.depth import TAP_SPREAD, Array, blend_depth, valid_depth
from attnwarp.warp.settings import DepthInterpolation
from attnwarp.warp.taps import bilinear_taps, clamp_index

_HALF_PRECISION = (torch.float16, torch.bfloat16)


def sample(
    features: Tensor,
    correspondence: Correspondence,
    *,
    mode: Literal["bilinear", "nearest"] = "bilinear",
) -> tuple[Tensor, Tensor]:
    """A source feature map, warped to the target's grid.

    Args:
        features: (C, h, w) or (B, C, h, w) on the source's image, of any size: a position u becomes
            u * w / W (for integer centres u * (w - 1) / (W - 1) on indices, which is what
            align_corners=True does). Its gradient flows back through the result.
        correspondence: H x W positions, float64; moved to the features' device.
        mode: "bilinear" for floating types: weights and sums in float32 for half precision, in the
            features' own type otherwise. "nearest" for any type, labels included.

    Returns:
        warped: (C, H, W) or (B, C, H, W) in the features' type. A position outside the image takes
            the border's value; a pixel without a position is 0, so that it cannot spread NaN into a
            network. Use the mask.
        mask: (H, W) bool, the position lies inside the source image (:func:`in_bounds`).

    Raises:
        ValueError: another number of axes, a type that cannot be blended, an unknown mode.
    """
    if features.ndim not in (3, 4):
        raise ValueError(
            f"features: got shape {tuple(features.shape)}, expected (C, h, w) or (B, C, h, w)"
        )
    xy = positions_in(correspondence, features.shape[-1], features.shape[-2])
    return sample_at(features, xy, mode=mode), in_bounds(correspondence).to(features.device)


def sample_at(
    features: Tensor, xy: Tensor, *, mode: Literal["bilinear", "nearest"] = "bilinear"
) -> Tensor:
    """Features at positions of their own image.

    Args:
        features: (..., h, w).
        xy: (H, W, 2) positions in pixels of the feature map (centres at +0.5), float32 or float64.
            NaN gives 0.
        mode: as in :func:`sample`.

    Returns:
        (..., H, W) in the features' type.

    Raises:
        ValueError: a half-precision or integer ``xy``: bfloat16 cannot even tell 256.5 from 257.
    """
    check.one_of(mode, ("bilinear", "nearest"), "mode")
    if xy.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"xy: got {xy.dtype}, expected float32 or float64; half precision moves positions by up"
            " to pixels"
        )
    check.shape(xy, ("H", "W", 2), "xy")
    if mode == "bilinear" and not features.dtype.is_floating_point:
        raise ValueError(
            f"features: got {features.dtype}, expected a floating type; labels and masks take"
            " mode='nearest'"
        )
    h, w = features.shape[-2:]
    xy = xy.to(device=features.device, dtype=torch.float64)
    # NaN is masked before it reaches an index.
    defined = torch.isfinite(xy).all(dim=-1)
    xy = torch.where(defined[..., None], xy, 0.5)
    flat = features.flatten(-2)
    if mode == "nearest":
        j = clamp_index(torch.floor(xy[..., 0]), w)
        i = clamp_index(torch.floor(xy[..., 1]), h)
        warped = flat[..., (i * w + j).reshape(-1)].unflatten(-1, defined.shape)
        return torch.where(
            defined, warped, torch.zeros((), dtype=features.dtype, device=features.device)
        )
    index, weight = bilinear_taps(xy, h, w)
    work = torch.float32 if features.dtype in _HALF_PRECISION else features.dtype
    total = torch.zeros((), dtype=work, device=features.device)
    for tap, share in zip(index, weight.to(work), strict=True):
        value = flat[..., tap.reshape(-1)].unflatten(-1, defined.shape).to(work)
        # A tap of weight 0 may hold anything, an infinity included.
        total = total + torch.where(share > 0, value * share, 0)
    return torch.where(defined, total, 0).to(features.dtype)


def sample_depth(
    source_depth: Array,
    correspondence: Correspondence,
    *,
    interpolation: DepthInterpolation = "inverse",
    spread: float | None = TAP_SPREAD,
) -> Tensor:
    """The source's own depth at the positions of a correspondence.

    Args:
        source_depth: (h, w) depth along the source's optical axis, of any size.
        interpolation, spread: as in :func:`resize_depth`.

    Returns:
        (H, W) float64, NaN outside the source image and where the taps do not answer.
    """
    depth = valid_depth(source_depth, "source_depth")
    xy = positions_in(correspondence, depth.shape[1], depth.shape[0])
    inside = in_bounds(correspondence)
    sampled = blend_depth(depth, torch.where(inside[..., None], xy, 0.5), interpolation, spread)
    return torch.where(inside, sampled, torch.nan)
