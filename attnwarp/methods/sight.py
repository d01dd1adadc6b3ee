"""Visibility of each pixel of a target from each source: the source it takes, and its weight."""

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
    """(H, W) source pixels on the piece of surface that one target pixel covers; 0 where undefined.

    A camera has fx fy abs(n . X) / z^3 pixels on a unit of surface at the point X of its axes with
    the unit normal n; the ratio of two cameras is the determinant of the Jacobian of the plane's
    homography. Below 1 the source is foreshortened against the target, or farther away.

    Args:
        view: with the target's normals.

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
    """(H, W) pixels on a unit of surface, but for the normal's length."""
    turned = normal @ torch.from_numpy(camera.rotation.T.copy())
    pixels = float(camera.K[0, 0] * camera.K[1, 1])
    return pixels * (turned * points).sum(dim=-1).abs() / points[..., 2].abs() ** 3


def depth_margin(view: WarpedView) -> Tensor:
    """(H, W) in [0, 1]: 1 - (abs(z - d) / tolerance)^2 of the rule of depth agreement; 1 without
    that rule.
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
"""Relative step of the depth that is an edge, as two taps that are not blended
(:attr:`attnwarp.warp.WarpSettings.depth_spread`)."""


def near_edges(depth: Array, margin: int) -> Tensor:
    """(H, W) bool: pixels among the first ``margin`` on either side of a depth edge.

    A picture's pixels there mix near and far. Inverse depth is affine in the pixel on a plane, so a
    step of it beyond its neighbours' is an edge: a plane at a grazing angle has none. Undefined
    depth counts as infinite. Pixels of the outermost rows and columns have one neighbour, so the
    margin reaches them from their neighbour alone.

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
    """A target seen by its sources.

    Args:
        views: the warp from each source, in the order of the sources.
        soft: weigh features by confidence instead of the mask alone.
        scales: scales of each source: its edit's pixels per pixel of its photograph, over the same
            of the target. Features have the edits' resolution, which photographs of several sizes
            need not differ in. None where all are 1.
        margins: margins of each source: px of its depth map on either side of a depth edge whose
            picture is not taken. None where all are 0.
        zeros: features of what projects outside a source are zeros, not its border's.

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
        """(H, W) float64 of each source: its :func:`pixel_ratio` of edits, at most 1, where its
        mask passes; more pixels than the target has show nothing more.
        """
        scales = [1.0] * len(self.views) if self.scales is None else self.scales
        return [
            view.mask * (scale * pixel_ratio(view)).clamp_max(1.0)
            for view, scale in zip(self.views, scales, strict=True)
        ]

    @cached_property
    def confidence(self) -> list[Tensor]:
        """(H, W) float64 in [0, 1] of each source: quality times :func:`depth_margin`."""
        pairs = zip(self.quality, self.views, strict=True)
        return [quality * depth_margin(view) for quality, view in pairs]

    @property
    def mask(self) -> Tensor:
        """(H, W) bool: some source sees the pixel."""
        return torch.stack([view.mask for view in self.views]).any(dim=0)

    @property
    def weight(self) -> Tensor:
        """(H, W) weight of the source that each pixel takes: its confidence, or 1 in its mask."""
        if not self.soft:
            return self.mask.float()
        choice = self.choice((self.mask.shape[0], self.mask.shape[1]))
        weights = [weight * (choice == k) for k, weight in enumerate(self.confidence)]
        return torch.stack(weights).sum(dim=0)

    @cached_property
    def clear(self) -> list[Tensor]:
        """(H, W) bool of each source: what it shows there is farther from its depth edges than the
        margin.
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
        """(h, w) bool: where a source's mask passes; of its picture, where it is clear as well."""
        # The mask does not depend on the size of the source's grid.
        mask = self.views[number].at(size, source_size=size).mask
        if not picture or self.margins is None:
            return mask
        return mask & (averaged(self.clear[number], size) >= 0.5)

    def choice(self, size: Size, *, picture: bool = False) -> Tensor:
        """(h, w) int64: number of the source of the best quality among those whose mask passes at
        that size, -1 where none does; of equals the first.

        Args:
            size: size of the grid.
            picture: whether it is of the sources' pictures, which :attr:`margins` keep away from
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
                # Rounding of the means must not decide between equals.
                number = (qualities >= best - 1e-9).long().argmax(dim=0)
                self._choices[key] = torch.where(best >= 0, number, -1)
        return self._choices[key]

    def warp(self, number: int, *, picture: bool = False) -> SourceWarp:
        """The part of the target that takes a source's features, or its picture."""
        return SourceWarp(self, number, picture)


@dataclass(frozen=True, eq=False)
class SourceWarp:
    """The warp from one source to the pixels of a target that take it; a
    :class:`attnwarp.editing.injection.LayerWarp`.

    Args:
        sight: sight of the target.
        number: number of the source.
        picture: whether the warp is that of its picture, not of its features.
    """

    sight: Sight
    number: int
    picture: bool = False
    _at: dict[tuple[int, ...], LayerOfSource] = field(default_factory=dict, init=False, repr=False)

    def at(self, size: Size, *, source_size: Size | None = None) -> LayerOfSource:
        """The warp of an (h, w) grid of the target from a grid of the source."""
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
    """The warp of a layer from one source.

    Args:
        warp: warp of the layer, with the mask.
        weight: (h w, 1) float32 in [0, 1], 0 outside the mask.
        zeros: zeros stand around the source's features, as zero padding has it: a tap beyond the
            border counts 0, so the border's value, which the warp gives there, is multiplied by the
            weight of the taps inside.
    """

    warp: FeatureWarp
    weight: Tensor
    zeros: bool = False

    @property
    def mask(self) -> Tensor:
        """(h, w) bool: where the warped features count."""
        return self.warp.mask

    @cached_property
    def inside(self) -> Tensor:
        """(h w, 1) float64 weight of the taps within the source's grid; 0 without a position."""
        both = self.warp.correspondence
        size = both.xy.new_tensor([both.source.width, both.source.height])
        place = both.xy - 0.5
        share = torch.minimum(place + 1, size - place).clamp(0, 1).prod(dim=-1)
        return torch.nan_to_num(share, nan=0.0).reshape(-1, 1)

    def warp_tokens(self, source: Tensor) -> Tensor:
        """Warp tokens as :meth:`attnwarp.warp.FeatureWarp.warp_tokens` tells."""
        warped = self.warp.warp_tokens(source)
        return warped * self.inside.to(warped) if self.zeros else warped


def averaged(values: Tensor, size: Size) -> Tensor:
    """(h, w) float64 means of (H, W) values over the pixels of another grid."""
    rows = axis_weights(size[0], values.shape[0], "area")
    columns = axis_weights(size[1], values.shape[1], "area")
    return rows @ values.double() @ columns.T
