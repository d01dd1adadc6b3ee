"""Draw pairs by the hundred on one device, from pictures that lie there.

A network of three million weights takes 512 pairs in the time of some kernel launches on a GPU; drawing them one by one
takes longer than training on them. So everything about a batch is a tensor with one row a pair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from tokenizers import Tokenizer
from torch import Tensor

from attnwarp.editing.latents import BLOCK, CHANNELS, HaarLatents
from attnwarp.editing.small_unet import SETTLED
from training.editors.answers import KIND_NAMES, membership, settled
from training.worlds.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    LOOKS,
    SIZE,
    SURFACES,
    THING,
    VIEWS,
    Worlds,
    ambiguous_instruction,
    instruction,
)

SENTENCES = 48
"""Instructions made ahead for each thing and result."""

POINTS = 256
"""Pixels of its thing made ahead for each picture, to cut crops and regions about."""

THING_WEIGHT = 0.25
MOST_THING_WEIGHT = 8.0
"""Cells of the thing weigh 0.25 / (its share of the picture), at least 1 and at most 8: small things would hardly
be learned. The mask depends on the picture before alone, so the best prediction stays the same."""

HALF_PLANES = 0.7
"""Share of half planes among the regions of composed results; the others are boxes."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Pictures that the pairs of a batch are made of; all are (B,).

    Attributes:
        world, view, source, target: numbers of the world, its view and its looks before and after.
        kind: place in :data:`KIND_NAMES`.
        unclear: whether the instruction leaves the answer to the noise.
        y, x, zoom: the cut's first pixel, and pixels of the full picture to one of the cut's.
        flip: whether it is mirrored.
    """

    world: Tensor
    view: Tensor
    source: Tensor
    target: Tensor
    kind: Tensor
    unclear: Tensor
    y: Tensor
    x: Tensor
    zoom: Tensor
    flip: Tensor

    def __len__(self) -> int:
        return len(self.world)


@dataclass(frozen=True, eq=False)
class Batch:
    """Pairs with their noise.

    Attributes:
        before, after: (B, 48, h, w) latents.
        noise: (B, 48, h, w).
        tokens: (B, 24).
        t: (B,) steps.
        weight: (B, 1, h, w) of the cells.
        rows: content of each pair.
    """

    before: Tensor
    after: Tensor
    noise: Tensor
    tokens: Tensor
    t: Tensor
    weight: Tensor
    rows: Rows


class PicturePool:
    """Pictures of worlds on one device, cut by the hundred."""

    def __init__(self, worlds: Worlds, device: torch.device | str = "cpu") -> None:
        self.worlds = worlds
        self.device = torch.device(device)
        self.points = points_of(worlds).to(self.device)
        self.images = torch.from_numpy(worlds.images).to(self.device).view(-1, 3)
        self.things = torch.from_numpy(worlds.ids == THING).to(self.device).view(-1)
        self.member = membership().to(self.device)
        self.coder = HaarLatents().to(self.device)

    def pick(self, weights: Tensor, generator: torch.Generator) -> Tensor:
        """(B,) columns drawn by (B, N) weights."""
        return torch.multinomial(weights, 1, generator=generator)[:, 0]

    def uniform(self, generator: torch.Generator, *shape: int) -> Tensor:
        """Numbers in [0, 1)."""
        return torch.rand(shape, generator=generator, device=self.device)

    def integers(self, high: int, count: int, generator: torch.Generator) -> Tensor:
        """(count,) whole numbers from 0 to ``high`` - 1."""
        return torch.randint(high, (count,), generator=generator, device=self.device)

    def point(
        self, world: Tensor, view: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """(B,) y and x of a pixel of the full picture's thing."""
        number = self.integers(POINTS, len(world), generator)
        y, x = self.points[world, view, number].long().unbind(1)
        return y, x

    def corner(
        self, world: Tensor, view: Tensor, size: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Place that pictures are cut from: y, x and zoom, see :class:`Rows`."""
        count, step = len(world), SIZE // size
        whole = torch.ones(count, dtype=torch.bool, device=self.device)
        if step > 1:
            whole = self.uniform(generator, count) < 0.5
        shift = (0.25 + 0.5 * self.uniform(generator, 2, count)) * size
        low = [
            (v - s).clamp(0, SIZE - size).long().masked_fill(whole, 0)
            for v, s in zip(self.point(world, view, generator), shift, strict=True)
        ]
        return low[0], low[1], torch.where(whole, step, 1)

    def pixels(self, rows: Rows, size: int, taps: int) -> Tensor:
        """(B, S, S, taps^2) numbers of the full view's pixels that each pixel of the cuts is the mean of."""
        cells = torch.arange(size, device=self.device)
        tap = torch.arange(taps, device=self.device)
        zoom = rows.zoom[:, None, None]
        first = zoom * cells[:, None] + (zoom - 1).clamp(max=1) * tap
        across = torch.where(rows.flip[:, None, None], first.flip(1), first) + rows.x[:, None, None]
        down = first + rows.y[:, None, None]
        return (SIZE * down[:, :, None, :, None] + across[:, None, :, None, :]).flatten(3)

    def pictures(self, rows: Rows, look: Tensor, size: int) -> Tensor:
        """(B, 3, S, S) in [-1, 1]."""
        number = (rows.world * VIEWS + rows.view) * LOOKS + look
        index = number[:, None, None, None] * SIZE**2 + self.pixels(rows, size, SIZE // size)
        mean = self.images[index].float().mean(dim=3)
        return (mean / 127.5 - 1).permute(0, 3, 1, 2)

    def thing(self, rows: Rows, size: int) -> Tensor:
        """(B, S, S) share of each pixel that the thing covers."""
        number = (rows.world * VIEWS + rows.view)[:, None, None, None] * SIZE**2
        return self.things[number + self.pixels(rows, size, SIZE // size)].float().mean(dim=3)

    def latents(self, pictures: Tensor) -> Tensor:
        """(B, 48, h, w) of (B, 3, S, S) pictures."""
        return self.coder.encode(pictures, return_dict=False)[0]

    def weight(self, rows: Rows, size: int) -> Tensor:
        """(B, 1, h, w) weight of the cells, see :data:`THING_WEIGHT`."""
        mask = self.thing(rows, size)
        touched = torch.nn.functional.max_pool2d(mask[:, None], BLOCK) > 0
        gain = (THING_WEIGHT / mask.mean(dim=(1, 2)).clamp(min=1e-3)).clamp(1, MOST_THING_WEIGHT)
        surface = self.member[rows.kind][:, :SURFACES].any(dim=1)
        gain = torch.where(surface, gain, 1.0)
        return 1 + touched * (gain - 1)[:, None, None, None]


class PairPool(PicturePool):
    """Pictures, instructions and choices of looks before and after."""

    def __init__(
        self, worlds: Worlds, tokenizer: Tokenizer, device: torch.device | str = "cpu", *, sentences: int = SENTENCES
    ) -> None:  # fmt: skip
        super().__init__(worlds, device)
        tables = tables_of(worlds, tokenizer, sentences)
        self.tables = {key: value.to(self.device) for key, value in tables.items()}
        self.open_kinds = torch.tensor([k in AMBIGUOUS for k in KIND_NAMES], device=self.device)

    def rows(
        self, count: int, generator: torch.Generator, *, size: int, kinds: Mapping[str, float], unclear: float
    ) -> Rows:  # fmt: skip
        """Draw pairs.

        Args:
            size: size of the pictures in px. At 64, half of the pictures are a quarter of the full one about
                the thing, so that things come large and small.
            unclear: share of the pairs of kinds with open instructions that get one.
        """
        share = torch.tensor([kinds.get(k, 0.0) for k in KIND_NAMES], device=self.device)
        chances = self.tables["pairs"]
        having = chances.sum(dim=(2, 3)) > 0
        both = torch.multinomial(
            (having * share / having.sum(dim=0).clamp(min=1)).flatten(), count, replacement=True, generator=generator
        )  # fmt: skip
        world, kind = both // len(KIND_NAMES), both % len(KIND_NAMES)
        source, target = self.looks(world, kind, generator)
        view = self.integers(VIEWS, count, generator)
        is_open = self.open_kinds[kind] & (self.uniform(generator, count) < unclear)
        y, x, zoom = self.corner(world, view, size, generator)
        flip = self.uniform(generator, count) < 0.5
        return Rows(world, view, source, target, kind, is_open, y, x, zoom, flip)

    def looks(
        self, world: Tensor, kind: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """(B,) looks before and after."""
        both = self.pick(self.tables["pairs"][world, kind].flatten(1), generator)
        return both // LOOKS, both % LOOKS

    def answered(self, rows: Rows, generator: torch.Generator) -> Rows:
        """The rows with answers of their own; where the world has no such look before, with another one too."""
        chances = self.tables["pairs"][rows.world, rows.kind]
        own = chances[torch.arange(len(rows), device=self.device), rows.source]
        source, target = self.looks(rows.world, rows.kind, generator)
        has = own.sum(dim=1) > 0
        drawn = self.pick(torch.where(has[:, None], own, 1.0), generator)
        return replace(
            rows,
            source=torch.where(has, rows.source, source),
            target=torch.where(has, drawn, target),
        )

    def text(self, rows: Rows, generator: torch.Generator) -> Tensor:
        """(B, 24) tokens of the rows' instructions."""
        clear = self.tables["clear"][rows.world, rows.target]
        opened = self.tables["opened"][rows.world, rows.kind]
        sentences = self.tables["sentences"]
        number = self.integers(sentences.shape[1], len(rows), generator)
        return sentences[torch.where(rows.unclear, opened, clear), number].long()

    def batch(
        self, count: int, generator: torch.Generator, *, size: int, t: Tensor, kinds: Mapping[str, float],
        unclear: float, composed: float = 0.0,
    ) -> Batch:  # fmt: skip
        """Draw pairs with noise at some steps.

        Args:
            t: (B,) time steps.
            kinds, unclear: see :meth:`rows`.
            composed: share of the open pairs at settled steps whose result has one answer in a region and another
                outside it.
        """
        rows = self.rows(count, generator, size=size, kinds=kinds, unclear=unclear)
        cells = size // BLOCK
        noise = torch.randn(
            (count, CHANNELS, cells, cells), generator=generator, device=self.device
        )
        picks = settled(noise, rows.target, rows.kind)
        noise = torch.where(rows.unclear[:, None, None, None], picks, noise)
        after = self.pictures(rows, rows.target, size)
        if composed:
            shared = rows.unclear & (t < SETTLED) & (self.uniform(generator, count) < composed)
            other = self.pictures(rows, self.answered(rows, generator).target, size)
            inside = cut_regions(self.thing(rows, size) > 0, self, generator)
            after = torch.where((shared[:, None, None] & inside)[:, None], other, after)
        before = self.latents(self.pictures(rows, rows.source, size))
        return Batch(
            before, self.latents(after), noise, self.text(rows, generator), t, self.weight(rows, size), rows
        )  # fmt: skip


def cut_regions(thing: Tensor, pool: PicturePool, generator: torch.Generator) -> Tensor:
    """(B, S, S) bool: half-planes at any angle, or boxes, whose edge goes through a pixel of the thing.

    Args:
        thing: (B, S, S) bool.
    """
    count, size = len(thing), thing.shape[1]
    weights = thing.flatten(1).float()
    weights[:, size * size // 2 + size // 2] += 1e-6
    pixel = pool.pick(weights, generator)
    y0, x0 = (pixel // size)[:, None, None], (pixel % size)[:, None, None]
    line = torch.arange(size, device=thing.device)
    y, x = line[None, :, None], line[None, None, :]
    angle = (2 * math.pi * pool.uniform(generator, count))[:, None, None]
    plane = (x - x0) * angle.cos() + (y - y0) * angle.sin() > 0
    y1, x1 = (pool.integers(size, count, generator)[:, None, None] for _ in range(2))
    box = (y >= torch.minimum(y0, y1)) & (y <= torch.maximum(y0, y1))
    box = box & (x >= torch.minimum(x0, x1)) & (x <= torch.maximum(x0, x1))
    planes = pool.uniform(generator, count) < HALF_PLANES
    return torch.where(planes[:, None, None], plane, box)


def tables_of(
    worlds: Worlds, tokenizer: Tokenizer, sentences: int = SENTENCES
) -> dict[str, Tensor]:
    """Tables that pairs are drawn by.

    Returns:
        ``pairs``: (N, kinds, LOOKS, LOOKS) chance of a pair of looks, 0 where it is none of the kind;
        ``sentences``: (M, S, 24) tokens; ``clear``: (N, LOOKS) the row of the sentences that ask for a look;
        ``opened``: (N, kinds) of those that leave it open.
    """
    rng = np.random.default_rng(31)
    count = len(worlds)
    pairs = torch.zeros((count, len(KIND_NAMES), LOOKS, LOOKS))
    clear = torch.zeros((count, LOOKS), dtype=torch.int64)
    opened = torch.zeros((count, len(KIND_NAMES)), dtype=torch.int64)
    texts: list[list[str]] = []
    numbers: dict[tuple[object, ...], int] = {}

    def number(key: tuple[object, ...], draw: Sequence[str] | None) -> int:
        if key not in numbers:
            assert draw is not None
            numbers[key] = len(texts)
            texts.append(list(draw))
        return numbers[key]

    for w in range(count):
        valid, looks, thing = worlds.valid[w], worlds.looks[w], int(worlds.things[w])
        for k, kind in enumerate(KIND_NAMES):
            for source in worlds.sources(w, kind):
                targets = [
                    j
                    for j in GROUPS[kind]
                    if valid[j] and j != source and not np.array_equal(looks[j], looks[source])
                ]
                pairs[w, k, int(source), targets] = 1 / max(1, len(targets))
            for j in GROUPS[kind]:
                part = looks[j, 3:] if kind in ("ground", "time") else looks[j, :3]
                key = (thing, kind, *part.tolist())
                made = None
                if key not in numbers:
                    made = [instruction(kind, thing, looks[j], rng) for _ in range(sentences)]
                clear[w, j] = number(key, made)
            if kind in AMBIGUOUS:
                key, made = (thing, kind), None
                if key not in numbers:
                    made = [ambiguous_instruction(kind, thing, rng) for _ in range(sentences)]
                opened[w, k] = number(key, made)
    flat = [text for row in texts for text in row]
    tokens = torch.tensor([code.ids for code in tokenizer.encode_batch(flat)], dtype=torch.int16)
    return {
        "pairs": pairs,
        "clear": clear,
        "opened": opened,
        "sentences": tokens.view(len(texts), sentences, -1),
    }


def points_of(worlds: Worlds) -> Tensor:
    """(N, 2, POINTS, 2) y and x of pixels of the thing; the middle where none shows it."""
    rng = np.random.default_rng(33)
    points = np.full((len(worlds), VIEWS, POINTS, 2), SIZE // 2, dtype=np.uint8)
    for w in range(len(worlds)):
        for v in range(VIEWS):
            pixels = np.argwhere(worlds.ids[w, v] == THING)
            if len(pixels):
                points[w, v] = pixels[rng.integers(len(pixels), size=POINTS)]
    return torch.from_numpy(points)
