"""Normal consistency of a CPU render by kernels: the value and its gradients in two passes.

In torch it is two dozen operations on images of three channels, a quarter of an iteration of a fit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.render._kernels import depth_normals
from attnwarp.render.threads import ranges, run_jobs, thread_count


def normal_consistency(
    depth: Tensor, alpha: Tensor, normal: Tensor, camera: Camera, rotation: Tensor
) -> Tensor:
    """Compute :func:`attnwarp.losses.normal_consistency` for float32 in the host's memory.

    Args:
        depth: (H, W) depth along the optical axis, NaN where undefined.
        alpha: (H, W).
        normal: (H, W, 3) weighted sum of the splats' normals, in world axes.
        camera: its camera.
        rotation: (3, 3) from world to camera. No gradient flows to it.
    """
    K = camera.K
    lens = depth_normals.Lens(
        *(float(value) for value in (K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2]))
    )
    turned = rotation.detach().to(torch.float32).reshape(9).contiguous().numpy()
    result: Tensor = _NormalConsistency.apply(depth, alpha, normal, lens, turned)
    return result


class _NormalConsistency(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        depth: Tensor,
        alpha: Tensor,
        normal: Tensor,
        lens: depth_normals.Lens,
        rotation: np.ndarray,
    ) -> Tensor:
        sums = np.empty(depth.shape[0])
        maps = _maps(depth, alpha, normal)
        run_jobs(
            depth_normals.disagreement,
            [(*rows, lens, rotation, maps, sums) for rows in _rows(depth)],
        )
        ctx.save_for_backward(depth, alpha, normal)
        ctx.lens, ctx.rotation = lens, rotation
        return depth.new_tensor(sums.sum() / max(1, depth.numel()))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        maps = _maps(*ctx.saved_tensors)
        pixels = max(1, maps.depth.size)
        share = np.float32(float(upstream) / pixels)
        d_depth, d_alpha, d_normal = (np.empty(part.shape, np.float32) for part in maps)
        to_neighbors = np.empty((4, *maps.depth.shape), np.float32)
        rows = _rows(ctx.saved_tensors[0])
        run_jobs(
            depth_normals.disagreement_backward,
            [
                (*r, ctx.lens, ctx.rotation, share, maps, d_alpha, d_normal, to_neighbors)
                for r in rows
            ],
        )
        run_jobs(depth_normals.gather, [(*r, to_neighbors, d_depth) for r in rows])
        return *map(torch.from_numpy, (d_depth, d_alpha, d_normal)), None, None


def _maps(*tensors: Tensor) -> depth_normals.Maps:
    return depth_normals.Maps(*(tensor.detach().contiguous().numpy() for tensor in tensors))


def _rows(depth: Tensor) -> list[tuple[int, int]]:
    height = depth.shape[0]
    return ranges(height, max(1, -(-height // (4 * thread_count()))))
