"""What the source saw: rules that each make a mask, and the masks they make together.

A rule is a pure function that returns an (H, W) bool tensor on the target's grid, True where the
pixel passes. A pixel whose answer is undefined does not pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.warp.correspondence import (
    TAP_SPREAD,
    Array,
    Correspondence,
    as_float64,
    correspond,
    correspond_at,
    in_bounds,
    layer_size,
    sample,
    sample_depth,
)
from attnwarp.warp.settings import PRESETS, GaussianFilter, MaskResize, NormalTest, WarpSettings

__all__ = [
    "PRESETS",
    "FeatureWarp",
    "Surface",
    "WarpSettings",
    "WarpedView",
    "angle_between",
    "camera_frame",
    "depth_agrees",
    "depth_slope",
    "facing",
    "gaussian_filter",
    "in_bounds",
    "in_front",
    "opaque",
    "photometric",
    "render_surface",
    "resize_mask",
    "source_incidence",
    "warp_surfaces",
    "warp_view",
]

EXACT_DEPTH_TOLERANCE = 1e-4
"""Relative depth tolerance for depth that is exact (ray cast). With half a pixel's slope it missed
none of the hidden pixels of a card 5 mm above its ground, which every fixed threshold above 5 mm
misses whole."""


# Rules


def in_front(correspondence: Correspondence) -> Tensor:
    """The point lies in front of the source camera (z > 0)."""
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
        minimum: smallest alpha that counts.
        target_alpha: (H, W) in [0, 1]; left out, every pixel passes.
        source_alpha: (h, w) in [0, 1], read bilinearly at the source position; left out, every
            pixel passes.
    """
    mask = torch.ones(correspondence.z.shape, dtype=torch.bool)
    if target_alpha is not None:
        alpha = as_float64(target_alpha, "target_alpha")
        check.shape(alpha, tuple(mask.shape), "target_alpha")
        mask &= alpha >= minimum
    if source_alpha is not None:
        alpha = as_float64(source_alpha, "source_alpha")
        check.shape(alpha, ("H", "W"), "source_alpha")
        sampled, inside = sample(alpha[None], correspondence)
        mask &= (sampled[0] >= minimum) & inside
    return mask


def depth_slope(depth: Array) -> Tensor:
    """Depth's change per pixel: the smaller one-sided |dz| of each axis, summed over the axes.

    The smaller side is the surface's own where the other one steps off an edge.

    Args:
        depth: (H, W), NaN where undefined.

    Returns:
        (H, W) float64; an axis without a defined neighbour adds 0, an undefined pixel gives NaN.
    """
    z = as_float64(depth, "depth")
    check.shape(z, ("H", "W"), "depth")
    slope = torch.zeros_like(z)
    for axis in (0, 1):
        step = z.diff(dim=axis).abs()
        step = torch.where(torch.isfinite(step), step, torch.inf)
        edge = torch.full_like(z.narrow(axis, 0, 1), torch.inf)
        smaller = torch.minimum(
            torch.cat([edge, step], dim=axis), torch.cat([step, edge], dim=axis)
        )
        slope = slope + torch.where(torch.isfinite(smaller), smaller, 0)
    return torch.where(torch.isfinite(z), slope, torch.nan)


def depth_agrees(
    correspondence: Correspondence,
    source_depth: Array,
    *,
    relative: float = EXACT_DEPTH_TOLERANCE,
    slope: float = 0.5,
    spread: float | None = TAP_SPREAD,
) -> Tensor:
    """The point's depth in the source camera is the depth the source itself sees there.

    ``|z - d| <= relative * z + slope * (depth_slope at the nearest source pixel)``, with d
    interpolated in 1 / z and taps that straddle an edge rejected.

    Args:
        source_depth: (h, w) depth along the source's optical axis, NaN where undefined.
        relative: tolerance as a fraction of z, :data:`EXACT_DEPTH_TOLERANCE` for exact depth.
        slope: pixels of the source's depth slope to allow.
        spread: as in :func:`attnwarp.warp.correspondence.resize_depth`.
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
        source_image: (h, w, C) and target_image: (H, W, C), before any edit, sRGB in [0, 1].
    """
    source = as_float64(source_image, "source_image")
    target = as_float64(target_image, "target_image")
    check.shape(source, ("H", "W", "C"), "source_image")
    check.shape(target, (*correspondence.z.shape, source.shape[2]), "target_image")
    warped, _ = sample(source.permute(2, 0, 1), correspondence)
    difference = (warped.permute(1, 2, 0) - target).abs().mean(dim=-1)
    return (difference <= limit) & correspondence.defined


def facing(correspondence: Correspondence, target_normal: Array) -> Tensor:
    """Source and target see the same side of the surface.

    World-space normals, flipped to each camera: they agree exactly where both cameras lie on one
    side of the tangent plane.

    Args:
        target_normal: (H, W, 3) world normals of either sign and any length; zero and NaN are
            undefined.
    """
    normal, defined = _normals(correspondence, target_normal)
    return defined & (
        _side(correspondence.source, normal, correspondence.points, correspondence.target) > 0
    )


def source_incidence(
    correspondence: Correspondence, target_normal: Array, angle: float = 60.0
) -> Tensor:
    """:func:`facing`, and the source sees the surface within ``angle`` degrees of its normal."""
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

    The two normals stand in the axes of two different cameras, so that the angle between them holds
    the cameras' relative rotation: the same surface seen by a rolled camera fails.
    """
    normal, defined = _normals(correspondence, target_normal)
    source = _flip(_rotate(correspondence.source, normal), correspondence.points)
    target = _flip(_rotate(correspondence.target, normal), correspondence.target_points)
    return defined & (angle_between(source, target) < angle)


def gaussian_filter(
    gaussians: Gaussians, source: Camera, target: Camera, rule: GaussianFilter, angle: float = 60.0
) -> Tensor:
    """Which Gaussians are left in before the target's depth is rendered.

    Args:
        rule: "none" keeps all. "facing" keeps those of which both cameras see the same side,
            "source_incidence" those the source also sees within ``angle`` of the normal.
            "camera_frame" keeps those whose camera-space normals, each flipped to its camera, are
            within ``angle`` degrees across the two frames (the published code). "printed" drops
            exactly those (the paper's text: "excluded if n_s . n_t >= cos 60").
        angle: degrees.

    Returns:
        (N,) bool.
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
    """
    a = a / torch.linalg.vector_norm(a, dim=-1, keepdim=True)
    b = b / torch.linalg.vector_norm(b, dim=-1, keepdim=True)
    half = torch.atan2(
        torch.linalg.vector_norm(a - b, dim=-1), torch.linalg.vector_norm(a + b, dim=-1)
    )
    return torch.rad2deg(2 * half)


def resize_mask(mask: Tensor, size: tuple[int, int], mode: MaskResize = "area") -> Tensor:
    """A mask on another grid; more than half counts.

    Args:
        mask: (H, W) bool.
        size: (h, w) of the other grid.
        mode: "area" weighs every mask pixel by its overlap with the new pixel; "bilinear" reads the
            4 pixels around the new centre; "nearest" the one that holds it.

    Returns:
        (h, w) bool.
    """
    check.one_of(mode, get_args(MaskResize), "mode")
    if mask.dtype != torch.bool:
        raise ValueError(f"mask: got {mask.dtype}, expected bool")
    check.shape(mask, ("H", "W"), "mask")
    weigh: Callable[[int, int], Tensor] = {
        "area": _area_weights,
        "bilinear": _linear_weights,
        "nearest": _nearest,
    }[mode]
    share = weigh(size[0], mask.shape[0]) @ mask.double().cpu() @ weigh(size[1], mask.shape[1]).T
    # Half of a pixel is not more than half, whatever the last bit of the sum says.
    return (share > 0.5 + 1e-9).to(mask.device)


# Everything for a pair of views


@dataclass(frozen=True, eq=False)
class Surface:
    """What one view knows of the surface before it.

    Args:
        depth: (H, W) along the optical axis, NaN where undefined.
        normal: (H, W, 3) world normals of either sign and any length, NaN or zero where undefined.
        alpha: (H, W) in [0, 1].
        image: (H, W, C) sRGB in [0, 1], before any edit.
        counters: how much work it was to render, see :class:`attnwarp.render.Render`.
    """

    depth: Array
    normal: Array | None = None
    alpha: Array | None = None
    image: Array | None = None
    counters: dict[str, int] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, eq=False)
class FeatureWarp:
    """The warp at one feature size.

    Args:
        correspondence: on the target's feature grid, into the source's.
        mask: (h, w) bool, where the warped features count.
    """

    correspondence: Correspondence
    mask: Tensor

    def warp(self, features: Tensor) -> Tensor:
        """Target features (..., h, w) from (C, h, w) or (B, C, h, w) source ones;
        :func:`attnwarp.warp.sample`.
        """
        return sample(features, self.correspondence)[0]


@dataclass(frozen=True, eq=False)
class WarpedView:
    """One target view seen from one source: the correspondence at image size and the mask.

    Args:
        settings: the choices it was made with.
        correspondence: of the H x W target image.
        mask: (H, W) bool, all rules together.
        rules: each rule's own (H, W) mask, by name, in the order they were applied. ``defined`` is
            always among them.
        target, source: the surfaces it was made from; ``source`` is None where no rule needed it.
    """

    settings: WarpSettings
    correspondence: Correspondence
    mask: Tensor
    rules: dict[str, Tensor]
    target: Surface
    source: Surface | None = None
    _at: dict[tuple[int, ...], FeatureWarp] = field(default_factory=dict, repr=False)

    def at(
        self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None
    ) -> FeatureWarp:
        """The warp of an (h, w) feature grid: its own correspondence, and the mask resized as the
        settings say.

        Worked out once per size. The mask drops pixels whose correspondence is undefined at this
        size.

        Args:
            size: (h, w) of the target's features.
            source_size: (h, w) of the source's; by default at the same fraction of its image.
        """
        source, target = self.correspondence.source, self.correspondence.target
        source_size = layer_size(source, target, size) if source_size is None else source_size
        key = (*size, *source_size)
        if key == (target.height, target.width, source.height, source.width):
            return FeatureWarp(self.correspondence, self.mask)
        if key not in self._at:
            settings = self.settings
            layer = correspond_at(
                source,
                target,
                self.correspondence.target_depth,
                size,
                source_size=source_size,
                pixel_centers=settings.pixel_centers,
                in_front=settings.in_front,
                interpolation=settings.depth_interpolation,
                spread=settings.depth_spread,
            )
            self._at[key] = FeatureWarp(
                layer, resize_mask(self.mask, size, settings.mask_resize) & layer.defined
            )
        return self._at[key]


def warp_surfaces(
    source: Camera,
    target: Camera,
    target_surface: Surface,
    source_surface: Surface | None = None,
    settings: WarpSettings = PRESETS["corrected"],
    *,
    target_segment: Tensor | None = None,
) -> WarpedView:
    """The correspondence and the mask of a pair of views, from depth maps: rendered, measured or
    exact.

    Args:
        source, target: the cameras.
        target_surface: what the target sees; its normals are needed by the normal tests, its image
            by the photometric.
        source_surface: what the source sees; needed by depth agreement (depth) and the photometric
            test (image).
        settings: which rules, and how. ``gaussian_filter``, ``depth`` and ``depth_statistic``
            concern the rendering of the surfaces and play no part here.
        target_segment: (H, W) bool, the part of the target that is edited.

    Raises:
        ValueError: a rule needs something that is not given; the message names the rule and what it
            needs.
    """
    correspondence = correspond(
        source,
        target,
        target_surface.depth,
        pixel_centers=settings.pixel_centers,
        in_front=settings.in_front,
    )
    bounds = source if settings.bounds == "source" else target
    rules = {
        "defined": correspondence.defined,
        "in_bounds": in_bounds(correspondence, (bounds.height, bounds.width)),
    }
    if settings.in_front:
        rules["in_front"] = in_front(correspondence)
    if settings.opaque is not None:
        rules["opaque"] = opaque(
            correspondence,
            settings.opaque,
            target_alpha=target_surface.alpha,
            source_alpha=source_surface.alpha if source_surface else None,
        )
    if settings.depth_agreement:
        rules["depth_agrees"] = depth_agrees(
            correspondence,
            _needed(source_surface, "source_surface", "depth", "depth_agreement"),
            relative=settings.depth_relative,
            slope=settings.depth_slope,
            spread=settings.depth_spread,
        )
    if settings.photometric is not None:
        rules["photometric"] = photometric(
            correspondence,
            _needed(source_surface, "source_surface", "image", "photometric"),
            _needed(target_surface, "target_surface", "image", "photometric"),
            settings.photometric,
        )
    if settings.normal_test != "none":
        normal = _needed(
            target_surface, "target_surface", "normal", f"normal_test={settings.normal_test!r}"
        )
        rules[settings.normal_test] = _normal_rule(
            correspondence, normal, settings.normal_test, settings.normal_angle
        )
    if settings.segment and target_segment is not None:
        check.shape(target_segment, (target.height, target.width), "target_segment")
        rules["segment"] = target_segment.to(device="cpu", dtype=torch.bool)
    mask = torch.stack(list(rules.values())).all(dim=0)
    return WarpedView(settings, correspondence, mask, rules, target_surface, source_surface)


def warp_view(
    gaussians: Gaussians,
    source: Camera,
    target: Camera,
    settings: WarpSettings = PRESETS["corrected"],
    *,
    source_image: Array | None = None,
    target_image: Array | None = None,
    target_segment: Tensor | None = None,
    source_surface: Surface | None = None,
    backend: str = "auto",
) -> WarpedView:
    """The correspondence and the mask of a pair of views, from splats.

    Renders what the settings' rules ask for and hands it to :func:`warp_surfaces`. The Gaussian
    filter concerns the target's render; the source's own depth is that of the whole model.

    Args:
        gaussians: the model before the edit. Hand in the current one to reproduce codes that warp
            with it.
        source, target: the cameras.
        settings: which rules, and how.
        source_image, target_image: (H, W, 3) sRGB images before the edit, for the photometric test;
            by default the renders of ``gaussians``.
        target_segment: (H, W) bool, the part of the target that is edited.
        source_surface: the source's render if it is at hand, :func:`render_surface`; one source
            serves many targets.
        backend: as in :func:`attnwarp.render.render`.
    """
    keep = gaussian_filter(
        gaussians, source, target, settings.gaussian_filter, settings.normal_angle
    )
    filtered = gaussians if bool(keep.all()) else gaussians.select(keep.to(gaussians.means.device))
    seen = render_surface(filtered, target, settings, backend=backend)
    if settings.photometric is not None:
        if target_image is None and filtered is not gaussians:
            target_image = render_surface(gaussians, target, settings, backend=backend).image
        if target_image is not None:
            seen = replace(seen, image=target_image)
    needs_source = (
        settings.depth_agreement or settings.photometric is not None or settings.opaque is not None
    )
    if source_surface is None and needs_source:
        source_surface = render_surface(gaussians, source, settings, backend=backend)
    if source_surface is not None and source_image is not None:
        source_surface = replace(source_surface, image=source_image)
    return warp_surfaces(
        source, target, seen, source_surface, settings, target_segment=target_segment
    )


def render_surface(
    gaussians: Gaussians,
    camera: Camera,
    settings: WarpSettings = PRESETS["corrected"],
    *,
    backend: str = "auto",
) -> Surface:
    """Depth, normals, alpha and colour of splats as ``settings`` wants them rendered, on the
    CPU."""
    from attnwarp.render import render

    depth = settings.depth
    how = "peak" if depth == "intersection" and gaussians.kind == "3d" else depth
    with torch.no_grad():
        seen = render(gaussians, camera, backend=backend, depth=how)
    z = seen.depth if settings.depth_statistic == "expected" else seen.median_depth
    return Surface(
        z.cpu(), seen.normal.cpu(), seen.alpha.cpu(), seen.color.cpu(), dict(seen.counters)
    )


def _normal_rule(
    correspondence: Correspondence, normal: Array, rule: NormalTest, angle: float
) -> Tensor:
    if rule == "facing":
        return facing(correspondence, normal)
    return (source_incidence if rule == "source_incidence" else camera_frame)(
        correspondence, normal, angle
    )


def _needed(surface: Surface | None, view: str, part: str, rule: str) -> Array:
    value: Array | None = getattr(surface, part, None)
    if value is None:
        raise ValueError(
            f"{view}.{part}: got None, but the rule {rule} needs it; give it or turn the rule off"
        )
    return value


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


def _area_weights(new: int, old: int) -> Tensor:
    low = torch.arange(new, dtype=torch.float64)[:, None] * (old / new)
    high = low + old / new
    pixel = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(high, pixel + 1) - torch.maximum(low, pixel)
    return overlap.clamp_min(0) * (new / old)


def _linear_weights(new: int, old: int) -> Tensor:
    index = (torch.arange(new, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    index = index.clamp(0, old - 1)
    return (1 - (index[:, None] - torch.arange(old, dtype=torch.float64)).abs()).clamp_min(0)


def _nearest(new: int, old: int) -> Tensor:
    index = (
        torch.floor((torch.arange(new, dtype=torch.float64) + 0.5) * (old / new))
        .long()
        .clamp(0, old - 1)
    )
    return torch.nn.functional.one_hot(index, old).double()
