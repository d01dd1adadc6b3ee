"""Sampling of features and depth at the positions of a correspondence, in torch on any device.

This is the definition. :mod:`attnwarp.warp.cpu` has kernels that give the same bits for feature
maps and tokens in the host's memory.
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
    """A source feature map, warped to the target's grid.

    Args:
        features: (C, h, w) or (B, C, h, w) on the source's image, of any size of its aspect ratio:
            a position u becomes u * w / W (for integer centres u * (w - 1) / (W - 1) on indices,
            which is what align_corners=True does). Its gradient flows back through the result.
        correspondence: H x W positions, float64; moved to the features' device.
        mode: "bilinear" for floating types: weights and sums in float32 for half precision, in the
            features' own type otherwise. "nearest" for any type, labels included.

    Returns:
        warped: (C, H, W) or (B, C, H, W) in the features' type. A position outside the image takes
            the border's value; a pixel without a position is 0, so that it cannot spread NaN into a
            network. Use the mask.
        mask: (H, W) bool, the position lies inside the source image (:func:`in_bounds`).

    Raises:
        ValueError: another number of axes or aspect ratio, a type that cannot be blended, an
            unknown mode.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, sample
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> import torch
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
    """The type of weights and sums: float32 for half precision, else the features' own."""
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def taps_at(
    correspondence: Correspondence, size: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> Taps:
    """The taps of a correspondence in the source's image at another size.

    Args:
        size: (h, w) of that image.
        dtype: dtype of the weights, which are worked out in float64.
        device: where the taps shall lie.
    """
    h, w = size
    taps = taps_of(positions_in(correspondence, w, h), h, w)
    return Taps(taps.index.to(device), taps.weight.to(dtype).to(device))


def sample_maps(maps: Tensor, taps: Taps) -> Tensor:
    """(..., N) weighted sums of the pixels of maps, in the maps' type.

    Args:
        maps: (..., h*w) floating.
        taps: taps of N positions, with weights of :func:`work_type`, on the maps' device.
    """
    total = torch.zeros((), dtype=taps.weight.dtype, device=maps.device)
    # Converted before it is read: the gradient sums what reads a pixel in this type too, and is
    # rounded once.
    values = maps.to(total.dtype)
    for index, share in zip(taps.index, taps.weight, strict=True):
        # A tap of weight 0 may hold anything, an infinity included.
        total = total + torch.where(share > 0, values[..., index] * share, 0)
    return total.to(maps.dtype)


def sample_tokens(tokens: Tensor, taps: Taps) -> Tensor:
    """(B, N, C) weighted sums of tokens, in the weights' type.

    Args:
        tokens: (B, h*w, C) floating, row by row of the picture.
        taps: as in :func:`sample_maps`.
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
    """The source's own depth at the positions of a correspondence, bilinear in 1 / z.

    Args:
        source_depth: (h, w) depth along the source's optical axis, of any size of the source's
            aspect ratio.
        spread: as in :func:`resize_depth`.

    Returns:
        (H, W) float64, NaN outside the source image and where the taps do not answer.

    Raises:
        ValueError: a depth of another shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, sample_depth
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> sample_depth(np.full((8, 8), 2.0), c)[0, 4:].tolist()
        [2.0, 2.0, nan, nan]
    """
    depth = valid_depth(source_depth, "source_depth")
    check_proportions(depth.shape, correspondence.source, "source_depth")
    xy = positions_in(correspondence, depth.shape[1], depth.shape[0])
    inside = in_bounds(correspondence)
    sampled = blend_depth(depth, torch.where(inside[..., None], xy, 0.5), "inverse", spread)
    return torch.where(inside, sampled, torch.nan)
