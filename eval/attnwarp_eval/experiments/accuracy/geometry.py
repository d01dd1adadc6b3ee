"""Error of depth and visibility against a brute-force test of every triangle in float64."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.numba_cache import CACHE
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.cost import in_turn
from attnwarp_eval.experiments.accuracy.panel import Contestant, Panel
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Box, Mesh

Array = npt.NDArray[np.float64]

WRONG = 1e-3
"""Relative errors of depth above this mean another surface; they are counted separately."""


@numba.njit(cache=CACHE, nogil=True, error_model="numpy")
def every_triangle(origins: Array, directions: Array, corners: Array, limit: Array) -> Array:
    """First hit of each ray with any of the triangles, all tested in float64 (Moeller &
    Trumbore 1997).

    Args:
        origins, directions: (N, 3); directions of any length, t counts in units of it.
        corners: (T, 3, 3).
        limit: (N,) upper limit of hits.

    Returns:
        (N,) t, infinity where nothing is hit before ``limit``.
    """
    out = np.full(origins.shape[0], np.inf)
    for j in range(corners.shape[0]):
        ax, ay, az = corners[j, 0]
        ux, uy, uz = corners[j, 1, 0] - ax, corners[j, 1, 1] - ay, corners[j, 1, 2] - az
        vx, vy, vz = corners[j, 2, 0] - ax, corners[j, 2, 1] - ay, corners[j, 2, 2] - az
        for i in range(origins.shape[0]):
            dx, dy, dz = directions[i]
            px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
            determinant = ux * px + uy * py + uz * pz
            if determinant == 0:
                continue
            sx, sy, sz = origins[i, 0] - ax, origins[i, 1] - ay, origins[i, 2] - az
            b = (sx * px + sy * py + sz * pz) / determinant
            if b < 0 or b > 1:
                continue
            qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
            c = (dx * qx + dy * qy + dz * qz) / determinant
            if c < 0 or b + c > 1:
                continue
            t = (vx * qx + vy * qy + vz * qz) / determinant
            if 0 < t < out[i] and t < limit[i]:
                out[i] = t
    return out


def triangles(scene: Scene) -> list[Mesh]:
    """The scene's triangles only: spheres and rectangles need no refinement."""
    meshes = [shape.mesh() if isinstance(shape, Box) else shape for shape in scene.shapes()]
    meshed = [shape for shape in meshes if isinstance(shape, Mesh)]
    if not meshed:
        raise InputError(
            f"scene {scene.name}: it has no triangles, so that nothing is refined; take one with a"
            " mesh"
        )
    return meshed


def depth(
    scene: Scene,
    *,
    size: int = 512,
    rays: int = 500,
    rounds: int = 9,
    report: Reporter = SILENT,
) -> Panel:
    """Error of depth for Open3D's hit (float32) and for the hit refined on its triangle's plane in
    float64.

    Args:
        size: size of the traced square image.
        rays: number of pixels compared with every triangle in float64.
    """
    from attnwarp_eval._open3d import open3d
    from attnwarp_eval.truth.raycast import Geometry

    class Unrefined(Geometry):
        """Open3D's unrefined hits, in the recentred and rescaled world."""

        refinement_limit = 0.0

    meshes = triangles(scene)
    camera = scene.with_size(size, size).source
    refined, unrefined = Geometry(meshes), Unrefined(meshes)
    o3d = open3d()
    raw = o3d.t.geometry.RaycastingScene(nthreads=0)
    for mesh in meshes:
        raw.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)),
            o3d.core.Tensor(mesh.faces.astype(np.uint32)),
        )

    def unmoved(_: int) -> Array:
        directions = camera.directions() @ camera.rotation
        origins = np.broadcast_to(camera.position, directions.shape)
        packed = np.concatenate([origins, directions], axis=-1, dtype=np.float32)
        t: Array = raw.cast_rays(o3d.core.Tensor(packed))["t_hit"].numpy().astype(np.float64)
        return np.where(np.isfinite(t), t, np.nan)

    def traced(geometry: Geometry) -> Callable[[int], Array]:
        def work(_: int) -> Array:
            geometry.forget()
            return geometry.trace(camera).depth

        return work

    count = sum(len(mesh.faces) for mesh in meshes)
    report.step(0, 0, f"{scene.name}: {count} triangles against {rays} rays in float64")
    valid = np.flatnonzero(refined.trace(camera).valid.ravel())
    chosen = np.sort(np.random.default_rng(0).choice(valid, min(rays, len(valid)), replace=False))
    directions = (camera.directions() @ camera.rotation).reshape(-1, 3)[chosen]
    # Relative to the camera, so that its position costs no precision.
    corners = np.concatenate([(m.vertices - camera.position)[m.faces] for m in meshes])
    limit = np.full(len(chosen), np.inf)
    exact = every_triangle(
        np.zeros_like(directions), np.ascontiguousarray(directions), corners, limit
    )

    report.step(0, 0, f"{scene.name}: depth at {size} x {size}, {rounds} rounds")
    works = [traced(refined), traced(unrefined), unmoved]
    names = ["refined in float64", "float32 hit, recentred", "float32 hit, world coordinates"]
    turns = in_turn(works, rounds)
    out = []
    for name, got, took in zip(names, turns.results, turns.seconds, strict=True):
        with np.errstate(invalid="ignore"):
            relative = np.abs(got[0].ravel()[chosen] / exact - 1)
        wrong = ~(relative < WRONG)
        right = relative[~wrong] if (~wrong).any() else np.array([np.nan])
        worst, half = float(right.max()), float(np.median(right))
        p99 = float(np.quantile(right, 0.99))
        more = {"median": half, "p99": p99, "wrong": float(wrong.mean())}
        out.append(Contestant(name, (worst, worst, worst), tuple(took), more))
    return Panel(
        "depth", scene.name, "largest relative error of depth", tuple(out), tuple(turns.again)
    )
