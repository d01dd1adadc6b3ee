"""Sampling of features and depth at the positions of a correspondence, in torch on any device.

This is the definition. :mod:`attnwarp.warp.cpu` has kernels that give the same bits for feature
maps and tokens on the CPU.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.warp.correspondence import (
    Correspondence,
    check_proportions,
    in_bounds,
    positions_in,
)
from attnwarp.warp.depth import TAP_SPREAD, Array, blend_depth, valid_depth
from attnwarp.warp.taps import Taps, clamp_index, taps_of


def sample(
    features: check.Array,
    correspondence: Correspondence,
    *,
    mode: Literal["bilinear", "nearest"] = "bilinear",
) -> tuple[Tensor, Tensor]:
    """Warp a source feature map to the target's grid.

    Args:
        features: (C, h, w) or (B, C, h, w) map of the source's image, of any size of its aspect
            ratio: a position u becomes u * w / W (for integer centres u * (w - 1) / (W - 1) on
            indices, as with align_corners=True). The gradient flows back through the result.
        correspondence: H x W positions, float64; moved to the features' device.
        mode: "bilinear" for floating types: weights and sums in float32 for half precision, in the
            features' dtype otherwise. "nearest" for any type, labels included.

    Returns:
        warped: (C, H, W) or (B, C, H, W) in the features' dtype. A position outside the image takes
            the border's value; a pixel without a position is 0, so that it cannot spread NaN into a
            network. Apply the mask.
        mask: (H, W) bool, True if the position lies inside the source image (:func:`in_bounds`).

    Raises:
        ValueError: a wrong number of axes or aspect ratio, a dtype that cannot be blended, or an
            unknown mode.

    Example:
        >>> import torch
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, sample
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> warped, mask = sample(torch.arange(8.0).expand(1, 8, 8), c)
        >>> warped[0, 0].tolist()  # beyond the border its value is taken
        [2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 7.0, 7.0]
    """
    features = check.tensor(features, "features")
    if features.ndim not in (3, 4):
        raise ValueError(
            f"features: got shape {tuple(features.shape)}, expected (C, h, w) or (B, C, h, w)"
        )
    check_proportions(features.shape[-2:], correspondence.source, "features")
    xy = positions_in(correspondence, features.shape[-1], features.shape[-2])
    return sample_at(features, xy, mode=mode), in_bounds(correspondence).to(features.device)


def sample_at(
    features: check.Array, xy: check.Array, *, mode: Literal["bilinear", "nearest"] = "bilinear"
) -> Tensor:
    """Sample features at positions in the features' grid.

    Args:
        features: (..., h, w) maps.
        xy: (H, W, 2) positions in pixels of the feature map (centres at +0.5), float32 or float64.
            NaN gives 0.
        mode: as in :func:`sample`.

    Returns:
        (..., H, W) in the features' dtype.

    Raises:
        ValueError: a half-precision or integer ``xy``: bfloat16 rounds 256.5 to 256.

    Example:
        >>> import torch
        >>> from attnwarp.warp import sample_at
        >>> sample_at(torch.tensor([[[1.0, 3.0]]]), torch.tensor([[[1.0, 0.5]]])).tolist()
        [[[2.0]]]
    """
    check.one_of(mode, ("bilinear", "nearest"), "mode")
    features, xy = check.tensor(features, "features"), check.tensor(xy, "xy")
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
    size = xy.shape[:2]
    flat = features.flatten(-2)
    if mode == "nearest":
        # NaN is masked before it reaches an index.
        defined = torch.isfinite(xy).all(dim=-1)
        xy = torch.where(defined[..., None], xy, 0.5)
        j = clamp_index(torch.floor(xy[..., 0]), w)
        i = clamp_index(torch.floor(xy[..., 1]), h)
        warped = flat[..., (i * w + j).reshape(-1)].unflatten(-1, size)
        return torch.where(
            defined, warped, torch.zeros((), dtype=features.dtype, device=features.device)
        )
    taps = taps_of(xy, h, w)
    taps = Taps(taps.index, taps.weight.to(work_type(features.dtype)))
    return sample_maps(flat, taps).unflatten(-1, size)


def work_type(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype of weights and sums: float32 for half precision, else the features'."""
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def taps_at(
    correspondence: Correspondence, size: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> Taps:
    """Compute the taps of a correspondence in the source's image at another size."""
    h, w = size
    taps = taps_of(positions_in(correspondence, w, h), h, w)
    return Taps(taps.index.to(device), taps.weight.to(dtype).to(device))


def sample_maps(maps: Tensor, taps: Taps) -> Tensor:
    """Sum weighted pixels of maps, (..., N), in the maps' dtype."""
    total = torch.zeros((), dtype=taps.weight.dtype, device=maps.device)
    # Converted before reading: the gradient then sums the reads of a pixel in this dtype too, and
    # is rounded once.
    values = maps.to(total.dtype)
    for index, share in zip(taps.index, taps.weight, strict=True):
        # A tap of weight 0 may have any value, even infinity.
        total = total + torch.where(share > 0, values[..., index] * share, 0)
    return total.to(maps.dtype)


def sample_tokens(tokens: Tensor, taps: Taps) -> Tensor:
    """Sum weighted tokens, (B, N, C), in the weights' dtype.

    Args:
        tokens: (B, h*w, C) floating tokens, row by row of the picture.
    """
    total = torch.zeros((), dtype=taps.weight.dtype, device=tokens.device)
    values = tokens.to(total.dtype)  # as in sample_maps
    for index, share in zip(taps.index, taps.weight[..., None], strict=True):
        total = total + torch.where(share > 0, values[:, index] * share, 0)
    return total


def sample_depth(
    source_depth: Array,
    correspondence: Correspondence,
    *,
    spread: float | None = TAP_SPREAD,
) -> Tensor:
    """Sample the source's depth map at a correspondence's positions, bilinear in 1 / z.

    Args:
        source_depth: (h, w) depth along the source's optical axis, of any size of the source's
            aspect ratio.
        spread: as in :func:`resize_depth`.

    Returns:
        (H, W) float64, NaN outside the source image and for rejected taps.

    Raises:
        ValueError: the depth has a wrong shape, aspect ratio or type.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, sample_depth
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> sample_depth(seen.depth, c)[0, 4:].tolist()
        [2.0, 2.0, nan, nan]
    """
    depth = valid_depth(source_depth, "source_depth")
    check_proportions(depth.shape, correspondence.source, "source_depth")
    xy = positions_in(correspondence, depth.shape[1], depth.shape[0])
    inside = in_bounds(correspondence)
    sampled = blend_depth(depth, torch.where(inside[..., None], xy, 0.5), "inverse", spread)
    return torch.where(inside, sampled, torch.nan)
