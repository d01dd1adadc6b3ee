"""Views of random worlds as light and parts: a picture in any colours of the parts is a product.

Every surface of the thing is matt, so its radiance is albedo times light. A part is a piece of a thing with parts,
or the points of a thing nearest to one of some random points of its surface.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp_eval.drawn.assemblies import KINDS
from attnwarp_eval.drawn.worlds import COLORS, FINISHES, OBJECTS
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.truth import Geometry
from training.worlds import render
from training.worlds.assemblies import WHOLE, draw_assembly
from training.worlds.data import joined, render_missing
from training.worlds.draw import TRAIN_SHAPES, World, draw_look, draw_world

RECOLORS_PROTOCOL = 1
"""Raised whenever the same seed would give other pictures."""

SIZE = 128
VIEWS = 2
SHARD = 10
"""Worlds in a file."""

CELLS = ((2, 5), (4, 8), (8, 15))
"""Least number of parts of a division, and the first that is too many; pieces take the place of the first where there are any."""


@dataclass(frozen=True)
class RecolorSplit:
    """A set of worlds; seeds of splits do not meet with each other's, nor with those of other recipes."""

    first: int
    worlds: int
    test: bool = False


RECOLOR_SPLITS = {
    "train": RecolorSplit(16_000_000, 1000),
    "test": RecolorSplit(17_000_000, 40, test=True),
}


def render_world(index: int, split: RecolorSplit) -> dict[str, npt.NDArray[Any]]:
    """Light, parts and depth of a world's views.

    Returns:
        ``light``: (2, S, S, 3) float16, on the thing the radiance of a white part, elsewhere that of the picture, linear;
        ``parts``: (2, 3, S, S) uint8, numbers from 1 on of three divisions, 0 elsewhere; ``depth``: (2, S, S) float32;
        ``K``, ``world_to_camera``.
    """
    seed = split.first + index
    rng = np.random.default_rng([seed, 40])
    world: World
    if index % 2:
        world = replace(
            draw_assembly(seed, index // 2 % len(KINDS), new_shapes=split.test), part=WHOLE
        )
    else:
        drawn = draw_world(
            seed, new_shapes=split.test, thing=index // 2 % len(OBJECTS), views=VIEWS
        )
        world = drawn if split.test else replace(drawn, instance=TRAIN_SHAPES + index)
    look = replace(
        draw_look(0, rng, pairs="any"),
        finish=FINISHES.index("plain"),
        color=COLORS.index("white"),
        second=-1,
    )
    scene = world.scene(look, SIZE)
    geometry, pieces = Geometry(scene), len(world.surfaces(look))
    white = np.array(linear_rgb(look.surface["texture"]["color"]))
    light, hits = [], [geometry.trace(camera) for camera in scene.cameras]
    for camera, seen in zip(scene.cameras, hits, strict=True):
        hit = seen.valid
        points, normals, ids = seen.point[hit], seen.normal[hit], seen.primitive_id[hit]
        rays = [
            (d, geometry.reached(points + 2 * geometry.extent * d, points, ids))
            for d in render.hemisphere(normals, render.SKY_RAYS)
        ]
        out = render._sky(scene, (camera.directions() @ camera.rotation).reshape(-1, 3)).reshape(
            *hit.shape, 3
        )
        color = render._albedo(scene, world.surfaces(look), geometry, points, ids)
        color[seen.object_id[hit] < pieces] /= white
        out[hit] = color * render.light_on(scene, geometry, points, normals, ids, rays) / np.pi
        light.append(out.astype(np.float16))
    things = [seen.valid & (seen.object_id < pieces) for seen in hits]
    points = np.concatenate([seen.point[thing] for seen, thing in zip(hits, things, strict=True)])
    parts = np.zeros((VIEWS, len(CELLS), SIZE, SIZE), dtype=np.uint8)
    for k, (low, high) in enumerate(CELLS):
        middles = points[rng.integers(len(points), size=int(rng.integers(low, high)))]
        for v, (seen, thing) in enumerate(zip(hits, things, strict=True)):
            near = ((seen.point[thing][:, None] - middles) ** 2).sum(axis=2).argmin(axis=1)
            parts[v, k, thing] = 1 + (seen.object_id[thing] if k == 0 and pieces > 1 else near)
    return {
        "light": np.stack(light), "parts": parts, "depth": np.stack([seen.depth for seen in hits]).astype(np.float32),
        "K": np.stack([camera.K for camera in scene.cameras]),
        "world_to_camera": np.stack([camera.world_to_camera for camera in scene.cameras]),
    }  # fmt: skip


def _make(path: Path, start: int, split: RecolorSplit) -> None:
    rows = [render_world(k, split) for k in range(start, start + SHARD)]
    arrays: dict[str, Any] = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    write_atomically(path, lambda stream: np.savez(stream, **arrays))


def load(folder: Path, name: str, worlds: int, workers: int = 1) -> dict[str, npt.NDArray[Any]]:
    """The arrays of :func:`render_world` of a split's first worlds, rendered where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    split = RECOLOR_SPLITS[name]
    files = {
        folder / f"recolors-{name}-v{RECOLORS_PROTOCOL}-{k:05d}.npz": k
        for k in range(0, worlds, SHARD)
    }
    return joined(
        render_missing(f"pictures: {name}", files, functools.partial(_make, split=split), workers)
    )
