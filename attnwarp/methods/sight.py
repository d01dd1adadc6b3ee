"""Visibility of a target from its sources: the source and the weight of each target pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.warp import FeatureWarp, WarpedView, depth_tolerance, sample, sample_depth
from attnwarp.warp.depth import Array, as_float64, valid_depth
from attnwarp.warp.masks import axis_weights
from attnwarp.warp.surface import needed

Size = tuple[int, int]


def pixel_ratio(view: WarpedView) -> Tensor:
    """Count source pixels on the surface of one target pixel, (H, W); 0 where undefined.

    A camera has fx fy abs(n . X) / z^3 pixels on a unit of surface at the point X of its axes with
    the unit normal n; the ratio of two cameras is the determinant of the Jacobian of the plane's
    homography. Below 1 the source is foreshortened against the target, or farther away.

    Args:
        view: warp with the target's normals.

    Raises:
        ValueError: the target has no normals.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import Surface, warp_surfaces
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> far = np.eye(4)
        >>> far[2, 3] = 2.0  # twice as far from the wall
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, far, 8, 8)
        >>> wall = Surface(np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
        >>> back = Surface(np.full((8, 8), 4.0), wall.normal)
        >>> pixel_ratio(warp_surfaces(source, target, wall, back))[4, 4].item()
        0.25
    """
    normal = as_float64(needed(view.target.normal, "target.normal", "pixel_ratio"), "normal")
    both = view.correspondence
    ratio = _density(both.source, normal, both.points) / _density(
        both.target, normal, both.target_points
    )
    return torch.where(torch.isfinite(ratio), ratio, 0.0)


def _density(camera: Camera, normal: Tensor, points: Tensor) -> Tensor:
    """Pixels per unit of surface, (H, W), up to the normal's length."""
    turned = normal @ torch.from_numpy(camera.rotation.T.copy())
    pixels = float(camera.K[0, 0] * camera.K[1, 1])
    return pixels * (turned * points).sum(dim=-1).abs() / points[..., 2].abs() ** 3


def depth_margin(view: WarpedView) -> Tensor:
    """Margin of depth agreement, (H, W) in [0, 1]: 1 - (abs(z - d) / tolerance)^2; 1 if the rule of
    depth agreement is off.
    """
    s, both = view.settings, view.correspondence
    if not s.depth_agreement or view.source is None:
        return torch.ones(both.z.shape, dtype=torch.float64)
    depth = as_float64(view.source.depth, "source_depth")
    seen = sample_depth(depth, both, spread=s.depth_spread)
    tolerance = depth_tolerance(both, depth, relative=s.depth_relative, slope=s.depth_slope)
    share = (both.z - seen).abs() / tolerance
    return torch.nan_to_num(1 - share**2, nan=0.0).clamp(0, 1)


EDGE = 0.05
"""Relative depth step that counts as an edge; equals the step at which taps are not blended
(:attr:`attnwarp.warp.WarpSettings.depth_spread`)."""


def near_edges(depth: Array, margin: int) -> Tensor:
    """Mark the pixels within ``margin`` on either side of a depth edge, (H, W) bool.

    A picture's pixels at an edge mix near and far. Inverse depth is affine in the pixel on a plane,
    so an inverse-depth step larger than its neighbours' is an edge, and a plane at a grazing angle
    has none. Undefined depth counts as infinite. Pixels of the outermost rows and columns have one
    neighbour and get the margin from that side alone.

    Args:
        depth: (H, W), undefined where it is NaN, zero, negative or infinite.
        margin: in px; 0 gives none.

    Example:
        >>> import torch
        >>> near_edges(torch.tensor([[2.0, 2.0, 2.0, 3.0, 3.0, 3.0]]), 1)[0].int().tolist()
        [0, 0, 1, 1, 0, 0]
    """
    z = valid_depth(depth, "depth")
    inverse = torch.nan_to_num(1 / z, nan=0.0)
    edge = torch.zeros(z.shape, dtype=torch.bool)
    if margin == 0:
        return edge
    for axis in (0, 1):
        if z.shape[axis] < 3:
            continue
        left, middle, right = (inverse.narrow(axis, k, z.shape[axis] - 2) for k in range(3))
        bend = (left - 2 * middle + right).abs()
        nearest = torch.maximum(torch.maximum(left, middle), right)
        edge.narrow(axis, 1, z.shape[axis] - 2).logical_or_(bend > EDGE * nearest)
    window = 2 * margin - 1
    grown = torch.nn.functional.max_pool2d(edge[None].float(), window, 1, margin - 1)
    return grown[0] > 0


@dataclass(frozen=True, eq=False)
class Sight:
    """Visibility of a target from its sources: the source of each pixel, and its weight.

    Args:
        views: the warp from each source, in the order of the sources.
        soft: True weighs features by confidence, False by the mask alone.
        scales: (edit's pixels per photograph's pixel) of each source over the same of the target.
            Features have the edits' resolution, which may differ between photographs of several
            sizes. None if all are 1.
        margins: margin of each source: px on either side of a depth edge whose picture is not
            warped. None if all are 0.
        zeros: True pads features outside a source with zeros, False with the border's values.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import Surface, warp_surfaces
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> far, near = (np.eye(4) for _ in range(2))
        >>> far[2, 3], near[0, 3] = 2.0, 1.0
        >>> target, *sources = (Camera(K, pose, 8, 8) for pose in (np.eye(4), far, near))
        >>> normal = np.broadcast_to([0.0, 0, -1], (8, 8, 3))
        >>> wall, back = (Surface(np.full((8, 8), z), normal) for z in (2.0, 4.0))
        >>> views = [warp_surfaces(s, target, wall, w) for s, w in zip(sources, (back, wall))]
        >>> Sight(views).choice((8, 8))[0].tolist()  # the near source, where it sees the wall
        [1, 1, 1, 1, 0, 0, 0, 0]
    """

    views: Sequence[WarpedView]
    soft: bool = False
    scales: Sequence[float] | None = None
    margins: Sequence[int] | None = None
    zeros: bool = False
    _choices: dict[tuple[Size, bool], Tensor] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def quality(self) -> list[Tensor]:
        """Quality of each source, (H, W) float64: :func:`pixel_ratio` of edits in the mask, at most
        1, since pixels beyond the target's resolution show nothing more.
        """
        scales = [1.0] * len(self.views) if self.scales is None else self.scales
        return [
            view.mask * (scale * pixel_ratio(view)).clamp_max(1.0)
            for view, scale in zip(self.views, scales, strict=True)
        ]

    @cached_property
    def confidence(self) -> list[Tensor]:
        """Confidence of each source, (H, W) float64 in [0, 1]: quality by :func:`depth_margin`."""
        pairs = zip(self.quality, self.views, strict=True)
        return [quality * depth_margin(view) for quality, view in pairs]

    @property
    def mask(self) -> Tensor:
        """Mask of the pixels seen by some source, (H, W) bool."""
        return torch.stack([view.mask for view in self.views]).any(dim=0)

    @property
    def weight(self) -> Tensor:
        """Weight of each pixel's source, (H, W): the source's confidence, or 1 in its mask."""
        if not self.soft:
            return self.mask.float()
        choice = self.choice((self.mask.shape[0], self.mask.shape[1]))
        weights = [weight * (choice == k) for k, weight in enumerate(self.confidence)]
        return torch.stack(weights).sum(dim=0)

    @cached_property
    def clear(self) -> list[Tensor]:
        """Mask of each source, (H, W) bool: True if the source pixel lies farther from depth edges
        than the margin.
        """
        margins = [0] * len(self.views) if self.margins is None else self.margins
        result = []
        for view, margin in zip(self.views, margins, strict=True):
            if margin == 0 or view.source is None:
                result.append(torch.ones(view.mask.shape, dtype=torch.bool))
                continue
            near = near_edges(view.source.depth, margin).double()[None]
            mixed, _ = sample(near, view.correspondence, mode="nearest")
            result.append(torch.nan_to_num(mixed[0], nan=1.0) < 0.5)
        return result

    def mask_at(self, number: int, size: Size, *, picture: bool = False) -> Tensor:
        """Resize a source's mask, (h, w) bool; for its picture, intersect with :attr:`clear`."""
        # The mask does not depend on the size of the source's grid.
        mask = self.views[number].at(size, source_size=size).mask
        if not picture or self.margins is None:
            return mask
        return mask & (averaged(self.clear[number], size) >= 0.5)

    def choice(self, size: Size, *, picture: bool = False) -> Tensor:
        """Choose each pixel's source at a grid's size, (h, w) int64: the best quality among sources
        whose mask passes, the first of equals, -1 without a source.

        Args:
            size: size of the grid.
            picture: True chooses for the sources' pictures, which :attr:`margins` keep away from
                depth edges.
        """
        key = size, picture and self.margins is not None
        if key not in self._choices:
            masks = [self.mask_at(k, size, picture=picture) for k in range(len(self.views))]
            if len(self.views) == 1:
                self._choices[key] = torch.where(masks[0], 0, -1)
            else:
                qualities = torch.stack([averaged(quality, size) for quality in self.quality])
                qualities = torch.where(torch.stack(masks), qualities, -1.0)
                best, number = qualities.max(dim=0)
                # Rounding of the means must not decide between equal qualities.
                number = (qualities >= best - 1e-9).long().argmax(dim=0)
                self._choices[key] = torch.where(best >= 0, number, -1)
        return self._choices[key]

    def warp(self, number: int, *, picture: bool = False) -> SourceWarp:
        """Build the warp of a source's features, or of its picture, to its part of the target."""
        return SourceWarp(self, number, picture)


@dataclass(frozen=True, eq=False)
class SourceWarp:
    """Warp from one source to the target pixels that use this source; a
    :class:`attnwarp.editing.injection.LayerWarp`.

    Args:
        sight: visibility: which source each target pixel uses.
        number: number of the source.
        picture: True warps the source's picture, False its features.
    """

    sight: Sight
    number: int
    picture: bool = False
    _at: dict[tuple[int, ...], LayerOfSource] = field(default_factory=dict, init=False, repr=False)

    def at(self, size: Size, *, source_size: Size | None = None) -> LayerOfSource:
        """Build the warp from a grid of the source to an (h, w) grid of the target."""
        key = (*size, *(source_size or ()))
        if key not in self._at:
            layer = self.sight.views[self.number].at(size, source_size=source_size)
            choice = self.sight.choice(size, picture=self.picture)
            mask = layer.mask & (choice == self.number)
            warp = FeatureWarp(layer.correspondence, mask, layer.backend)
            weight = warp.weight
            if self.sight.soft:
                share = averaged(self.sight.confidence[self.number], size) * mask
                weight = share.reshape(-1, 1).float()
            zeros = self.sight.zeros and not self.picture
            self._at[key] = LayerOfSource(warp, weight, zeros)
        return self._at[key]


@dataclass(frozen=True, eq=False)
class LayerOfSource:
    """Warp of a layer from one source.

    Args:
        warp: warp of the layer, with the mask.
        weight: (h w, 1) float32 in [0, 1], 0 outside the mask.
        zeros: True surrounds the source's features with zeros, as zero padding does: a tap beyond
            the border counts 0, so the border's value returned by the warp is multiplied by the
            weight of the taps inside.
    """

    warp: FeatureWarp
    weight: Tensor
    zeros: bool = False

    @property
    def mask(self) -> Tensor:
        """Mask of the warped features, (h, w) bool."""
        return self.warp.mask

    @cached_property
    def inside(self) -> Tensor:
        """Weight of the taps within the source's grid, (h w, 1) float64; 0 without a position."""
        both = self.warp.correspondence
        size = both.xy.new_tensor([both.source.width, both.source.height])
        place = both.xy - 0.5
        share = torch.minimum(place + 1, size - place).clamp(0, 1).prod(dim=-1)
        return torch.nan_to_num(share, nan=0.0).reshape(-1, 1)

    def warp_tokens(self, source: Tensor) -> Tensor:
        """Warp tokens like :meth:`attnwarp.warp.FeatureWarp.warp_tokens`."""
        warped = self.warp.warp_tokens(source)
        return warped * self.inside.to(warped) if self.zeros else warped


def averaged(values: Tensor, size: Size) -> Tensor:
    """Average (H, W) values over the pixels of an (h, w) grid, float64."""
    rows = axis_weights(size[0], values.shape[0], "area")
    columns = axis_weights(size[1], values.shape[1], "area")
    return rows @ values.double() @ columns.T
