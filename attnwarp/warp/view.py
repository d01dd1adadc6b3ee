"""Warp of a pair of views: the correspondence, the rules' masks, and the feature grids."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.devices import on_cpu_unless_named
from attnwarp.errors import InputWarning
from attnwarp.gaussians import Gaussians
from attnwarp.warp.correspondence import (
    Correspondence,
    correspond,
    correspond_at,
    layer_size,
    share_of,
)
from attnwarp.warp.depth import Array
from attnwarp.warp.features import Backend, FeatureWarp
from attnwarp.warp.masks import resize_mask
from attnwarp.warp.rules import RULES, gaussian_filter, parts_of, parts_read
from attnwarp.warp.settings import PRESETS, WarpSettings
from attnwarp.warp.surface import Surface

OVERSHOOT = 0.1
"""Largest accepted distance of a picture beyond [0, 1]: cubic resampling overshoots an edge by a
tenth.
"""


WORK: Counter[str] = Counter()
"""Work of this process so far: ``view_pairs`` warped, splat-pixel ``pairs`` of their surfaces."""


@dataclass(frozen=True, eq=False)
class WarpedView:
    """Warp of one target view from one source: the correspondence at image size and the mask.

    Args:
        settings: settings of the warp.
        correspondence: correspondence of the H x W target image.
        mask: (H, W) bool, the conjunction of all rules.
        rules: (H, W) mask of each rule, by name, in the order of application; always includes
            ``defined``.
        target, source: surfaces of both views; ``source`` is None if no rule needed it.
        backend: backend of the feature grids, see :func:`warp_surfaces`.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import warp_surfaces
        >>> _, camera, seen = wall()
        >>> view = warp_surfaces(camera, camera, seen, seen)
        >>> view.mask.all().item(), view.at((4, 4)).mask.shape
        (True, torch.Size([4, 4]))
    """

    settings: WarpSettings
    correspondence: Correspondence
    mask: Tensor
    rules: dict[str, Tensor]
    target: Surface
    source: Surface | None = None
    backend: Backend = "auto"
    # Excluded from ``init``, so that dataclasses.replace drops the layers, which contain the mask.
    _at: dict[tuple[int, ...], FeatureWarp] = field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        rules = ", ".join(f"{name} {share_of(rule)}" for name, rule in self.rules.items())
        sizes = self.correspondence.sizes
        return f"WarpedView({sizes}, mask {share_of(self.mask)}; rules: {rules})"

    def with_mask(self, mask: Tensor) -> WarpedView:
        """Return this warp with another mask, such as the exact one.

        Args:
            mask: (H, W) bool; pixels without a source position are removed from it.

        Example:
            >>> from attnwarp.trial import wall
            >>> from attnwarp.warp import warp_surfaces
            >>> _, camera, seen = wall()
            >>> view = warp_surfaces(camera, camera, seen, seen)
            >>> view.with_mask(torch.zeros(8, 8, dtype=torch.bool)).at((4, 4)).mask.any().item()
            False
        """
        return replace(self, mask=mask & self.correspondence.defined)

    def at(
        self, size: tuple[int, int], *, source_size: tuple[int, int] | None = None
    ) -> FeatureWarp:
        """Build the warp of an (h, w) feature grid: the grid's correspondence, and the mask resized
        as the settings specify.

        The result is computed once per size. Its mask excludes pixels whose correspondence is
        undefined at this size.

        Args:
            size: (h, w) of the target's features.
            source_size: (h, w) of the source's features; by default the same fraction of its image.

        Raises:
            ValueError: a size is not a pair of positive integers.
        """
        size = check.size(size, "size")
        source, target = self.correspondence.source, self.correspondence.target
        if source_size is None:
            source_size = layer_size(source, target, size)
        else:
            source_size = check.size(source_size, "source_size")
        key = (*size, *source_size)
        if key == (target.height, target.width, source.height, source.width):
            self._at.setdefault(key, FeatureWarp(self.correspondence, self.mask, self.backend))
        if key not in self._at:
            self._at[key] = self._layer(size, source_size)
        return self._at[key]

    def _layer(self, size: tuple[int, int], source_size: tuple[int, int]) -> FeatureWarp:
        settings, full = self.settings, self.correspondence
        if self.backend == "reference":
            layer = correspond_at(
                full.source,
                full.target,
                full.target_depth,
                size,
                source_size=source_size,
                pixel_centers=settings.pixel_centers,
                in_front=settings.in_front,
                interpolation=settings.depth_interpolation,
                spread=settings.depth_spread,
            )
            mask = resize_mask(self.mask, size, settings.mask_resize) & layer.defined
            return FeatureWarp(layer, mask, self.backend)
        from attnwarp.warp import cpu

        layer = cpu.correspond_layer(
            full.source.resize(source_size[1], source_size[0]),
            full.target.resize(size[1], size[0]),
            full.target_depth,
            settings,
        )
        mask = cpu.resize_mask(self.mask, size, settings.mask_resize, layer.defined)
        return FeatureWarp(layer, mask, self.backend)


@on_cpu_unless_named
def warp_surfaces(
    source: Camera,
    target: Camera,
    target_surface: Surface,
    source_surface: Surface | None = None,
    settings: WarpSettings = PRESETS["corrected"],
    *,
    target_segment: Array | None = None,
    backend: Backend = "auto",
    warn_empty: bool = True,
) -> WarpedView:
    """Compute the correspondence and the mask of a pair of views from depth maps: rendered,
    measured or exact.

    Args:
        source, target: cameras of the pair.
        target_surface: surface seen by the target; the normal tests need its normals, the
            photometric test its image. The rule ``opaque`` treats a view without alpha, target or
            source, as opaque everywhere.
        source_surface: surface seen by the source; needed by depth agreement (depth) and the
            photometric test (image).
        settings: settings of the rules. ``gaussian_filter``, ``depth`` and ``depth_statistic``
            concern the rendering of the surfaces and are unused here.
        target_segment: (H, W) bool, the edited part of the target; for settings with
            ``segment``.
        backend: "auto" computes with kernels (:mod:`attnwarp.warp.cpu`), "reference" with the
            definition in torch. Positions agree to 1e-6 px, masks except for pixels within rounding
            of a rule's threshold.
        warn_empty: True warns if no pixel of the target has a source position. A loop over views,
            some of which see nothing, turns the warning off.

    Raises:
        ValueError: a rule lacks an input, or no rule reads a given input; the message names both.
            A picture or a segment differs in size from its view; a picture ranges from 0 to
            255.
        TypeError: an argument has a wrong type.

    Example:
        >>> from attnwarp.trial import wall
        >>> from attnwarp.warp import warp_surfaces
        >>> source, target, seen = wall()  # 2 px apart
        >>> view = warp_surfaces(source, target, seen, seen)
        >>> view.mask[0].tolist()
        [True, True, True, True, True, True, False, False]
        >>> list(view.rules)
        ['defined', 'in_bounds', 'in_front', 'opaque', 'depth_agrees', 'facing']
    """
    check.one_of(backend, get_args(Backend), "backend")
    _check_pair(source, target, settings)
    check.instance(target_surface, Surface, "target_surface", "Surface, such as Surface(depth)")
    if source_surface is not None:
        check.instance(source_surface, Surface, "source_surface", "Surface, such as Surface(depth)")
    _refuse_unread(settings, target_segment=target_segment)
    segment = None if target_segment is None else _checked_segment(target_segment, target)
    WORK["view_pairs"] += 1
    parts = parts_of(target_surface, source_surface, segment)
    on = [rule for rule in RULES if rule.on(settings)]
    arguments = {rule.name: rule.arguments(settings, parts) for rule in on}
    _check_pictures(source, target, {k: parts[k] for k in parts_read(settings) & parts.keys()})
    if backend == "reference":
        correspondence = correspond(
            source,
            target,
            target_surface.depth,
            pixel_centers=settings.pixel_centers,
            in_front=settings.in_front,
        )
        by_kernel, mask = dict[str, Tensor](), correspondence.defined
    else:
        from attnwarp.warp import cpu

        correspondence, by_kernel, mask = cpu.correspond_and_mask(
            source, target, parts, on, settings
        )
    rules: dict[str, Tensor] = {}
    for rule in on:
        passes = by_kernel.get(rule.name)
        if passes is None:
            found = rule.definition(correspondence, **arguments[rule.name])
            if found is None:
                continue
            passes = torch.as_tensor(found)
            mask = mask & passes
        rules[rule.name] = passes
    view = WarpedView(
        settings, correspondence, mask, rules, target_surface, source_surface, backend
    )
    if warn_empty:
        _warn_if_empty(view, NO_DEPTH)
    return view


@on_cpu_unless_named
def warp_view(
    gaussians: Gaussians,
    source: Camera,
    target: Camera,
    settings: WarpSettings = PRESETS["corrected"],
    *,
    source_image: Array | None = None,
    target_image: Array | None = None,
    target_segment: Array | None = None,
    source_surface: Surface | None = None,
    near: float | None = None,
    backend: str = "auto",
    warp_backend: Backend = "auto",
    warn_empty: bool = True,
) -> WarpedView:
    """Compute the correspondence and the mask of a pair of views from splats.

    Render the surfaces that the settings' rules need and call :func:`warp_surfaces`. The Gaussian
    filter applies to the target's render; the source's depth comes from the unfiltered model.

    Args:
        gaussians: model before the edit; the current model reproduces codes that warp with it.
        source, target: cameras of the pair.
        settings: settings of the rules.
        source_image, target_image: (H, W, 3) sRGB images before the edit, for the photometric test
            (settings with ``photometric``): the target's at its camera's size, the source's at its
            aspect ratio; by default the renders of ``gaussians``.
        target_segment: (H, W) bool, the edited part of the target; for settings with
            ``segment``.
        source_surface: existing render of the source, by :func:`render_surface`; one source serves
            many targets.
        near: near-plane depth as in :func:`render_surface`.
        backend: name of the renderer, as in :func:`attnwarp.render.render`.
        warp_backend, warn_empty: arguments of the warp, as in :func:`warp_surfaces`.

    Raises:
        ValueError, TypeError: as in :func:`warp_surfaces`.

    Example:
        >>> from attnwarp.trial import disc, view
        >>> from attnwarp.warp import warp_view
        >>> warp = warp_view(disc(), view(0), view(1))
        >>> warp.mask[16, 16].item(), warp.at((4, 4)).mask.shape
        (True, torch.Size([4, 4]))
    """
    check.instance(gaussians, Gaussians, "gaussians", "attnwarp.Gaussians")
    _check_pair(source, target, settings)
    read = parts_read(settings)
    _refuse_unread(settings, source_image=source_image, target_image=target_image)
    keep = gaussian_filter(
        gaussians, source, target, settings.gaussian_filter, settings.normal_angle
    )
    filtered = gaussians if bool(keep.all()) else gaussians.select(keep.to(gaussians.means.device))
    seen = render_surface(filtered, target, settings, near=near, backend=backend)
    if "target_image" in read:
        if target_image is None and filtered is not gaussians:
            whole = render_surface(gaussians, target, settings, near=near, backend=backend)
            target_image = whole.image
        if target_image is not None:
            seen = replace(seen, image=target_image)
    if source_surface is None and any(part.startswith("source_") for part in read):
        source_surface = render_surface(gaussians, source, settings, near=near, backend=backend)
    if source_surface is not None and source_image is not None:
        source_surface = replace(source_surface, image=source_image)
    view = warp_surfaces(
        source,
        target,
        seen,
        source_surface,
        settings,
        target_segment=target_segment,
        backend=warp_backend,
        warn_empty=False,
    )
    # The Gaussian filter may have emptied the view.
    if warn_empty and filtered is gaussians:
        _warn_if_empty(view, UNSEEN)
    return view


@on_cpu_unless_named
def render_surface(
    gaussians: Gaussians,
    camera: Camera,
    settings: WarpSettings = PRESETS["corrected"],
    *,
    near: float | None = None,
    backend: str = "auto",
) -> Surface:
    """Render depth, normals, alpha and colour of splats as ``settings`` specify.

    Args:
        gaussians: splats to render.
        camera: camera of the rendered view; (H, W) is its size.
        settings: settings whose ``depth``, ``depth_statistic`` and ``undefined_depth`` define the
            depth. 3D splats use "peak" depth for "intersection".
        near: near-plane depth, in scene units; by default a hundredth of the splats' median
            distance.
        backend: name of the renderer, for :func:`attnwarp.render.render`.

    Returns:
        Surface of (H, W) tensors without gradients, on the CPU.

    Example:
        >>> from attnwarp.trial import disc, view
        >>> from attnwarp.warp import render_surface
        >>> surface = render_surface(disc(), view())
        >>> surface.depth.shape, round(float(surface.depth[16, 16]), 4)
        (torch.Size([32, 32]), 3.0)
    """
    from attnwarp.render import render

    depth = settings.depth
    how = "peak" if depth == "intersection" and gaussians.kind == "3d" else depth
    with torch.no_grad():
        plane = near_plane(gaussians, camera) if near is None else near
        seen = render(gaussians, camera, backend=backend, depth=how, near=plane)
    WORK["pairs"] += seen.counters.get("pairs", 0)
    z = seen.depth if settings.depth_statistic == "expected" else seen.median_depth
    if settings.undefined_depth == "farthest":
        undefined = z.isnan()
        farthest = torch.where(undefined, -torch.inf, z).max()
        z = torch.where(undefined & farthest.isfinite(), farthest, z)  # NaN if the view is empty
    return Surface(
        z.cpu(), seen.normal.cpu(), seen.alpha.cpu(), seen.color.cpu(), dict(seen.counters)
    )


def _check_pair(source: Camera, target: Camera, settings: WarpSettings) -> None:
    check.instance(source, Camera, "source", "attnwarp.Camera")
    check.instance(target, Camera, "target", "attnwarp.Camera")
    check.instance(settings, WarpSettings, "settings", "WarpSettings, such as PRESETS['corrected']")


def _check_pictures(source: Camera, target: Camera, parts: Mapping[str, Array]) -> None:
    """Check the pictures read by rules: size or aspect ratio of their views, values in [0, 1]."""
    first, second = parts.get("source_image"), parts.get("target_image")
    if first is not None:
        check.shape(first, ("H", "W", "C"), "source_image")
        # The source's picture is sampled at positions, so any resolution is valid.
        size = (source.height, source.width)
        check.same_aspect(tuple(first.shape[:2]), size, "source_image", "its axes are (H, W, C)")
    if second is not None:
        channels = "C" if first is None else first.shape[2]
        check.shape(second, (target.height, target.width, channels), "target_image")
    for name, image in (("source_image", first), ("target_image", second)):
        if image is None:
            continue
        # A render's colours may slightly exceed 1, and resampling may overshoot either end.
        # 8-bit tensors have no mean.
        # Arrays are copied, since torch reads neither flipped nor big-endian ones.
        plain = image if isinstance(image, Tensor) else torch.from_numpy(np.array(image, "f4"))
        values = plain.float()
        if values.min() < -OVERSHOOT or values.mean() > 1 + OVERSHOOT:
            raise ValueError(
                f"{name}: got values in [{values.min():.3g}, {values.max():.3g}], expected sRGB in"
                " [0, 1]; divide 8 bits by 255"
            )


UNSEEN = "the target sees no surface; check"
NO_DEPTH = "the target's depth is nowhere finite and above zero; check the depth map, and"


def _warn_if_empty(view: WarpedView, without_surface: str) -> None:
    # numpy's any, since torch's reads one byte at a time.
    if view.rules["defined"].numpy().any():
        return
    surface = torch.isfinite(view.correspondence.target_depth).any()
    reason = "every point lies behind the source; check" if surface else without_surface
    warnings.warn(
        f"no pixel of the target has a position in the source: {reason} world_to_camera of"
        " both: from world to camera, not camera-to-world; OpenCV axes (x right, y down, z"
        " forward), not OpenGL's",
        InputWarning,
        stacklevel=4,
    )


def _refuse_unread(settings: WarpSettings, **given: Array | None) -> None:
    """Raise ValueError if no rule of the settings reads a given input."""
    for name, value in given.items():
        if value is not None and name not in parts_read(settings):
            off = [rule.setting for rule in RULES if name in rule.parts and rule.setting]
            have = " and ".join(f"{field}={getattr(settings, field)!r}" for field in off)
            raise ValueError(
                f"{name}: the settings have {have} and do not read it; set {' or '.join(off)}, or"
                " leave it out"
            )


def _checked_segment(segment: Array, target: Camera) -> Tensor:
    """Check the segment, (H, W) bool, and move it to the CPU."""
    tensor = segment if isinstance(segment, Tensor) else torch.from_numpy(np.array(segment))
    check.shape(tensor, (target.height, target.width), "target_segment")
    if tensor.dtype != torch.bool:
        raise ValueError(
            f"target_segment: got {tensor.dtype}, expected bool; pass mask > 0.5 for a mask of"
            " shares, mask > 127 for one of 8 bits"
        )
    return tensor.cpu()


def near_plane(gaussians: Gaussians, camera: Camera) -> float:
    """Compute a hundredth of the splats' median distance from the camera, in scene units.

    An absolute length would draw floaters in front of the camera in a scene of large units, and
    nothing at all in a scene of small units.
    """
    if not len(gaussians):
        from attnwarp.render.constants import NEAR

        return NEAR
    offset = gaussians.means.new_tensor(camera.position - gaussians.origin)
    away = torch.linalg.vector_norm(gaussians.means.detach() - offset, dim=1)
    return float(away.median()) / 100
