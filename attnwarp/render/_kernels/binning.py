# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Binning: assignment of splats to the tiles they may cover, down to squares of 4 x 4 pixels.

It uses exact outlines, no bounding circles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from attnwarp.render._kernels.compilation import bare, f32, f64, inlined, u64
from attnwarp.render._kernels.lanes import (
    approximate_sqrt,
    broadcast,
    ceil,
    copy4_integers,
    floor,
    load,
    maximum,
    minimum,
    select,
    store,
    store_integers,
    store_intervals,
    swap1,
    swap2,
)
from attnwarp.render._kernels.layout import (
    DISC,
    NO_ELLIPSE,
    OUTLINE,
    PLACE_BITS,
    RUN,
    RUN_SIZE,
    SIDE,
    SINGLE,
    SPLAT,
    TILE,
)

PIECES = 64
"""Number of pieces of outlines, 16 rows of squares each, processed together."""
PIECE_SPANS = 48  # int32 of a piece in ``spans``: intervals, then first and last column of squares
FIRST_COLUMN, LAST_COLUMN = 16, 32
NO_COLUMNS = 32767.0  # first column of a row without any; its last is -1


class Pieces(NamedTuple):
    """Pieces of outlines waiting to be processed."""

    outlines: np.ndarray  # (16 PIECES,) float32, the outlines' rows
    spans: np.ndarray  # (PIECE_SPANS PIECES,) int32
    rows: np.ndarray  # (PIECES, 3) int64: splat, first row of tiles, rows of tiles


@inlined
def _overlaps(row, x1, x2, y1, y2, cut, w_most):
    """Return True if a 2D splat of any outline may cover a rectangle, by interval arithmetic.

    Args:
        row: (ROW_DOUBLES,) float64 of the table.
        x1, x2, y1, y2: rectangle, relative to the reference point.
    """
    hx, hy, mx, my = (x2 - x1) / 2, (y2 - y1) / 2, (x1 + x2) / 2, (y1 + y2) / 2
    ux, uy, vx, vy = row[DISC.u_x], row[DISC.u_y], row[DISC.v_x], row[DISC.v_y]
    wx, wy = row[DISC.w_x], row[DISC.w_y]
    w = 1.0 + wx * mx + wy * my + abs(wx) * hx + abs(wy) * hy
    if w > 0:
        w = min(w, w_most)
        u = max(abs(ux * mx + uy * my) - abs(ux) * hx - abs(uy) * hy, 0.0)
        v = max(abs(vx * mx + vy * my) - abs(vx) * hx - abs(vy) * hy, 0.0)
        if u * u + v * v <= cut * w * w:
            return True
    dx, dy = max(abs(mx) - hx, 0.0), max(abs(my) - hy, 0.0)
    return 2 * (dx * dx + dy * dy) <= cut


@inlined
def _runs_by_intervals(k, table, view, tiles, target, used):
    """Find the runs of splat k, whose outline is no ellipse; see :func:`find_runs`."""
    row, singles = table.doubles[k], table.singles[k]
    cut = f64(singles[SINGLE + SPLAT.cut]) * (1 + 1e-6)
    w_most = singles[SINGLE + DISC.w_most]
    x0, y0, slack = row[SPLAT.center_x], row[SPLAT.center_y], 1e-4
    runs, changes = target.runs, target.changes
    for ty in range(tiles.down):
        y1 = ty * TILE + 0.5 - y0 - slack
        y2 = min(ty * TILE + TILE, view.height) - 0.5 - y0 + slack
        length = 0
        for tx in range(tiles.across + 1):
            x1 = tx * TILE + 0.5 - x0 - slack
            x2 = min(tx * TILE + TILE, view.width) - 0.5 - x0 + slack
            if tx < tiles.across and _overlaps(row, x1, x2, y1, y2, cut, w_most):
                length += 1
            elif length > 0:
                if used < runs.shape[0]:
                    tile = ty * tiles.across + tx - length
                    runs[used, RUN.tile], runs[used, RUN.tiles] = tile, length
                    runs[used, RUN.column] = begin = SIDE * (tx - length)
                    for r in range(SIDE):
                        runs[used, RUN.intervals + r] = begin | (begin + SIDE * length - 1) << 16
                    changes[tile] += 1
                    changes[tile + length] -= 1
                target.counts[k] += 1
                used += 1
                length = 0
    return used


@inlined
def _piece_ends(outlines, piece, steps, discs, width):
    """Find the leftmost and rightmost pixel of an outline in each of 16 rows of squares.

    Args:
        outlines, piece: outlines of :class:`Pieces`, and the flat start of this piece.
        steps: Lanes, starts of the rows, in pixels from the first.
        discs: True joins the disc of the screen filter to the ellipse.
    """
    zero, far = f32(0.0), f32(1e9)
    # Relative to the ellipse's middle; rows cut by the image's end are taken completely.
    y1 = steps + broadcast(outlines, piece + OUTLINE.row_y)
    y2 = y1 + broadcast(outlines, piece + OUTLINE.row_height)
    top = broadcast(outlines, piece + OUTLINE.top)
    inverse_top = broadcast(outlines, piece + OUTLINE.inverse_top)
    half = broadcast(outlines, piece + OUTLINE.half_chord)
    lean = broadcast(outlines, piece + OUTLINE.lean)
    half_width = broadcast(outlines, piece + OUTLINE.half_width)
    tip = broadcast(outlines, piece + OUTLINE.tip_y)
    e1 = maximum(y1 - broadcast(outlines, piece + OUTLINE.middle_y), -top)
    e2 = minimum(y2 - broadcast(outlines, piece + OUTLINE.middle_y), top)
    t1, t2 = e1 * inverse_top, e2 * inverse_top
    # 5e-7 bounds the rounding of 1 - t^2; at the tips its root is large.
    chord1 = approximate_sqrt(maximum(f32(1.0) - t1 * t1, zero) + f32(5e-7)) * half
    chord2 = approximate_sqrt(maximum(f32(1.0) - t2 * t2, zero) + f32(5e-7)) * half
    right = maximum(lean * e1 + chord1, lean * e2 + chord2)
    right = select((e1 <= tip) & (tip <= e2), half_width, right)
    left = minimum(lean * e1 - chord1, lean * e2 - chord2)
    left = select((e1 <= -tip) & (-tip <= e2), -half_width, left)
    meets = e1 <= e2
    middle = broadcast(outlines, piece + OUTLINE.middle_x)
    left, right = select(meets, left + middle, far), select(meets, right + middle, -far)
    if discs:
        near = maximum(maximum(y1, -y2), zero)
        square = broadcast(outlines, piece + OUTLINE.radius_squared)
        chord = approximate_sqrt(maximum(square - near * near, f32(1e-12)))
        meets = near < broadcast(outlines, piece + OUTLINE.radius)
        left = select(meets, minimum(left, -chord), left)
        right = select(meets, maximum(right, chord), right)
    left = ceil(maximum(left + broadcast(outlines, piece + OUTLINE.left), zero))
    right = floor(minimum(right + broadcast(outlines, piece + OUTLINE.right), f32(width - 1)))
    return left, right


@inlined
def _find_columns(pieces, waiting, steps, discs, width):
    """Write the columns of squares of the waiting pieces, per row and per row of tiles, to
    ``spans``."""
    for j in range(waiting):
        left, right = _piece_ends(pieces.outlines, j * 16, steps, discs, width)
        shows = left <= right
        left = select(shows, left * f32(0.25), f32(NO_COLUMNS))
        right = select(shows, right * f32(0.25), f32(-1.0))
        store_intervals(pieces.spans, j * PIECE_SPANS, left, right)
        # Of the four rows of each row of tiles.
        left, right = minimum(left, swap1(left)), maximum(right, swap1(right))
        left, right = minimum(left, swap2(left)), maximum(right, swap2(right))
        store_integers(pieces.spans, j * PIECE_SPANS + FIRST_COLUMN, left)
        store_integers(pieces.spans, j * PIECE_SPANS + LAST_COLUMN, right)


@bare
def _flush(pieces, waiting, discs, steps, width, tiles, wanted_before, target, used):
    """Write the runs of the waiting pieces; see :func:`find_runs`.

    The work runs in steps over all pieces: finding columns waits for no branch, and the branches
    (number of rows of a splat) wait for no root or division.
    """
    _find_columns(pieces, waiting, steps, discs, width)
    spans, rows = pieces.spans, pieces.rows
    runs, changes = target.runs, target.changes
    room = runs.shape[0]
    for j in range(waiting):
        k, ty = rows[j, 0], rows[j, 1]
        begin, span = used, j * PIECE_SPANS
        for _ in range(rows[j, 2]):
            left, right = int(spans[u64(span + FIRST_COLUMN)]), int(spans[u64(span + LAST_COLUMN)])
            if right >= 0:
                tx = left // SIDE
                length = right // SIDE - tx + 1
                tile = ty * tiles.across + tx
                if wanted_before[u64(tile)] != wanted_before[u64(tile + length)]:
                    if used < room:
                        to = u64(used)
                        runs[to, RUN.tile], runs[to, RUN.tiles] = tile, length
                        runs[to, RUN.column] = tx * SIDE
                        copy4_integers(runs, used * RUN_SIZE + RUN.intervals, spans, span)
                        changes[u64(tile)] += 1
                        changes[u64(tile + length)] -= 1
                    used += 1
            ty += 1
            span += SIDE
        target.counts[k] += used - begin
    return used


@bare
def find_runs(
    first,
    last,
    view,
    tiles,
    table,
    outlines,  # (last - first, OUTLINE_SIZE) float32, from project
    wanted_before,  # (tiles + 1,) int64, number of wanted tiles before each
    target,
    pieces,
):
    """Write the runs of tiles that the splats first..last may show in to ``target``, a ``Runs``.

    Exact for ellipses, down to the tiles' squares of 4 x 4 pixels: a square is taken if and only if
    the outline rho <= cut meets the rectangle of its pixel centres (up to roundings, which only
    add). Sixteen rows of squares are processed at once. The runs of splat k follow those of k - 1.
    Runs without a wanted tile are left out.

    Returns:
        Number of runs. If it exceeds the room, the written runs are invalid.
    """
    discs, counts = view.discs, target.counts
    for k in range(16):
        pieces.outlines[k] = f32(4 * k)
    steps = load(pieces.outlines, 0)
    used, waiting = 0, 0
    for k in range(first, last):
        outline = u64(k - first)
        counts[k] = 0
        row = int(outlines[outline, u64(OUTLINE.first_row)])
        end = int(outlines[outline, u64(OUTLINE.last_row)])
        if row == NO_ELLIPSE:
            # In the order of the splats, so the waiting pieces come first.
            used = _flush(
                pieces, waiting, discs, steps, view.width, tiles, wanted_before, target, used
            )
            waiting = 0
            used = _runs_by_intervals(k, table, view, tiles, target, used)
            continue
        start = f64(outlines[outline, u64(OUTLINE.row_y)]) - table.doubles[k, SPLAT.center_y]
        while row <= end:
            if waiting == PIECES:
                used = _flush(
                    pieces, waiting, discs, steps, view.width, tiles, wanted_before, target, used
                )
                waiting = 0
            store(pieces.outlines, waiting * 16, load(outlines, (k - first) * 16))
            pieces.outlines[u64(waiting * 16 + OUTLINE.row_y)] = start + 4 * row
            pieces.rows[waiting, 0], pieces.rows[waiting, 1] = k, row // SIDE
            pieces.rows[waiting, 2] = min(16 // SIDE, end // SIDE - row // SIDE + 1)
            waiting += 1
            row += 16
    return _flush(pieces, waiting, discs, steps, view.width, tiles, wanted_before, target, used)


@bare
def place_cursors(
    changes,  # (groups, tiles + 1) int32, of each group's runs
    live,  # (tiles,) bool
    cursors,  # (groups, tiles + 1) int64
    starts,  # (tiles,) int64
    counts,  # (tiles,) int64
):
    """Write the start of each group's entries to ``cursors``, and the tiles' lists to ``starts``
    and ``counts``; tiles that are not live get nothing.
    """
    total = 0
    groups, tiles = changes.shape[0], starts.shape[0]
    running = cursors[:, tiles]
    running[:] = 0
    for t in range(tiles):
        starts[t] = total
        for g in range(groups):
            running[g] += changes[g, t]
            cursors[g, t] = total
            if live[t]:
                total += running[g]
        counts[t] = total - starts[t]


@inlined
def _row_bits(interval, begin):
    """Encode a row of a run as one bit per column of squares from ``begin`` on, up to 58."""
    low, high = (interval & 0xFFFF) - begin, (interval >> 16) - begin
    return ((2 << high) - (1 << low)) if interval >= 0 else 0


@inlined
def _tile_bits(interval, column):
    """Extract the bits of SIDE columns of squares from ``column`` on, in a row of a run."""
    begin, end = max((interval & 0xFFFF) - column, 0), min((interval >> 16) - column, SIDE - 1)
    return ((2 << end) - (1 << begin)) if end >= begin else 0


@bare
def scatter(
    first,
    last,
    runs,  # (., RUN_SIZE) int32, of these splats, in order
    counts,  # (M,) int32, runs of each splat
    live,  # (tiles,) bool
    live_before,  # (tiles + 1,) int64, live tiles before each
    cursor,  # (tiles + 1,) int64, where the next entry of a tile goes
    entries,  # (.) int64
):
    """Write the entries of the splats first..last to the lists of the tiles that are live."""
    every = live_before[-1] == live.shape[0]
    run = u64(0)
    for place in range(first, last):
        for _ in range(counts[place]):
            tile, length = u64(runs[run, RUN.tile]), runs[run, RUN.tiles]
            begin = int(runs[run, RUN.column])
            r0, r1 = int(runs[run, RUN.intervals]), int(runs[run, RUN.intervals + 1])
            r2, r3 = int(runs[run, RUN.intervals + 2]), int(runs[run, RUN.intervals + 3])
            run += u64(1)
            if every and length * SIDE <= 56:
                b0, b1 = _row_bits(r0, begin), _row_bits(r1, begin) << SIDE
                b2, b3 = _row_bits(r2, begin), _row_bits(r3, begin) << SIDE
                for t in range(tile, tile + u64(length)):
                    c = u64(cursor[t])
                    upper, lower = (b0 & 0x0F) | (b1 & 0xF0), (b2 & 0x0F) | (b3 & 0xF0)
                    entries[c] = place | (upper | lower << 8) << PLACE_BITS
                    cursor[t] = int(c) + 1
                    b0, b1, b2, b3 = b0 >> SIDE, b1 >> SIDE, b2 >> SIDE, b3 >> SIDE
                continue
            if live_before[tile] == live_before[tile + u64(length)]:
                continue
            for k in range(length):
                t = tile + u64(k)
                if every or live[t]:
                    column = begin + SIDE * k
                    upper = _tile_bits(r0, column) | _tile_bits(r1, column) << SIDE
                    lower = _tile_bits(r2, column) | _tile_bits(r3, column) << SIDE
                    entries[u64(cursor[t])] = place | (upper | lower << 2 * SIDE) << PLACE_BITS
                    cursor[t] += 1
