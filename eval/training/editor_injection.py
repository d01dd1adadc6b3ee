"""The stage that teaches an editor to let injected features carry the answer, and where.

Run A is recorded with its gradient on, run B gets its features at the same step, and B's target is composed to match:
A's answer where the features went, B's own answer elsewhere. Features go over in part (halves, boxes) and from A's
picture mirrored or shifted, or from the other view of its world along the true warp, so "this colour, anywhere" does not help.
Features of an unrelated picture change nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.editing.attention import Call, Layer, choose_layers, hooked
from attnwarp.editing.latents import BLOCK
from attnwarp.warp import EXACT_DEPTH_TOLERANCE, FeatureWarp, Surface, WarpSettings, warp_surfaces
from training.editing_pairs import SIZE
from training.editor import (
    T_STEPS,
    Batch,
    EditorNet,
    Pairs,
    Row,
    answered,
    draw_steps,
    loss_of,
    noised,
    settled,
)

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
"""Where run A's features come from, and how often."""

INJECTED_KINDS = {"color": 0.6, "material": 0.25, "ground": 0.15}

EXACT = WarpSettings(opaque=None, normal_test="none", depth_relative=EXACT_DEPTH_TOLERANCE)

Mask = npt.NDArray[np.bool_]


def region(cells: int, rng: np.random.Generator) -> Mask:
    """(h, w) where features go over: everything, a half, or a box."""
    mask = np.zeros((cells, cells), dtype=bool)
    draw = rng.uniform()
    if draw < 0.4:
        mask[:] = True
    elif draw < 0.7:
        half = cells // 2
        rows = [mask[:half], mask[half:], mask[:, :half], mask[:, half:]]
        rows[int(rng.integers(4))][:] = True
    else:
        side = rng.integers(cells // 4, 3 * cells // 4 + 1, 2)
        low = [int(rng.integers(cells - s + 1)) for s in side]
        mask[low[0] : low[0] + side[0], low[1] : low[1] + side[1]] = True
    return mask


class Moves:
    """How features of run A lead to run B's grid, one a pair: an index into A's cells, and where there is one.

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
        mixed = torch.lerp(new, moved, self.weight[:, None, None])
        return torch.where(mask[:, :, None], mixed, new)


def view_warp(pairs: Pairs, source: Row, target: Row) -> FeatureWarp:
    """The exact warp between two views of a world on the grid of the whole picture's latents."""
    worlds, cells = pairs.worlds, pairs.size // BLOCK

    def camera(row: Row) -> Camera:
        K, pose = worlds.K[row.world, row.view], worlds.world_to_camera[row.world, row.view]
        return Camera(K, pose, SIZE, SIZE)

    def surface(row: Row) -> Surface:
        return Surface(worlds.depth[row.world, row.view].astype(np.float64))

    view = warp_surfaces(camera(source), camera(target), surface(target), surface(source), EXACT)
    return view.at((cells, cells))


def draw_moves(
    pairs: Pairs, rows: Sequence[Row], rng: np.random.Generator
) -> tuple[list[Row], list[str], Tensor, Tensor]:
    """For each of B's rows: A's row, the way, (B, cells^2) index into A's cells and mask."""
    cells = pairs.size // BLOCK
    y, x = np.mgrid[0:cells, 0:cells]
    sources, ways, indices, masks = [], [], [], []
    for row in rows:
        way = str(rng.choice(list(WAYS), p=list(WAYS.values())))
        source, inside = row, np.ones((cells, cells), dtype=bool)
        if way == "mirrored":
            source, index = replace(row, flip=not row.flip), y * cells + (cells - 1 - x)
        elif way == "shifted":
            source, index, inside = _shifted(pairs, row, rng)
        elif way == "other view":
            # Crops and mirror images have cameras of their own; the whole picture has the world's.
            row = replace(row, corner=(0, 0, SIZE // pairs.size), flip=False)
            source = replace(row, view=1 - row.view)
            warp = view_warp(pairs, source, row)
            xy = warp.correspondence.xy.numpy()
            index = np.clip(np.nan_to_num(xy), 0, cells - 1e-6).astype(np.int64) @ [1, cells]
            inside = warp.mask.numpy()
        else:
            index = y * cells + x
            if way == "unrelated":
                world = int(rng.integers(len(pairs.worlds)))
                source = replace(row, world=world, corner=pairs.corner(world, row.view, rng))
        ways.append(way)
        sources.append(source)
        indices.append(index.ravel())
        masks.append((inside & region(cells, rng)).ravel())
    return sources, ways, torch.from_numpy(np.stack(indices)), torch.from_numpy(np.stack(masks))


def _shifted(
    pairs: Pairs, row: Row, rng: np.random.Generator
) -> tuple[Row, npt.NDArray[np.int64], Mask]:
    """The same picture cut elsewhere, and which of its cells shows each of the row's."""
    cells, n = pairs.size // BLOCK, row.corner[2]
    y, x = np.mgrid[0:cells, 0:cells]
    most = SIZE - n * pairs.size
    if most == 0:  # the whole picture cannot be cut elsewhere
        return row, y * cells + x, np.ones((cells, cells), dtype=bool)
    block = n * BLOCK
    by = [
        int(
            np.clip(
                rng.integers(-cells // 4, cells // 4 + 1), -(low // block), (most - low) // block
            )
        )
        for low in row.corner[:2]
    ]
    corner = (row.corner[0] + by[0] * block, row.corner[1] + by[1] * block, n)
    from_y, from_x = y - by[0], x + by[1] if row.flip else x - by[1]
    inside = (from_y >= 0) & (from_y < cells) & (from_x >= 0) & (from_x < cells)
    index = np.clip(from_y, 0, cells - 1) * cells + np.clip(from_x, 0, cells - 1)
    return replace(row, corner=corner), index, inside


def falling_weight(t: Tensor, rng: np.random.Generator) -> Tensor:
    """(B,) weights of the features at (B,) time steps, near the paper's decay."""
    spread = torch.from_numpy(rng.uniform(-WEIGHT_SPREAD, WEIGHT_SPREAD, len(t))).float()
    return (FIRST_WEIGHT * (t + 1) / T_STEPS + spread).clamp(LEAST_WEIGHT, 1)


def injected_loss(
    pairs: Pairs, net: EditorNet, alphas: Tensor, empty: Tensor, count: int, rng: np.random.Generator,
    generator: torch.Generator, *, inject: bool = True, noisy_from: int = 850,
) -> tuple[Tensor, dict[str, float]]:  # fmt: skip
    """The loss of ``count`` pairs of runs, each against its own target; the runs share their steps.

    Args:
        pairs: to draw from.
        net: being trained.
        alphas: alpha-bar of the steps.
        empty: tokens of no text.
        count: of pairs; twice as many pictures go through the network.
        rng, generator: to draw from.
        inject: False is the control: the same runs, nothing goes over, B's target is its own answer.
        noisy_from: more of the steps are drawn from here on.
    """
    noisy = np.flatnonzero(alphas.numpy() < MOST_ALPHA)
    carried = torch.from_numpy(rng.uniform(size=count) < CARRIED)
    t = torch.where(
        carried, draw_steps(count, rng, noisy_from), torch.from_numpy(rng.choice(noisy, count))
    )
    b = pairs.batch(count, rng, generator, t=t, kinds=INJECTED_KINDS, unclear=1.0)
    sources, ways, index, mask = draw_moves(pairs, b.rows, rng)
    # "Other view" needs the whole picture, so B's rows may have changed with A's.
    rows = [
        replace(r, corner=s.corner, flip=s.flip) if way == "other view" else r
        for r, s, way in zip(b.rows, sources, ways, strict=True)
    ]
    b = _rebuilt(pairs, b, rows)
    no_text = torch.from_numpy(rng.uniform(size=count) < NO_TEXT)
    b = replace(b, tokens=torch.where(no_text[:, None], empty, b.tokens))
    sources = [answered(pairs.worlds, s, rng) for s in sources]
    noise = torch.randn(b.noise.shape, generator=generator)
    noise = torch.stack([settled(n, s.target, s.kind) for n, s in zip(noise, sources, strict=True)])
    a = replace(_rebuilt(pairs, b, sources), noise=noise)
    related = torch.tensor([way != "unrelated" for way in ways])
    cells = pairs.size // BLOCK
    weight = falling_weight(t, rng)
    moves = Moves(cells, index, mask, weight)
    recorded: dict[str, Tensor] = {}

    def keep(layer: Layer, features: Tensor, call: Call) -> None:
        recorded[layer.name] = features

    def blend(layer: Layer, features: Tensor, call: Call) -> Tensor:
        return moves.blend(layer, recorded[layer.name], features)

    layers = choose_layers(net.unet)
    alpha = alphas[t]
    with hooked(net.unet, layers, keep):
        first = net(noised(a.after, a.noise, alpha), a.before, t, a.tokens)
    loss_a = loss_of(first, a.after, a.weight, alpha)
    target = shown = b.after
    if inject:
        answers = [replace(r, target=s.target) for r, s in zip(rows, sources, strict=True)]
        wanted = pairs.latents([pairs.picture(r, r.target) if k else pairs.picture(o, o.target) for r, o, k in zip(answers, rows, related.tolist(), strict=True)])  # fmt: skip
        warped = mask.view(count, 1, cells, cells) & related[:, None, None, None]
        target = torch.where(warped, wanted, b.after)
        own = torch.from_numpy(rng.uniform(0, MOST_OWN, count)).float()
        own = torch.where(carried, own, 1.0)[:, None, None, None]
        shown = torch.lerp(target, b.after, own)
    with hooked(net.unet, layers, blend if inject else keep):
        second = net(noised(shown, b.noise, alpha), b.before, t, b.tokens)
    loss_b = loss_of(second, target, b.weight, alpha)
    return loss_a + loss_b, {"recorded": float(loss_a.detach()), "injected": float(loss_b.detach())}


def _rebuilt(pairs: Pairs, batch: Batch, rows: list[Row]) -> Batch:
    """The batch with the pictures of other rows."""
    return replace(
        batch,
        before=pairs.latents([pairs.picture(r, r.source) for r in rows]),
        after=pairs.latents([pairs.picture(r, r.target) for r in rows]),
        weight=torch.from_numpy(np.stack([pairs.weight(r) for r in rows]))[:, None],
        rows=rows,
    )
