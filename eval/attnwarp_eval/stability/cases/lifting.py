"""Hard cases of masks lifted through splats."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.camera import Camera
from attnwarp.editing.segment import cut_out
from attnwarp.errors import InputError
from attnwarp.gaussians import Gaussians
from attnwarp.warp import lift_masks, piece_around
from attnwarp_eval.stability.case import Way, exact, hard, ways
from attnwarp_eval.stability.closed_forms import orbit, plane_depth, sphere
from attnwarp_eval.stability.rendered import splats

SIZE = 64
BALL, WALL = 2400, 80
"""Discs on a ball of radius 1; discs along each side of a wall."""

EDGE = 3
"""Px from an outline that may be wrong: the screen filter widens discs that are seen edge-on."""

SOURCE, TARGET = 0.0, 40.0
"""Degrees on the orbit."""

Mask = npt.NDArray[np.bool_]


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) evenly spread points of the unit sphere, equal to their normals."""
    k = np.arange(BALL) + 0.5
    z, turn = 1 - 2 * k / BALL, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
    return points, points


def _wall(x: float, half: tuple[float, float], step: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points of a rectangle across the x axis, and their normals."""
    # Cells of at most a step fill the rectangle, so that discs keep off its edge by half a cell.
    sides = []
    for side in half:
        cells = int(np.ceil(2 * side / step))
        sides.append((2 * np.arange(cells) + 1 - cells) / cells * side)
    y, z = np.meshgrid(*sides)
    points = np.stack([0 * y + x, y, z], axis=-1).reshape(-1, 3)
    return points, np.broadcast_to([1.0, 0, 0], points.shape)


def _scene(way: Way, *parts: tuple[tuple[np.ndarray, np.ndarray], float]) -> Gaussians:
    """Discs of one grey: the parts differ only in positions and normals."""
    points = np.concatenate([points for (points, _), _ in parts])
    normals = np.concatenate([normals for (_, normals), _ in parts])
    scales = np.concatenate([np.full((len(points), 2), scale) for (points, _), scale in parts])
    made = splats(points, torch.from_numpy(scales), 0.95, normals=normals, colors=0.5)
    return made.to(dtype=way.dtype)


def _lifted(scene: Gaussians, mask: Mask, way: Way) -> Mask:
    """(H, W) bool of the target, from a mask of the source."""
    lifted = lift_masks(scene, [_view(SOURCE)], [mask], backend=way.backend)
    return np.asarray(lifted.render(_view(TARGET)) > 0.5)


def _view(yaw: float, size: int = SIZE) -> Camera:
    return orbit(yaw, size=size, height=0.8)


def _ball_mask(camera: Camera) -> Mask:
    return np.isfinite(sphere(camera)[0])


def _around(mask: Mask) -> npt.NDArray[np.bool_]:
    """(M, H, W) bool: a mask moved by up to :data:`EDGE` px each way."""
    height, width = mask.shape
    padded = np.pad(mask, EDGE, mode="edge")
    steps = range(2 * EDGE + 1)
    return np.stack([padded[y : y + height, x : x + width] for y in steps for x in steps])


def _far_off(mine: Mask, true: Mask) -> float:
    """Pixels marked far from the exact mask, or missing in its interior or far from marks."""
    near = _around(true)
    stray, hole = mine & ~near.any(0), ~mine & near.all(0)
    return float((stray | hole | (true & ~_around(mine).any(0))).sum())


def _touching(gap: float, way: Way) -> float:
    """Pixels far off, of a ball in front of a wall, at a gap."""
    step = 6 / WALL
    scene = _scene(way, (_ball(), 0.04), (_wall(-1 - gap, (3, 3), step), step / 2))
    return _far_off(_lifted(scene, _ball_mask(_view(SOURCE)), way), _ball_mask(_view(TARGET)))


def _half(width: float) -> float:
    """Half of a width in px of the source's middle, in scene units."""
    source = _view(SOURCE)
    return width / 2 * float(np.linalg.norm(source.position)) / float(source.K[0, 0])


def _square_mask(camera: Camera, half: float, upright: float | None = None) -> Mask:
    """(H, W) bool: pixels whose central rays meet a rectangle across the x axis at its origin."""
    depth = plane_depth(camera, (1, 0, 0), 0.0)
    point = camera.position + depth[..., None] * (camera.directions() @ camera.rotation)
    tall = half if upright is None else upright
    return np.asarray((np.abs(point[..., 1]) < half) & (np.abs(point[..., 2]) < tall))


def _thin(width: float, way: Way) -> float:
    """Pixels far off, of an upright strip of a width in px of the source, before a wall."""
    half, wall = _half(width), 6 / WALL
    step = min(half, 0.1)
    scene = _scene(way, (_wall(0, (half, 1), step), step / 2), (_wall(-1, (3, 3), wall), wall / 2))
    mine = _lifted(scene, _square_mask(_view(SOURCE), half, 1), way)
    return _far_off(mine, _square_mask(_view(TARGET), half, 1))


def _size(size: float, way: Way) -> float:
    """Pixels far off, of the ball, from a mask of a size in px."""
    step = 6 / WALL
    scene = _scene(way, (_ball(), 0.04), (_wall(-1.5, (3, 3), step), step / 2))
    mask = _ball_mask(_view(SOURCE, int(size)))
    return _far_off(_lifted(scene, mask, way), _ball_mask(_view(TARGET)))


def _part(side: float, way: Way) -> float:
    """Pixels far off, of a wall of which the source's mask marks a square of a side in px."""
    step = 8 / WALL
    scene = _scene(way, (_wall(0, (4, 4), step), step / 2))
    source, half = _view(SOURCE), _half(side)
    if side == SIZE:  # everything, also surfaces hidden from the source
        half = np.inf
    return _far_off(
        _lifted(scene, _square_mask(source, half), way), _square_mask(_view(TARGET), half)
    )


def _clicked(distance: float, way: Way) -> float:
    """Pixels far off, of what clicks at a distance from each edge of the picture mark: by depth a
    band across the picture, by colours a square that the edge cuts.
    """
    worst, refused, ends = 0.0, [], (distance, SIZE - distance)
    for upright in (False, True):
        if way.backend == "piece":
            half = (0.4, 6) if upright else (6, 0.4)
            scene = _scene(way, (_wall(0, half, 0.06), 0.03), (_wall(-2.5, (6, 6), 0.12), 0.06))
        for end in ends:
            at = (SIZE / 2, end) if upright else (end, SIZE / 2)
            x, y = (np.arange(SIZE) + 0.5 for _ in at)
            true = (np.abs(x - ends.index(end) * SIZE) < 16) & (np.abs(y[:, None] - SIZE / 2) < 8)
            true = true.T if upright else true
            try:
                if way.backend == "piece":
                    true = _square_mask(_view(SOURCE), *half)
                    mine = piece_around(scene, _view(SOURCE), at)
                else:
                    mine = cut_out(np.where(true[..., None], 0.7, 0.3).repeat(3, -1), at=at)
                worst = max(worst, _far_off(mine, true))
            except InputError as problem:
                refused.append(problem)
    if len(refused) == 4:
        raise refused[0]
    return float("inf") if refused else worst


def _hidden(yaw: float, way: Way) -> float:
    """Pixels far off, of a ball lifted from a view and rendered in one that a wall hides it from,
    and values that are not finite.
    """
    step = 12 / 2 / WALL
    scene = _scene(way, (_ball(), 0.04), (_wall(-1.5, (6, 6), step), step / 2))
    source, target = _view(SOURCE), _view(yaw)
    lifted = lift_masks(scene, [source], [_ball_mask(source)], backend=way.backend)
    seen = np.asarray(lifted.render(target))
    # Before the wall's plane nothing stands between the camera and the ball.
    free = _ball_mask(target) & (target.position[0] > -1.5)
    return _far_off(seen > 0.5, free) + float((~np.isfinite(seen)).sum())


WAYS = ways("cpu")
FAR = exact("pixels more than 3 px off")

CASES = [
    hard("lifted_touching", _touching, WAYS, bounds=FAR),
    hard("lifted_thin", _thin, WAYS, bounds=FAR),
    hard("lifted_size", _size, WAYS, bounds=FAR),
    hard("lifted_part", _part, WAYS, bounds=FAR),
    hard(
        "click_on_the_edge",
        _clicked,
        tuple(Way(engine, "float32") for engine in ("piece", "colors")),
        bounds=FAR,
        must_refuse=lambda distance, way: distance < 0,
    ),
    hard("lifted_hidden", _hidden, WAYS, bounds=FAR),
]
