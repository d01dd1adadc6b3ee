"""Pictures of random worlds on disk, in shards: seeded, resumable, the same whatever the number of
workers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp_eval.drawn.worlds import FINISHES, GROUNDS, OBJECTS, TIMES, Look
from training.worlds.draw import TRAIN_SHAPES, attributes, change, draw_look, draw_world

DATA_PROTOCOL = 1
"""Raised whenever the same seed would give other pictures."""

SIZE = 160
"""Pixels along a side; crops are taken from it, so more than the 128 that the encoders see."""


@dataclass(frozen=True)
class Split:
    """A set of worlds.

    Attributes:
        first: seed of the first world; the seeds of splits do not meet.
        worlds: how many.
        shard: worlds in a file.
        pairs: colours of the objects: "seen" in training, or "any".
        new_shapes: whether the shapes are ones that training never sees.
        own_shapes: whether every world has a shape of its own, which training may see; else worlds
            share :data:`training.worlds.draw.TRAIN_SHAPES` of each thing.
        path_traced: whether Mitsuba makes the pictures (one look and one view of each world) or the
            ray caster (two views of each look).
        moved: whether all looks of a world have its surface, on other grounds at other times; else
            there are three, of which the second differs from the first in one attribute.
        bare: whether every thing stands alone on the same grass by day, so that nothing but the
            thing tells it apart.
    """

    first: int
    worlds: int
    shard: int = 50
    pairs: str = "seen"
    new_shapes: bool = False
    own_shapes: bool = False
    path_traced: bool = False
    moved: bool = False
    bare: bool = False


SPLITS = {
    "train": Split(0, 2500),
    "train-moved": Split(6_000_000, 2000, moved=True),
    "train-shapes": Split(9_000_000, 4000, own_shapes=True, moved=True),
    "train-rendered": Split(1_000_000, 1000, path_traced=True),
}
"""Everything that the recipes train on."""

SPP = 16
TEXELS = 512


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures with their attributes.

    Attributes:
        images: (N, size, size, 3) uint8 sRGB.
        attributes: (N, 6) as :data:`training.worlds.draw.ATTRIBUTES`.
        world: (N,) seed of the world.
        view: (N,) which of its cameras.
        look: (N,) which of its looks; 1 differs from 0 in one attribute, 2 in everything that was
            drawn.
    """

    images: npt.NDArray[np.uint8]
    attributes: npt.NDArray[np.int64]
    world: npt.NDArray[np.int64]
    view: npt.NDArray[np.int64]
    look: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.images)


def looks_of(seed: int, thing: int, split: Split) -> list[Look]:
    """The looks of a world: one, the same with one attribute changed, and another."""
    rng = np.random.default_rng([seed, 6])
    first = draw_look(thing, rng, pairs=split.pairs)
    if split.path_traced:
        # Mitsuba's plastic cannot have the colours of a mesh's vertices, which bodies have.
        while FINISHES[first.finish] == "shiny":
            first = draw_look(thing, rng, pairs=split.pairs)
        return [first]
    if split.bare:
        return [replace(first, ground=GROUNDS.index("grass"), time=TIMES.index("day"))]
    if split.moved:
        second = draw_look(thing, rng, pairs="any")
        while second.ground == first.ground or second.time == first.time:
            second = draw_look(thing, rng, pairs="any")
        return [first, replace(first, ground=second.ground, time=second.time)]
    # What the test for directions changes is drawn like everything else.
    what = ("surface", "surface", "ground", "time")[int(rng.integers(4))]
    return [
        first,
        change(first, what, thing, rng, pairs=split.pairs),
        draw_look(thing, rng, pairs=split.pairs),
    ]


def render_world(
    seed: int, split: Split, size: int = SIZE
) -> Iterator[tuple[npt.NDArray[np.uint8], tuple[int, ...], int, int]]:
    """The pictures of one world: image, attributes, view, look."""
    from training.worlds.render import pictures

    # Objects come in turn, so that every word is seen as often.
    world = draw_world(
        seed, new_shapes=split.new_shapes, thing=seed % len(OBJECTS), bare=split.bare
    )
    if split.own_shapes:
        world = replace(world, instance=TRAIN_SHAPES + seed - split.first)
    looks = looks_of(seed, world.thing, split)
    if split.path_traced:
        from attnwarp_eval.colors import to_srgb
        from attnwarp_eval.truth.mitsuba import build, render_plan
        from attnwarp_eval.truth.plan import plan

        # Baking textures as finely as truth wants them takes ten times as long as the small picture
        # itself.
        build.TEXELS = TEXELS
        scene = world.scene(looks[0], size)
        image = to_srgb(render_plan(scene, scene.source, plan(scene, SPP), seed))
        yield np.rint(255 * image).astype(np.uint8), attributes(world.thing, looks[0]), 0, 0
        return
    for view in range(world.views):
        images, _ = pictures(world, looks, size, view=view)
        for look, image in enumerate(images):
            yield image, attributes(world.thing, looks[look]), view, look


def _make_shard(path: Path, start: int, split: Split) -> Path:
    rows = []
    for seed in range(start, min(start + split.shard, split.first + split.worlds)):
        rows += [
            (image, values, seed, view, look)
            for image, values, view, look in render_world(seed, split)
        ]
    images, values, world, view, look = zip(*rows, strict=True)
    arrays: dict[str, Any] = {
        "images": np.stack(images),
        "attributes": np.array(values),
        "world": world,
        "view": view,
        "look": look,
    }
    write_atomically(path, lambda stream: np.savez(stream, **arrays))
    return path


def render_missing(
    title: str, files: Mapping[Path, int], render: Callable[[Path, int], object], workers: int
) -> list[Path]:
    """Render the files that are not there, each from its number; all of them are returned in order."""
    from rich.progress import Progress

    missing = [pair for pair in files.items() if not pair[0].exists()]
    if missing:
        with Progress() as bar, ProcessPoolExecutor(workers) as pool:
            task = bar.add_task(title, total=len(files), completed=len(files) - len(missing))
            for finished in as_completed([pool.submit(render, *pair) for pair in missing]):
                finished.result()
                bar.advance(task)
    return list(files)


def joined(files: Sequence[Path]) -> dict[str, npt.NDArray[Any]]:
    """The arrays of files of one kind, one file after the other."""
    columns: dict[str, list[npt.NDArray[Any]]] = {}
    for path in files:
        with np.load(path) as stored:
            for key in stored.files:
                columns.setdefault(key, []).append(stored[key])
    return {key: np.concatenate(parts) for key, parts in columns.items()}


def make(folder: Path, name: str, workers: int = 2, *, worlds: int | None = None) -> list[Path]:
    """Render the missing files of a split's first ``worlds`` (all if left out); they are returned in order."""
    split = SPLITS[name]
    folder.mkdir(parents=True, exist_ok=True)
    count = split.worlds if worlds is None else min(worlds, split.worlds)
    starts = range(split.first, split.first + count, split.shard)
    files = {folder / f"{name}-v{DATA_PROTOCOL}-{start}.npz": start for start in starts}
    render = functools.partial(_make_shard, split=split)
    return render_missing(f"pictures: {name}", files, render, workers)


def load(folder: Path, name: str, workers: int = 2, *, worlds: int | None = None) -> Pictures:
    """The pictures of a split's first ``worlds`` (all if left out), rendered where they are missing."""
    return Pictures(**joined(make(folder, name, workers, worlds=worlds)))
