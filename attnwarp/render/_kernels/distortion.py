# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Exact depth distortion: sum over ordered pairs w_i w_j |z_i - z_j| at each pixel.

Splats are composited in the order of their centres, and the depths at a pixel may differ from it.
In this order, sum_{j<i} w_i w_j (z_i - z_j) takes two running sums, but a pair out of order counts
with the wrong sign. So every splat walks back over the splats in front of it, until the largest
depth among them no longer exceeds its depth, and adds the correction of such pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from attnwarp.render._kernels.compilation import bare, f32, inlined, u64
from attnwarp.render._kernels.evaluation import (
    depth_from,
    evaluate,
    lay_out,
    move_to_quarter,
    prepare_moments,
)
from attnwarp.render._kernels.lanes import (
    any_true,
    load,
    lowest_bit,
    maximum,
    select,
    store,
)
from attnwarp.render._kernels.layout import (
    PIXELS,
    PLACE,
    PLACE_BITS,
    QUARTER,
    QUARTER_CORNER,
    ROOT2,
    ROW,
    SIDE,
    SQUARES,
    STATE,
    TILE,
)
from attnwarp.render._kernels.rasterization import prefetch_row, quarter_offset, tile_at

FAR = f32(1e30)
"""Depth beyond that of any splat."""


class Slots(NamedTuple):
    """Slots of a tile's buffer, PIXELS float32 each; square by square, row by row in each.

    Depths are relative to the first splat's, which keeps the digits of thin layers far away.
    """

    x: int = 0  # from the tile's middle
    y: int = 1
    last_step: int = 2
    transmittance: int = 3  # in front of the splat at hand
    alpha: int = 4  # sum w
    depth_sum: int = 5  # sum w z
    first_depth: int = 6
    distortion: int = 7  # sum of the pairs, each once


SLOT = Slots()
BUFFER_FLOATS = len(SLOT) * PIXELS


class PastColumns(NamedTuple):
    """A splat at the 16 pixels of a square, PAST float32.

    ``lean`` and ``spread`` are half the changes made by pairs out of order in
    sum_j w_j sign(z_i - z_j) and in sum_j w_j |z_i - z_j|.
    """

    weight: int = 0
    depth: int = 16  # -FAR where it is not drawn
    deepest: int = 32  # the largest depth so far
    lean: int = 48
    spread: int = 64


PAST_AT = PastColumns()
PAST = 80


class WorkRegions(NamedTuple):
    """Offsets of parts of the work on a splat, in float32."""

    row: int = 0  # see lay_out
    linear: int = ROW  # at the quarter at hand


WORK = WorkRegions()
WORK_FLOATS = ROW + 16


class Workspace(NamedTuple):
    """Memory of one job; ``room`` is the largest number of a tile's splats, each counted once for
    every square that it may cover."""

    buffer: np.ndarray  # (BUFFER_FLOATS,) float32, see Slots
    splat: np.ndarray  # (WORK_FLOATS,) float32, see WorkRegions
    moments: np.ndarray  # (MOMENTS,) float64; see lay_out
    past: np.ndarray  # (room PAST,) float32, see PastColumns
    previous: np.ndarray  # (room,) int64, the one before in the same square; -1: none
    latest: np.ndarray  # (SQUARES,) int64, the last one in each square


def bits(squares):
    """Count the squares, one bit each."""
    pairs = squares - (squares >> 1 & 0x5555)
    fours = (pairs & 0x3333) + (pairs >> 2 & 0x3333)
    eights = (fours + (fours >> 4)) & 0x0F0F
    return (eights + (eights >> 8)) & 31


count_bits = inlined(bits)


@inlined
def prepare(space):
    """Set the values common to all tiles."""
    buffer = space.buffer
    for p in range(PIXELS):
        buffer[SLOT.x * PIXELS + p] = f32(p // 16 % SIDE * 4 + p % 4) - f32(TILE / 2 - 0.5)
        buffer[SLOT.y * PIXELS + p] = f32(p // (16 * SIDE) * 4 + p // 4 % 4) - f32(TILE / 2 - 0.5)
    prepare_moments(space.moments, 0)


@inlined
def _begin(space, tile, state):
    buffer = space.buffer
    for p in range(SLOT.last_step * PIXELS, BUFFER_FLOATS, 16):
        store(buffer, p, f32(0.0))
    for p in range(SLOT.transmittance * PIXELS, SLOT.transmittance * PIXELS + PIXELS, 16):
        store(buffer, p, f32(1.0))
    for q in range(SQUARES):
        space.latest[u64(q)] = -1
    for r in range(tile.rows):
        for k in range(tile.columns):
            p = u64((r // 4 * SIDE + k // 4) * 16 + r % 4 * 4 + k % 4)
            last = state[STATE.last_step, u64(tile.top + r), u64(tile.left + k)]
            buffer[u64(SLOT.last_step * PIXELS) + p] = last


@inlined
def _walk_back(space, k, w, z, lean, spread, differentiate):
    """Pair a splat with the splats in front of it whose depth may be larger.

    Args:
        k: index of the latest splat in front.
        w, z: Lanes of the splat; FAR if not drawn.
        lean, spread: Lanes of zeros.

    Returns:
        ``lean`` and ``spread`` of the splat; those of the other splats are updated.
    """
    past = space.past
    while k >= 0:
        at = k * PAST
        if not any_true(z < load(past, at + PAST_AT.deepest)):
            break
        z_k, w_k = load(past, at + PAST_AT.depth), load(past, at + PAST_AT.weight)
        behind = z < z_k
        gap = select(behind, z_k - z, f32(0.0))
        spread = spread + w_k * gap
        if differentiate:
            lean = lean - select(behind, w_k, f32(0.0))
            column = at + PAST_AT.lean
            store(past, column, load(past, column) + select(behind, w, f32(0.0)))
            column = at + PAST_AT.spread
            store(past, column, load(past, column) + w * gap)
        k = space.previous[u64(k)]
    return lean, spread


@inlined
def _add(space, q, slot, hit, alpha, scaled, inverse, discs, by_center, differentiate):
    """Add a splat to the pairs of square q."""
    buffer, past = space.buffer, space.past
    s, at = q * 16, slot * PAST
    zero = load(buffer, SLOT.x * PIXELS) * f32(0.0)
    T = load(buffer, SLOT.transmittance * PIXELS + s)
    A = load(buffer, SLOT.alpha * PIXELS + s)
    depth_sum = load(buffer, SLOT.depth_sum * PIXELS + s)
    first = load(buffer, SLOT.first_depth * PIXELS + s)
    w = select(hit, alpha * T, f32(0.0))
    depth, _ = depth_from(space.splat, WORK.row, scaled, inverse, discs, by_center, zero, zero)
    first = select(hit & (f32(1.0) <= T), depth, first)
    depth, _ = depth_from(space.splat, WORK.row, scaled, inverse, discs, by_center, first, zero)
    k = space.latest[u64(q)]
    lean, spread = _walk_back(space, k, w, select(hit, depth, FAR), zero, zero, differentiate)
    deepest = select(hit, depth, -FAR)
    store(past, at + PAST_AT.weight, w)
    store(past, at + PAST_AT.depth, deepest)
    if k >= 0:
        deepest = maximum(deepest, load(past, k * PAST + PAST_AT.deepest))
    store(past, at + PAST_AT.deepest, deepest)
    store(past, at + PAST_AT.lean, lean)
    store(past, at + PAST_AT.spread, spread)
    space.previous[u64(slot)], space.latest[u64(q)] = k, slot
    w_depth = w * depth
    distortion = load(buffer, SLOT.distortion * PIXELS + s)
    distortion = distortion + (w_depth * A - w * depth_sum) + f32(2.0) * w * spread
    store(buffer, SLOT.distortion * PIXELS + s, distortion)
    store(buffer, SLOT.transmittance * PIXELS + s, T - w)
    store(buffer, SLOT.alpha * PIXELS + s, A + w)
    store(buffer, SLOT.depth_sum * PIXELS + s, depth_sum + w_depth)
    store(buffer, SLOT.first_depth * PIXELS + s, first)


@bare
def pair_up(space, table, view, tile, entries, begin, count, state, differentiate):
    """Find the pairs of a tile's splats that are out of order.

    Every splat has a place in ``space.past`` for each square that it may cover: splat by splat
    front to back, and quarter by quarter.

    Returns:
        Number of places.
    """
    buffer, work, moments = space.buffer, space.splat, space.moments
    discs, by_center = view.discs, view.by_center
    middle_x, middle_y = tile.left + TILE / 2, tile.top + TILE / 2
    _begin(space, tile, state)
    slot = 0
    for e in range(begin, begin + count):
        entry = entries[u64(e)]
        prefetch_row(table, entries[u64(min(e + 8, begin + count - 1))] & PLACE)
        squares = entry >> PLACE_BITS
        if squares == 0:
            continue
        step = f32(e - begin + 1)
        lay_out(
            work, WORK.row, moments, 0, table, entry & PLACE, middle_x, middle_y, discs, by_center
        )
        quarter, dx, dy = 0, 0.0, 0.0
        while squares != 0:
            if quarter == 0:
                corner = lowest_bit(squares) & QUARTER_CORNER
                quarter = squares & (QUARTER << corner)
                dx, dy = quarter_offset(corner)
                move_to_quarter(work, WORK.linear, moments, 0, dx, dy)
            q = lowest_bit(quarter)
            quarter &= quarter - 1
            squares &= ~(1 << q)
            nx = load(buffer, SLOT.x * PIXELS + q * 16) - f32(dx)
            ny = load(buffer, SLOT.y * PIXELS + q * 16) - f32(dy)
            inside, alpha, scaled, inverse = evaluate(
                work, WORK.row, WORK.linear, nx, ny, nx * f32(ROOT2), ny * f32(ROOT2), discs,
                by_center,
            )  # fmt: skip
            hit = inside & (step <= load(buffer, SLOT.last_step * PIXELS + q * 16))
            _add(space, q, slot, hit, alpha, scaled, inverse, discs, by_center, differentiate)
            slot += 1
    return slot


@bare
def distort(first, last, view, tiles, lists, table, state, target, space):
    """Write the distortion of the tiles order[first:last] to ``target``, (H, W) float32."""
    prepare(space)
    for visited in range(first, last):
        t = tiles.order[visited]
        tile = tile_at(t, tiles, view)
        pair_up(
            space, table, view, tile, lists.entries, lists.starts[t], lists.counts[t], state, False
        )
        for r in range(tile.rows):
            for k in range(tile.columns):
                p = u64((r // 4 * SIDE + k // 4) * 16 + r % 4 * 4 + k % 4)
                once = space.buffer[u64(SLOT.distortion * PIXELS) + p]
                # Clamped to 0: running sums of equal depths leave a rounding error.
                target[u64(tile.top + r), u64(tile.left + k)] = f32(2.0) * max(once, f32(0.0))
