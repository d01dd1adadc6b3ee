"""Pictures of things with parts in many looks, with what each pixel shows: what clip-parts learns from.

Every part has a surface of its own, drawn anew for each look. The looks of a world differ in one part, in all, in
the ground or in the light.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp_eval.drawn.assemblies import KINDS, PART_NOUNS
from attnwarp_eval.drawn.worlds import OBJECTS, Look, held_out
from training.worlds.assemblies import Assembly, draw_assembly
from training.worlds.data import SIZE, joined, render_missing
from training.worlds.draw import draw_look

PARTS_PROTOCOL = 1
"""Raised whenever the same seed would give other pictures."""

PARTS = tuple(PART_NOUNS)
"""Names of all parts; a part's number is its place here."""

LOOKS = 6
VIEWS = 2
SHARD = 17
"""Worlds in a file: one of each kind."""

OTHER, SKY = 254, 255
GROUND = 253
"""Label of a pixel that shows no part: the ground, something else, the sky."""

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PartSplit:
    """A set of worlds.

    Attributes:
        first: seed of the first world; no other recipe draws from these seeds.
        worlds: how many, a multiple of :data:`SHARD`.
        test: whether the shapes are ones that training never sees.
    """

    first: int
    worlds: int
    test: bool = False


PART_SPLITS = {
    "parts-train": PartSplit(14_000_000, 73 * SHARD),
}


@dataclass(frozen=True)
class Dress(Look):
    """A look with a surface for each part; the surface of its own is the first part's.

    Attributes:
        parts: a look for each part, in the order of :meth:`Assembly.pieces`.
    """

    parts: tuple[Look, ...] = ()


class DressedAssembly(Assembly):
    """A thing whose parts look as a :class:`Dress` says."""

    def surfaces(self, look: Look) -> tuple[Look, ...]:
        """The dress's."""
        if not isinstance(look, Dress):
            raise TypeError(f"look: got {type(look).__name__}, expected a Dress")
        return look.parts


@dataclass(frozen=True, eq=False)
class PartPictures:
    """Pictures with what they show; P counts :data:`PARTS`.

    Attributes:
        images: (N, S, S, 3) uint8 sRGB.
        surfaces: (N, P, 3) finish, color and second of each part; -2 where the thing has no such part, -1 where a
            surface has no such value.
        kind: (N,) index into :data:`attnwarp_eval.drawn.assemblies.KINDS`.
        ground, time: (N,).
        world, view, look: (N,).
        place: (N,) row of :attr:`ids`.
        ids: (M, S, S) uint8, the part that each pixel shows, else :data:`GROUND`, :data:`OTHER` or :data:`SKY`.
        shares: (M, P) share of the picture that each part covers.
    """

    images: npt.NDArray[np.uint8]
    surfaces: Ints
    kind: Ints
    ground: Ints
    time: Ints
    world: Ints
    view: Ints
    look: Ints
    place: Ints
    ids: npt.NDArray[np.uint8]
    shares: npt.NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.images)


def part_world(index: int, split: PartSplit) -> DressedAssembly:
    """The world of that number; kinds come in turn."""
    drawn = draw_assembly(split.first + index, index % len(KINDS), new_shapes=split.test)
    fields = {
        name: getattr(drawn, name)
        for name in ("thing", "instance", "seed", "views", "bare", "part")
    }
    return DressedAssembly(**fields)


def draw_surface(world: Assembly, name: str, rng: np.random.Generator, *, usual: float) -> Look:
    """A surface for a part: as it usually is with that probability, else any.

    Colours that the recipes keep from a thing of one piece are kept from its parts too.
    """
    thing = OBJECTS.index(world.kind) if world.kind in OBJECTS else None
    while True:
        look = draw_look(0, rng, pairs="any")
        if rng.uniform() < usual:
            look = replace(look, **world.usual(name, rng), second=-1)
            usual *= 0.9  # where all usual colours are kept back, any other will do
        colors = [c for c in (look.color, look.second) if c >= 0]
        if thing is None or not any(held_out(thing, c) for c in colors):
            return look


def dresses(world: Assembly) -> list[Dress]:
    """The looks of a world: one; two with a part changed; all parts alike; another ground or light; all anew."""
    rng = np.random.default_rng([world.seed, 24])
    names = list(world.pieces())

    def clothed(usual: float) -> list[Look]:
        return [draw_surface(world, name, rng, usual=usual) for name in names]

    def dress(parts: list[Look], surroundings: Look) -> Dress:
        first = parts[0]
        return Dress(
            first.finish,
            first.color,
            first.second,
            surroundings.ground,
            surroundings.time,
            surroundings.seed,
            tuple(parts),
        )

    around, parts = draw_look(0, rng, pairs="any"), clothed(0.6)
    looks = [dress(parts, around)]
    # The part that the world's draw found large is seen in both views.
    seen = names.index(world.part) if world.part in names else int(rng.integers(len(names)))
    for k in (seen, int(rng.integers(len(names)))):
        changed = list(parts)
        while words_of(changed[k]) == words_of(parts[k]):
            changed[k] = draw_surface(world, names[k], rng, usual=0.0)
        looks.append(dress(changed, around))
    one = draw_surface(world, names[0], rng, usual=0.0)
    looks.append(dress([one] * len(names), around))
    other = draw_look(0, rng, pairs="any")
    what = "ground" if rng.uniform() < 0.5 else "time"
    value = getattr(other, what)
    looks.append(dress(parts, replace(around, **{what: value})))
    looks.append(dress(clothed(0.3), other))
    return looks


def words_of(look: Look) -> tuple[int, int, int]:
    """Attributes of a surface that words can tell: finish, color, second."""
    return look.finish, look.color, look.second


def render_part_world(index: int, split: PartSplit) -> dict[str, Any]:
    """Everything that :class:`PartPictures` holds of one world."""
    from training.worlds.render import pictures

    world = part_world(index, split)
    looks = dresses(world)
    numbers = np.array([PARTS.index(name) for name in world.pieces()])
    images, ids = [], []
    for view in range(VIEWS):
        made, hits = pictures(world, looks, SIZE, view=view)
        images.append(np.stack(made))
        table = np.full(256, OTHER, dtype=np.uint8)
        table[: len(numbers)] = numbers
        table[len(numbers)] = GROUND
        ids.append(
            np.where(hits.object_id < 0, SKY, table[np.clip(hits.object_id, 0, 255)]).astype(
                np.uint8
            )
        )
    surfaces = np.full((LOOKS, len(PARTS), 3), -2)
    for k, look in enumerate(looks):
        surfaces[k, numbers] = [words_of(part) for part in look.parts]
    return {
        "images": np.stack(images), "ids": np.stack(ids), "surfaces": surfaces, "kind": world.thing,
        "around": np.array([(k.ground, k.time) for k in looks]), "seed": world.seed,
    }  # fmt: skip


def _make_shard(path: Path, start: int, split: PartSplit) -> Path:
    rows = [render_part_world(k, split) for k in range(start, start + SHARD)]
    arrays: dict[str, Any] = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    write_atomically(path, lambda stream: np.savez(stream, **arrays))
    return path


def make(folder: Path, name: str, workers: int = 2) -> list[Path]:
    """Render the missing files of a split; all of them are returned in order."""
    split = PART_SPLITS[name]
    folder.mkdir(parents=True, exist_ok=True)
    starts = range(0, split.worlds, SHARD)
    files = {folder / f"clip-{name}-v{PARTS_PROTOCOL}-{start:05d}.npz": start for start in starts}
    render = functools.partial(_make_shard, split=split)
    return render_missing(f"pictures: {name}", files, render, workers)


def shares_of(ids: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """(N, P) share of each (S, S) picture that every part covers."""
    counts = [np.bincount(one.ravel(), minlength=256)[: len(PARTS)] for one in ids]
    return np.stack(counts) / ids[0].size


def load(folder: Path, name: str, workers: int = 2) -> PartPictures:
    """The pictures of a split, rendered where they are missing."""
    table = joined(make(folder, name, workers))
    worlds = len(table["kind"])
    world, view, look = (v.ravel() for v in np.indices((worlds, VIEWS, LOOKS)))
    ids = table["ids"].reshape(-1, SIZE, SIZE)
    return PartPictures(
        images=table["images"].reshape(-1, SIZE, SIZE, 3),
        surfaces=table["surfaces"][world, look],
        kind=table["kind"][world],
        ground=table["around"][world, look, 0],
        time=table["around"][world, look, 1],
        world=world,
        view=view,
        look=look,
        place=world * VIEWS + view,
        ids=ids,
        shares=shares_of(ids),
    )
