# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Rasterization: splats composited front to back, tile by tile.

In vectors of 16 pixels, a square of 4 x 4, with the sums of a square in registers while a block of
splats goes by.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from attnwarp.render._kernels.compilation import (
    bare,
    f32,
    f64,
    inlined,
    prefetch,
    prefetch_to_write,
    u64,
)
from attnwarp.render._kernels.evaluation import (
    depth_from,
    evaluate,
    lay_out,
    move_to_quarter,
    prepare_moments,
)
from attnwarp.render._kernels.lanes import (
    absolute,
    any_true,
    broadcast,
    copy4,
    count_true,
    interleave4,
    load,
    lowest_bit,
    reciprocal,
    select,
    store,
    sum_each,
    with_any_bit,
)
from attnwarp.render._kernels.layout import (
    EVERY_SQUARE,
    MOMENTS,
    PIXELS,
    PLACE,
    PLACE_BITS,
    QUARTER,
    ROOT2,
    ROW,
    ROW_DOUBLES,
    SIDE,
    SPLAT,
    SQUARES,
    STATE,
    TILE,
    TILE_ROW,
)
from attnwarp.render.constants import MEDIAN_TRANSMITTANCE, TRANSMITTANCE_STOP

BLOCK = 32
"""Splats that a tile's squares are composited with in turn."""
AHEAD = 32
"""Entries by which rows of the table are prefetched."""
WEIGHT_UNIT = 2.0**-36
"""Weights are summed as whole numbers of this: the same bits in any order."""


class BlockRegions(NamedTuple):
    """Offsets of parts of the work on a block of splats, in float32."""

    rows: int = 0  # BLOCK rows; see lay_out
    weights: int = BLOCK * ROW  # of each splat, at the 16 pixels of all squares
    shares: int = BLOCK * (ROW + 16)  # of each splat, at the 16 pixels of the square at hand
    linear: int = BLOCK * (ROW + 32)  # 8 of each splat, at the quarter at hand


BLOCK_WORK = BlockRegions()
BLOCK_FLOATS = BLOCK * (ROW + 32 + 8)


class Slots(NamedTuple):
    """Slots of a tile's buffer, PIXELS float32 each; square by square, row by row in each.

    Sums of depths are relative to the first splat's, which keeps the digits of thin layers far
    away.
    """

    x: int = 0  # from the middle of its quarter of the tile
    y: int = 1
    transmittance: int = 2
    depth: int = 3  # made of the sums when the tile is done
    alpha: int = 4
    depth_sum: int = 5  # sum w (z - first_depth)
    ordered: int = 6
    median: int = 7
    median_step: int = 8
    last_step: int = 9
    first_depth: int = 10
    normal: int = 11  # (3)
    color: int = 14  # (channels)


SLOT = Slots()
FIRST_SUM = SLOT.alpha


def buffer_floats(channels: int) -> int:
    """Floats of a tile's buffer."""
    return (SLOT.color + max(3, channels)) * PIXELS


class Workspace(NamedTuple):
    """Memory of one job of :func:`rasterize`."""

    buffer: np.ndarray  # (buffer_floats,) float32, see Slots
    block: np.ndarray  # (BLOCK_FLOATS,) float32, see BlockRegions
    moments: np.ndarray  # (BLOCK MOMENTS,) float64; see lay_out
    picks: np.ndarray  # (BLOCK,) int64, splats of the block that the square at hand took
    entries: np.ndarray  # (BLOCK,) int64, the block's entries
    masks: np.ndarray  # (BLOCK,) int32, the squares that each is composited in


class Tile(NamedTuple):
    """A tile of the picture."""

    top: Any  # its first row and column of pixels
    left: Any
    rows: Any  # its size: less than TILE at the picture's edge
    columns: Any


@inlined
def tile_at(index, tiles, view):
    top, left = index // tiles.across * TILE, index % tiles.across * TILE
    return Tile(top, left, min(TILE, view.height - top), min(TILE, view.width - left))


@inlined
def quarter_offset(corner):
    """(x, y) of the middle of the quarter whose first square is ``corner``, from the tile's."""
    return (corner & 2) * 4.0 - 4.0, (corner & 8) - 4.0


@inlined
def prefetch_row(table, k):
    """Load the three cache lines of a row of the table."""
    prefetch(table.doubles, k * ROW_DOUBLES)
    prefetch(table.doubles, k * ROW_DOUBLES + 8)
    prefetch(table.doubles, k * ROW_DOUBLES + 16)


@inlined
def _prefetch_pictures(pictures, tile, width, channels):
    """Ask for the pixels of a tile: they are written when it is done, so the memory has time."""
    plane = pictures.alpha.shape[0] * width
    for r in range(tile.rows):
        to = (tile.top + r) * width + tile.left
        prefetch_to_write(pictures.alpha, to)
        prefetch_to_write(pictures.depth, to)
        prefetch_to_write(pictures.median, to)
        prefetch_to_write(pictures.ordered, to)
        prefetch_to_write(pictures.normal, 3 * to)
        prefetch_to_write(pictures.normal, 3 * to + 3 * tile.columns - 1)
        prefetch_to_write(pictures.color, channels * to)
        prefetch_to_write(pictures.color, channels * (to + tile.columns) - 1)
        if pictures.state.shape[1] > 0:
            for k in range(pictures.state.shape[0]):
                prefetch_to_write(pictures.state, k * plane + to)


@inlined
def _clear(buffer, tile, stop):
    """Begin a tile; returns the squares that have ended already, one bit each."""
    for p in range(0, PIXELS, 16):
        store(buffer, SLOT.transmittance * PIXELS + p, f32(1.0))
    if tile.rows < TILE or tile.columns < TILE:
        # Pixels outside of the image are opaque from the start: they take no part and never delay
        # the stop.
        for p in range(PIXELS):
            column, row = p // 16 % SIDE * 4 + p % 4, p // (16 * SIDE) * 4 + p // 4 % 4
            if column >= tile.columns or row >= tile.rows:
                buffer[SLOT.transmittance * PIXELS + p] = f32(0.0)
    for p in range(FIRST_SUM * PIXELS, buffer.shape[0], 16):
        store(buffer, p, f32(0.0))
    ended = 0
    for q in range(SQUARES):
        if not any_true(stop < load(buffer, SLOT.transmittance * PIXELS + q * 16)):
            ended |= 1 << q
    return ended


@inlined
def _lay_out_block(space, table, lists, weights, view, tile, begin, e, end, ended):
    """Lay out the next splats of a list that show in squares that have not ended.

    Returns:
        The entry after the last one looked at, and the number of splats in the block.
    """
    middle_x, middle_y = tile.left + TILE / 2, tile.top + TILE / 2
    size = 0
    while e < end and size < BLOCK:
        # The rows are anywhere in a table larger than the cache.
        prefetch_row(table, lists.entries[min(e + AHEAD, end - 1)] & PLACE)
        entry = lists.entries[e]
        squares = entry >> PLACE_BITS & ~ended
        if squares == 0:
            weights[u64(e)] = f32(0.0)
        else:
            space.entries[u64(size)], space.masks[u64(size)] = e, squares
            row = BLOCK_WORK.rows + size * ROW
            lay_out(
                space.block, row, space.moments, size * MOMENTS, table, entry & PLACE, middle_x,
                middle_y, view.discs, view.by_center,
            )  # fmt: skip
            space.block[u64(row + TILE_ROW.step)] = f32(e - begin + 1)
            store(space.block, BLOCK_WORK.weights + size * 16, f32(0.0))
            size += 1
        e += 1
    for k in range(size, BLOCK):
        space.masks[u64(k)] = 0
    return e, size


@inlined
def _in_block(masks, squares):
    """Mask of the block's splats that are composited in any of these squares: a bit for each."""
    return with_any_bit(masks, 0, squares) | with_any_bit(masks, 16, squares) << 16


@inlined
def _first_and_median(work, row, hit, T, z, discs, by_center, zero, sums):
    """Take a splat as the first of a pixel, and as its median, where it is that.

    Args:
        T: transmittance in front of it.
        sums: first_depth, median, median_step.
    """
    first_depth, median, median_step = sums
    depth = depth_from(work, row, z, discs, by_center, zero)
    opens, is_first = hit & (f32(MEDIAN_TRANSMITTANCE) < T), hit & (f32(1.0) <= T)
    step = broadcast(work, row + TILE_ROW.step)
    return (
        select(is_first, depth, first_depth),
        select(opens, depth, median),
        select(opens, step, median_step),
    )


@inlined
def _composite_square(space, q, left, view, channels, keep):
    """Composite splats of the block, ``left`` as bits, in square q, its sums in registers.

    The sums are the slots' of the same names.

    Returns:
        How many splats were evaluated; in how many pairs they are composited, and drawn; and the
        splat with which every pixel has ended, or -1.
    """
    buffer, work, discs, by_center = space.buffer, space.block, view.discs, view.by_center
    stop = f32(TRANSMITTANCE_STOP)
    s = q * 16
    zero = load(buffer, SLOT.x * PIXELS) * f32(0.0)
    x, y = load(buffer, SLOT.x * PIXELS + s), load(buffer, SLOT.y * PIXELS + s)
    sx, sy = x * f32(ROOT2), y * f32(ROOT2)
    T, A = load(buffer, SLOT.transmittance * PIXELS + s), load(buffer, SLOT.alpha * PIXELS + s)
    depth_sum = load(buffer, SLOT.depth_sum * PIXELS + s)
    ordered = load(buffer, SLOT.ordered * PIXELS + s)
    last_step = load(buffer, SLOT.last_step * PIXELS + s)
    n0 = load(buffer, SLOT.normal * PIXELS + s)
    n1 = load(buffer, (SLOT.normal + 1) * PIXELS + s)
    n2 = load(buffer, (SLOT.normal + 2) * PIXELS + s)
    c0 = load(buffer, SLOT.color * PIXELS + s)
    c1 = load(buffer, (SLOT.color + 1) * PIXELS + s)
    c2 = load(buffer, (SLOT.color + 2) * PIXELS + s)
    first_depth = load(buffer, SLOT.first_depth * PIXELS + s)
    median = load(buffer, SLOT.median * PIXELS + s)
    median_step = load(buffer, SLOT.median_step * PIXELS + s)
    # What only the first splats of a pixel decide: once no pixel is undecided, that is over for a
    # block at a time, so that it costs no branch that goes both ways.
    undecided = any_true(f32(MEDIAN_TRANSMITTANCE) < T)
    alive = stop < T
    used, composited, contributing, ends_with = 0, 0, 0, -1
    ahead = lowest_bit(left)
    inside_ahead, alpha_ahead, z_ahead = evaluate(
        work, ahead * ROW, BLOCK_WORK.linear + ahead * 8, x, y, sx, sy, discs, by_center
    )
    while True:
        k, inside, alpha, z = ahead, inside_ahead, alpha_ahead, z_ahead
        row = k * ROW
        left &= left - 1
        if left != 0:
            # One splat ahead: a long chain of operations that wait for each other, while the sums
            # of the one at hand wait for nothing.
            ahead = lowest_bit(left)
            inside_ahead, alpha_ahead, z_ahead = evaluate(
                work, ahead * ROW, BLOCK_WORK.linear + ahead * 8, x, y, sx, sy, discs, by_center
            )
        hit = inside & alive
        w = select(hit, alpha * T, f32(0.0))
        if keep:
            last_step = select(hit, broadcast(work, row + TILE_ROW.step), last_step)
        if undecided:
            first_depth, median, median_step = _first_and_median(
                work, row, hit, T, z, discs, by_center, zero, (first_depth, median, median_step)
            )
        w_depth = w * depth_from(work, row, z, discs, by_center, first_depth)
        ordered = ordered + absolute(w_depth * A - w * depth_sum)
        A, depth_sum = A + w, depth_sum + w_depth
        n0 = n0 + w * broadcast(work, row + SPLAT.normal)
        n1 = n1 + w * broadcast(work, row + SPLAT.normal + 1)
        n2 = n2 + w * broadcast(work, row + SPLAT.normal + 2)
        c0 = c0 + w * broadcast(work, row + SPLAT.values)
        c1 = c1 + w * broadcast(work, row + SPLAT.values + 1)
        c2 = c2 + w * broadcast(work, row + SPLAT.values + 2)
        T = T - w
        weights = BLOCK_WORK.weights + k * 16
        store(work, weights, load(work, weights) + w)
        if channels > 3:
            store(work, BLOCK_WORK.shares + used * 16, w)
            space.picks[u64(used)] = k
        drawn = count_true(hit)
        contributing += drawn
        # 16 if there are any: no second test of the mask.
        composited += (drawn + 15) & 16
        used += 1
        alive = stop < T
        if not any_true(alive):
            ends_with = k
            break
        if left == 0:
            break
    store(buffer, SLOT.transmittance * PIXELS + s, T)
    store(buffer, SLOT.alpha * PIXELS + s, A)
    store(buffer, SLOT.depth_sum * PIXELS + s, depth_sum)
    store(buffer, SLOT.ordered * PIXELS + s, ordered)
    store(buffer, SLOT.last_step * PIXELS + s, last_step)
    store(buffer, SLOT.normal * PIXELS + s, n0)
    store(buffer, (SLOT.normal + 1) * PIXELS + s, n1)
    store(buffer, (SLOT.normal + 2) * PIXELS + s, n2)
    store(buffer, SLOT.color * PIXELS + s, c0)
    store(buffer, (SLOT.color + 1) * PIXELS + s, c1)
    store(buffer, (SLOT.color + 2) * PIXELS + s, c2)
    store(buffer, SLOT.first_depth * PIXELS + s, first_depth)
    store(buffer, SLOT.median * PIXELS + s, median)
    store(buffer, SLOT.median_step * PIXELS + s, median_step)
    return used, composited, contributing, ends_with


@inlined
def _add_channels(space, q, used, entries, features, channels):
    """Sum the channels from the fourth on in square q, over the splats it took."""
    for c in range(3, channels):
        slot = (SLOT.color + c) * PIXELS + q * 16
        sums = load(space.buffer, slot)
        for k in range(used):
            splat = entries[u64(space.entries[space.picks[u64(k)]])] & PLACE
            share = load(space.block, BLOCK_WORK.shares + k * 16)
            sums = sums + share * features[u64(splat), u64(c)]
        store(space.buffer, slot, sums)


@inlined
def _entry_weights(space, size, weights):
    """The weights of the block's entries: sums over the tile's pixels."""
    work = space.block
    for k in range(0, size, 16):
        b = BLOCK_WORK.weights + k * 16
        sums = sum_each(
            load(work, b), load(work, b + 16), load(work, b + 32), load(work, b + 48),
            load(work, b + 64), load(work, b + 80), load(work, b + 96), load(work, b + 112),
            load(work, b + 128), load(work, b + 144), load(work, b + 160), load(work, b + 176),
            load(work, b + 192), load(work, b + 208), load(work, b + 224), load(work, b + 240),
        )  # fmt: skip
        store(work, BLOCK_WORK.shares, sums)
        for j in range(min(16, size - k)):
            weights[u64(space.entries[u64(k + j)])] = work[u64(BLOCK_WORK.shares + j)]


@inlined
def _finish(buffer, background):
    """Make depths, the distortion and colours of a tile's sums."""
    for p in range(0, PIXELS, 16):
        A = load(buffer, SLOT.alpha * PIXELS + p)
        covered = f32(0.0) < A
        inverse = select(covered, reciprocal(A), f32(0.0))
        depth = load(buffer, SLOT.first_depth * PIXELS + p)
        depth = depth + load(buffer, SLOT.depth_sum * PIXELS + p) * inverse
        store(buffer, SLOT.depth * PIXELS + p, select(covered, depth, f32(np.nan)))
        median = load(buffer, SLOT.median * PIXELS + p)
        store(buffer, SLOT.median * PIXELS + p, select(covered, median, f32(np.nan)))
        # Pairs were counted once.
        ordered = load(buffer, SLOT.ordered * PIXELS + p)
        store(buffer, SLOT.ordered * PIXELS + p, ordered * f32(2.0))
        through = f32(1.0) - A
        for c in range(background.shape[0]):
            slot = (SLOT.color + c) * PIXELS + p
            store(buffer, slot, load(buffer, slot) + through * background[c])


@inlined
def _write_whole_tile(buffer, pictures, tile, width):
    """Write a whole tile of three channels, four pixels at once."""
    plane = pictures.alpha.shape[0] * width
    for k in range(PIXELS // 4):
        r, q = k // SIDE, k % SIDE
        p = (r // 4 * SIDE + q) * 16 + r % 4 * 4
        to = (tile.top + r) * width + tile.left + q * 4
        copy4(pictures.alpha, to, buffer, SLOT.alpha * PIXELS + p)
        copy4(pictures.depth, to, buffer, SLOT.depth * PIXELS + p)
        copy4(pictures.median, to, buffer, SLOT.median * PIXELS + p)
        copy4(pictures.ordered, to, buffer, SLOT.ordered * PIXELS + p)
        interleave4(pictures.color, 3 * to, buffer, SLOT.color * PIXELS + p, PIXELS)
        interleave4(pictures.normal, 3 * to, buffer, SLOT.normal * PIXELS + p, PIXELS)
        if pictures.state.shape[1] > 0:
            state = pictures.state
            copy4(state, to + STATE.transmittance * plane, buffer, SLOT.transmittance * PIXELS + p)
            copy4(state, to + STATE.last_step * plane, buffer, SLOT.last_step * PIXELS + p)
            copy4(state, to + STATE.median_step * plane, buffer, SLOT.median_step * PIXELS + p)


@inlined
def _write_tile(buffer, pictures, tile):
    """Write a tile of any size and any number of channels."""
    state = pictures.state
    for r in range(tile.rows):
        for k in range(tile.columns):
            p = u64((r // 4 * SIDE + k // 4) * 16 + r % 4 * 4 + k % 4)
            y, x = u64(tile.top + r), u64(tile.left + k)
            pictures.alpha[y, x] = buffer[u64(SLOT.alpha * PIXELS) + p]
            pictures.depth[y, x] = buffer[u64(SLOT.depth * PIXELS) + p]
            pictures.median[y, x] = buffer[u64(SLOT.median * PIXELS) + p]
            pictures.ordered[y, x] = buffer[u64(SLOT.ordered * PIXELS) + p]
            for c in range(pictures.color.shape[2]):
                pictures.color[y, x, u64(c)] = buffer[u64((SLOT.color + c) * PIXELS) + p]
            for c in range(3):
                pictures.normal[y, x, u64(c)] = buffer[u64((SLOT.normal + c) * PIXELS) + p]
            if state.shape[1] > 0:
                state[STATE.transmittance, y, x] = buffer[u64(SLOT.transmittance * PIXELS) + p]
                state[STATE.last_step, y, x] = buffer[u64(SLOT.last_step * PIXELS) + p]
                state[STATE.median_step, y, x] = buffer[u64(SLOT.median_step * PIXELS) + p]


@bare
def rasterize(
    first,
    last,
    view,
    tiles,
    live,  # (tiles,) bool
    lists,
    table,
    background,  # (C,) float32
    pictures,
    progress,
    space,
):
    """Composite those of the tiles order[first:last] that are live.

    Splats come in blocks of those that show in a square that is not opaque yet: their coefficients
    are laid out once for the tile; each square then picks those that its list says may show in it,
    and composites them with its sums in registers.

    Args:
        pictures, progress: written to.
        space: a ``Workspace``.
    """
    buffer, channels = space.buffer, background.shape[0]
    keep = pictures.state.shape[1] > 0
    for p in range(PIXELS):
        # From the middle of the tile's quarter: offsets are small, and so is what they round.
        buffer[SLOT.x * PIXELS + p] = f32(p // 16 % 2 * 4 + p % 4) - f32(3.5)
        buffer[SLOT.y * PIXELS + p] = f32(p // (16 * SIDE) % 2 * 4 + p // 4 % 4) - f32(3.5)
    for k in range(BLOCK):
        prepare_moments(space.moments, k * MOMENTS)
    for visited in range(first, last):
        t = tiles.order[visited]
        if not live[t]:
            continue
        begin = lists.starts[t]
        end = begin + lists.counts[t]
        tile = tile_at(t, tiles, view)
        _prefetch_pictures(pictures, tile, view.width, channels)
        ended = _clear(buffer, tile, f32(TRANSMITTANCE_STOP))
        tested, composited, contributing, reached = 0, 0, 0, 0
        e = begin
        while e < end and ended != EVERY_SQUARE:
            e, size = _lay_out_block(
                space, table, lists, progress.weights, view, tile, begin, e, end, ended
            )
            for turn in range(SQUARES):
                # The tile's quarters after one another.
                corner = turn & 8 | turn >> 1 & 2
                if turn & 3 == 0:
                    dx, dy = quarter_offset(corner)
                    left = _in_block(space.masks, QUARTER << corner)
                    while left != 0:
                        k = lowest_bit(left)
                        left &= left - 1
                        linear = BLOCK_WORK.linear + k * 8
                        move_to_quarter(space.block, linear, space.moments, k * MOMENTS, dx, dy)
                q = corner + (turn << 1 & 4) + (turn & 1)
                if ended >> q & 1:
                    continue
                left = _in_block(space.masks, 1 << q)
                if left == 0:
                    continue
                used, pairs, drawn, ends_with = _composite_square(
                    space, q, left, view, channels, keep
                )
                tested += 16 * used
                composited += pairs
                contributing += drawn
                if ends_with >= 0:
                    ended |= 1 << q
                    reached = max(reached, space.entries[u64(ends_with)] - begin + 1)
                _add_channels(space, q, used, lists.entries, table.features, channels)
            _entry_weights(space, size, progress.weights)
        progress.opaque[t] = ended == EVERY_SQUARE
        progress.processed[t] = reached if ended == EVERY_SQUARE else end - begin
        progress.tested[t] = tested
        progress.composited[t] = composited
        progress.contributing[t] = contributing
        _finish(buffer, background)
        if tile.rows == TILE and tile.columns == TILE and channels == 3:
            _write_whole_tile(buffer, pictures, tile, view.width)
        else:
            _write_tile(buffer, pictures, tile)


@bare
def splat_weights(
    order,  # (M,) int32
    sums,  # (M,) int64, in WEIGHT_UNIT, in the order of depth
    weight,  # (N,) float32
):
    """Hand the sums of :func:`settle` out to the splats."""
    for place in range(order.shape[0]):
        weight[u64(order[u64(place)])] = sums[u64(place)] * WEIGHT_UNIT


@bare
def settle(
    ended,  # (tiles,) bool
    lists,
    progress,
    sums,  # (M,) int64, in WEIGHT_UNIT, in the order of depth
    offset,
    starts,  # (tiles,) int64
    cached,  # (.) int64: the entries processed in these tiles, or none
):
    """Add the weights of the tiles that have ended to their splats' ``sums``; cache what was
    processed for the backward pass, tile t's from starts[t] - ``offset`` on.

    Weights are summed as whole numbers: the same bits in whatever order tiles end.
    """
    used = 0
    keep = cached.shape[0] > 0
    entries, weights = lists.entries, progress.weights
    for t in range(ended.shape[0]):
        if ended[t]:
            starts[t] = offset + used
            begin = lists.starts[t]
            for e in range(begin, begin + progress.processed[t]):
                entry, weight = entries[u64(e)], weights[u64(e)]
                sums[entry & PLACE] += int(f64(weight) * (1 / WEIGHT_UNIT))
                if keep:
                    # Of what is nowhere drawn, no square is of interest to the backward pass.
                    cached[used] = entry if weight > 0 else entry & PLACE
                    used += 1
