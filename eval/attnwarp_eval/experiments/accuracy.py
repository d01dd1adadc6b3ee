"""What accuracy of the truth itself costs in time: error against seconds of pictures, depth and
visibility.

Every contestant is held against an answer that it does not share: pictures against the mean of many
others at far more samples, depth and visibility against every triangle of the scene met one by one
in float64. Seconds are taken in turn, in an order drawn anew each round; the first contestant runs
twice a round, and the ratio of it to itself is what noise alone does on the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import numpy.typing as npt

from attnwarp_eval.statistics.intervals import Ratio, time_ratio

if TYPE_CHECKING:
    from pathlib import Path

    from attnwarp.camera import Camera
    from attnwarp_eval.scene.scene import Scene
    from attnwarp_eval.scene.shapes import Mesh
    from attnwarp_eval.truth.raycast import Hits

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

PICTURE_SCENES = ("spheres", "bear", "glass", "fog")
GEOMETRY_SCENES = ("bear", "garden", "far")
SAMPLES = (1, 4, 16, 64)
MAPS = (32, 128, 512)
"""Sizes of the depth maps whose test of visibility is held against rays."""

WRONG = 1e-3
"""A depth this far off, relatively, is that of another surface, or of no use; it is counted
apart."""


@dataclass(frozen=True)
class Contestant:
    """What one way to the truth got, and what it took.

    Attributes:
        name: for a person.
        error: in the panel's unit, with a 95 % interval where rounds differ (bootstrap over
            rounds), else three times itself.
        seconds: of each round.
        more: further figures by name.
    """

    name: str
    error: tuple[float, float, float]
    seconds: tuple[float, ...]
    more: dict[str, float]


@dataclass(frozen=True)
class Panel:
    """The contestants of one question on one scene; the first is the baseline of the ratios.

    Attributes:
        question: "pictures", "depth" or "visibility".
        scene: its name.
        unit: of the error.
        contestants: the baseline first.
        again: seconds of the baseline's second run of each round.
        efficiency: error's variance times seconds of each round, relative to the baseline's
            ("pictures" only).
    """

    question: str
    scene: str
    unit: str
    contestants: tuple[Contestant, ...]
    again: tuple[float, ...]
    squares: tuple[tuple[float, ...], ...] = ()

    def ratio(self, index: int | None) -> Ratio:
        """Seconds of a contestant (None: the baseline's second run) over the baseline's, paired by
        round.
        """
        seconds = self.again if index is None else self.contestants[index].seconds
        return time_ratio([seconds], [self.contestants[0].seconds])

    def at_equal_error(self, index: int) -> Ratio:
        """Variance x seconds of a contestant over the baseline's, paired by round: what the same
        noise would take.
        """
        products = [
            np.array(self.squares[k]) * np.array(self.contestants[k].seconds) for k in (index, 0)
        ]
        return time_ratio([products[0].tolist()], [products[1].tolist()])


def in_turn(
    works: Sequence[Callable[[int], Any]],
    rounds: int,
    seed: int = 0,
    before: Callable[[int], None] = lambda _: None,
) -> tuple[list[list[Any]], list[list[float]]]:
    """Results and seconds of ``works`` and of the first of them again, each round in an order drawn
    anew.

    Args:
        works: called with the number of the round. A first round, which compiles and fills caches,
            is not kept.
        rounds: how many are kept.
        seed: of the order.
        before: called with the index of the work that comes next, untimed.
    """
    rng = np.random.default_rng(seed)
    every = [*works, works[0]]
    results: list[list[Any]] = [[] for _ in every]
    seconds: list[list[float]] = [[] for _ in every]
    for turn in range(rounds + 1):
        for index in rng.permutation(len(every)):
            before(int(index) % len(works))
            start = time.perf_counter()
            # The baseline's second run gets other noise.
            result = every[index](turn if index < len(works) else turn + 10_000)
            took = time.perf_counter() - start
            if turn:
                results[index].append(result)
                seconds[index].append(took)
    return results, seconds


# Pictures
# --------------------------------------------------------------------------------------------------


def pictures(
    scene: Scene,
    *,
    size: int = 96,
    samples: Sequence[int] = SAMPLES,
    rounds: int = 7,
    reference: tuple[int, int] = (16, 256),
    progress: Callable[[str], None] = lambda _: None,
) -> Panel:
    """Error of the source's picture against a converged one, by samples a pixel, plan and Mitsuba's
    variant.

    Args:
        size: of the square picture.
        samples: a pixel.
        rounds: pictures of each contestant.
        reference: how many pictures of how many samples the converged one is the mean of. Its own
            noise is estimated from their spread and taken out of the errors.
    """
    from attnwarp_eval.truth.llvm import LLVM, SCALAR, variant
    from attnwarp_eval.truth.mitsuba import render_plan, use
    from attnwarp_eval.truth.plan import everything_on, plan

    small = scene.with_size(size, size)
    best = variant()
    contestants = [(f"plan, {spp} spp", plan(small, spp), best) for spp in samples]
    contestants += [
        (f"everything on, {spp} spp", everything_on(small, spp), best) for spp in samples[-2:]
    ]
    if best == LLVM:
        contestants += [(f"plan, {spp} spp, scalar", plan(small, spp), SCALAR) for spp in samples]
    # The baseline is the plan at the second largest number of samples.
    contestants.insert(0, contestants.pop(len(samples) - 2))

    progress(f"{scene.name}: converged picture")
    count, spp = reference
    made = np.stack(
        [
            render_plan(small, small.source, plan(small, spp), 50_000 + k, made_by=best)
            for k in range(count)
        ]
    )
    truth = made.mean(0, dtype=np.float64)
    floor = float(made.var(0, ddof=1, dtype=np.float64).mean()) / count

    def work(k: int) -> Callable[[int], Any]:
        _, planned, by = contestants[k]
        return lambda turn: render_plan(small, small.source, planned, 100 + turn, made_by=by)

    progress(f"{scene.name}: {len(contestants)} kinds of pictures, {rounds} rounds")
    results, seconds = in_turn(
        [work(k) for k in range(len(contestants))], rounds, before=lambda k: use(contestants[k][2])
    )
    scale = float(truth.mean())
    out, squares = [], []
    draws = np.random.default_rng(0).integers(rounds, size=(1000, rounds))
    for (name, _, _), got, took in zip(contestants, results, seconds, strict=False):
        stack = np.array(got, dtype=np.float64)
        square = ((stack - truth) ** 2).mean((1, 2, 3)) - floor
        drawn = np.sqrt(np.clip(square[draws].mean(1), 0, None)) / scale
        error = float(np.sqrt(max(square.mean(), 0.0))) / scale
        low, high = np.quantile(drawn, [0.025, 0.975])
        means = stack.mean((1, 2, 3)) / scale - 1
        more = {
            "bias": float(means.mean()),
            "bias_error": float(means.std(ddof=1) / np.sqrt(rounds)),
        }
        out.append(Contestant(name, (error, float(low), float(high)), tuple(took), more))
        squares.append(tuple(np.clip(square, 1e-300, None).tolist()))
    unit = "RMS error of a pixel, share of the picture's mean"
    return Panel("pictures", scene.name, unit, tuple(out), tuple(seconds[-1]), tuple(squares))


# Depth
# --------------------------------------------------------------------------------------------------


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


def _triangles(scene: Scene) -> list[Mesh]:
    """The scene's triangles alone: spheres and rectangles are closed forms, where there is nothing
    to refine.
    """
    from attnwarp_eval.scene.shapes import Box, Mesh

    meshes = [shape.mesh() if isinstance(shape, Box) else shape for shape in scene.shapes()]
    found = [shape for shape in meshes if isinstance(shape, Mesh)]
    if not found:
        from attnwarp.errors import InputError

        raise InputError(
            f"scene {scene.name}: it has no triangles, so that nothing is refined; take one with a"
            " mesh"
        )
    return found


def depth(
    scene: Scene,
    *,
    size: int = 512,
    rays: int = 500,
    rounds: int = 9,
    progress: Callable[[str], None] = lambda _: None,
) -> Panel:
    """Error of depth with the hit as Open3D has it (float32) and refined on its triangle's plane in
    float64.

    Args:
        size: of the square image that is traced.
        rays: pixels held against every triangle in float64.
        rounds: of the timing.
    """
    from attnwarp_eval._open3d import open3d
    from attnwarp_eval.truth.raycast import Geometry

    class Unrefined(Geometry):
        """Open3D's own hits, in the recentred and rescaled world."""

        def _refined(self, rough: Array, *_: Any) -> Array:
            return rough

    meshes = _triangles(scene)
    camera = scene.with_size(size, size).source
    refined, unrefined = Geometry(meshes), Unrefined(meshes)
    o3d = open3d()
    raw = o3d.t.geometry.RaycastingScene(nthreads=0)
    for mesh in meshes:
        raw.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)),
            o3d.core.Tensor(mesh.faces.astype(np.uint32)),
        )

    def said(_: int) -> Array:
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

    progress(
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

    progress(f"{scene.name}: depth at {size} x {size}, {rounds} rounds")
    works = [traced(refined), traced(unrefined), said]
    names = ["refined in float64", "float32 hit, recentred", "float32 hit, world coordinates"]
    results, seconds = in_turn(works, rounds)
    out = []
    for name, got, took in zip(names, results, seconds, strict=False):
        with np.errstate(invalid="ignore"):
            relative = np.abs(got[0].ravel()[chosen] / exact - 1)
        wrong = ~(relative < WRONG)
        kept = relative[~wrong] if (~wrong).any() else np.array([np.nan])
        worst, half = float(kept.max()), float(np.median(kept))
        more = {"median": half, "p99": float(np.quantile(kept, 0.99)), "wrong": float(wrong.mean())}
        out.append(Contestant(name, (worst, worst, worst), tuple(took), more))
    return Panel(
        "depth", scene.name, "largest relative error of depth", tuple(out), tuple(seconds[-1])
    )


# Visibility
# --------------------------------------------------------------------------------------------------


def visibility(
    scene: Scene,
    *,
    size: int = 512,
    points: int = 500,
    rounds: int = 5,
    maps: Sequence[int] = MAPS,
    progress: Callable[[str], None] = lambda _: None,
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
    """
    from attnwarp_eval.truth.raycast import Geometry

    meshes = _triangles(scene)
    geometry = Geometry(meshes)
    target = scene.with_size(size, size).targets[len(scene.targets) // 2]
    source = scene.with_size(size, size).source
    hits = geometry.trace(target)
    asked = _faces_and_falls_in(hits, source)
    where, normal, primitive = hits.point[asked], hits.normal[asked], hits.primitive_id[asked]

    def by_rays(_: int) -> npt.NDArray[np.float64]:
        return geometry.visible_from(where, normal, primitive, source).astype(np.float64)

    def by_map(pixels: int, bilinear: bool) -> Callable[[int], npt.NDArray[np.float64]]:
        camera = source.resize(pixels, pixels)

        def work(_: int) -> npt.NDArray[np.float64]:
            geometry.forget()
            return _seen_in_map(geometry.trace(camera).depth, camera, where, bilinear)

        return work

    progress(
        f"{scene.name}: {sum(len(m.faces) for m in meshes)} triangles against {points} points in"
        " float64"
    )
    chosen = np.sort(
        np.random.default_rng(1).choice(len(where), min(points, len(where)), replace=False)
    )
    away = where[chosen] - source.position
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
    progress(f"{scene.name}: visibility of {len(where)} points, {rounds} rounds")
    results, seconds = in_turn(works, rounds)
    out = []
    for name, got, took in zip(names, results, seconds, strict=False):
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
        tuple(seconds[-1]),
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


# All together
# --------------------------------------------------------------------------------------------------


def measure(
    names: Sequence[str] = (), *, rounds: int = 7, progress: Callable[[str], None] = lambda _: None
) -> list[Panel]:
    """Every question on every scene that it makes sense for.

    Args:
        names: scenes' names or paths; :data:`PICTURE_SCENES` and :data:`GEOMETRY_SCENES` if left
            out.
        rounds: of every timing.
        progress: told what is at work.
    """
    from attnwarp.errors import InputError
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth.mitsuba import forget

    panels = []
    for name in names or PICTURE_SCENES:
        panels.append(pictures(load_scene(name), rounds=rounds, progress=progress))
        forget()
    for name in names or GEOMETRY_SCENES:
        scene = load_scene(name)
        try:
            panels.append(depth(scene, rounds=rounds, progress=progress))
        except InputError:
            if names:
                progress(f"{name}: no triangles, so that depth and visibility are closed forms")
            continue
        panels.append(visibility(scene, rounds=rounds, progress=progress))
    return panels


def _read(path: Path) -> list[Panel]:
    import json

    from attnwarp.errors import InputError

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    try:
        found = []
        for said in json.loads(text)["panels"]:
            contestants = [
                Contestant(c["name"], tuple(c["error"]), tuple(c["seconds"]), c["more"])
                for c in said["contestants"]
            ]
            squares = tuple(tuple(row) for row in said["squares"])
            found.append(
                Panel(
                    said["question"],
                    said["scene"],
                    said["unit"],
                    tuple(contestants),
                    tuple(said["again"]),
                    squares,
                )
            )
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: it is no measurement of accuracy; name another folder with --out"
        ) from None
    return found


def write(panels: Sequence[Panel], out: Path) -> list[Path]:
    """accuracy.md, accuracy.json and the figures below ``out``; their paths.

    Panels of other scenes that are in ``accuracy.json`` already stay, so that scenes can be
    measured one by one.

    Raises:
        InputError: an ``accuracy.json`` of something else.
    """
    import json

    from attnwarp_eval.cost import environment
    from attnwarp_eval.document import figures
    from attnwarp_eval.document.model import Picture, Report
    from attnwarp_eval.document.write import markdown
    from attnwarp_eval.statistics.intervals import Interval
    from attnwarp_eval.truth.llvm import variant

    out.mkdir(parents=True, exist_ok=True)
    nan = float("nan")
    merged = {
        (panel.question, panel.scene): panel for panel in [*_read(out / "accuracy.json"), *panels]
    }
    panels = list(merged.values())

    def point(panel: Panel, k: int) -> tuple[Interval, Interval]:
        base, ratio = float(np.median(panel.contestants[0].seconds)), panel.ratio(k)
        mean, low, high = panel.contestants[k].error
        if mean == 0 and high > 0:
            # None wrong has no place on a logarithmic axis: shown at half a point, up to what none
            # of so many excludes.
            mean = 0.5 / panel.contestants[k].more["points"]
        seconds = Interval(
            base * ratio.ratio, base * ratio.low, base * ratio.high, 1, 1, 0, nan, nan
        )
        return seconds, Interval(mean, low, high, 1, 1, 0, nan, nan)

    drawn = []
    for question in ("pictures", "depth", "visibility"):
        mine = [panel for panel in panels if panel.question == question]
        if not mine:
            continue
        path = out / f"{question}.svg"
        with figures.drawing(path, columns=len(mine)) as axes:
            for ax, panel in zip(axes, mine, strict=True):
                shown = {c.name: point(panel, k) for k, c in enumerate(panel.contestants)}
                figures.cost_front(ax, shown, x="seconds", y=SHORT[question], title=panel.scene)
        drawn.append((question, path))
    sections = _sections(panels)
    for section in sections:
        section.figures += [
            Picture(path.name, f"{section.title}: error against time")
            for question, path in drawn if TITLES[question] == section.title
        ]  # fmt: skip
    about = environment()
    lead = [
        (
            f"Mitsuba {about['versions']['mitsuba']} as `{variant()}`, Open3D"
            f" {about['versions']['open3d']}, {about['machine']['cores']} cores"
            f" ({about['machine']['arch']})."
        ),
        (
            "All contestants of a scene ran in turn in one process, in an order drawn anew each"
            " round. A ratio is the median over rounds of the ratio to the first row within a"
            " round, with a 95 % bootstrap interval over rounds. The row `again` is the first row"
            " against itself: inside its band nothing is called faster or slower."
        ),
    ]
    files = [out / "accuracy.md", out / "accuracy.json", *(path for _, path in drawn)]
    files[0].write_text(
        markdown(Report("Error of the truth itself, against time", lead, sections)),
        encoding="utf-8",
    )
    data = {
        "environment": about,
        "variant": variant(),
        "panels": [asdict(panel) for panel in panels],
    }
    files[1].write_text(
        json.dumps(data, indent=1, allow_nan=False, default=float) + "\n", encoding="utf-8"
    )
    return files


SHORT = {
    "pictures": "RMS error / mean",
    "depth": "largest relative error",
    "visibility": "not labelled rightly",
}
TITLES = {
    "pictures": "Pictures: samples, plan and variant",
    "depth": "Depth: float32 hits and their refinement",
    "visibility": "Visibility: rays and depth maps",
}


def _sections(panels: Sequence[Panel]) -> list[Any]:
    from attnwarp_eval.document.model import Section, Table
    from attnwarp_eval.document.numbers import number

    def ratio(value: Ratio) -> str:
        return f"{number(value.ratio)} [{number(value.low)}, {number(value.high)}]"

    sections = []
    for question, title in TITLES.items():
        mine = [panel for panel in panels if panel.question == question]
        if not mine:
            continue
        section = Section(title)
        extra = {
            "pictures": ["bias of the mean", "time for the same noise, ratio"],
            "depth": ["median", "99 %", "off by more than 0.1 %"],
            "visibility": ["wrong", "unanswered"],
        }[question]
        for panel in mine:
            rows = []
            for k, c in enumerate(panel.contestants):
                value, low, high = c.error
                shown = (
                    number(value)
                    if low == high
                    else f"{number(value)} [{number(low)}, {number(high)}]"
                )
                if question == "pictures":
                    more = [f"{100 * c.more['bias']:+.2f} % ± {196 * c.more['bias_error']:.2f}",
                            "1" if k == 0 else ratio(panel.at_equal_error(k))]  # fmt: skip
                elif question == "depth":
                    more = [
                        f"{c.more['median']:.1e}",
                        f"{c.more['p99']:.1e}",
                        f"{100 * c.more['wrong']:.2f} %",
                    ]
                    shown = f"{value:.1e}"
                else:
                    more = [f"{100 * c.more[key]:.1f} %" for key in ("wrong", "unanswered")]
                    shown = f"{100 * value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
                times = [
                    number(1000 * float(np.median(c.seconds))),
                    "1" if k == 0 else ratio(panel.ratio(k)),
                ]
                rows.append([c.name, shown, *more, *times])
            blank = ["–"] * (1 + len(extra))
            rows.append(
                [
                    "again",
                    *blank,
                    number(1000 * float(np.median(panel.again))),
                    ratio(panel.ratio(None)),
                ]
            )
            section.tables.append(
                Table(["contestant", panel.unit, *extra, "ms", "time, ratio"], rows, panel.scene)
            )
        sections.append(section)
    return sections
