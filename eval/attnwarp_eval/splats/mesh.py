"""A mesh of depth maps, fused as the authors of 2DGS fuse theirs, and points spread over it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval._open3d import open3d

Array = npt.NDArray[np.float64]


TRUNCATION = 5.0
"""Voxels from a surface to where its signed distance is cut, as in 2DGS."""


def fused_mesh(depths: Sequence[Any], cameras: Sequence[Camera], *, voxel: float) -> Any:
    """Triangle mesh of a truncated signed distance function (Curless & Levoy 1996), by Open3D.

    Args:
        depths: (H, W) each, along the optical axis; NaN, infinite or not positive is no surface.
        cameras: one a depth map, without skew.
        voxel: edge of a voxel, in the scene's unit.

    Returns:
        ``open3d.geometry.TriangleMesh`` in world coordinates; empty where no depth is defined.

    Example:
        >>> import numpy as np
        >>> camera = Camera(np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]), np.eye(4), 32, 32)
        >>> mesh = fused_mesh([np.full((32, 32), 2.0)], [camera], voxel=0.1)
        >>> bool(np.allclose(np.asarray(mesh.vertices)[:, 2], 2, atol=1e-3))
        True
    """
    o3d = open3d()
    float32 = o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (float32, float32), ((1,), (1,)), voxel_size=voxel
    )
    for depth, camera in zip(depths, cameras, strict=True):
        z = np.asarray(depth, dtype=np.float32)
        z = np.where(np.isfinite(z) & (z > 0), z, np.float32(0))
        if not z.any():
            continue
        seen = camera.unproject(camera.pixel_centers()[z > 0], z[z > 0]).astype(np.float32)
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(seen))
        grid.integrate(
            grid.compute_unique_block_coordinates(cloud, trunc_voxel_multiplier=TRUNCATION),
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(z))),
            o3d.core.Tensor(camera.K.copy()),  # it truncates a position to its pixel: our K
            o3d.core.Tensor(camera.world_to_camera.copy()),
            depth_scale=1.0,
            depth_max=1.0 + float(z.max()),
            trunc_voxel_multiplier=TRUNCATION,
        )
    try:
        return grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    except RuntimeError as error:
        # Open3D refuses a grid without a block, and one whose surface crosses no edge.
        if not any(told in str(error) for told in ("keys should > 0", "Tensor has shape {0}")):
            raise
        return o3d.geometry.TriangleMesh()


def mesh_points(mesh: Any, spacing: float, *, seed: int = 0) -> tuple[Array, Array]:
    """Points drawn evenly over a mesh: one for each square of ``spacing``, and their normals.

    Args:
        mesh: ``open3d.geometry.TriangleMesh``.
        spacing: in the mesh's unit.
        seed: of the draw.

    Returns:
        (P, 3) positions and (P, 3) unit normals of their triangles; none of a mesh without area.

    Example:
        >>> from attnwarp_eval._open3d import open3d
        >>> points, normals = mesh_points(open3d().geometry.TriangleMesh.create_box(), 0.1)
        >>> points.shape, normals.shape
        ((600, 3), (600, 3))
    """
    o3d = open3d()
    count = round(mesh.get_surface_area() / spacing**2) if len(mesh.triangles) else 0
    if not count:
        return np.zeros((0, 3)), np.zeros((0, 3))
    o3d.utility.random.seed(seed)
    cloud = mesh.sample_points_uniformly(count, use_triangle_normal=True)
    return np.asarray(cloud.points).copy(), np.asarray(cloud.normals).copy()


def thinned(points: Array, spacing: float) -> npt.NDArray[np.int64]:
    """Indices of the first point in each cube of a grid.

    Args:
        points: (P, 3).
        spacing: edge of a cube.

    Example:
        >>> thinned(np.array([[0.1, 0, 0], [0.2, 0, 0], [1.1, 0, 0]]), 1.0).tolist()
        [0, 2]
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(np.asarray(points) / spacing).astype(np.int64)
    cells -= cells.min(0)
    cube = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1))
    return np.sort(np.unique(cube, return_index=True)[1])
