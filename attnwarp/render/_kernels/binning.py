# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Which splats may show in which tiles, down to squares of 4 x 4 pixels: exact outlines, no
bounding circles.
"""

from __future__ import annotations

from attnwarp.render._kernels import lanes as L

# isort: off
from attnwarp.render._kernels.layout import (
    CODES, CUT, FILTER, FLAT, HEIGHT, PLACE_BITS, RUN, SHAPE_EX, SHAPE_EY, SHAPE_FIRST, SHAPE_HALF, SHAPE_HIGH, SHAPE_LAST,
    SHAPE_LEAN, SHAPE_LEFT, SHAPE_RADIUS, SHAPE_RIGHT, SHAPE_SHRINK, SHAPE_SQUARE, SHAPE_TIP, SHAPE_TOP, SHAPE_WIDE, SHAPE_Y,
    SIDE, TILE, U0, UX, UY, V0, VX, VY, W0, WIDE, WIDTH, WMAX, WX, WY, X0, Y0, bare, f32, f64, inlined, u64,
)  # fmt: skip
# isort: on

NOTES = 64


@inlined
def _overlaps(row, x1, x2, y1, y2, cut, most, filtered):
    """Whether a 2D splat of any outline may show in a rectangle (relative to its reference point),
    by intervals.
    """
    hx, hy, mx, my = (x2 - x1) / 2, (y2 - y1) / 2, (x1 + x2) / 2, (y1 + y2) / 2
    w = row[W0] + row[WX] * mx + row[WY] * my + abs(row[WX]) * hx + abs(row[WY]) * hy
    if w > 0:
        w = min(w, most)
        u = max(
            abs(row[U0] + row[UX] * mx + row[UY] * my) - abs(row[UX]) * hx - abs(row[UY]) * hy, 0.0
        )
        v = max(
            abs(row[V0] + row[VX] * mx + row[VY] * my) - abs(row[VX]) * hx - abs(row[VY]) * hy, 0.0
        )
        if u * u + v * v <= cut * w * w:
            return True
    if filtered:
        dx, dy = max(abs(mx) - hx, 0.0), max(abs(my) - hy, 0.0)
        return 2 * (dx * dx + dy * dy) <= cut
    return False


@inlined
def _intervals(row, slim, k, width, height, tiles_x, tiles_y, cut, spans, used, counts, change):
    """The runs of a splat whose outline is no ellipse, by intervals; see :func:`outline`."""
    x0, y0, slack = row[X0], row[Y0], 1e-4
    for ty in range(tiles_y):
        y1 = ty * TILE + 0.5 - y0 - slack
        y2 = min(ty * TILE + TILE, height) - 0.5 - y0 + slack
        run = 0
        for tx in range(tiles_x + 1):
            x1 = tx * TILE + 0.5 - x0 - slack
            x2 = min(tx * TILE + TILE, width) - 0.5 - x0 + slack
            if tx < tiles_x and _overlaps(
                row, x1, x2, y1, y2, cut, slim[WIDE + WMAX], slim[WIDE + FILTER] > 0
            ):
                run += 1
            elif run > 0:
                if used < spans.shape[0]:
                    tile = ty * tiles_x + tx - run
                    spans[used, 0], spans[used, 1] = tile, run
                    spans[used, 2] = begin = SIDE * (tx - run)
                    for r in range(SIDE):
                        spans[used, CODES + r] = begin | (begin + SIDE * run - 1) << 16
                    change[tile] += 1
                    change[tile + run] -= 1
                counts[k] += 1
                used += 1
                run = 0
    return used


@bare
def _emit(
    notes, pieces, noted, flat, steps, codes, width, tiles_x, before, spans, used, counts, change
):
    """The runs of the pieces of ellipses that are noted; see :func:`outline`.

    In steps, each for all notes: what finds the columns waits for no branch, and the branches (how
    many rows has a splat) wait for no root or division.
    """
    zero, far = f32(0.0), f32(1e9)
    for j in range(noted):
        at = j * 16
        # From the ellipse's middle; rows that the image ends within are taken whole.
        y1 = steps + L.spread(pieces, at)
        y2 = y1 + L.spread(pieces, at + SHAPE_HIGH)
        top, shrink = L.spread(pieces, at + SHAPE_TOP), L.spread(pieces, at + SHAPE_SHRINK)
        half, lean = L.spread(pieces, at + SHAPE_HALF), L.spread(pieces, at + SHAPE_LEAN)
        stretch, tip = L.spread(pieces, at + SHAPE_WIDE), L.spread(pieces, at + SHAPE_TIP)
        e1, e2 = (
            L.most(y1 - L.spread(pieces, at + SHAPE_EY), -top),
            L.least(y2 - L.spread(pieces, at + SHAPE_EY), top),
        )
        t1, t2 = e1 * shrink, e2 * shrink
        # 5e-7: what 1 - t^2 may be rounded by; at the tips its root is much.
        chord1 = L.rough_root(L.most(f32(1.0) - t1 * t1, zero) + f32(5e-7)) * half
        chord2 = L.rough_root(L.most(f32(1.0) - t2 * t2, zero) + f32(5e-7)) * half
        right = L.where(
            (e1 <= tip) & (tip <= e2), stretch, L.most(lean * e1 + chord1, lean * e2 + chord2)
        )
        left = L.where(
            (e1 <= -tip) & (-tip <= e2), -stretch, L.least(lean * e1 - chord1, lean * e2 - chord2)
        )
        meets = e1 <= e2
        middle = L.spread(pieces, at + SHAPE_EX)
        left, right = L.where(meets, left + middle, far), L.where(meets, right + middle, -far)
        if flat:
            # The disc of the screen filter is joined to the ellipse.
            near = L.most(L.most(y1, -y2), zero)
            chord = L.rough_root(
                L.most(L.spread(pieces, at + SHAPE_SQUARE) - near * near, f32(1e-12))
            )
            meets = near < L.spread(pieces, at + SHAPE_RADIUS)
            left = L.where(meets, L.least(left, -chord), left)
            right = L.where(meets, L.most(right, chord), right)
        left = L.up(L.most(left + L.spread(pieces, at + SHAPE_LEFT), zero))
        right = L.down(L.least(right + L.spread(pieces, at + SHAPE_RIGHT), f32(width - 1)))
        shows = left <= right
        left, right = (
            L.where(shows, left * f32(0.25), f32(32767.0)),
            L.where(shows, right * f32(0.25), f32(-1.0)),
        )
        L.store_ends(codes, j * 48, left, right)
        # Of the four rows of each row of tiles.
        left, right = L.least(left, L.swapped1(left)), L.most(right, L.swapped1(right))
        left, right = L.least(left, L.swapped2(left)), L.most(right, L.swapped2(right))
        L.store_whole(codes, j * 48 + 16, left)
        L.store_whole(codes, j * 48 + 32, right)
    room = spans.shape[0]
    for j in range(noted):
        k, ty = notes[j, 0], notes[j, 1]
        begin, at = used, j * 48
        for _ in range(notes[j, 2]):
            left, right = int(codes[u64(at + 16)]), int(codes[u64(at + 32)])
            if right >= 0:
                tx = left // SIDE
                run = right // SIDE - tx + 1
                tile = ty * tiles_x + tx
                if before[u64(tile)] != before[u64(tile + run)]:
                    if used < room:
                        to = u64(used)
                        spans[to, 0], spans[to, 1], spans[to, 2] = tile, run, tx * SIDE
                        L.copy_whole4(spans, used * RUN + CODES, codes, at)
                        change[u64(tile)] += 1
                        change[u64(tile + run)] -= 1
                    used += 1
            ty += 1
            at += SIDE
        counts[k] += used - begin
    return used


@bare
def outline(first, last, table, thin, view, tiles_x, tiles_y, before, shapes, spans, counts, change, codes, pieces,
            notes):  # fmt: skip
    """Write the runs of tiles that the splats first..last (places in the order of depth) may show
    in to ``spans``.

    Exact for ellipses, down to the tiles' squares of 4 x 4 pixels: a square is taken if and only if
    the outline rho <= cut meets the rectangle of its pixel centres (but for roundings, which only
    add). Sixteen rows of squares are done at once. Splat k has ``counts[k]`` runs, which follow
    those of k - 1; a run is (first tile, number of tiles, columns of squares in each row of them),
    see RUN. ``change`` (tiles + 1) gets 1 added where a run begins and taken away behind its end.
    Returns the rows needed; where they are more than fit, nothing of this counts. Runs without a
    tile that is wanted, by ``before`` (tiles + 1), the number of them before each, are left out.
    ``shapes`` are the outlines, from :func:`project`. ``codes`` (48 NOTES, int32), ``pieces`` (16
    NOTES, float32) and ``notes`` (NOTES, 3) are for work: ellipses are noted in pieces of 16 rows
    of squares, NOTES of them, and then worked off together.
    """
    flat = view[FLAT] > 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    for k in range(16):
        pieces[k] = f32(4 * k)
    steps = L.load(pieces, 0)
    used, noted = 0, 0
    for k in range(first, last):
        shape = u64(k - first)
        counts[k] = 0
        r1, r2 = int(shapes[shape, u64(SHAPE_FIRST)]), int(shapes[shape, u64(SHAPE_LAST)])
        if r1 < 0:
            # In the order of the splats: what has been noted comes first.
            used = _emit(
                notes,
                pieces,
                noted,
                flat,
                steps,
                codes,
                width,
                tiles_x,
                before,
                spans,
                used,
                counts,
                change,
            )
            noted = 0
            row, slim = table[k], thin[k]
            cut = f64(slim[WIDE + CUT]) * (1 + 1e-6)
            used = _intervals(
                row, slim, k, width, height, tiles_x, tiles_y, cut, spans, used, counts, change
            )
            continue
        start = f64(shapes[shape, u64(SHAPE_Y)]) - table[k, Y0]
        while r1 <= r2:
            if noted == NOTES:
                used = _emit(
                    notes,
                    pieces,
                    noted,
                    flat,
                    steps,
                    codes,
                    width,
                    tiles_x,
                    before,
                    spans,
                    used,
                    counts,
                    change,
                )
                noted = 0
            L.store(pieces, noted * 16, L.load(shapes, (k - first) * 16))
            pieces[u64(noted * 16)] = start + 4 * r1
            notes[noted, 0], notes[noted, 1] = k, r1 // SIDE
            notes[noted, 2] = min(16 // SIDE, r2 // SIDE - r1 // SIDE + 1)
            noted += 1
            r1 += 16
    return _emit(
        notes,
        pieces,
        noted,
        flat,
        steps,
        codes,
        width,
        tiles_x,
        before,
        spans,
        used,
        counts,
        change,
    )


@bare
def place_cursors(changes, live, cursors, starts):
    """Where each chunk of splats puts its entries: from the changes (chunks, tiles + 1) that its
    runs make, to ``cursors`` of the same shape and ``starts`` (tiles + 1); nothing goes to tiles
    that are not live."""
    total = 0
    chunks = changes.shape[0]
    running = cursors[:, starts.shape[0] - 1]
    running[:] = 0
    for t in range(starts.shape[0] - 1):
        starts[t] = total
        for c in range(chunks):
            running[c] += changes[c, t]
            cursors[c, t] = total
            if live[t]:
                total += running[c]
    starts[-1] = total


@inlined
def _bits(code, begin):
    """A row of a run, as :func:`outline` writes it, as one bit for each column of squares from
    ``begin`` on; up to 58 columns."""
    low, high = (code & 0xFFFF) - begin, (code >> 16) - begin
    return ((2 << high) - (1 << low)) if code >= 0 else 0


@inlined
def _columns(code, column):
    """Of a row of a run, the bits of SIDE columns of squares from this one on."""
    begin, end = max((code & 0xFFFF) - column, 0), min((code >> 16) - column, SIDE - 1)
    return ((2 << end) - (1 << begin)) if end >= begin else 0


@bare
def scatter(first, last, spans, counts, live, before, cursor, entries):
    """Write the entries of the splats first..last to the tiles that are live, each at its
    ``cursor``.

    Args:
        spans: their runs, in order. before: (tiles + 1) live tiles before each.
    """
    every = before[-1] == live.shape[0]
    at = u64(0)
    for place in range(first, last):
        for _ in range(counts[place]):
            tile, run = u64(spans[at, 0]), spans[at, 1]
            origin = int(spans[at, 2])
            r0, r1 = int(spans[at, CODES]), int(spans[at, CODES + 1])
            r2, r3 = int(spans[at, CODES + 2]), int(spans[at, CODES + 3])
            at += u64(1)
            if every and run * SIDE <= 56:
                b0, b1 = _bits(r0, origin), _bits(r1, origin) << SIDE
                b2, b3 = _bits(r2, origin), _bits(r3, origin) << SIDE
                for t in range(tile, tile + u64(run)):
                    c = u64(cursor[t])
                    upper, lower = (b0 & 0x0F) | (b1 & 0xF0), (b2 & 0x0F) | (b3 & 0xF0)
                    entries[c] = place | (upper | lower << 8) << PLACE_BITS
                    cursor[t] = int(c) + 1
                    b0, b1, b2, b3 = b0 >> SIDE, b1 >> SIDE, b2 >> SIDE, b3 >> SIDE
                continue
            if before[tile] == before[tile + u64(run)]:
                continue
            for k in range(run):
                t = tile + u64(k)
                if every or live[t]:
                    column = origin + SIDE * k
                    upper = _columns(r0, column) | _columns(r1, column) << SIDE
                    lower = _columns(r2, column) | _columns(r3, column) << SIDE
                    entries[u64(cursor[t])] = place | (upper | lower << 2 * SIDE) << PLACE_BITS
                    cursor[t] += 1
