"""The exact relation of two views as plain data, computed by truth and read by metrics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NONE, VISIBLE, HIDDEN, AMBIGUOUS = 0, 1, 2, 3
"""Labels of a target pixel; :class:`TwoView` defines them."""


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of the central rays of a camera's pixels.

    Attributes:
        depth: (H, W) float64 z along the optical axis; NaN where nothing is hit.
        point: (H, W, 3) world coordinates; NaN where nothing is hit.
        normal: (H, W, 3) unit geometric normal in world axes, facing the camera; NaN where nothing
            is hit.
        cosine: (H, W) of the angle between that normal and the ray, in (0, 1]; NaN where nothing is
            hit.
        object_id: (H, W) int32 index of the object in the scene, -1 where nothing is hit.
        primitive_id: (H, W) int64, -1 where nothing is hit.
        valid: (H, W) bool.
    """

    depth: Array
    point: Array
    normal: Array
    cosine: Array
    object_id: npt.NDArray[np.int32]
    primitive_id: npt.NDArray[np.int64]
    valid: Mask


@dataclass(frozen=True, eq=False)
class TwoView:
    """The exact relation of two views. H, W are the target's.

    Attributes:
        hits: hits of the target's pixels.
        xy: (H, W, 2) float64 source pixel coordinates of the same surface point; NaN where there is
            no surface or it is not in front of the source camera.
        z_source: (H, W) float64 depth of the point in the source camera, of either sign; NaN where
            no surface.
        in_source_image: (H, W) bool: in front of the source camera and inside its image.
        label: (H, W) uint8.
            0 NONE: no surface in the target pixel, or its point is outside the source image (or
            behind its camera); ``hits.valid`` tells the two apart.
            1 VISIBLE: inside the source image, on the side that faces it, and unoccluded.
            2 HIDDEN: inside the source image, but occluded or turned away.
            3 AMBIGUOUS: there is a surface, but the four corners of the pixel do not have the same
            class as its centre (no surface, outside, visible or hidden), or the surface is seen at
            a cosine of incidence under 1e-3 by either camera.
        edge: (H, W) bool: within 2 px of a depth or object edge of the target, or, where the point
            falls inside the source image, within 2 px of one there.
    """

    source: Camera
    target: Camera
    hits: Hits
    xy: Array
    z_source: Array
    in_source_image: Mask
    label: npt.NDArray[np.uint8]
    edge: Mask

    @property
    def visible(self) -> Mask:
        """(H, W) bool: the source certainly shows this pixel's surface."""
        return self.label == VISIBLE

    @property
    def outside(self) -> Mask:
        """(H, W) bool: a surface certainly out of the source's frame or behind its camera."""
        return self.hits.valid & (self.label == NONE)

    @property
    def unseen(self) -> Mask:
        """(H, W) bool: a surface that the source certainly does not show: hidden or outside."""
        return (self.label == HIDDEN) | self.outside

    @property
    def behind(self) -> Mask:
        """(H, W) bool: a surface point that is not in front of the source camera."""
        return self.hits.valid & ~(self.z_source > 0)
