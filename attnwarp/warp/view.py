"""Everything for a pair of views: the correspondence, the rules' masks, and the feature grids."""

from __future__ import annotations

import warnings
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
"""Largest distance beyond [0, 1] that a picture may reach: cubic resampling overshoots an edge by a
tenth.
"""


@dataclass(frozen=True, eq=False)
class WarpedView:
    """One target view seen from one source: the correspondence at image size and the mask.

    Args:
        settings: the choices it was made with.
        correspondence: correspondence of the H x W target image.
        mask: (H, W) bool, all rules together.
        rules: each rule's own (H, W) mask, by name, in the order they were applied. ``defined`` is
            always among them.
        target, source: the surfaces it was made from; ``source`` is None where no rule needed it.
        backend: who computes the feature grids, see :func:`warp_surfaces`.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import Surface, warp_surfaces
        >>> camera = Camera(np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(4), 8, 8)
        >>> wall = Surface(np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
        >>> view = warp_surfaces(camera, camera, wall, wall)
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
    # Not of ``init``, so that dataclasses.replace begins anew: the layers have the mask.
    _at: dict[tuple[int, ...], FeatureWarp] = field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        rules = ", ".join(f"{name} {share_of(rule)}" for name, rule in self.rules.items())
        sizes = self.correspondence.sizes
        return f"WarpedView({sizes}, mask {share_of(self.mask)}; rules: {rules})"

    def with_mask(self, mask: Tensor) -> WarpedView:
        """This warp with another mask, such as the exact one.

        Args:
            mask: (H, W) bool; pixels without a position in the source are left out of it.

        Example:
            >>> import numpy as np
            >>> from attnwarp import Camera
            >>> from attnwarp.warp import Surface, warp_surfaces
            >>> camera = Camera(np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(4), 8, 8)
            >>> wall = Surface(np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
            >>> view = warp_surfaces(camera, camera, wall, wall)
            >>> view.with_mask(torch.zeros(8, 8, dtype=torch.bool)).at((4, 4)).mask.any().item()
            False
        """
        return replace(self, mask=mask & self.correspondence.defined)

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

        Raises:
            ValueError: a size that is no pair of whole numbers from 1.
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
    """The correspondence and the mask of a pair of views, from depth maps: rendered, measured or
    exact.

    Args:
        source, target: the cameras.
        target_surface: surface that the target sees; its normals are needed by the normal tests,
            its image by the photometric. The rule ``opaque`` takes a view without alpha, target or
            source, for opaque everywhere.
        source_surface: surface that the source sees; needed by depth agreement (depth) and the
            photometric test (image).
        settings: which rules, and how. ``gaussian_filter``, ``depth`` and ``depth_statistic``
            concern the rendering of the surfaces and play no part here.
        target_segment: (H, W) bool, the part of the target that is edited; for settings with
            ``segment``.
        backend: "auto" computes with kernels (:mod:`attnwarp.warp.cpu`), "reference" with the
            definition in torch. Positions agree to 1e-6 px, masks but for a pixel within rounding
            of a rule's threshold.
        warn_empty: warn where no pixel of the target has a position in the source. A loop over
            views, some of which see nothing, turns it off.

    Raises:
        ValueError: a rule needs something that is not given, or what is given is read by no rule;
            the message names both. A picture or a segment of another size than its view's; a
            picture in 0 to 255.
        TypeError: an argument of another type.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import Surface, warp_surfaces
        >>> K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
        >>> shift = np.eye(4)
        >>> shift[0, 3] = 0.5  # the source stands to the left: 8 * 0.5 / 2 px at depth 2
        >>> target, source = Camera(K, np.eye(4), 8, 8), Camera(K, shift, 8, 8)
        >>> wall = Surface(np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
        >>> view = warp_surfaces(source, target, wall, wall)
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
    """The correspondence and the mask of a pair of views, from splats.

    Renders what the settings' rules ask for and hands it to :func:`warp_surfaces`. The Gaussian
    filter concerns the target's render; the source's own depth is that of the whole model.

    Args:
        gaussians: the model before the edit. Hand in the current one to reproduce codes that warp
            with it.
        source, target: the cameras.
        settings: which rules, and how.
        source_image, target_image: (H, W, 3) sRGB images before the edit, for the photometric test,
            the target's of its camera's size and the source's of its aspect ratio;
            by default the renders of ``gaussians``. For settings with ``photometric``.
        target_segment: (H, W) bool, the part of the target that is edited; for settings with
            ``segment``.
        source_surface: the source's render if it is at hand, :func:`render_surface`; one source
            serves many targets.
        near: as in :func:`render_surface`.
        backend: name of the renderer, as in :func:`attnwarp.render.render`.
        warp_backend, warn_empty: arguments of the warp, as in :func:`warp_surfaces`.

    Raises:
        ValueError, TypeError: as in :func:`warp_surfaces`.

    Example:
        >>> import torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp.warp import warp_view
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=16, height=16, fov_y=40, up=[0, 1, 0])
        >>> camera = Camera.look_at([0, 0, 3], [0, 0, 0], **view)
        >>> view = warp_view(disc, camera, camera)
        >>> view.mask[8, 8].item(), view.at((4, 4)).mask.shape
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
    # Where a filter left splats out, it may be what emptied the view.
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
    """Depth, normals, alpha and colour of splats, rendered as ``settings`` demand.

    Args:
        gaussians: to render.
        camera: camera of the rendered view; (H, W) is its size.
        settings: their ``depth``, ``depth_statistic`` and ``undefined_depth`` choose the depth. 3D
            splats have "peak" depth in place of "intersection".
        near: nothing nearer than this depth is seen, in scene units; a hundredth of the splats'
            median distance if left out.
        backend: name of :func:`attnwarp.render.render`.

    Returns:
        A surface of (H, W) tensors without gradients, on the CPU.

    Example:
        >>> import torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp.warp import render_surface
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=16, height=16, fov_y=40, up=[0, 1, 0])
        >>> camera = Camera.look_at([0, 0, 3], [0, 0, 0], **view)
        >>> surface = render_surface(disc, camera)
        >>> surface.depth.shape, round(float(surface.depth[8, 8]), 4)
        (torch.Size([16, 16]), 3.0)
    """
    from attnwarp.render import render

    depth = settings.depth
    how = "peak" if depth == "intersection" and gaussians.kind == "3d" else depth
    with torch.no_grad():
        plane = near_plane(gaussians, camera) if near is None else near
        seen = render(gaussians, camera, backend=backend, depth=how, near=plane)
    z = seen.depth if settings.depth_statistic == "expected" else seen.median_depth
    if settings.undefined_depth == "farthest":
        undefined = z.isnan()
        farthest = torch.where(undefined, -torch.inf, z).max()
        z = torch.where(undefined & farthest.isfinite(), farthest, z)  # none where nothing is seen
    return Surface(
        z.cpu(), seen.normal.cpu(), seen.alpha.cpu(), seen.color.cpu(), dict(seen.counters)
    )


def _check_pair(source: Camera, target: Camera, settings: WarpSettings) -> None:
    check.instance(source, Camera, "source", "attnwarp.Camera")
    check.instance(target, Camera, "target", "attnwarp.Camera")
    check.instance(settings, WarpSettings, "settings", "WarpSettings, such as PRESETS['corrected']")


def _check_pictures(source: Camera, target: Camera, parts: Mapping[str, Array]) -> None:
    """Check the pictures that rules read: of their views, in [0, 1]."""
    first, second = parts.get("source_image"), parts.get("target_image")
    if first is not None:
        check.shape(first, ("H", "W", "C"), "source_image")
        # The source's is read at positions, so at any resolution.
        size = (source.height, source.width)
        check.same_aspect(tuple(first.shape[:2]), size, "source_image", "its axes are (H, W, C)")
    if second is not None:
        channels = "C" if first is None else first.shape[2]
        check.shape(second, (target.height, target.width, channels), "target_image")
    for name, image in (("source_image", first), ("target_image", second)):
        if image is None:
            continue
        # A render's colours may exceed 1 here and there, resampling may overshoot either end.
        # Tensors of 8 bits have no mean of their own.
        # A copy of arrays, since torch reads neither flipped nor big-endian ones.
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
    # numpy's any: torch's reads a byte at a time.
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
    """Raise ValueError if something is given that no rule of the settings reads."""
    for name, value in given.items():
        if value is not None and name not in parts_read(settings):
            off = [rule.setting for rule in RULES if name in rule.parts and rule.setting]
            have = " and ".join(f"{field}={getattr(settings, field)!r}" for field in off)
            raise ValueError(
                f"{name}: the settings have {have} and do not read it; set {' or '.join(off)}, or"
                " leave it out"
            )


def _checked_segment(segment: Array, target: Camera) -> Tensor:
    """(H, W) bool on the CPU."""
    tensor = segment if isinstance(segment, Tensor) else torch.from_numpy(np.array(segment))
    check.shape(tensor, (target.height, target.width), "target_segment")
    if tensor.dtype != torch.bool:
        raise ValueError(
            f"target_segment: got {tensor.dtype}, expected bool; pass mask > 0.5 for a mask of"
            " shares, mask > 127 for one of 8 bits"
        )
    return tensor.cpu()


def near_plane(gaussians: Gaussians, camera: Camera) -> float:
    """A hundredth of the splats' median distance from the camera, in scene units.

    An absolute length would draw what hangs before the camera in a scene of large units, and
    nothing at all in one of small units.
    """
    if not len(gaussians):
        from attnwarp.render.constants import NEAR

        return NEAR
    offset = gaussians.means.new_tensor(camera.position - gaussians.origin)
    away = torch.linalg.vector_norm(gaussians.means.detach() - offset, dim=1)
    return float(away.median()) / 100
