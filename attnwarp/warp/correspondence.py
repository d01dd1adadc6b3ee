"""Position of each pixel of a target in the source image.

Coordinates are pixels with centres at +0.5, so an image spans [0, W] x [0, H], and a coordinate u
of an image becomes exactly u * s in the image resized by s. A correspondence is computed once per
pair of views, in float64; any number of feature maps, of any channel count, can then be sampled
along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.warp.depth import TAP_SPREAD, Array, resize_depth, valid_depth
from attnwarp.warp.settings import DepthInterpolation, PixelCenters


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Position of each pixel of a target grid in the source image.

    Built by :func:`correspond`. Every tensor is float64.

    Args:
        source, target: cameras whose sizes are the sizes of the two grids.
        xy: (H, W, 2) source pixels (centres at +0.5 for any ``pixel_centers``); NaN where
            undefined.
        points: (H, W, 3) surface points in the source camera's axes; NaN where the target's depth
            is undefined.
        target_depth: (H, W) depth along the target's optical axis; NaN where undefined.
        pixel_centers: convention of the computation, see :func:`correspond`.
        in_front: True leaves points at and behind the source camera without ``xy``.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond
        >>> _, camera, seen = wall()
        >>> depth = np.full((8, 8), 2.0)
        >>> depth[0, 0] = np.nan  # no surface
        >>> c = correspond(camera, camera, depth)
        >>> c.defined.sum().item(), c.xy[1, 2].tolist(), c.z[1, 2].item()
        (63, [2.5, 1.5], 2.0)
    """

    source: Camera
    target: Camera
    xy: Tensor
    points: Tensor
    target_depth: Tensor
    pixel_centers: PixelCenters = "half"
    in_front: bool = True

    def __post_init__(self) -> None:
        check.one_of(self.pixel_centers, get_args(PixelCenters), "pixel_centers")
        h, w = self.target.height, self.target.width
        check.shape(self.xy, (h, w, 2), "xy")
        check.shape(self.points, (h, w, 3), "points")
        check.shape(self.target_depth, (h, w), "target_depth")
        for name in ("xy", "points", "target_depth"):
            if getattr(self, name).dtype != torch.float64:
                raise ValueError(f"{name}: got {getattr(self, name).dtype}, expected float64")

    def __repr__(self) -> str:
        return f"Correspondence({self.sizes}, {share_of(self.defined)} defined)"

    @property
    def sizes(self) -> str:
        """Describe (H, W) of target and source, such as "(48, 64) <- (48, 64)"."""
        target, source = ((c.height, c.width) for c in (self.target, self.source))
        return f"{target} <- {source}"

    @property
    def z(self) -> Tensor:
        """Depth of the points in the source camera, (H, W), of either sign; NaN without a target
        depth.
        """
        return self.points[..., 2]

    @property
    def defined(self) -> Tensor:
        """Mask of the pixels with a source position, (H, W) bool."""
        return torch.isfinite(self.xy).all(dim=-1)

    @property
    def target_points(self) -> Tensor:
        """Surface points in the target camera's axes, (H, W, 3)."""
        return _directions(self.target, self.pixel_centers) * self.target_depth[..., None]


def share_of(mask: Tensor) -> str:
    """Format the True share of a mask, such as "48 %"."""
    return f"{100 * float(mask.double().mean()):.0f} %"


def correspond(
    source: Camera,
    target: Camera,
    target_depth: Array,
    *,
    pixel_centers: PixelCenters = "half",
    in_front: bool = True,
) -> Correspondence:
    """Locate each target pixel's surface point in the source image.

    The pixel is unprojected with its depth, moved by the relative pose of the cameras, and
    projected. The pose uses the difference of the cameras' centres, so far-away worlds and tiny
    baselines keep their digits.

    Args:
        source, target: cameras in one world.
        target_depth: (H, W) depth along the target's optical axis, of the target's size. Zero,
            negative, infinite and NaN depths are undefined: they are masked, never filled.
        pixel_centers: "half" puts the centre of pixel j at j + 0.5. "integer" reproduces an error
            of the published code: pixel j, whose depth was sampled at j + 0.5, is unprojected at j,
            and the projection u is read as the index u, which is the position u + 0.5. The error is
            a fraction of a pixel of the cameras' grid.
        in_front: True leaves points at and behind the source camera without a position. False
            reproduces warps that lack the test: such points project upside down through the centre.

    Raises:
        ValueError: the depth's size differs from ``target``, or its type is not floating.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> c.xy[0, 0].tolist()
        [2.5, 0.5]
    """
    check.one_of(pixel_centers, get_args(PixelCenters), "pixel_centers")
    depth = valid_depth(target_depth, "target_depth")
    if tuple(depth.shape) != (target.height, target.width):
        raise ValueError(
            f"target_depth: got shape {tuple(depth.shape)}, expected ({target.height},"
            f" {target.width}), the target camera's size; resize the camera, or use correspond_at"
            " for a feature grid"
        )
    pose = torch.from_numpy(source.relative_to(target))
    camera_points = _directions(target, pixel_centers) * depth[..., None]
    points = camera_points @ pose[:3, :3].T + pose[:3, 3]
    z = points[..., 2]
    usable = (z > 0) if in_front else (z != 0) & torch.isfinite(z)
    # Masked before the division: a point in the camera centre's plane has no position.
    normalised = points / torch.where(usable, z, torch.nan)[..., None]
    xy = (normalised @ torch.from_numpy(source.K.copy()).T)[..., :2]
    if pixel_centers == "integer":
        xy = xy + 0.5
    xy = torch.where(torch.isfinite(xy).all(dim=-1, keepdim=True), xy, torch.nan)
    return Correspondence(source, target, xy, points, depth, pixel_centers, in_front)


def correspond_at(
    source: Camera,
    target: Camera,
    target_depth: Array,
    size: tuple[int, int],
    *,
    source_size: tuple[int, int] | None = None,
    pixel_centers: PixelCenters = "half",
    in_front: bool = True,
    interpolation: DepthInterpolation = "inverse",
    spread: float | None = TAP_SPREAD,
) -> Correspondence:
    """Compute the correspondence of a feature grid: resize the cameras and interpolate depth at the
    centres of the grid's pixels.

    Args:
        source, target, target_depth, pixel_centers, in_front: as in :func:`correspond`, at image
            size.
        size: (h, w) of the target's feature grid.
        source_size: (h, w) of the source's grid; by default scaled like the target's.
        interpolation, spread: as in :func:`resize_depth`.

    Raises:
        ValueError: as :func:`correspond` and :func:`layer_size`, or the size is not a pair of
            positive integers.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond_at
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond_at(source, target, seen.depth, (4, 4))
        >>> c.xy[0, 0].tolist()  # half as many pixels
        [1.5, 0.5]
    """
    size = check.size(size, "size")
    if source_size is None:
        source_size = layer_size(source, target, size)
    else:
        source_size = check.size(source_size, "source_size")
    depth = resize_depth(target_depth, size, interpolation=interpolation, spread=spread)
    return correspond(
        source.resize(source_size[1], source_size[0]),
        target.resize(size[1], size[0]),
        depth,
        pixel_centers=pixel_centers,
        in_front=in_front,
    )


def layer_size(source: Camera, target: Camera, size: tuple[int, int]) -> tuple[int, int]:
    """Compute (h, w) of the source's feature grid for a target grid of ``size``, at the same
    fraction of the image.

    Raises:
        ValueError: the size is not a pair of positive integers, or the source's size would not be
            integers.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import layer_size
        >>> wide, square = (Camera(np.eye(3), np.eye(4), width, 64) for width in (128, 64))
        >>> layer_size(wide, square, (8, 8))
        (8, 16)
    """
    size = check.size(size, "size")
    h, w = size[0] * source.height / target.height, size[1] * source.width / target.width
    if h != round(h) or w != round(w):
        raise ValueError(
            f"size: {size} of a {target.height} x {target.width} target makes the source's feature"
            f" grid {h:g} x {w:g}; give source_size"
        )
    return round(h), round(w)


def in_bounds(correspondence: Correspondence, size: tuple[int, int] | None = None) -> Tensor:
    """Mask positions inside an image of ``size`` (h, w), by default the source's, (H, W) bool.

    With half centres the test is 0 <= x <= W. With integer centres the method confuses index and
    position, so the test is 0 <= u < W on the index.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, in_bounds
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> in_bounds(c)[0].tolist()
        [True, True, True, True, True, True, False, False]
    """
    h, w = size if size is not None else (correspondence.source.height, correspondence.source.width)
    x, y = correspondence.xy.unbind(-1)
    if correspondence.pixel_centers == "integer":
        x, y = x - 0.5, y - 0.5
        return (x >= 0) & (x < w) & (y >= 0) & (y < h)
    return (x >= 0) & (x <= w) & (y >= 0) & (y <= h)


def _directions(camera: Camera, pixel_centers: str) -> Tensor:
    xy: Any = camera.pixel_centers()
    if pixel_centers == "integer":
        xy = xy - 0.5
    return torch.from_numpy(camera.directions(xy))


def check_proportions(size: Sequence[int], camera: Camera, name: str) -> None:
    """Raise ValueError unless a map of ``size`` (h, w) has the camera's aspect ratio."""
    check.same_aspect(
        (size[0], size[1]),
        (camera.height, camera.width),
        name,
        "transpose a map of (w, h), and leave no part of the view out",
    )


def positions_in(correspondence: Correspondence, width: int, height: int) -> Tensor:
    """Convert positions to a source image of another size, (H, W, 2)."""
    source = correspondence.source
    if correspondence.pixel_centers == "integer":
        scale = torch.tensor(
            [(width - 1) / max(source.width - 1, 1), (height - 1) / max(source.height - 1, 1)],
            dtype=torch.float64,
        )
        return (correspondence.xy - 0.5) * scale + 0.5
    return correspondence.xy * torch.tensor(
        [width / source.width, height / source.height], dtype=torch.float64
    )
