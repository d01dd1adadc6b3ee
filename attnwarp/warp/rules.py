"""Rules of visibility: each rule is a mask of the target pixels that pass.

A rule is a pure function that returns an (H, W) bool tensor on the target's grid, True for passing
pixels. A pixel with an undefined result does not pass. :data:`RULES` has a record of each rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.warp.correspondence import Correspondence, check_proportions, in_bounds
from attnwarp.warp.depth import TAP_SPREAD, Array, as_float64, depth_slope
from attnwarp.warp.sampling import sample, sample_depth
from attnwarp.warp.settings import GaussianFilter, WarpSettings
from attnwarp.warp.surface import Surface, needed

EXACT_DEPTH_TOLERANCE = 1e-4
"""Relative depth tolerance for exact (ray cast) depth. With half a pixel's slope it missed none of
the hidden pixels of a card 5 mm above its ground, which every fixed threshold above 5 mm misses
completely."""


def in_front(correspondence: Correspondence) -> Tensor:
    """Rule: the point lies in front of the source camera (z > 0).

    Args:
        correspondence: correspondence of the target's pixels, by :func:`attnwarp.warp.correspond`.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, in_front
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
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
    """Rule: both images show surface rather than background.

    Args:
        correspondence: correspondence of the target's pixels, by :func:`attnwarp.warp.correspond`.
        minimum: smallest alpha that counts as surface.
        target_alpha: (H, W) in [0, 1]; if omitted, every pixel passes.
        source_alpha: (h, w) in [0, 1], read bilinearly at the source position; if omitted, every
            pixel passes.

    Raises:
        ValueError: an alpha has a wrong shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, opaque
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> opaque(c, 0.5, target_alpha=np.eye(8))[0].tolist()
        [True, False, False, False, False, False, False, False]
    """
    return _opacity(correspondence, target_alpha, source_alpha) >= minimum


def depth_agrees(
    correspondence: Correspondence,
    source_depth: Array,
    *,
    relative: float = EXACT_DEPTH_TOLERANCE,
    slope: float = 0.5,
    spread: float | None = TAP_SPREAD,
) -> Tensor:
    """Rule: the point's depth in the source camera equals the source's depth map at its position.

    ``|z - d| <= relative * z + slope * (depth_slope at the nearest source pixel)``, with d
    interpolated in 1 / z and taps that straddle an edge rejected.

    Args:
        correspondence: correspondence of the target's pixels, by :func:`attnwarp.warp.correspond`.
        source_depth: (h, w) depth along the source's optical axis, NaN where undefined.
        relative: tolerance as a fraction of z, :data:`EXACT_DEPTH_TOLERANCE` for exact depth.
        slope: tolerance in pixels of the source's depth slope.
        spread: as in :func:`attnwarp.warp.depth.resize_depth`.

    Raises:
        ValueError: the depth has a wrong shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, depth_agrees
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> depth_agrees(c, np.full((8, 8), 1.5)).any().item()  # something stands before it
        False
    """
    return _depth_margin(correspondence, source_depth, relative, slope, spread) >= 0


def depth_tolerance(
    correspondence: Correspondence, source_depth: Array, *, relative: float, slope: float
) -> Tensor:
    """Compute the depth difference allowed by :func:`depth_agrees`, (H, W), from its arguments.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, depth_tolerance
        >>> source, target, seen = wall()
        >>> c = correspond(source, target, seen.depth)
        >>> depth_tolerance(c, seen.depth, relative=0.01, slope=0.5)[4, 4].item()
        0.02
    """
    depth = as_float64(source_depth, "source_depth")
    change, _ = sample(depth_slope(depth)[None], correspondence, mode="nearest")
    return relative * correspondence.z + slope * torch.nan_to_num(change[0], nan=0.0)


def photometric(
    correspondence: Correspondence,
    source_image: Array,
    target_image: Array,
    limit: float = 0.2,
) -> Tensor:
    """Rule: the warped source image resembles the target image: the mean over channels of the
    absolute difference is at most ``limit``.

    Args:
        correspondence: correspondence of the target's pixels, by :func:`attnwarp.warp.correspond`.
        source_image: (h, w, C) image before any edit, sRGB in [0, 1].
        target_image: (H, W, C) image before any edit, sRGB in [0, 1].
        limit: largest passing difference.

    Raises:
        ValueError: an image has a wrong shape, aspect ratio or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, photometric
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> black, grey = np.zeros((8, 8, 3)), np.full((8, 8, 3), 0.15)
        >>> [photometric(c, black, grey, limit).all().item() for limit in (0.2, 0.1)]
        [True, False]
    """
    return _difference(correspondence, source_image, target_image) <= limit


def facing(correspondence: Correspondence, target_normal: Array) -> Tensor:
    """Rule: source and target see the same side of the surface.

    World-space normals are flipped to face each camera: they agree exactly if both cameras lie on
    one side of the tangent plane.

    Args:
        correspondence: correspondence of the target's pixels, by :func:`attnwarp.warp.correspond`.
        target_normal: (H, W, 3) world normals of either sign and any length; zero and NaN are
            undefined.

    Raises:
        ValueError: the normals have a wrong shape or type.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, facing
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> facing(c, seen.normal).all().item()
        True
    """
    normal, defined = _normals(correspondence, target_normal)
    return defined & (
        _side(correspondence.source, normal, correspondence.points, correspondence.target) > 0
    )


def source_incidence(
    correspondence: Correspondence, target_normal: Array, angle: float = 60.0
) -> Tensor:
    """Rule: :func:`facing`, and the source sees the surface within ``angle`` degrees of its normal.

    Args:
        correspondence, target_normal: as :func:`facing`.
        angle: largest angle in degrees.

    Raises:
        ValueError: the normals have a wrong shape or type.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import correspond, source_incidence
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> source_incidence(c, seen.normal, 20.0)[4].tolist()  # of the source's axis
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
    """Rule of the published code: camera-space normals, flipped to each camera, lie within
    ``angle`` degrees of each other.

    The two normals are in the axes of different cameras, so their angle contains the cameras'
    relative rotation. The same surface seen by a rolled camera fails.

    Args:
        correspondence, target_normal: as :func:`facing`.
        angle: largest angle in degrees.

    Raises:
        ValueError: the normals have a wrong shape or type.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import camera_frame, correspond
        >>> source, target, seen = wall()  # 2 px apart
        >>> c = correspond(source, target, seen.depth)
        >>> camera_frame(c, seen.normal).all().item()
        True
    """
    return _frame_angle(correspondence, target_normal) < angle


def gaussian_filter(
    gaussians: Gaussians, source: Camera, target: Camera, rule: GaussianFilter, angle: float = 60.0
) -> Tensor:
    """Select the Gaussians that remain in the render of the target's depth.

    Args:
        gaussians: Gaussians of the scene.
        source, target: cameras of the pair.
        rule: "none" keeps all. "facing" keeps Gaussians seen from the same side by both cameras,
            "source_incidence" those the source also sees within ``angle`` of the normal.
            "camera_frame" keeps those whose camera-space normals, each flipped to its camera, are
            within ``angle`` degrees across the two frames (the published code). "printed" drops
            exactly those (the paper's text: "excluded if n_s . n_t >= cos 60").
        angle: largest angle in degrees.

    Returns:
        (N,) bool.

    Example:
        >>> from attnwarp.trial import disc, view
        >>> from attnwarp.warp import gaussian_filter
        >>> above, below = (view(z=z, side=8) for z in (3, -3))
        >>> gaussian_filter(disc(0.2), above, below, "facing").tolist()
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
        # The printed rule includes the limit angle.
        return within if rule == "camera_frame" else ~(angle_between(seen[0], seen[1]) <= angle)
    world = [
        s @ torch.from_numpy(camera.rotation.copy())
        for s, camera in zip(seen, (source, target), strict=True)
    ]
    same = (world[0] * world[1]).sum(dim=-1) > 0
    return same if rule == "facing" else same & (angle_between(seen[0], -points[0]) < angle)


def angle_between(a: check.Array, b: check.Array) -> Tensor:
    """Compute the angle (...) in degrees between vectors (..., 3) of any length; NaN for zero.

    The formula 2 atan2(|a/|a| - b/|b||, |a/|a| + b/|b||) (Kahan, "How futile are mindless
    assessments of roundoff", 2006) keeps digits near 0 and 180, where an arccosine loses half.

    Example:
        >>> import torch
        >>> from attnwarp.warp import angle_between
        >>> round(float(angle_between(torch.tensor([2.0, 0, 0]), torch.tensor([0, 1.0, 0]))), 4)
        90.0
    """
    a, b = check.tensor(a, "a"), check.tensor(b, "b")
    a = a / torch.linalg.vector_norm(a, dim=-1, keepdim=True)
    b = b / torch.linalg.vector_norm(b, dim=-1, keepdim=True)
    half = torch.atan2(
        torch.linalg.vector_norm(a - b, dim=-1), torch.linalg.vector_norm(a + b, dim=-1)
    )
    return torch.rad2deg(2 * half)


def _opacity(
    correspondence: Correspondence, target_alpha: Array | None, source_alpha: Array | None
) -> Tensor:
    """Compute the smaller alpha of both views, (H, W): infinite without any alpha, NaN outside
    the source."""
    smaller = torch.full(correspondence.z.shape, torch.inf, dtype=torch.float64)
    if target_alpha is not None:
        smaller = as_float64(target_alpha, "target_alpha")
        check.shape(smaller, tuple(correspondence.z.shape), "target_alpha")
    if source_alpha is not None:
        alpha = as_float64(source_alpha, "source_alpha")
        check.shape(alpha, ("H", "W"), "source_alpha")
        check_proportions(alpha.shape, correspondence.source, "source_alpha")
        sampled, inside = sample(alpha[None], correspondence)
        smaller = torch.where(inside, torch.minimum(smaller, sampled[0]), torch.nan)
    return smaller


def _difference(correspondence: Correspondence, source_image: Array, target_image: Array) -> Tensor:
    """Average the warped source's absolute difference from the target over channels, (H, W)."""
    source = as_float64(source_image, "source_image")
    target = as_float64(target_image, "target_image")
    check.shape(source, ("H", "W", "C"), "source_image")
    check_proportions(source.shape[:2], correspondence.source, "source_image")
    check.shape(target, (*correspondence.z.shape, source.shape[2]), "target_image")
    warped, _ = sample(source.permute(2, 0, 1), correspondence)
    difference = (warped.permute(1, 2, 0) - target).abs().mean(dim=-1)
    return torch.where(correspondence.defined, difference, torch.nan)


def _frame_angle(correspondence: Correspondence, target_normal: Array) -> Tensor:
    """Compute degrees between camera-space normals, each flipped to its camera, (H, W)."""
    normal, defined = _normals(correspondence, target_normal)
    source = _flip(_rotate(correspondence.source, normal), correspondence.points)
    target = _flip(_rotate(correspondence.target, normal), correspondence.target_points)
    return torch.where(defined, angle_between(source, target), torch.nan)


def _incidence(correspondence: Correspondence, target_normal: Array) -> Tensor:
    """Compute degrees between the target-facing normal and the direction to the source, (H, W)."""
    normal, defined = _normals(correspondence, target_normal)
    n, points = _rotate(correspondence.source, normal), correspondence.points
    centre = correspondence.source.relative_to(correspondence.target)[:3, 3]
    seen = _flip(n, points - torch.from_numpy(centre.copy()))
    return torch.where(defined, angle_between(seen, -points), torch.nan)


def _normals(correspondence: Correspondence, target_normal: Array) -> tuple[Tensor, Tensor]:
    normal = as_float64(target_normal, "target_normal")
    check.shape(normal, (*correspondence.z.shape, 3), "target_normal")
    length = torch.linalg.vector_norm(normal, dim=-1)
    return normal, torch.isfinite(length) & (length > 0) & torch.isfinite(correspondence.z)


def _rotate(camera: Camera, normal: Tensor) -> Tensor:
    """Rotate world directions to the camera's axes."""
    return normal @ torch.from_numpy(camera.rotation.T.copy())


def _flip(normal: Tensor, points: Tensor) -> Tensor:
    """Flip camera-space normals at camera-space points to face the camera."""
    return torch.where((normal * points).sum(dim=-1, keepdim=True) > 0, -normal, normal)


def _side(source: Camera, normal: Tensor, points: Tensor, target: Camera) -> Tensor:
    """Test the side of tangent planes: positive if both camera centres lie on one side.

    The test uses n . (C - X) for each camera, in the source's axes, where the target's centre comes
    from the relative pose.
    """
    n = _rotate(source, normal)
    centre = torch.from_numpy(source.relative_to(target)[:3, 3].copy())
    return -(n * points).sum(dim=-1) * (n * (centre - points)).sum(dim=-1)


@dataclass(frozen=True, eq=False)
class Rule:
    """Rule of visibility: its activation, its inputs, and its mask.

    To add a rule, append an entry to :data:`RULES`, with the field of
    :class:`~attnwarp.warp.settings.WarpSettings` that enables it. A kernel of the same name in
    ``attnwarp/warp/_kernels/pair.py`` replaces the definition.

    Args:
        name: name of the mask in :attr:`~attnwarp.warp.view.WarpedView.rules`.
        definition: function of the correspondence and, by keyword, of all inputs that returns an
            (H, W) bool mask, or None if the rule does not apply.
        setting: field of the settings that enables the rule by True, a number, or the rule's name;
            None for a rule of every view.
        reads: required parts of both surfaces, such as "source_depth" or "target_normal".
        may_read: optional parts, None if not given, such as "source_alpha" or
            "target_segment".
        limits: field of the settings for each additional keyword.
        margin: function of the same arguments that returns the (H, W) distance to the opposite
            verdict, positive for passing pixels and NaN where undefined; None without a margin.
        unit: unit of the margin.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import RULES, Rule, warp_surfaces
        >>> def near(correspondence, target_depth):
        ...     return target_depth < 1
        >>> RULES.append(Rule("near", near, reads=("target_depth",)))
        >>> source, target, seen = wall()
        >>> warp_surfaces(source, target, seen, seen).mask.any().item()
        False
        >>> RULES.pop().name
        'near'
    """

    name: str
    definition: Callable[..., Any]
    setting: str | None = None
    reads: tuple[str, ...] = ()
    may_read: tuple[str, ...] = ()
    limits: Mapping[str, str] = field(default_factory=dict)
    margin: Callable[..., Tensor] | None = None
    unit: str = "(yes or no)"

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts of the surfaces that the rule reads."""
        return (*self.reads, *self.may_read)

    def on(self, settings: WarpSettings) -> bool:
        """Return True if the settings enable the rule."""
        if self.setting is None:
            return True
        value = getattr(settings, self.setting, None)
        if isinstance(value, str):
            return value == self.name
        return value is not None and value is not False

    def arguments(self, settings: WarpSettings, parts: Mapping[str, Any]) -> dict[str, Any]:
        """Collect the keywords of the definition and of the margin.

        Raises:
            ValueError: a required part is missing.
        """
        setting = self.setting or self.name
        value = getattr(settings, setting, None)
        asked = f"{setting}={value!r}" if isinstance(value, str) else setting
        for name in self.reads:
            needed(parts.get(name), name.replace("_", "_surface.", 1), asked)
        return {name: parts.get(name) for name in self.parts} | {
            keyword: getattr(settings, limit) for keyword, limit in self.limits.items()
        }


def parts_of(
    target: Surface, source: Surface | None, segment: Tensor | None = None
) -> dict[str, Any]:
    """Collect the rules' inputs by name: parts of both surfaces, and ``target_segment``.

    Example:
        >>> import numpy as np
        >>> from attnwarp.warp import Surface
        >>> parts_of(Surface(np.ones((2, 2))), None).keys()
        dict_keys(['target_depth'])
    """
    parts = {
        f"{view}_{part}": getattr(surface, part, None)
        for view, surface in (("target", target), ("source", source))
        for part in ("depth", "normal", "alpha", "image")
    }
    parts["target_segment"] = segment
    return {name: part for name, part in parts.items() if part is not None}


def parts_read(settings: WarpSettings) -> set[str]:
    """Collect the names of the parts read by the settings' rules, as in :attr:`Rule.reads`.

    Example:
        >>> from attnwarp.warp import PRESETS, parts_read
        >>> sorted(parts_read(PRESETS["released"]))
        ['source_image', 'target_image', 'target_segment']
    """
    return {part for rule in RULES if rule.on(settings) for part in rule.parts}


def _in_bounds(correspondence: Correspondence, bounds: str) -> Tensor:
    camera = correspondence.source if bounds == "source" else correspondence.target
    return in_bounds(correspondence, (camera.height, camera.width))


def _border(correspondence: Correspondence, bounds: str) -> Tensor:
    camera = correspondence.source if bounds == "source" else correspondence.target
    # With integer centres the method compares the index with the border.
    slip = 0.5 if correspondence.pixel_centers == "integer" else 0.0
    low = correspondence.xy - slip
    high = torch.tensor([camera.width, camera.height], dtype=torch.float64) - low
    return torch.minimum(low, high).amin(dim=-1)


def _opaque_margin(
    correspondence: Correspondence,
    minimum: float,
    target_alpha: Array | None,
    source_alpha: Array | None,
) -> Tensor:
    margin = _opacity(correspondence, target_alpha, source_alpha) - minimum
    return torch.where(margin.isinf(), torch.nan, margin)


def _depth_margin(
    correspondence: Correspondence,
    source_depth: Array,
    relative: float,
    slope: float,
    spread: float | None,
) -> Tensor:
    seen = sample_depth(as_float64(source_depth, "source_depth"), correspondence, spread=spread)
    tolerance = depth_tolerance(correspondence, source_depth, relative=relative, slope=slope)
    return tolerance - (correspondence.z - seen).abs()


_ANGLE = {"angle": "normal_angle"}

RULES: list[Rule] = [
    Rule(
        "defined",
        lambda c: c.defined,
        margin=lambda c: c.target_depth,
        unit="of depth",
    ),
    Rule(
        "in_bounds",
        _in_bounds,
        limits={"bounds": "bounds"},
        margin=_border,
        unit="px to the border",
    ),
    Rule(
        "in_front",
        in_front,
        setting="in_front",
        margin=lambda c: c.z,
        unit="of depth",
    ),
    Rule(
        "opaque",
        opaque,
        setting="opaque",
        may_read=("target_alpha", "source_alpha"),
        limits={"minimum": "opaque"},
        margin=_opaque_margin,
        unit="of alpha",
    ),
    Rule(
        "depth_agrees",
        depth_agrees,
        setting="depth_agreement",
        reads=("source_depth",),
        limits={"relative": "depth_relative", "slope": "depth_slope", "spread": "depth_spread"},
        margin=_depth_margin,
        unit="of depth",
    ),
    Rule(
        "photometric",
        photometric,
        setting="photometric",
        reads=("source_image", "target_image"),
        limits={"limit": "photometric"},
        margin=lambda correspondence, limit, **images: (
            limit - _difference(correspondence, **images)
        ),
        unit="of colour",
    ),
    Rule(
        "facing",
        facing,
        setting="normal_test",
        reads=("target_normal",),
        margin=lambda c, target_normal: 90.0 - _incidence(c, target_normal),
        unit="degrees of incidence",
    ),
    Rule(
        "source_incidence",
        source_incidence,
        setting="normal_test",
        reads=("target_normal",),
        limits=_ANGLE,
        margin=lambda correspondence, target_normal, angle: (
            min(90.0, angle) - _incidence(correspondence, target_normal)
        ),
        unit="degrees of incidence",
    ),
    Rule(
        "camera_frame",
        camera_frame,
        setting="normal_test",
        reads=("target_normal",),
        limits=_ANGLE,
        margin=lambda correspondence, target_normal, angle: (
            angle - _frame_angle(correspondence, target_normal)
        ),
        unit="degrees between normals",
    ),
    Rule(
        "segment",
        lambda c, target_segment: target_segment,
        setting="segment",
        may_read=("target_segment",),
    ),
]
"""All rules, in the order in which a view lists them."""
