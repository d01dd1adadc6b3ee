"""Public interface: check every argument, choose a backend, and name the outputs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch

from attnwarp import check
from attnwarp.camera import ORTHONORMAL_TOLERANCE, Camera
from attnwarp.devices import on_cpu_unless_named
from attnwarp.gaussians import Gaussians
from attnwarp.render import constants
from attnwarp.render.interface import Inputs, Outputs

Tensor = torch.Tensor

BACKENDS = ("auto", "cpu", "reference", "gpu")
DEPTHS = {"2d": ("intersection", "center"), "3d": ("center", "peak")}

WORK: Counter[str] = Counter()
"""Work of this process so far: splat-pixel ``pairs`` of all renders."""


@dataclass(eq=False)
class Render:
    """Rendered picture of splats. Every output has the same meaning for all kinds, backends and
    depth modes.

    Per pixel, w_i = alpha_i prod_{j<i} (1 - alpha_j) is the share of splat i, z_i its depth.

    Attributes:
        color: (H, W, C) sum w_i c_i + (1 - alpha) background: sRGB colour, or the features passed
            in.
        alpha: (H, W) sum w_i, coverage in [0, 1].
        depth: (H, W) expected depth sum w_i z_i / sum w_i along the optical axis, in scene units;
            NaN where nothing was drawn. Background and sky (``Gaussians.far``) have no
            influence, here and in every output but ``color`` and ``weight``.
        median_depth: (H, W) depth of the last splat drawn while the transmittance before it is
            above 1/2; NaN where nothing was drawn. If alpha stays below 1/2 it is the last
            splat's.
        normal: (H, W, 3) sum w_i n_i in world axes, each n_i turned to face the camera; its length
            is at most alpha.
        distortion_ordered: (H, W) 2 sum_i w_i |sum_{j<i} w_j (z_i - z_j)| in compositing order:
            sum_ij w_i w_j |z_i - z_j| (the 2DGS paper) where depth grows along that order, less
            elsewhere, and 0 only where that sum is 0. Scene units.
        weight: (N,) sum over pixels of w_i: a splat's contribution to the picture; 0 means
            invisible. A sky splat's is that without the scene before it.
        counters: amounts of work. "splats": of the model. "visible": possibly visible splats.
            "tiles", "tile_pairs": splats over tiles, of 16 x 16 pixels on the CPU and 8 x 8 on a
            GPU. "pairs": splats over pixels whose intersection was computed. "composited": those
            pairs in a 4 x 4 square that the splat draws to. "contributing": pairs drawn. Backend
            "reference" has "splats", "pairs" and "contributing"; "gpu" has the first four, which
            need no synchronisation.
        camera: camera with the pose used.
        depth_mode, backend: requested depth mode, and the backend that rendered.

    Example:
        A disc that faces the camera: its normals point back at it, and beside it nothing is drawn.

        >>> from attnwarp.render import render
        >>> from attnwarp.trial import disc, view
        >>> seen = render(disc(0.2), view(side=65))
        >>> bool(seen.valid[32, 32]), bool(seen.valid[0, 0]), bool(seen.depth[0, 0].isnan())
        (True, False, True)
        >>> [round(float(n), 2) + 0.0 for n in seen.normal[32, 32]]
        [0.0, 0.0, 0.99]
        >>> round(float(seen.weight[0] / seen.alpha.sum()), 4)
        1.0
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor
    normal: Tensor
    distortion_ordered: Tensor
    weight: Tensor
    counters: dict[str, int] = field(repr=False)
    camera: Camera = field(repr=False)
    depth_mode: str
    backend: str
    _pose: Tensor = field(repr=False)

    @cached_property
    def valid(self) -> Tensor:
        """Mask of drawn pixels, (H, W) bool, for which depth, median_depth and the direction of
        normal are defined.
        """
        return ~torch.isnan(self.depth.detach())

    @cached_property
    def normal_from_depth(self) -> Tensor:
        """Unit normals, (H, W, 3), in world axes and facing the camera, of the surface described by
        ``depth``.

        The cross product of central differences of the unprojected points (2DGS); NaN on the
        image's border and if one of the four neighbours is undefined. Computed on first use,
        differentiable in ``depth`` and the pose.
        """
        return normal_from_depth(self.depth, self.camera, self._pose)


@on_cpu_unless_named
def normal_from_depth(
    depth: check.Array, camera: Camera, pose: check.Array | None = None
) -> Tensor:
    """Compute unit normals (H, W, 3) in world axes, facing the camera, of a depth map; see
    :class:`Render`.

    Args:
        depth: (H, W) depth along the optical axis, NaN where undefined.
        camera: camera of the depth map.
        pose: (4, 4) world-to-camera transform that replaces the camera's.

    Example:
        >>> import torch
        >>> from attnwarp.render import normal_from_depth
        >>> from attnwarp.trial import wall
        >>> _, camera, seen = wall()
        >>> normal = normal_from_depth(torch.full((8, 8), 2.0), camera)  # a wall that faces it
        >>> (normal[4, 4] + 0.0).tolist(), bool(normal[0, 0].isnan().all())
        ([0.0, 0.0, -1.0], True)
    """
    depth = check.tensor(depth, "depth")
    pose = None if pose is None else check.tensor(pose, "pose")
    check.shape(depth, (camera.height, camera.width), "depth")
    rays = torch.as_tensor(camera.directions(), dtype=depth.dtype, device=depth.device)
    defined = torch.isfinite(depth)
    points = rays * torch.where(defined, depth, 1.0)[..., None]
    result = torch.full_like(points, torch.nan)
    if camera.width < 3 or camera.height < 3:
        return result
    around = (
        defined[1:-1, :-2]
        & defined[1:-1, 2:]
        & defined[:-2, 1:-1]
        & defined[2:, 1:-1]
        & defined[1:-1, 1:-1]
    )
    # x right, y down, z forward: for a surface that faces the camera, d/dy x d/dx points at it.
    across = torch.linalg.cross(
        points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2]
    )
    length = torch.where(around, (across * across).sum(-1), 1.0)
    around = around & (length > 0)
    unit = across / torch.where(around, length, 1.0).sqrt()[..., None]
    rotation = torch.tensor(camera.world_to_camera) if pose is None else pose
    world = unit @ rotation[:3, :3].to(depth)
    inner = torch.where(around[..., None], world, torch.nan)
    return torch.nn.functional.pad(inner, (0, 0, 1, 1, 1, 1), value=torch.nan)


@on_cpu_unless_named
def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    backend: str = "auto",
    depth: str | None = None,
    background: check.Array | Sequence[float] | None = None,
    features: check.Array | None = None,
    sh_degree: int | None = None,
    near: float = constants.NEAR,
    antialiased: bool | None = None,
    pose: check.Array | None = None,
) -> Render:
    """Render Gaussian splats: colour, coverage, depth, normals, distortion; differentiable.

    Gradients reach every tensor that requires them: means, quats, scales, opacities, sh (or
    ``features``), ``pose`` and ``background``. They come from every output except
    ``Render.counters`` and the mask ``valid``.

    Args:
        gaussians: N splats of kind "2d" (2DGS) or "3d" (3DGS), float32 or float64.
        camera: camera of the view; H x W pixels.
        backend: "cpu" is numba, float32 with a float64 projection. "reference" is brute force in
            float64, for small scenes. "gpu" is NVIDIA Warp, float32 with a float64 projection, on
            the splats' GPU; see :mod:`attnwarp.render.gpu`. "auto" is "gpu" for splats on a GPU and
            "cpu" otherwise.
        depth: definition of a splat's z at a pixel. "2d": "intersection" of ray and disc (default)
            or "center". "3d": "center" (default) or "peak", where the Gaussian is largest along
            the ray.
        background: (C,) colour behind everything; black if omitted.
        features: (N, C) values rendered instead of the spherical harmonics' colour; the sky has
            none.
        sh_degree: highest degree of the harmonics used.
        near: near-plane depth, in scene units. 2D splats are cut per pixel, 3D splats as a unit by
            their centre. Scale it with the scene.
        antialiased: True compensates the opacity of 3D splats for the screen filter. Default: the
            Gaussians' setting.
        pose: (4, 4) world-to-camera transform that replaces the camera's; may require gradients.

    Returns:
        :class:`Render`, float32 from "cpu" and "gpu", float64 from "reference".

    Raises:
        ValueError: an argument is out of range or has a wrong shape; the message names it and the
            expectation. Also backend "gpu" without Warp (:class:`attnwarp.errors.InputError`).
        TypeError: an argument has a wrong type; the message names it.

    Example:
        >>> from attnwarp.render import render
        >>> from attnwarp.trial import disc, view
        >>> seen = render(disc(0.2), view(side=65))
        >>> seen.color.shape
        torch.Size([65, 65, 3])
        >>> [round(float(c), 2) for c in seen.color[32, 32]]
        [0.5, 0.5, 0.5]
        >>> round(float(seen.depth[32, 32]), 4)
        3.0
    """
    check.instance(gaussians, Gaussians, "gaussians", "attnwarp.Gaussians")
    check.instance(camera, Camera, "camera", "attnwarp.Camera")
    check.one_of(backend, BACKENDS, "backend")
    given: dict[str, Any] = {
        "depth": depth,
        "background": background,
        "features": features,
        "sh_degree": sh_degree,
        "near": near,
        "antialiased": antialiased,
        "pose": pose,
    }
    if math.isfinite(gaussians.far):
        return _before_sky(gaussians, camera, {"backend": backend, **given})
    chosen = ("gpu" if gaussians.means.is_cuda else "cpu") if backend == "auto" else backend
    inputs = _prepare(gaussians, camera, **given, on_cpu=chosen != "gpu")
    # A backend is imported on first use, since numba and Warp are slow to import.
    if chosen == "cpu":
        from attnwarp.render import cpu

        outputs = cpu.render(inputs)
    elif chosen == "reference":
        from attnwarp.render import reference

        outputs = reference.render(inputs)
    else:
        from attnwarp.render import gpu

        outputs = gpu.render(inputs)
    WORK["pairs"] += outputs.counters.get("pairs", 0)
    return _result(outputs, inputs, camera, pose, chosen)


def _before_sky(gaussians: Gaussians, camera: Camera, given: dict[str, Any]) -> Render:
    """Render the splats within ``gaussians.far`` of the camera, over a picture of those beyond."""
    moved = _checked_pose(given["pose"], camera).detach().numpy()
    eye = torch.as_tensor(-moved[:3, :3].T @ moved[:3, 3] - gaussians.origin)
    sky = (gaussians.means.detach() - eye.to(gaussians.means)).norm(dim=1) > gaussians.far
    plain, index = gaussians.unchecked(far=math.inf), torch.nonzero(sky)[:, 0]
    # Without opacity rather than left out, which would copy the scene.
    scene = plain.unchecked(opacities=torch.where(sky, 0.0, plain.opacities))
    if given["features"] is not None:
        return render(scene, camera, **given)
    behind = render(plain.select(index), camera, **given)
    view = render(scene, camera, **{**given, "background": None})
    view.weight = view.weight.index_add(0, index, behind.weight)
    view.color = view.color + (1 - view.alpha)[..., None] * behind.color
    counts = {name: n + behind.counters[name] for name, n in view.counters.items()}
    view.counters = {**counts, "splats": len(gaussians)}
    return view


def _result(
    outputs: Outputs, inputs: Inputs, camera: Camera, pose: check.Array | None, backend: str
) -> Render:
    used = camera
    if pose is not None:
        used = Camera(
            camera.K, inputs.pose.detach().cpu().numpy(), camera.width, camera.height, camera.name
        )
    values = {name: getattr(outputs, name) for name in Outputs.__dataclass_fields__}
    return Render(
        **values,
        camera=used,
        depth_mode=inputs.depth,
        backend=backend,
        _pose=inputs.pose,
    )


def _prepare(
    gaussians: Gaussians,
    camera: Camera,
    depth: str | None,
    background: check.Array | Sequence[float] | None,
    features: check.Array | None,
    sh_degree: int | None,
    near: float,
    antialiased: bool | None,
    pose: check.Array | None,
    *,
    on_cpu: bool,
) -> Inputs:
    kind = gaussians.kind
    device = gaussians.means.device
    if on_cpu and device.type != "cpu":
        raise ValueError(
            f"gaussians: lie on {device}, but this backend renders on the CPU; use backend 'gpu',"
            " or gaussians.to(device='cpu')"
        )
    mode = DEPTHS[kind][0] if depth is None else depth
    if kind == "3d" and mode == "intersection":
        raise ValueError(
            "depth: 'intersection' needs flat splats; for kind '3d' use 'peak', the maximum along"
            " the ray"
        )
    if kind == "2d" and mode == "peak":
        raise ValueError(
            "depth: 'peak' is for kind '3d'; a 2D splat has an 'intersection' with the ray"
        )
    check.one_of(mode, DEPTHS[kind], "depth")
    if not (np.isfinite(near) and near > 0):
        raise ValueError(f"near: got {near}, expected a positive depth in scene units")
    if antialiased and kind == "2d":
        raise ValueError(
            "antialiased: applies to kind '3d' only; 2D splats have a screen filter instead"
        )
    if features is not None:
        if sh_degree is not None:
            raise ValueError(
                "sh_degree: has no meaning beside features, which replace the spherical harmonics"
            )
        features = check.tensor(features, "features")
        check.shape(features, (len(gaussians), "C"), "features")
        if features.shape[1] < 1:
            raise ValueError("features: got 0 channels, expected at least 1")
        _floating(features, "features", device)
        check.finite(features, "features")
        values = features
    else:
        values = gaussians.sh
        if sh_degree is not None:
            if not 0 <= sh_degree <= gaussians.sh_degree:
                raise ValueError(
                    f"sh_degree: got {sh_degree}, expected 0 to {gaussians.sh_degree}, the splats'"
                    " degree"
                )
            if sh_degree < gaussians.sh_degree:  # a slice's gradient is another tensor of zeros
                values = values[:, : (sh_degree + 1) ** 2]
    channels = 3 if features is None else features.shape[1]
    if background is None:
        behind = torch.zeros(channels, dtype=torch.float32, device=device)
    else:
        behind = _as_tensor(background, channels, device)
        if not behind.is_floating_point() and not behind.requires_grad:
            behind = behind.float()
        check.shape(behind, (channels,), "background")
        _floating(behind, "background", device)
        check.finite(behind, "background")
    return Inputs(
        kind=kind,
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        values=values,
        harmonic=features is None,
        origin=torch.from_numpy(gaussians.origin),
        K=torch.tensor(camera.K),
        pose=_checked_pose(pose, camera),
        width=camera.width,
        height=camera.height,
        background=behind,
        depth=mode,
        near=float(near),
        antialiased=kind == "3d"
        and (gaussians.antialiased if antialiased is None else bool(antialiased)),
        screen_filter=gaussians.screen_filter,
    )


def _as_tensor(
    background: check.Array | Sequence[float], channels: int, device: torch.device
) -> Tensor:
    if isinstance(background, Tensor):
        return background
    own = None if isinstance(background, np.ndarray) else torch.float32
    try:
        return torch.tensor(background, dtype=own, device=device)
    except (TypeError, ValueError, RuntimeError):  # a word, an object; rows of unequal length
        raise TypeError(
            f"background: got {background!r}, expected a tensor or a sequence of {channels} numbers"
        ) from None


def _floating(tensor: Tensor, name: str, device: torch.device) -> None:
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name}: got {tensor.dtype}, expected float32 or float64")
    if tensor.device != device:
        raise ValueError(f"{name}: lies on {tensor.device}, the splats on {device}")


def _checked_pose(pose: check.Array | None, camera: Camera) -> Tensor:
    if pose is None:
        return torch.tensor(camera.world_to_camera)
    pose = check.tensor(pose, "pose")
    check.shape(pose, (4, 4), "pose")
    if pose.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"pose: got {pose.dtype}, expected float32 or float64")
    check.finite(pose, "pose")
    values = pose.detach().double().cpu()
    if not torch.equal(values[3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)):
        raise ValueError(f"pose: got last row {values[3].tolist()}, expected [0, 0, 0, 1]")
    error = float(
        (values[:3, :3] @ values[:3, :3].T - torch.eye(3, dtype=torch.float64)).abs().max()
    )
    if error > ORTHONORMAL_TOLERANCE or torch.linalg.det(values[:3, :3]) < 0:
        raise ValueError(
            f"pose: its rotation is mirrored or not orthonormal, max |R R^T - I| = {error:.3g} "
            f"(allowed {ORTHONORMAL_TOLERANCE:g})"
        )
    return pose.double().cpu()
