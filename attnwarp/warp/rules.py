"""Rules of visibility: each is a mask of the target pixels that pass.

A rule is a pure function that returns an (H, W) bool tensor on the target's grid, True where the
pixel passes. A pixel whose answer is undefined does not pass.
"""

from __future__ import annotations

from typing import get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.warp.correspondence import Correspondence, check_proportions
from attnwarp.warp.depth import TAP_SPREAD, Array, as_float64, depth_slope
from attnwarp.warp.sampling import sample, sample_depth
from attnwarp.warp.settings import GaussianFilter

EXACT_DEPTH_TOLERANCE = 1e-4
"""Relative depth tolerance for depth that is exact (ray cast). With half a pixel's slope it missed
none of the hidden pixels of a card 5 mm above its ground, which every fixed threshold above 5 mm
misses whole."""


def in_front(correspondence: Correspondence) -> Tensor:
    """The point lies in front of the source camera (z > 0).

    Args:
        correspondence: of the target's pixels, by :func:`attnwarp.warp.correspond`.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, in_front
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> bool(in_front(c).all())
        True
    """
    return correspondence.z > 0


def opaque(
    correspondence: Correspondence,
    minimum: float,
    *,
    target_alpha: Array | None = None,
    source_alpha: Array | None = None,
) -> Tensor:
    """Both images show surface rather than background.

    Args:
        correspondence: of the target's pixels, by :func:`attnwarp.warp.correspond`.
        minimum: smallest alpha that counts.
        target_alpha: (H, W) in [0, 1]; left out, every pixel passes.
        source_alpha: (h, w) in [0, 1], read bilinearly at the source position; left out, every
            pixel passes.

    Raises:
        ValueError: an alpha of another shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, opaque
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> opaque(c, 0.5, target_alpha=np.eye(8))[0].tolist()
        [True, False, False, False, False, False, False, False]
    """
    mask = torch.ones(correspondence.z.shape, dtype=torch.bool)
    if target_alpha is not None:
        alpha = as_float64(target_alpha, "target_alpha")
        check.shape(alpha, tuple(mask.shape), "target_alpha")
        mask &= alpha >= minimum
    if source_alpha is not None:
        alpha = as_float64(source_alpha, "source_alpha")
        check.shape(alpha, ("H", "W"), "source_alpha")
        check_proportions(alpha.shape, correspondence.source, "source_alpha")
        sampled, inside = sample(alpha[None], correspondence)
        mask &= (sampled[0] >= minimum) & inside
    return mask


def depth_agrees(
    correspondence: Correspondence,
    source_depth: Array,
    *,
    relative: float = EXACT_DEPTH_TOLERANCE,
    slope: float = 0.5,
    spread: float | None = TAP_SPREAD,
) -> Tensor:
    """The point's depth in the source camera is the source's own depth at its position.

    ``|z - d| <= relative * z + slope * (depth_slope at the nearest source pixel)``, with d
    interpolated in 1 / z and taps that straddle an edge rejected.

    Args:
        correspondence: of the target's pixels, by :func:`attnwarp.warp.correspond`.
        source_depth: (h, w) depth along the source's optical axis, NaN where undefined.
        relative: tolerance as a fraction of z, :data:`EXACT_DEPTH_TOLERANCE` for exact depth.
        slope: pixels of the source's depth slope to allow.
        spread: as in :func:`attnwarp.warp.depth.resize_depth`.

    Raises:
        ValueError: a depth of another shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, depth_agrees
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> depth_agrees(c, np.full((8, 8), 1.5)).any().item()  # something stands before it
        False
    """
    depth = as_float64(source_depth, "source_depth")
    seen = sample_depth(depth, correspondence, spread=spread)
    change, _ = sample(depth_slope(depth)[None], correspondence, mode="nearest")
    tolerance = relative * correspondence.z + slope * torch.nan_to_num(change[0], nan=0.0)
    return (correspondence.z - seen).abs() <= tolerance


def photometric(
    correspondence: Correspondence,
    source_image: Array,
    target_image: Array,
    limit: float = 0.2,
) -> Tensor:
    """The warped source image looks like the target's: mean over channels of the absolute
    difference <= ``limit``.

    Args:
        correspondence: of the target's pixels, by :func:`attnwarp.warp.correspond`.
        source_image: (h, w, C), before any edit, sRGB in [0, 1].
        target_image: (H, W, C), likewise.
        limit: the largest difference that passes.

    Raises:
        ValueError: an image of another shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, photometric
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> black, grey = np.zeros((8, 8, 3)), np.full((8, 8, 3), 0.15)
        >>> [photometric(c, black, grey, limit).all().item() for limit in (0.2, 0.1)]
        [True, False]
    """
    source = as_float64(source_image, "source_image")
    target = as_float64(target_image, "target_image")
    check.shape(source, ("H", "W", "C"), "source_image")
    check_proportions(source.shape[:2], correspondence.source, "source_image")
    check.shape(target, (*correspondence.z.shape, source.shape[2]), "target_image")
    warped, _ = sample(source.permute(2, 0, 1), correspondence)
    difference = (warped.permute(1, 2, 0) - target).abs().mean(dim=-1)
    return (difference <= limit) & correspondence.defined


def facing(correspondence: Correspondence, target_normal: Array) -> Tensor:
    """Source and target see the same side of the surface.

    World-space normals, flipped to each camera: they agree exactly where both cameras lie on one
    side of the tangent plane.

    Args:
        correspondence: of the target's pixels, by :func:`attnwarp.warp.correspond`.
        target_normal: (H, W, 3) world normals of either sign and any length; zero and NaN are
            undefined.

    Raises:
        ValueError: normals of another shape or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, facing
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> normal = np.broadcast_to([0.0, 0, -1], (8, 8, 3))
        >>> facing(c, normal).all().item()
        True
    """
    normal, defined = _normals(correspondence, target_normal)
    return defined & (
        _side(correspondence.source, normal, correspondence.points, correspondence.target) > 0
    )


def source_incidence(
    correspondence: Correspondence, target_normal: Array, angle: float = 60.0
) -> Tensor:
    """:func:`facing`, and the source sees the surface within ``angle`` degrees of its normal.

    Args:
        correspondence, target_normal: as :func:`facing`.
        angle: degrees.

    Raises:
        ValueError: normals of another shape or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import correspond, source_incidence
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> normal = np.broadcast_to([0.0, 0, -1], (8, 8, 3))
        >>> source_incidence(c, normal, 20.0)[4].tolist()  # within 20 degrees of the source's axis
        [True, True, True, True, True, False, False, False]
    """
    normal, defined = _normals(correspondence, target_normal)
    points = correspondence.points
    toward = -points
    flipped = _flip(_rotate(correspondence.source, normal), points)
    same = _side(correspondence.source, normal, points, correspondence.target) > 0
    return defined & same & (angle_between(flipped, toward) < angle)


def camera_frame(
    correspondence: Correspondence, target_normal: Array, angle: float = 60.0
) -> Tensor:
    """The published code's test: camera-space normals, flipped to each camera, within ``angle``
    degrees of each other.

    The two normals are in the axes of different cameras, so the angle between them contains the
    cameras' relative rotation. The same surface seen by a rolled camera fails.

    Args:
        correspondence, target_normal: as :func:`facing`.
        angle: degrees.

    Raises:
        ValueError: normals of another shape or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import camera_frame, correspond
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> c = correspond(source, target, np.full((8, 8), 2.0))
        >>> normal = np.broadcast_to([0.0, 0, -1], (8, 8, 3))
        >>> camera_frame(c, normal).all().item()
        True
    """
    normal, defined = _normals(correspondence, target_normal)
    source = _flip(_rotate(correspondence.source, normal), correspondence.points)
    target = _flip(_rotate(correspondence.target, normal), correspondence.target_points)
    return defined & (angle_between(source, target) < angle)


def gaussian_filter(
    gaussians: Gaussians, source: Camera, target: Camera, rule: GaussianFilter, angle: float = 60.0
) -> Tensor:
    """Mask of the Gaussians that remain when the target's depth is rendered.

    Args:
        gaussians: of the scene.
        source, target: the cameras.
        rule: "none" keeps all. "facing" keeps those of which both cameras see the same side,
            "source_incidence" those the source also sees within ``angle`` of the normal.
            "camera_frame" keeps those whose camera-space normals, each flipped to its camera, are
            within ``angle`` degrees across the two frames (the published code). "printed" drops
            exactly those (the paper's text: "excluded if n_s . n_t >= cos 60").
        angle: degrees.

    Returns:
        (N,) bool.

    Example:
        >>> import torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp.warp import gaussian_filter
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.2), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=8, height=8, fov_y=40, up=[0, 1, 0])
        >>> above, below = (Camera.look_at([0, 0, z], [0, 0, 0], **view) for z in (3, -3))
        >>> gaussian_filter(disc, above, below, "facing").tolist()
        [False]
    """
    check.one_of(rule, get_args(GaussianFilter), "rule")
    if rule == "none":
        return torch.ones(len(gaussians), dtype=torch.bool)
    normal = gaussians.normals().detach().to(device="cpu", dtype=torch.float64)
    centres = gaussians.world_means()
    points = [
        torch.from_numpy(centres - camera.position) @ torch.from_numpy(camera.rotation.T.copy())
        for camera in (source, target)
    ]
    seen = [
        _flip(_rotate(camera, normal), point)
        for camera, point in zip((source, target), points, strict=True)
    ]
    if rule in ("camera_frame", "printed"):
        within = angle_between(seen[0], seen[1]) < angle
        # The printed rule takes the angle itself with it.
        return within if rule == "camera_frame" else ~(angle_between(seen[0], seen[1]) <= angle)
    world = [
        s @ torch.from_numpy(camera.rotation.copy())
        for s, camera in zip(seen, (source, target), strict=True)
    ]
    same = (world[0] * world[1]).sum(dim=-1) > 0
    return same if rule == "facing" else same & (angle_between(seen[0], -points[0]) < angle)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """(...) angle in degrees between vectors (..., 3) of any length; NaN for a zero vector.

    2 atan2(|a/|a| - b/|b||, |a/|a| + b/|b||) (Kahan, "How futile are mindless assessments of
    roundoff", 2006), which keeps its digits near 0 and 180 where an arccosine loses half of them.

    Example:
        >>> import torch
        >>> from attnwarp.warp import angle_between
        >>> round(float(angle_between(torch.tensor([2.0, 0, 0]), torch.tensor([0, 1.0, 0]))), 4)
        90.0
    """
    a = a / torch.linalg.vector_norm(a, dim=-1, keepdim=True)
    b = b / torch.linalg.vector_norm(b, dim=-1, keepdim=True)
    half = torch.atan2(
        torch.linalg.vector_norm(a - b, dim=-1), torch.linalg.vector_norm(a + b, dim=-1)
    )
    return torch.rad2deg(2 * half)


def _normals(correspondence: Correspondence, target_normal: Array) -> tuple[Tensor, Tensor]:
    normal = as_float64(target_normal, "target_normal")
    check.shape(normal, (*correspondence.z.shape, 3), "target_normal")
    length = torch.linalg.vector_norm(normal, dim=-1)
    return normal, torch.isfinite(length) & (length > 0) & torch.isfinite(correspondence.z)


def _rotate(camera: Camera, normal: Tensor) -> Tensor:
    """World directions in the camera's axes."""
    return normal @ torch.from_numpy(camera.rotation.T.copy())


def _flip(normal: Tensor, points: Tensor) -> Tensor:
    """Camera-space normals at camera-space points, turned to look at the camera."""
    return torch.where((normal * points).sum(dim=-1, keepdim=True) > 0, -normal, normal)


def _side(source: Camera, normal: Tensor, points: Tensor, target: Camera) -> Tensor:
    """Positive where both camera centres lie on one side of the tangent planes.

    n . (C - X) for each camera, in the source's axes, where the target's centre comes from the
    relative pose.
    """
    n = _rotate(source, normal)
    centre = torch.from_numpy(source.relative_to(target)[:3, 3].copy())
    return -(n * points).sum(dim=-1) * (n * (centre - points)).sum(dim=-1)
