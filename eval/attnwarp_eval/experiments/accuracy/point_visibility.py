"""Cost of visibility: rays against depth maps, with exact visibility as the judge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.cost import in_turn
from attnwarp_eval.experiments.accuracy.geometry import every_triangle, triangles
from attnwarp_eval.experiments.accuracy.panel import Contestant, Panel
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.two_view import Hits

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MAPS = (32, 128, 512)
"""Sizes of the depth maps whose visibility test is compared with rays."""


def visibility(
    scene: Scene,
    *,
    size: int = 512,
    points: int = 500,
    rounds: int = 5,
    maps: Sequence[int] = MAPS,
    report: Reporter = SILENT,
) -> Panel:
    """Visibility of the middle target's surface points from the source: by rays, and by depth maps
    of the source.

    Points that face the source and fall inside its image are tested. A depth map answers with its
    nearest pixel (visible when not more than 1 % behind it), or bilinearly in 1 / z (undefined if
    its four pixels spread by more than 2 %). The reference is the first hit, among all triangles
    in float64, of a ray from the source.

    Args:
        size: size of the target; every pixel is a point.
        points: number of points compared with every triangle.
        rounds: number of rounds of the timing, which covers all points and the rendering of the
            depth map.
        maps: sizes of the depth maps.

    Returns:
        A panel without contestants if no point can be tested.
    """
    from attnwarp_eval.truth.raycast import Geometry

    meshes = triangles(scene)
    geometry = Geometry(meshes)
    target = scene.with_size(size, size).targets[len(scene.targets) // 2]
    source = scene.with_size(size, size).source
    hits = geometry.trace(target)
    asked = _faces_and_falls_in(hits, source)
    unit = "share of points not labelled rightly"
    if not asked.any():
        return Panel("visibility", scene.name, unit, (), ())
    points_asked, normal = hits.point[asked], hits.normal[asked]
    primitive, count = hits.primitive_id[asked], sum(len(mesh.faces) for mesh in meshes)

    def by_map(pixels: int, bilinear: bool) -> Callable[[int], npt.NDArray[np.float64]]:
        camera = source.resize(pixels, pixels)

        def work(_: int) -> npt.NDArray[np.float64]:
            geometry.forget()
            return _seen_in_map(geometry.trace(camera).depth, camera, points_asked, bilinear)

        return work

    report.step(0, 0, f"{scene.name}: {count} triangles against {points} points in float64")
    random, most = np.random.default_rng(1), min(points, len(points_asked))
    chosen = np.sort(random.choice(len(points_asked), most, replace=False))
    away = points_asked[chosen] - source.position
    corners = np.concatenate([(m.vertices - source.position)[m.faces] for m in meshes])
    # A hit within 1e-7 of the way before the point is its own or a coincident surface.
    first = every_triangle(
        np.zeros_like(away), np.ascontiguousarray(away), corners, np.full(len(away), 1 - 1e-7)
    )
    seen = ~np.isfinite(first)

    works: list[Callable[[int], Any]] = [
        lambda _: geometry.visible_from(points_asked, normal, primitive, source).astype(float)
    ]
    names = ["rays"]
    for pixels in maps:
        for bilinear in (False, True):
            works.append(by_map(pixels, bilinear))
            names.append(
                f"depth map {pixels}, {'bilinear in 1/z, 2 %' if bilinear else 'nearest, 1 %'}"
            )
    report.step(0, 0, f"{scene.name}: visibility of {len(points_asked)} points, {rounds} rounds")
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
    return Panel("visibility", scene.name, unit, tuple(out), tuple(turns.again))


def _share(count: int, total: int) -> tuple[float, float, float]:
    """A share with the 95 % interval of Clopper & Pearson (1934)."""
    from scipy import stats

    low = float(stats.beta.ppf(0.025, count, total - count + 1)) if count else 0.0
    high = float(stats.beta.ppf(0.975, count + 1, total - count)) if count < total else 1.0
    return count / total, low, high


def _faces_and_falls_in(hits: Hits, source: Camera) -> Mask:
    point = np.nan_to_num(hits.point)
    xy, z = source.project(point)
    inside = (z > 0) & ((xy > 0) & (xy < (source.width, source.height))).all(-1)
    facing = np.einsum("hwi,hwi->hw", np.nan_to_num(hits.normal), source.position - point) > 0
    return hits.valid & inside & facing


def _seen_in_map(depth: Array, camera: Camera, points: Array, bilinear: bool) -> Array:
    """1 if a point is not behind the depth map, 0 if it is, NaN if the map has no
    depth."""
    (x, y), z = (values.T for values in camera.project(points))
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
        # A threshold of 1 % again; interpolated depth allows less, but then slants decide.
        return np.where(steady, (z <= 1.01 * surface).astype(float), np.nan)
