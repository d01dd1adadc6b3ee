"""Error of depth and visibility against every triangle of a scene, one by one in float64."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp_eval.cost import in_turn
from attnwarp_eval.experiments.accuracy.panel import Contestant, Panel
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Box, Mesh
from attnwarp_eval.twoview import Hits

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MAPS = (32, 128, 512)
"""Sizes of the depth maps whose test of visibility is held against rays."""

WRONG = 1e-3
"""Relative errors of depth above this are those of another surface; they are counted apart."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def every_triangle(origins: Array, directions: Array, corners: Array, limit: Array) -> Array:
    """First hit of each ray with any of the triangles, all of them tried in float64 (Moeller &
    Trumbore 1997).

    Args:
        origins, directions: (N, 3); directions of any length, t counts in units of it.
        corners: (T, 3, 3).
        limit: (N,) hits from here on do not count.

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
    """The scene's triangles alone: spheres and rectangles are closed forms, where there is nothing
    to refine.
    """
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
    tell: Callable[[str], None] = lambda _: None,
) -> Panel:
    """Error of depth with the hit as Open3D has it (float32) and refined on its triangle's plane in
    float64.

    Args:
        size: of the square image that is traced.
        rays: pixels held against every triangle in float64.
        rounds: of the timing.
        tell: told what is at work.
    """
    from attnwarp_eval._open3d import open3d
    from attnwarp_eval.truth.raycast import Geometry

    class Unrefined(Geometry):
        """Open3D's own hits, in the recentred and rescaled world."""

        def _refined(self, rough: Array, *_: Any) -> Array:
            return rough

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

    tell(
        f"{scene.name}: {sum(len(m.faces) for m in meshes)} triangles against {rays} rays in"
        " float64"
    )
    valid = np.flatnonzero(refined.trace(camera).valid.ravel())
    chosen = np.sort(np.random.default_rng(0).choice(valid, min(rays, len(valid)), replace=False))
    directions = (camera.directions() @ camera.rotation).reshape(-1, 3)[chosen]
    # Seen from the camera, so that its place takes no digits.
    corners = np.concatenate([(m.vertices - camera.position)[m.faces] for m in meshes])
    limit = np.full(len(chosen), np.inf)
    exact = every_triangle(
        np.zeros_like(directions), np.ascontiguousarray(directions), corners, limit
    )

    tell(f"{scene.name}: depth at {size} x {size}, {rounds} rounds")
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
        more = {
            "median": half,
            "p99": float(np.quantile(right, 0.99)),
            "wrong": float(wrong.mean()),
        }
        out.append(Contestant(name, (worst, worst, worst), tuple(took), more))
    return Panel(
        "depth", scene.name, "largest relative error of depth", tuple(out), tuple(turns.again)
    )


def visibility(
    scene: Scene,
    *,
    size: int = 512,
    points: int = 500,
    rounds: int = 5,
    maps: Sequence[int] = MAPS,
    tell: Callable[[str], None] = lambda _: None,
) -> Panel:
    """Whether surface points of the middle target are seen by the source: by rays, and by depth
    maps of the source.

    A point is asked about when it faces the source and falls inside its image. A depth map answers
    with its nearest pixel (visible when not more than 1 % behind it), or bilinearly in 1 / z (and
    then not where its four pixels spread by more than 2 %). What a ray from the source meets first,
    of all triangles in float64, is right.

    Args:
        size: of the target, whose every pixel is a point.
        points: how many of them are held against every triangle.
        rounds: of the timing, which covers all points and the making of the depth map.
        maps: sizes of the depth maps.
        tell: told what is at work.
    """
    from attnwarp_eval.truth.raycast import Geometry

    meshes = triangles(scene)
    geometry = Geometry(meshes)
    target = scene.with_size(size, size).targets[len(scene.targets) // 2]
    source = scene.with_size(size, size).source
    hits = geometry.trace(target)
    asked = _faces_and_falls_in(hits, source)
    points_asked, normal, primitive = (
        hits.point[asked],
        hits.normal[asked],
        hits.primitive_id[asked],
    )

    def by_rays(_: int) -> npt.NDArray[np.float64]:
        return geometry.visible_from(points_asked, normal, primitive, source).astype(np.float64)

    def by_map(pixels: int, bilinear: bool) -> Callable[[int], npt.NDArray[np.float64]]:
        camera = source.resize(pixels, pixels)

        def work(_: int) -> npt.NDArray[np.float64]:
            geometry.forget()
            return _seen_in_map(geometry.trace(camera).depth, camera, points_asked, bilinear)

        return work

    tell(
        f"{scene.name}: {sum(len(m.faces) for m in meshes)} triangles against {points} points in"
        " float64"
    )
    chosen = np.sort(
        np.random.default_rng(1).choice(
            len(points_asked), min(points, len(points_asked)), replace=False
        )
    )
    away = points_asked[chosen] - source.position
    corners = np.concatenate([(m.vertices - source.position)[m.faces] for m in meshes])
    # What lies within 1e-7 of the way before the point is its own surface, or one glued to it.
    first = every_triangle(
        np.zeros_like(away), np.ascontiguousarray(away), corners, np.full(len(away), 1 - 1e-7)
    )
    seen = ~np.isfinite(first)

    works: list[Callable[[int], Any]] = [by_rays]
    names = ["rays"]
    for pixels in maps:
        for bilinear in (False, True):
            works.append(by_map(pixels, bilinear))
            names.append(
                f"depth map {pixels}, {'bilinear in 1/z, 2 %' if bilinear else 'nearest, 1 %'}"
            )
    tell(f"{scene.name}: visibility of {len(points_asked)} points, {rounds} rounds")
    turns = in_turn(works, rounds)
    out = []
    for name, got, took in zip(names, turns.results, turns.seconds, strict=True):
        answer = got[0][chosen]
        right, answered = int((answer == seen).sum()), np.isfinite(answer)
        wrong = int((answer[answered] != seen[answered]).sum())
        more = {
            "wrong": wrong / len(seen),
            "unanswered": float(1 - answered.mean()),
            "points": float(len(seen)),
        }
        out.append(Contestant(name, _share(len(seen) - right, len(seen)), tuple(took), more))
    return Panel(
        "visibility",
        scene.name,
        "share of points not labelled rightly",
        tuple(out),
        tuple(turns.again),
    )


def _share(count: int, total: int) -> tuple[float, float, float]:
    """A share with the 95 % interval of Clopper & Pearson (1934)."""
    from scipy import stats

    low = float(stats.beta.ppf(0.025, count, total - count + 1)) if count else 0.0
    high = float(stats.beta.ppf(0.975, count + 1, total - count)) if count < total else 1.0
    return count / total, low, high


def _faces_and_falls_in(hits: Hits, source: Camera) -> Mask:
    point = np.nan_to_num(hits.point)
    local = (point - source.position) @ source.rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = local @ source.K.T
        xy = xy[..., :2] / xy[..., 2:]
    inside = (
        (local[..., 2] > 0)
        & (xy > 0).all(-1)
        & (xy[..., 0] < source.width)
        & (xy[..., 1] < source.height)
    )
    facing = np.einsum("hwi,hwi->hw", np.nan_to_num(hits.normal), source.position - point) > 0
    return hits.valid & inside & facing


def _seen_in_map(depth: Array, camera: Camera, points: Array, bilinear: bool) -> Array:
    """1 where a point is not behind the depth map, 0 where it is, NaN where the map has no
    answer."""
    local = (points - camera.position) @ camera.rotation.T
    z = local[:, 2]
    x, y = ((local @ camera.K.T)[:, k] / z for k in (0, 1))
    height, width = depth.shape
    if not bilinear:
        surface = depth[np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)]
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(surface), (z <= 1.01 * surface).astype(float), 1.0)
    x, y = np.clip(x - 0.5, 0, width - 1.001), np.clip(y - 0.5, 0, height - 1.001)
    left, top = x.astype(int), y.astype(int)
    a, b = x - left, y - top
    taps = np.stack([depth[top + j, left + i] for j in (0, 1) for i in (0, 1)])
    weights = np.stack([(b if j else 1 - b) * (a if i else 1 - a) for j in (0, 1) for i in (0, 1)])
    with np.errstate(invalid="ignore"):
        surface = 1 / (weights / taps).sum(0)
        steady = taps.max(0) <= 1.02 * taps.min(0)
        # A threshold of 1 % again; interpolated depth needs less, but then slants decide.
        return np.where(steady, (z <= 1.01 * surface).astype(float), np.nan)
