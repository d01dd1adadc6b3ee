"""Definition of every output, by brute force: each splat at each pixel in float64 torch, with
autograd.

No tiles, no boxes, no cut-offs except those of ``constants.py``. The formulas follow the papers
(ray-plane intersection, EWA projection), not the fast backend, so that agreement of the two is
meaningful. Only for small scenes and images: memory is splats x pixels.

Notation. c = R m + t is a splat's centre in camera axes, d = K^-1 (x, y, 1) the ray of a pixel with
d_z = 1, so that a depth z is the point z d. w_i = alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j),
front to back by c_z. Splats whose centre is not beyond the near plane, c_z <= near, are not drawn.

2D splats: the ray meets the plane at z = n.c / n.d in the splat's coordinates (u, v); rho = min(u^2
+ v^2, 2 |x - x_c|^2) and alpha = o exp(-rho / 2). The first term holds only where near <= z. Where
the second decides, z of the plane may lie anywhere: it is bounded to the splat's extent, c_z +-
3.33 sigma_z, and to near. Since |u, v| <= 3.33 wherever the first decides, the bound changes
nothing there and z is continuous.

3D splats: EWA, Sigma' = J Sigma_c J^T + 0.3 I with J at x/z clamped on each side of the image.
"peak" depth is where the 3D Gaussian is largest along the ray, z = d.P.c / d.P.d with P =
Sigma_c^-1, bounded to the splat's extent in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from attnwarp.render import constants, harmonics, order
from attnwarp.render.interface import Inputs, Outputs

Tensor = torch.Tensor


@dataclass(frozen=True)
class Thresholds:
    """Cut-offs of ``constants.py``. Tests shift them slightly to bracket decisions that rounding
    may change.
    """

    alpha_min: float = constants.ALPHA_MIN
    stop: float = constants.TRANSMITTANCE_STOP
    median: float = constants.MEDIAN_TRANSMITTANCE


def rotation_matrices(quats: Tensor) -> Tensor:
    """Convert (N, 4) quaternions wxyz of any length but zero to rotations, (N, 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=0).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


CHUNK = 1 << 22
"""Splat-pixel pairs held at once."""


def render(inputs: Inputs, thresholds: Thresholds | None = None, *, chunk: int = CHUNK) -> Outputs:
    """Render by brute force in float64; differentiable in every tensor of ``inputs``.

    Args:
        chunk: number of splat-pixel pairs held at once; rows of pixels are processed in groups of
            about this size.
    """
    return _render(inputs, thresholds or Thresholds(), chunk)[0]


def distortion_l1(inputs: Inputs, *, chunk: int = CHUNK) -> Tensor:
    """Compute sum_ij w_i w_j |z_i - z_j| at each pixel, (H, W), the loss of the 2DGS paper, in
    which every pair counts twice; differentiable.

    It takes each pixel's splats sorted by depth. ``distortion_ordered`` of a render equals it
    where the order of compositing is that of depth.
    """
    return _render(inputs, Thresholds(), chunk)[1]


def _render(inputs: Inputs, limits: Thresholds, chunk: int) -> tuple[Outputs, Tensor]:
    """Render; also the paper's distortion."""
    means, quats, scales = inputs.means.double(), inputs.quats.double(), inputs.scales.double()
    opacities, values, background = (
        inputs.opacities.double(),
        inputs.values.double(),
        inputs.background.double(),
    )
    K, pose, origin = inputs.K.double(), inputs.pose.double(), inputs.origin.double()
    R = pose[:3, :3]
    # The world's origin is moved to the splats' origin in float64 before any other operation.
    centers = means @ R.T + (R @ origin + pose[:3, 3])
    world_axes = rotation_matrices(quats)
    axes = R @ world_axes
    if inputs.harmonic:
        direction = torch.nn.functional.normalize(centers @ R, dim=-1)
        features = harmonics.color(values, direction)
    else:
        features = values
    axis = (
        torch.full((len(means),), 2, dtype=torch.int64)
        if inputs.kind == "2d"
        else scales.argmin(dim=-1)
    )
    pick = axis[:, None, None].expand(-1, 3, 1)
    facing = (axes.gather(2, pick)[..., 0] * centers).sum(-1)
    normals = world_axes.gather(2, pick)[..., 0] * torch.where(facing > 0, -1.0, 1.0)[:, None]

    content = [t.detach().numpy() for t in (means, scales, quats, opacities, values.flatten(1))]
    index = torch.from_numpy(
        order.front_to_back(centers[:, 2].detach().numpy().astype("float32"), content)
    )
    index = index[centers[index, 2] > inputs.near]
    splats = _Splats(
        centers[index],
        axes[index],
        scales[index],
        opacities[index],
        features[index],
        normals[index],
        inputs,
        K,
        limits,
    )

    rows_at_once = max(1, chunk // max(1, len(means) * inputs.width))
    parts = []
    for top in range(0, inputs.height, rows_at_once):
        bottom = min(inputs.height, top + rows_at_once)
        y, x = torch.meshgrid(
            torch.arange(top, bottom, dtype=torch.float64) + 0.5,
            torch.arange(inputs.width, dtype=torch.float64) + 0.5,
            indexing="ij",
        )
        parts.append(splats.composite(x.reshape(-1), y.reshape(-1)))
    merged = [torch.cat([part[k] for part in parts]) for k in range(7)]
    shape = (inputs.height, inputs.width)
    color, normal = merged[0].reshape(*shape, -1), merged[4].reshape(*shape, 3)
    alpha, depth, median, ordered, l1 = (merged[k].reshape(shape) for k in (1, 2, 3, 5, 6))
    color = color + (1 - alpha)[..., None] * background
    weight = torch.zeros(len(means), dtype=torch.float64).index_add(
        0, index, torch.stack([part[7] for part in parts]).sum(dim=0)
    )
    counters = {
        "splats": len(means),
        "pairs": len(means) * inputs.width * inputs.height,
        "contributing": sum(int(part[8]) for part in parts),
    }
    return Outputs(color, alpha, depth, median, normal, ordered, weight, counters), l1


@dataclass(frozen=True)
class _Splats:
    """Splats in compositing order, in camera axes."""

    centers: Tensor
    axes: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    normals: Tensor
    inputs: Inputs
    K: Tensor
    limits: Thresholds

    def composite(self, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """Composite per pixel colour over black, alpha, depth, median, normal, distortions
        (ordered, l1); also weight per splat, contributing pairs.
        """
        inputs, limits = self.inputs, self.limits
        rays = torch.stack(_unproject(x, y, self.K), dim=-1)
        raw, z = (self._disc if inputs.kind == "2d" else self._ellipsoid)(x, y, rays)
        drawn = raw >= limits.alpha_min
        alpha = torch.where(drawn, raw.clamp(max=constants.ALPHA_MAX), 0.0)
        before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[
            :, :-1
        ]
        alpha = torch.where(before > limits.stop, alpha, 0.0)
        drawn = alpha > 0
        w = alpha * before
        z = torch.where(drawn, z, 1.0)
        color = w @ self.features
        normal = w @ self.normals
        total = w.sum(dim=1)
        # The first splat drawn has w >= ALPHA_MIN: a pixel is either clearly covered or not covered
        # at all.
        covered = drawn.any(dim=1)
        safe = torch.where(covered, total, 1.0)
        nan = torch.full_like(total, torch.nan)
        depth = torch.where(covered, (w * z).sum(dim=1) / safe, nan)
        opens = drawn & (before > limits.median)
        if opens.shape[1]:
            last = opens.shape[1] - 1 - opens.flip(1).int().argmax(dim=1)
            median = torch.where(covered, z.gather(1, last[:, None])[:, 0], nan)
        else:
            median = nan
        gaps = _gaps(w, z)
        flat = gaps.detach().abs() <= constants.GAP_MIN * z.detach()
        ordered = 2 * (w * torch.where(flat, gaps.detach(), gaps).abs()).sum(dim=1)
        # By depth at the pixel, no pair is out of order. Depths that are equal in float32 stay in
        # compositing order: |z_i - z_j| has no slope there, and the sign of rounding is none.
        by_depth = z.detach().float().argsort(dim=1, stable=True)
        sorted_w = w.gather(1, by_depth)
        l1 = 2 * (sorted_w * _gaps(sorted_w, z.gather(1, by_depth))).sum(dim=1)
        return color, total, depth, median, normal, ordered, l1, w.sum(dim=0), drawn.sum()

    def _extent(self, variance_z: Tensor) -> tuple[Tensor, Tensor]:
        # Bounded from below: the slope of a square root at zero is infinite, and a disc may lie
        # exactly across the axis.
        reach = constants.EXTENT_SIGMAS * variance_z.clamp(min=1e-300).sqrt()
        z = self.centers[:, 2]
        return (z - reach).clamp(min=self.inputs.near), z + reach

    def _disc(self, x: Tensor, y: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        near, c = self.inputs.near, self.centers
        tu, tv, n = self.axes.unbind(-1)
        nc = (n * c).sum(-1)
        floor = constants.EDGE_ON * c.norm(dim=-1)
        tilted = torch.where(nc.abs() < floor, torch.where(nc < 0, -floor, floor), nc)
        # Tilting an edge-on plane leaves it through the centre, so n.d changes by as much as n.c
        # does.
        nd = rays @ n.T + (tilted - nc) / c[:, 2]
        # 1 / z is the linear quantity along a row of pixels; it passes through zero where the plane
        # is parallel to the ray.
        inverse = nd / tilted
        ahead = inverse > 0
        z = 1 / torch.where(ahead, inverse, 1.0)
        hit = z[..., None] * rays[:, None] - c
        u = (hit * tu).sum(-1) / self.scales[:, 0]
        v = (hit * tv).sum(-1) / self.scales[:, 1]
        meets = ahead & (z >= near)
        rho = torch.where(meets, u * u + v * v, torch.inf)
        xc, yc = _project(c, self.K)
        square = (x[:, None] - xc) ** 2 + (y[:, None] - yc) ** 2
        rho = torch.minimum(rho, square / constants.FILTER_SIGMA_2D**2)
        alpha = self.opacities * torch.exp(-0.5 * rho)
        if self.inputs.depth == "center":
            return alpha, c[:, 2].expand_as(alpha)
        spread = (self.scales[:, 0] * tu[:, 2]) ** 2 + (self.scales[:, 1] * tv[:, 2]) ** 2
        lo, hi = self._extent(spread)
        # On a disc parallel to the image lo = z = hi, but however little it is tilted, z lies
        # inside: the slope is that of z. minimum and maximum would mix it with the bounds'.
        bounded = torch.where(z < lo, lo, torch.where(z > hi, hi, z))
        return alpha, torch.where(ahead, bounded, hi.expand_as(z))

    def _ellipsoid(self, x: Tensor, y: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        inputs, c, K = self.inputs, self.centers, self.K
        depth = c[:, 2]
        half = self.axes * self.scales[:, None, :]
        sigma = half @ half.transpose(1, 2)
        limit = []
        for k, size in ((0, inputs.width), (1, inputs.height)):
            margin = constants.JACOBIAN_MARGIN * size / 2 / K[k, k]
            slope = c[:, k] / depth
            low, high = -K[k, 2] / K[k, k] - margin, (size - K[k, 2]) / K[k, k] + margin
            limit.append(torch.minimum(torch.maximum(slope, low), high))
        zero, inverse = torch.zeros_like(depth), 1 / depth
        J = torch.stack(
            [inverse, zero, -limit[0] * inverse, zero, inverse, -limit[1] * inverse], dim=-1
        ).reshape(-1, 2, 3)
        # The columns of M are the splat's axes in the picture, cov = M M^T. Sums of squares keep
        # their digits where S11 S22 - S12^2 of a needle loses all: with axes of 1e6 px and less
        # than one, the squares are 1e24 apart.
        M = K[:2, :2] @ J @ half
        blur = inputs.screen_filter
        minors = torch.linalg.cross(M[:, 0], M[:, 1])
        sharp = (minors**2).sum(-1)
        det = sharp + blur * (M**2).sum((-1, -2)) + blur**2
        opacity = self.opacities
        if inputs.antialiased:
            opacity = opacity * (sharp / det).clamp(min=constants.COMPENSATION_MIN).sqrt()
        xc, yc = _project(c, K)
        dx, dy = x[:, None] - xc, y[:, None] - yc
        across = dx[..., None] * M[:, 1] - dy[..., None] * M[:, 0]
        power = ((across**2).sum(-1) + blur * (dx * dx + dy * dy)) / det
        alpha = opacity * torch.exp(-0.5 * power)
        if inputs.depth == "center":
            return alpha, depth.expand_as(alpha)
        # d.P.c and d.P.d in the splat's axes and scales: P itself spans the scales squared.
        ray = torch.einsum("pi,nij->pnj", rays, self.axes) / self.scales
        center = torch.einsum("ni,nij->nj", c, self.axes) / self.scales
        along, across = (ray * center).sum(-1), (ray * ray).sum(-1)
        lo, hi = self._extent(sigma[:, 2, 2])
        return alpha, torch.minimum(torch.maximum(along / across, lo), hi)


def _gaps(w: Tensor, z: Tensor) -> Tensor:
    """Compute sum_{j<i} w_j (z_i - z_j) for each splat i."""
    return z * _before(w) - _before(w * z)


def _before(values: Tensor) -> Tensor:
    """Compute the exclusive sum over the splats in front."""
    return torch.cumsum(values, dim=1) - values


def _unproject(x: Tensor, y: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    dy = (y - K[1, 2]) / K[1, 1]
    dx = (x - K[0, 2] - K[0, 1] * dy) / K[0, 0]
    return dx, dy, torch.ones_like(dx)


def _project(c: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    z = c[:, 2]
    return (K[0, 0] * c[:, 0] + K[0, 1] * c[:, 1]) / z + K[0, 2], K[1, 1] * c[:, 1] / z + K[1, 2]
