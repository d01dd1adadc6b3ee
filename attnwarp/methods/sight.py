"""Visibility of a target from its sources: the source of each target pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.warp import FeatureWarp, WarpedView
from attnwarp.warp.depth import as_float64
from attnwarp.warp.masks import axis_weights
from attnwarp.warp.surface import needed

Size = tuple[int, int]


def pixel_ratio(view: WarpedView) -> Tensor:
    """Count source pixels on the surface of one target pixel, (H, W); 0 where undefined.

    A camera has fx fy abs(n . X) / z^3 pixels on a unit of surface at the point X of its axes with
    the unit normal n; the ratio of two cameras is the determinant of the Jacobian of the plane's
    homography. Below 1 the source is foreshortened against the target, or farther away.

    Raises:
        ValueError: the target has no normals.
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


@dataclass(frozen=True, eq=False)
class Sight:
    """Visibility of a target from its sources: the source of each pixel.

    Args:
        views: the warp from each source, in the order of the sources.
        scales: (edit's pixels per photograph's pixel) of each source over the same of the target.
            Features have the edits' resolution, which may differ between photographs of several
            sizes. None if all are 1.
        zeros: True pads features outside a source with zeros, False with the border's values.
    """

    views: Sequence[WarpedView]
    scales: Sequence[float] | None = None
    zeros: bool = False
    _choices: dict[Size, Tensor] = field(default_factory=dict, init=False, repr=False)

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

    @property
    def mask(self) -> Tensor:
        """Mask of the pixels seen by some source, (H, W) bool."""
        return torch.stack([view.mask for view in self.views]).any(dim=0)

    def mask_at(self, number: int, size: Size) -> Tensor:
        """Resize a source's mask, (h, w) bool."""
        # The mask does not depend on the size of the source's grid.
        return self.views[number].at(size, source_size=size).mask

    def choice(self, size: Size) -> Tensor:
        """Choose each pixel's source at a grid's size, (h, w) int64: the best quality among sources
        whose mask passes, the first of equals, -1 without a source.
        """
        if size not in self._choices:
            masks = [self.mask_at(k, size) for k in range(len(self.views))]
            if len(self.views) == 1:
                self._choices[size] = torch.where(masks[0], 0, -1)
            else:
                qualities = torch.stack([averaged(quality, size) for quality in self.quality])
                qualities = torch.where(torch.stack(masks), qualities, -1.0)
                best, number = qualities.max(dim=0)
                # Rounding of the means must not decide between equal qualities.
                number = (qualities >= best - 1e-9).long().argmax(dim=0)
                self._choices[size] = torch.where(best >= 0, number, -1)
        return self._choices[size]

    def warp(self, number: int, *, picture: bool = False) -> SourceWarp:
        """Build the warp of a source's features, or of its picture, to its part of the target."""
        return SourceWarp(self, number, picture)


@dataclass(frozen=True, eq=False)
class SourceWarp:
    """Warp from one source to the target pixels that use this source; a
    :class:`attnwarp.editing.injection.LayerWarp`.

    Args:
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
            mask = layer.mask & (self.sight.choice(size) == self.number)
            warp = FeatureWarp(layer.correspondence, mask, layer.backend)
            self._at[key] = LayerOfSource(warp, self.sight.zeros and not self.picture)
        return self._at[key]


@dataclass(frozen=True, eq=False)
class LayerOfSource:
    """Warp of a layer from one source.

    Args:
        zeros: True surrounds the source's features with zeros, as zero padding does: a tap beyond
            the border counts 0, so the border's value returned by the warp is multiplied by the
            weight of the taps inside.
    """

    warp: FeatureWarp
    zeros: bool = False

    @property
    def weight(self) -> Tensor:
        """Weight (h w, 1) float32: 1 inside the mask, 0 elsewhere."""
        return self.warp.weight

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
