"""The stage that teaches an editor to let injected features carry the answer, and where.

Run A is recorded with its gradient on, run B gets its features at the same step, and B's target is composed to match:
A's answer where the features went, B's own answer elsewhere. Features go over in part (halves, boxes) and from A's
picture mirrored or shifted, or from the other view of its world along the true warp, so "this colour, anywhere" does not help.
Features of an unrelated picture change nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from attnwarp.editing.latents import BLOCK, CHANNELS
from attnwarp.editing.layers import BareUNet, Call, Layer, hooked
from training.editors.answers import settled
from training.editors.net import T_STEPS, EditorNet, draw_steps, loss_of, noised
from training.editors.pool import Batch, PairPool, Rows
from training.worlds.editing_pairs import SIZE

FIRST_WEIGHT, WEIGHT_SPREAD, LEAST_WEIGHT = 0.9, 0.15, 0.05
"""Features are mixed in with the paper's falling weight at that step, give or take the spread.

A weight that does not follow the step asks for what no network can give: of two features mixed by halves,
each would have to win.
"""

MOST_ALPHA = 0.05
"""Largest alpha-bar of a step at which B's state may still show its own answer: later that is visible."""

CARRIED = 0.5
"""Share of the pairs whose state of B shows what earlier steps carried over, at any step."""

MOST_OWN = 0.35
"""Largest share of B's own answer in such a state: earlier steps do not carry all."""

NO_TEXT = 0.1
"""Share of the pairs whose runs both have no text, as guidance's other branch has."""

WAYS = {"same": 0.35, "mirrored": 0.15, "shifted": 0.15, "other view": 0.25, "unrelated": 0.1}
"""Sources of run A's features, and the share of each."""

INJECTED_KINDS = {"color": 0.6, "material": 0.25, "ground": 0.15}


def regions(cells: int, count: int, pool: PairPool, generator: torch.Generator) -> Tensor:
    """(B, h, w) bool, where features go over: everything (40 %), a half (30 %), or a box."""
    line = torch.arange(cells, device=pool.device)
    y, x = line[None, :, None], line[None, None, :]
    draw = pool.uniform(generator, count)[:, None, None]
    which = pool.integers(4, count, generator)[:, None, None]
    along = torch.where(which < 2, y, x)
    half = (along < cells // 2) == (which % 2 == 0)
    box = torch.ones((count, cells, cells), dtype=torch.bool, device=pool.device)
    for place in (y, x):
        side = cells // 4 + pool.integers(3 * cells // 4 + 1 - cells // 4, count, generator)
        low = (pool.uniform(generator, count) * (cells - side + 1)).long()
        low, side = low[:, None, None], side[:, None, None]
        box = box & (place >= low) & (place < low + side)
    return (draw < 0.4) | torch.where(draw < 0.7, half, box)


class Moves:
    """Moves of run A's features to run B's grid, one a pair: an index into A's cells, and where
    there is one.

    Args:
        cells: along a side of the latents.
        index: (B, cells^2) into A's cells, row by row.
        mask: (B, cells^2) bool.
        weight: (B,) of the blend.
    """

    def __init__(self, cells: int, index: Tensor, mask: Tensor, weight: Tensor) -> None:
        self.cells, self.index, self.mask, self.weight = cells, index, mask, weight

    def level(self, level: int) -> tuple[Tensor, Tensor]:
        """(B, n) index and mask of a layer of that level, whose cells are 2 ** level of the latents' each."""
        step, n = 2**level, self.cells // 2**level
        shape = (len(self.index), self.cells, self.cells)
        # The cell at a block's middle stands for it.
        pick = self.index.view(shape)[:, step // 2 :: step, step // 2 :: step]
        y, x = pick // self.cells // step, pick % self.cells // step
        mask = self.mask.view(shape).float()
        share = torch.nn.functional.avg_pool2d(mask[:, None], step)[:, 0]
        return (y * n + x).flatten(1), (share > 0.5).flatten(1)

    def blend(self, layer: Layer, recorded: Tensor, new: Tensor) -> Tensor:
        """a (M moved + (1 - M) new) + (1 - a) new for (B, n, C) tokens."""
        index, mask = self.level(layer.level)
        moved = recorded.gather(1, index[:, :, None].expand_as(recorded))
        mixed = torch.lerp(new, moved, self.weight[:, None, None].to(new))
        return torch.where(mask[:, :, None], mixed, new)


def draw_moves(
    pool: PairPool, rows: Rows, size: int, generator: torch.Generator
) -> tuple[Rows, Rows, Tensor, Tensor, Tensor]:
    """For each of B's rows: the way's place in :data:`WAYS` and where features come from.

    Returns:
        B's rows (another view's warp needs the whole picture), A's rows, (B,) ways, (B, cells^2) index into A's
        cells and mask.
    """
    cells, count = size // BLOCK, len(rows)
    names = list(WAYS)
    shares = torch.tensor(list(WAYS.values()), device=pool.device)
    way = torch.multinomial(shares, count, replacement=True, generator=generator)
    line = torch.arange(cells, device=pool.device)
    y, x = line[None, :, None], line[None, None, :]
    index = (y * cells + x).expand(count, cells, cells)
    inside = torch.ones((count, cells, cells), dtype=torch.bool, device=pool.device)

    def of(name: str) -> Tensor:
        return way == names.index(name)

    zero = torch.zeros_like(rows.x)
    whole = replace(
        rows, y=zero, x=zero, zoom=torch.full_like(zero, SIZE // size), flip=torch.zeros_like(rows.flip)
    )  # fmt: skip
    rows = whole.where(of("other view"), rows)
    source = replace(
        rows,
        flip=rows.flip ^ of("mirrored"),
        view=torch.where(of("other view"), 1 - rows.view, rows.view),
    )
    index = torch.where(of("mirrored")[:, None, None], y * cells + (cells - 1 - x), index)

    # The same picture cut elsewhere; a whole one cannot be.
    cut = of("shifted") & (SIZE - rows.zoom * size > 0)
    by = []
    for low in (rows.y, rows.x):
        drawn = pool.integers(2 * (cells // 4) + 1, count, generator) - cells // 4
        least, most = -(low // BLOCK), (SIZE - size - low) // BLOCK
        by.append(torch.where(cut, torch.maximum(torch.minimum(drawn, most), least), 0))
    source = replace(source, y=source.y + by[0] * BLOCK, x=source.x + by[1] * BLOCK)
    along = torch.where(rows.flip, -by[1], by[1])
    from_y, from_x = y - by[0][:, None, None], x - along[:, None, None]
    within = (from_y >= 0) & (from_y < cells) & (from_x >= 0) & (from_x < cells)
    shifted = from_y.clamp(0, cells - 1) * cells + from_x.clamp(0, cells - 1)
    index = torch.where(cut[:, None, None], shifted, index)
    inside = torch.where(cut[:, None, None], within, inside)

    warp_index, warp_mask = pool.moves(size)
    other = of("other view")[:, None, None]
    index = torch.where(
        other, warp_index[rows.world, rows.view].long().view(-1, cells, cells), index
    )
    inside = torch.where(other, warp_mask[rows.world, rows.view].view(-1, cells, cells), inside)

    strange = pool.rows(count, generator, size=size, kinds=INJECTED_KINDS, unclear=1.0)
    strange = replace(strange, kind=rows.kind, source=rows.source, flip=rows.flip)
    source = strange.where(of("unrelated"), source)
    mask = inside & regions(cells, count, pool, generator)
    return rows, source, way, index.flatten(1), mask.flatten(1)


def falling_weight(t: Tensor, generator: torch.Generator) -> Tensor:
    """(B,) weights of the features at (B,) time steps, near the paper's decay."""
    draw = torch.rand(len(t), generator=generator, device=t.device)
    spread = WEIGHT_SPREAD * (2 * draw - 1)
    return (FIRST_WEIGHT * (t + 1) / T_STEPS + spread).clamp(LEAST_WEIGHT, 1)


def inputs(
    pool: PairPool, alphas: Tensor, empty: Tensor, size: int, count: int, generator: torch.Generator, *,
    inject: bool = True, noisy_from: int = 850,
) -> dict[str, Tensor]:  # fmt: skip
    """Pairs of runs A and B as the network gets them, with their targets; the runs of a pair share their step.

    Args:
        alphas: alpha-bar of the steps.
        empty: tokens of no text.
        count: number of pairs.
        generator: on the pool's device.
        inject: False is the control: nothing goes over, B's target is its own answer.
        noisy_from: more of the steps are drawn from here on.
    """
    cells = size // BLOCK
    carried = pool.uniform(generator, count) < CARRIED
    noisy = (alphas < MOST_ALPHA).nonzero()[:, 0]
    least = noisy[pool.integers(len(noisy), count, generator)]
    t = torch.where(carried, draw_steps(count, generator, noisy_from), least)
    b = pool.batch(count, generator, size=size, t=t, kinds=INJECTED_KINDS, unclear=1.0)
    rows, sources, way, index, mask = draw_moves(pool, b.rows, size, generator)
    b = _rebuilt(pool, b, rows, size)
    no_text = pool.uniform(generator, count) < NO_TEXT
    tokens = torch.where(no_text[:, None], empty, b.tokens)
    sources = pool.answered(sources, generator)
    noise = torch.randn((count, CHANNELS, cells, cells), generator=generator, device=pool.device)
    noise = settled(noise, sources.target, sources.kind)
    a = _rebuilt(pool, b, sources, size)
    related = way != list(WAYS).index("unrelated")
    target = shown = b.after
    if inject:
        answer = torch.where(related, sources.target, rows.target)
        wanted = pool.latents(pool.pictures(rows, answer, size))
        warped = mask.view(count, 1, cells, cells) & related[:, None, None, None]
        target = torch.where(warped, wanted, b.after)
        own = MOST_OWN * pool.uniform(generator, count)
        own = torch.where(carried, own, 1.0)[:, None, None, None]
        shown = torch.lerp(target, b.after, own)
    alpha = alphas[t]
    return {
        "t": t, "alpha": alpha, "tokens": tokens, "index": index, "mask": mask, "share": falling_weight(t, generator),
        "noisy A": noised(a.after, noise, alpha), "before A": a.before, "target A": a.after, "weight A": a.weight,
        "noisy B": noised(shown, b.noise, alpha), "before B": b.before, "target B": target, "weight B": b.weight,
    }  # fmt: skip


def injected_loss(
    net: EditorNet, x: Mapping[str, Tensor], *, inject: bool = True
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of pairs of runs (:func:`inputs`), each against its own target.

    Args:
        net: being trained.
        x: inputs of :func:`inputs`.
        inject: False is the control: the same runs, nothing goes over.
    """
    moves = Moves(x["noisy A"].shape[-1], x["index"], x["mask"], x["share"])
    recorded: dict[str, Tensor] = {}

    def keep(layer: Layer, features: Tensor, call: Call) -> None:
        recorded[layer.name] = features

    def blend(layer: Layer, features: Tensor, call: Call) -> Tensor:
        return moves.blend(layer, recorded[layer.name], features)

    unet = BareUNet(net.unet)
    layers = unet.layers()
    with hooked(unet, layers, keep):
        first = net(x["noisy A"], x["before A"], x["t"], x["tokens"])
    loss_a = loss_of(first, x["target A"], x["weight A"], x["alpha"])
    with hooked(unet, layers, blend if inject else keep):
        second = net(x["noisy B"], x["before B"], x["t"], x["tokens"])
    loss_b = loss_of(second, x["target B"], x["weight B"], x["alpha"])
    return loss_a + loss_b, {"recorded": loss_a.detach(), "injected": loss_b.detach()}


def _rebuilt(pool: PairPool, batch: Batch, rows: Rows, size: int) -> Batch:
    """The batch with the pictures of other rows."""
    return replace(
        batch,
        before=pool.latents(pool.pictures(rows, rows.source, size)),
        after=pool.latents(pool.pictures(rows, rows.target, size)),
        weight=pool.weight(rows, size),
        rows=rows,
    )
