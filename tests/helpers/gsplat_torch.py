"""gsplat's own torch reference, run whole on a CPU: an independent judge.

gsplat enumerates splat-pixel pairs in CUDA and composites with nerfacc; both are supplied here: the
pairs by brute force over each splat's box, nerfacc's two functions by a cumulative sum of
logarithms and an index_add. Projection, opacity, harmonics, colour and normals are gsplat's,
unchanged; gradients reach the splats through its own functions.

What gsplat's kernels leave out is drawn here, unless asked for: ``true_center``, ``box`` and
``stop`` of :func:`render`.
"""

from __future__ import annotations

import itertools
import os
import sys
import types
from dataclasses import dataclass

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import constants

Tensor = torch.Tensor

TILE = 16
"""Edge of gsplat's tiles in pixels: a splat is drawn in whole tiles."""

STOP = 1e-4
"""gsplat's rays end before the splat that would bring their transmittance to or below this."""


@dataclass(frozen=True)
class Judged:
    """gsplat's picture: (H, W, 3) colour over black, (H, W) alpha, (H, W, 3) normals in world axes
    (2D only), (H, W) expected depth of the centres in scene units (NaN where nothing was drawn;
    None if not asked for)."""

    color: Tensor
    alpha: Tensor
    normal: Tensor | None
    depth: Tensor | None


def _nerfacc() -> types.ModuleType:
    module = types.ModuleType("nerfacc")

    def render_weight_from_alpha(
        alphas: Tensor, ray_indices: Tensor, n_rays: int
    ) -> tuple[Tensor, Tensor]:
        logs = torch.log1p(-alphas.double())
        before = torch.cumsum(logs, 0) - logs
        first = torch.searchsorted(ray_indices, ray_indices)
        trans = torch.exp(before - before[first]).to(alphas.dtype)
        return alphas * trans, trans

    def accumulate_along_rays(
        weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int
    ) -> Tensor:
        source = weights[:, None] if values is None else weights[:, None] * values
        return torch.zeros(n_rays, source.shape[1], dtype=source.dtype).index_add(
            0, ray_indices, source
        )

    module.render_weight_from_alpha = render_weight_from_alpha  # type: ignore[attr-defined]
    module.accumulate_along_rays = accumulate_along_rays  # type: ignore[attr-defined]
    return module


def render(
    splats: Gaussians,
    camera: Camera,
    *,
    true_center: bool = True,
    box: bool = False,
    stop: bool = False,
    antialiased: bool = False,
    depth: bool = False,
    near: float = constants.NEAR,
) -> Judged:
    """Render with gsplat's torch functions, in the splats' own dtype.

    Args:
        true_center: 2D only: centre the screen filter on the projected centre, as here, in place of
            the middle of the splat's box, as in gsplat.
        box: draw a splat only in the tiles that its box of 3.33 sigma touches, as gsplat's kernels
            do.
        stop: leave out the splat that brings a ray's transmittance to 1e-4 and all behind it, as
            gsplat's kernels do.
        antialiased: 3D only.
        depth: composite the depth of the centres too.

    Raises:
        ImportError: gsplat is not installed.
    """
    # A folder that does not exist: gsplat must not find a compiler to build its CUDA code with.
    os.environ["CUDA_HOME"] = "/nonexistent/cuda"
    from gsplat.cuda._torch_impl import (
        _fully_fused_projection,
        _quat_scale_to_covar_preci,
        _spherical_harmonics,
        accumulate,
    )
    from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs, accumulate_2dgs

    dtype = splats.means.dtype
    height, width = camera.height, camera.width
    view = torch.tensor(camera.world_to_camera, dtype=dtype)[None]
    K = torch.tensor(camera.K, dtype=dtype)[None]
    means = splats.means + torch.tensor(splats.origin, dtype=dtype)
    position = torch.tensor(camera.position, dtype=dtype)
    # As gsplat's rasterization() makes colours of them.
    colors = (_spherical_harmonics(splats.sh_degree, means - position, splats.sh) + 0.5).clamp(
        min=0
    )
    opacities = splats.opacities
    installed = sys.modules.get("nerfacc")
    sys.modules["nerfacc"] = _nerfacc()
    try:
        if splats.kind == "3d":
            covariances, _ = _quat_scale_to_covar_preci(
                splats.quats, splats.scales, compute_preci=False
            )
            radii, means2d, depths, conics, factors = _fully_fused_projection(
                means,
                covariances,
                view,
                K,
                width,
                height,
                near_plane=near,
                calc_compensations=antialiased,
            )
            if antialiased:
                opacities = opacities * factors[0]
            table, boxes = conics, means2d
        else:
            scales = torch.cat([splats.scales, torch.ones_like(splats.scales[:, :1])], dim=1)
            radii, means2d, depths, table, normals = _fully_fused_projection_2dgs(
                means, splats.quats, scales, view, K, width, height, near_plane=near
            )
            boxes = means2d
            if true_center:
                means2d = table[..., :2, 2] / table[..., 2:, 2]
        limits = (
            torch.cat([boxes[0] - radii[0], boxes[0] + radii[0]], dim=-1).detach() / TILE
            if box
            else None
        )
        with torch.no_grad():
            ids, pixels = _pairs(
                splats,
                camera,
                means2d[0].detach(),
                depths[0].detach(),
                table[0].detach(),
                opacities.detach(),
                near,
                limits,
                stop,
            )
        images = torch.zeros_like(ids)
        if depth:
            colors = torch.cat([colors, depths[0][:, None]], dim=1)
        if splats.kind == "3d":
            picture, alpha = accumulate(
                means2d, table, opacities[None], colors[None], ids, pixels, images, width, height
            )
            normal = None
        else:
            picture, alpha, in_camera = accumulate_2dgs(
                means2d,
                table,
                opacities[None],
                colors[None],
                normals,
                ids,
                pixels,
                images,
                width,
                height,
            )
            normal = in_camera[0] @ view[0, :3, :3]
    finally:
        if installed is None:
            del sys.modules["nerfacc"]
        else:
            sys.modules["nerfacc"] = installed
    covered = alpha[0, ..., 0]
    expected = None
    if depth:
        drawn = covered > 0
        expected = torch.where(
            drawn, picture[0, ..., 3] / torch.where(drawn, covered, 1.0), torch.nan
        )
    return Judged(picture[0, ..., :3], covered, normal, expected)


def _pairs(
    splats: Gaussians,
    camera: Camera,
    centers: Tensor,
    depths: Tensor,
    table: Tensor,
    opacities: Tensor,
    near: float,
    boxes: Tensor | None,
    stop: bool,
) -> tuple[Tensor, Tensor]:
    """Splat and pixel of every pair with alpha >= 1/255, sorted by pixel, then depth; whole splats
    at a time.

    ``boxes`` (N, 4) are low and high x, y in tiles, outside of which a splat is left out.
    """
    height, width = camera.height, camera.width
    rank = torch.empty(len(depths), dtype=torch.long)
    rank[torch.argsort(depths, stable=True)] = torch.arange(len(depths))
    # A box that surely holds the footprint: the ball of 3.4 sigma around the mean, and the filters'
    # few pixels.
    reach = 3.4 * splats.scales.detach().amax(dim=-1)
    z = depths.clamp(min=near)
    slope = (
        torch.tensor(camera.directions([[0, 0], [width, height]]), dtype=depths.dtype).abs().amax()
    )
    spread = (reach / (z - reach).clamp(min=near) * (1 + slope) * float(camera.K.max()) + 4).numpy()
    xy = centers.numpy()
    low = np.clip(np.floor(xy - spread[:, None]), 0, [width, height]).astype(np.int64)
    high = np.clip(np.ceil(xy + spread[:, None]), 0, [width, height]).astype(np.int64)
    sides = np.where((depths.numpy() > near)[:, None], np.maximum(high - low, 0), 0)
    areas = sides.prod(axis=1)
    pieces: list[tuple[Tensor, Tensor, Tensor]] = []
    cuts = [0, *(np.flatnonzero(np.diff(np.cumsum(areas) // 4_000_000)) + 1), len(areas)]
    for begin, end in itertools.pairwise(cuts):
        ids = np.repeat(np.arange(begin, end), areas[begin:end])
        starts = np.repeat(np.cumsum(areas[begin:end]) - areas[begin:end], areas[begin:end])
        offset = np.arange(len(ids)) - starts
        x = low[ids, 0] + offset % np.maximum(sides[ids, 0], 1)
        y = low[ids, 1] + offset // np.maximum(sides[ids, 0], 1)
        i, px, py = torch.from_numpy(ids), torch.from_numpy(x + 0.5), torch.from_numpy(y + 0.5)
        dx, dy = px - centers[i, 0], py - centers[i, 1]
        if splats.kind == "3d":
            a, b, d = table[i].unbind(-1)
            rho = a * dx * dx + 2 * b * dx * dy + d * dy * dy
        else:
            M = table[i]
            cross = torch.linalg.cross(
                M[:, 2] * px[:, None] - M[:, 0], M[:, 2] * py[:, None] - M[:, 1]
            )
            uv = cross[:, :2] / cross[:, 2:]
            rho = torch.minimum((uv * uv).sum(-1), 2 * (dx * dx + dy * dy))
        alphas = opacities[i] * torch.exp(-0.5 * rho)
        keep = alphas >= constants.ALPHA_MIN
        if boxes is not None:
            low_x, low_y, high_x, high_y = boxes[i].unbind(-1)
            tile_x, tile_y = torch.from_numpy(x // TILE), torch.from_numpy(y // TILE)
            keep &= (tile_x >= low_x.floor()) & (tile_x < high_x.ceil())
            keep &= (tile_y >= low_y.floor()) & (tile_y < high_y.ceil())
        pieces.append((i[keep], torch.from_numpy(y * width + x)[keep], alphas[keep]))
    ids_all = torch.cat([f[0] for f in pieces])
    pixels = torch.cat([f[1] for f in pieces])
    order = torch.argsort(pixels * len(depths) + rank[ids_all])
    ids_all, pixels = ids_all[order], pixels[order]
    if stop:
        logs = torch.log1p(-torch.cat([f[2] for f in pieces])[order].clamp(max=0.999).double())
        along = torch.cumsum(logs, 0)
        first = torch.searchsorted(pixels, pixels)
        # What is left of the light after each: it only falls along a ray, so all behind the first
        # are left out too.
        goes_on = torch.exp(along - (along - logs)[first]) > STOP
        ids_all, pixels = ids_all[goes_on], pixels[goes_on]
    return ids_all, pixels
