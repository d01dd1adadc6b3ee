# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Splats over one another, tile by tile: the pictures, and what the backward pass needs of them.

In vectors of 16 pixels, a square of 4 x 4, with the sums of a square in registers while a block of
splats goes by. exp is a polynomial, since LLVM has no vector exp here.
"""

from __future__ import annotations

import math

import numpy as np

from attnwarp.render import constants as K
from attnwarp.render._kernels import lanes as L

# isort: off
from attnwarp.render._kernels.layout import (
    AT_U, AT_V, AT_W, AT_X, AT_Y, CA, CB, CC, CENTER, COLUMNS, CUT, EVERY, EXACT, F11, F12, F22, FILTER, FLAT, HEIGHT, HUGE,
    IZ0, IZLO, LX, LY, NORMAL, OPACITY, PIXELS, PLACE, PLACE_BITS, QUARTER, ROOT2, ROW, RXX, RXY, RYY, SCREEN_X, SCREEN_Y,
    SIDE, SQUARES, TILE, U0, UX, UY, VALUES, VX, VY, WIDE, WIDTH, WLOW, WMAX, WTOP, WX, WY, X0, Y0, Z0, ZHI, ZLO, prefetch,
    prefetch_to_write, bare, f32, f64, inlined, u64,
)  # fmt: skip
# isort: on

# A block of splats as the forward pass works on them: their rows, with each one's place among the
# tile's; then its weights at the 16 pixels of all squares, and of the square at hand; then what
# depends on where pixels are counted from, at the middle of the quarter of the tile at hand.
BLOCK = 32
AHEAD = 32
STEP = 28
WEIGHTS = BLOCK * ROW
SHARES = WEIGHTS + BLOCK * 16
PLACED = SHARES + BLOCK * 16
WORK = PLACED + BLOCK * 8
WEIGHT_UNIT = 2.0**-36

# Slots of a tile's buffer, each PIXELS floats.
(XS, YS, AL, TT, AA, DD, M1, M2, L1, MED, MEDK, LAST, ZREF, IREF, NX, NY, NZ, C_0, C_1,
 C_2) = range(20)  # fmt: skip
SLOTS = 20  # and one more for each channel from the fourth on
FAR = 1e15  # its square is HUGE
LOG2E_HALF = f32(0.5 * math.log2(math.e))

# exp2(x) on [-0.5, 0.5], the polynomial of degree 5 that is 1 at 0 with the least relative error,
# 9.1e-8.
E1, E2, E3, E4, E5 = (
    f32(c)
    for c in (
        0.6931469775373009,
        0.24022242044016756,
        0.05550733832514562,
        0.009671514536030823,
        0.0013264700286626865,
    )
)
ROUND = f32(1.5 * 2**23)


@inlined
def _gauss(rho):
    """exp(-rho / 2), relative error 1.5e-7, for rho from 0 to 88; beyond, anything."""
    # Adding 1.5 2^23 rounds to an integer and leaves it in the lowest bits.
    shifted = L.fma(rho, -LOG2E_HALF, ROUND)
    f = L.fma(rho, -LOG2E_HALF, ROUND - shifted)
    # In pairs rather than in a row: the products wait less for one another.
    g = f * f
    return L.times_power(((f * E5 + E4) * g + (f * E3 + E2)) * g + (f * E1 + f32(1.0)), shifted)


@inlined
def slopes(exact, at):
    """What is the same for all splats in ``exact``; see :func:`lay_out`."""
    for k in range(EXACT):
        exact[u64(at + k)] = 0.0
    exact[u64(at + 8 + SCREEN_X)] = exact[u64(at + 16 + SCREEN_Y)] = ROOT2
    exact[u64(at + 8 + AT_X)] = exact[u64(at + 16 + AT_Y)] = 1.0


@inlined
def lay_out(work, at, exact, begin, table, thin, i, ox, oy, flat):
    """Row i of the table as float32 to ``work`` from ``at`` on; and to ``exact`` from ``begin`` on
    what it is at the tile's middle (ox, oy), and its slopes."""
    i, b, e = u64(i), u64(at), u64(begin)
    L.narrow(work, at, table, i * u64(COLUMNS))
    work[b + u64(8)], work[b + u64(9)] = table[i, 8], table[i, 9]
    L.store(work, at + WIDE, L.load(thin, i * u64(2 * COLUMNS) + u64(2 * WIDE)))
    work[b + u64(VALUES + 2)] = thin[i, u64(WIDE + VALUES + 2)]
    sx, sy = ox - table[i, X0], oy - table[i, Y0]
    exact[e + u64(AT_X)], exact[e + u64(AT_Y)] = sx, sy
    if flat:
        for k in range(3):
            gx, gy = table[i, UX + 3 * k], table[i, UY + 3 * k]
            exact[e + u64(AT_U + k)] = table[i, U0 + 3 * k] + gx * sx + gy * sy
            exact[e + u64(8 + AT_U + k)], exact[e + u64(16 + AT_U + k)] = gx, gy
        # Without a filter, farther away than anything.
        exact[e + u64(SCREEN_X)] = ROOT2 * sx if thin[i, u64(WIDE + FILTER)] > 0 else FAR
        exact[e + u64(SCREEN_Y)] = ROOT2 * sy
    else:
        f11, f12, f22 = table[i, F11], table[i, F12], table[i, F22]
        work[b + u64(CA)], work[b + u64(CB)], work[b + u64(CC)] = f11, f12, f22
        exact[e + u64(AT_U)], exact[e + u64(AT_V)] = f11 * sx + f12 * sy, f22 * sy
        exact[e + u64(8 + AT_U)], exact[e + u64(16 + AT_U)], exact[e + u64(16 + AT_V)] = (
            f11,
            f12,
            f22,
        )


@inlined
def refer(work, at, exact, begin, dx, dy):
    """What depends on where pixels are counted from, as float32 to ``work`` from ``at`` on: counted
    from (dx, dy) off the tile's middle."""
    slope_x, slope_y = L.load8(exact, begin + 8), L.load8(exact, begin + 16)
    L.store8(work, at, L.load8(exact, begin) + slope_x * dx + slope_y * dy)


@inlined
def shade(work, at, off, x, y, screen_x, screen_y, flat, peak):
    """Of a splat at 16 pixels: where it is drawn, and its alpha (anything elsewhere); and p, q,
    which :func:`depth_less` makes its z and 1 / z of. ``at``: its row. ``off``: what :func:`refer`
    made. ``screen_x`` and ``screen_y`` are x and y times the root of 2.

    A 2D splat's W is clamped to the z that it may have, between WLOW and WTOP, before anything is
    divided by it. That bounds the z of what its filter draws, and changes nothing that its
    intersection draws, nor adds to it. For take its centre in front, and the centre's z as 1: at
    (u, v) = U / W the plane has z = 1 / W = 1 + s u for a slope s, so s U = 1 - W, and WLOW = 1 /
    (1 + E |s|) with E = EXTENT_SIGMAS. Where W is less than WLOW, |U| > (1 - WLOW) / |s| = E WLOW:
    |U| / WLOW is more than E too, where nothing is drawn. Where W is more than WTOP, |U| / WTOP is more than |U| / W, which is more than E, unless WTOP is that of the near plane; this is what WMAX is for.
    """
    if flat:
        w = L.spread(work, off + AT_W) + L.spread(work, at + WX) * x + L.spread(work, at + WY) * y
        u = L.spread(work, off + AT_U) + L.spread(work, at + UX) * x + L.spread(work, at + UY) * y
        v = L.spread(work, off + AT_V) + L.spread(work, at + VX) * x + L.spread(work, at + VY) * y
        q = L.least(L.most(w, L.spread(work, at + WLOW)), L.spread(work, at + WTOP))
        p = L.inverse(q)
        ex, ey = (
            screen_x + L.spread(work, off + SCREEN_X),
            screen_y + L.spread(work, off + SCREEN_Y),
        )
        meets = w <= L.spread(work, at + WMAX)
        rho = L.least(L.where(meets, (u * u + v * v) * (p * p), f32(HUGE)), ex * ex + ey * ey)
    else:
        # The row holds F11, F12 and F22 here.
        u = L.spread(work, off + AT_U) + L.spread(work, at + CA) * x + L.spread(work, at + CB) * y
        v = L.spread(work, off + AT_V) + L.spread(work, at + CC) * y
        rho = u * u + v * v
        p, q = L.spread(work, at + ZLO), L.spread(work, at + IZLO)
        if peak:
            low, high = L.spread(work, at + ZLO), L.spread(work, at + ZHI)
            ex, ey = x + L.spread(work, off + AT_X), y + L.spread(work, off + AT_Y)
            along = L.spread(work, at + LX) * ex + L.spread(work, at + LY) * ey + f32(1.0)
            form = (L.spread(work, at + RXX) * ex + L.spread(work, at + RXY) * ey * f32(2.0)) * ex
            across = along * along + L.most(form + L.spread(work, at + RYY) * ey * ey, f32(0.0))
            p = L.spread(work, at + Z0) * along * L.inverse(L.most(across, f32(1e-30)))
            p = L.least(L.most(p, low), high)
            q = L.inverse(p)
    inside = rho <= L.spread(work, at + CUT)
    alpha = L.least(L.spread(work, at + OPACITY) * _gauss(rho), f32(K.ALPHA_MAX))
    return inside, alpha, p, q


@inlined
def depth_less(work, at, p, q, flat, peak, z, iz):
    """z and 1 / z of a splat from what :func:`shade` says, less these."""
    if flat:
        if peak:
            return L.fma(L.spread(work, at + Z0), p, -z), L.fma(L.spread(work, at + IZ0), q, -iz)
        return L.spread(work, at + ZLO) - z, L.spread(work, at + IZ0) - iz
    return p - z, q - iz


@bare
def forward(first, last, visit, view, tiles_x, live, starts, entries, table, thin, features, background, ndc_scale,
            color, alpha, depth, median, normal, l1, l2, state, done, tested_in, shaded_in, drawn_in, full, seen, buf,
            work, exact, picks, places, masks):  # fmt: skip
    """Composite those of the tiles visit[first:last] that are live.

    A tile is 16 squares of 16 pixels. Splats come in blocks of those that show in a square that is
    not opaque yet: their coefficients are laid out once for the tile; each square then picks those
    that its list says may show in it, and composites them with its sums in registers.

    ``state`` (5, H, W) keeps what the backward pass needs: transmittance, last and median entry,
    mean and spread of 1 / z; of no height if there will be none. Per tile, ``done`` is the number
    of entries worked off, ``tested_in`` that of pairs whose intersection was computed,
    ``shaded_in`` of those in a square that the splat draws to, ``drawn_in`` of contributing pairs,
    ``full`` whether every pixel has ended; ``seen`` is the sum of weights of each entry.
    """
    flat, peak = view[FLAT] > 0, view[CENTER] == 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    channels = background.shape[0]
    keep = state.shape[1] > 0
    for p in range(PIXELS):
        # From the middle of the tile's quarter: offsets are small, and so is what they round.
        buf[XS * PIXELS + p] = f32(p // 16 % 2 * 4 + p % 4) - f32(3.5)
        buf[YS * PIXELS + p] = f32(p // (16 * SIDE) % 2 * 4 + p // 4 % 4) - f32(3.5)
    for k in range(BLOCK):
        slopes(exact, k * EXACT)
    zero = L.load(buf, XS * PIXELS) * f32(0.0)
    stop, half = f32(K.TRANSMITTANCE_STOP), f32(K.MEDIAN_TRANSMITTANCE)
    for visited in range(first, last):
        t = visit[visited]
        if not live[t]:
            continue
        begin, end = starts[t], starts[t + 1]
        tested, shaded, contributing = 0, 0, 0
        ty, tx = t // tiles_x, t % tiles_x
        ox, oy = tx * TILE + TILE / 2, ty * TILE + TILE / 2
        rows, cols = min(TILE, height - ty * TILE), min(TILE, width - tx * TILE)
        for r in range(rows):
            # They will be written when the tile is done: the memory has time until then.
            to = (ty * TILE + r) * width + tx * TILE
            prefetch_to_write(alpha, to)
            prefetch_to_write(depth, to)
            prefetch_to_write(median, to)
            prefetch_to_write(l1, to)
            prefetch_to_write(l2, to)
            prefetch_to_write(normal, 3 * to)
            prefetch_to_write(normal, 3 * to + 3 * cols - 1)
            prefetch_to_write(color, channels * to)
            prefetch_to_write(color, channels * (to + cols) - 1)
            if keep:
                for k in range(5):
                    prefetch_to_write(state, k * height * width + to)
        for p in range(0, PIXELS, 16):
            L.store(buf, TT * PIXELS + p, f32(1.0))
        if rows < TILE or cols < TILE:
            # Pixels outside of the image are opaque from the start: they take no part and never
            # delay the stop.
            for p in range(PIXELS):
                column, row = p // 16 % SIDE * 4 + p % 4, p // (16 * SIDE) * 4 + p // 4 % 4
                if column >= cols or row >= rows:
                    buf[TT * PIXELS + p] = f32(0.0)
        for p in range(AA * PIXELS, buf.shape[0], 16):
            L.store(buf, p, f32(0.0))
        ended, reached = 0, 0
        for q in range(SQUARES):
            if not L.some(stop < L.load(buf, TT * PIXELS + q * 16)):
                ended |= 1 << q
        e = begin
        while e < end and ended != EVERY:
            size = 0
            while e < end and size < BLOCK:
                # The rows are anywhere in a table larger than the cache.
                ahead = entries[min(e + AHEAD, end - 1)] & PLACE
                prefetch(table, ahead * COLUMNS)
                prefetch(table, ahead * COLUMNS + 8)
                prefetch(table, ahead * COLUMNS + 16)
                entry = entries[e]
                squares = entry >> PLACE_BITS & ~ended
                if squares == 0:
                    seen[u64(e)] = f32(0.0)
                else:
                    places[u64(size)], masks[u64(size)] = e, squares
                    lay_out(
                        work,
                        size * ROW,
                        exact,
                        size * EXACT,
                        table,
                        thin,
                        entry & PLACE,
                        ox,
                        oy,
                        flat,
                    )
                    work[u64(size * ROW + STEP)] = f32(e - begin + 1)
                    L.store(work, WEIGHTS + size * 16, f32(0.0))
                    size += 1
                e += 1
            for k in range(size, BLOCK):
                masks[u64(k)] = 0
            for turn in range(SQUARES):
                # The tile's quarters after one another.
                corner = turn & 8 | turn >> 1 & 2
                if turn & 3 == 0:
                    dx, dy = (corner & 2) * 4.0 - 4.0, (corner & 8) - 4.0
                    left = (
                        L.having(masks, 0, QUARTER << corner)
                        | L.having(masks, 16, QUARTER << corner) << 16
                    )
                    while left != 0:
                        k = L.lowest(left)
                        left &= left - 1
                        refer(work, PLACED + k * 8, exact, k * EXACT, dx, dy)
                q = corner + (turn << 1 & 4) + (turn & 1)
                if ended >> q & 1:
                    continue
                left = L.having(masks, 0, 1 << q) | L.having(masks, 16, 1 << q) << 16
                if left == 0:
                    continue
                s = q * 16
                x, y = L.load(buf, XS * PIXELS + s), L.load(buf, YS * PIXELS + s)
                sx, sy = x * f32(ROOT2), y * f32(ROOT2)
                T, A, D = (
                    L.load(buf, TT * PIXELS + s),
                    L.load(buf, AA * PIXELS + s),
                    L.load(buf, DD * PIXELS + s),
                )
                sum1, sum2 = L.load(buf, M1 * PIXELS + s), L.load(buf, M2 * PIXELS + s)
                pairs, final = L.load(buf, L1 * PIXELS + s), L.load(buf, LAST * PIXELS + s)
                n0, n1 = L.load(buf, NX * PIXELS + s), L.load(buf, NY * PIXELS + s)
                n2, c0 = L.load(buf, NZ * PIXELS + s), L.load(buf, C_0 * PIXELS + s)
                c1, c2 = L.load(buf, C_1 * PIXELS + s), L.load(buf, C_2 * PIXELS + s)
                zref, iref = L.load(buf, ZREF * PIXELS + s), L.load(buf, IREF * PIXELS + s)
                med, medk = L.load(buf, MED * PIXELS + s), L.load(buf, MEDK * PIXELS + s)
                # Once no pixel is, what only the first splats of a pixel decide is over: for a
                # block at a time, so that it costs no branch that goes both ways.
                undecided = L.some(half < T)
                alive = stop < T
                used = 0
                following = L.lowest(left)
                inside_then, a_then, p_then, q_then = shade(
                    work, following * ROW, PLACED + following * 8, x, y, sx, sy, flat, peak
                )
                while True:
                    k, inside, a, p, iq = following, inside_then, a_then, p_then, q_then
                    b = k * ROW
                    left &= left - 1
                    if left != 0:
                        # One splat ahead: a long chain of operations that wait for each other,
                        # while the sums of the one at hand wait for nothing.
                        following = L.lowest(left)
                        inside_then, a_then, p_then, q_then = shade(
                            work, following * ROW, PLACED + following * 8, x, y, sx, sy, flat, peak
                        )
                    hit = inside & alive
                    w = L.where(hit, a * T, f32(0.0))
                    step = L.spread(work, b + STEP)
                    if keep:
                        final = L.where(hit, step, final)
                    if undecided:
                        z, iz = depth_less(work, b, p, iq, flat, peak, zero, zero)
                        opens, first_hit = hit & (half < T), hit & (f32(1.0) <= T)
                        med, medk = L.where(opens, z, med), L.where(opens, step, medk)
                        # Depths are summed relative to the pixel's first, which keeps the digits of
                        # thin layers far away.
                        zref, iref = L.where(first_hit, z, zref), L.where(first_hit, iz, iref)
                    z, m = depth_less(work, b, p, iq, flat, peak, zref, iref)
                    wz, wm = w * z, w * m
                    pairs = pairs + wz * A - w * D
                    A, D = A + w, D + wz
                    sum1, sum2 = sum1 + wm, sum2 + wm * m
                    n0 = n0 + w * L.spread(work, b + NORMAL)
                    n1 = n1 + w * L.spread(work, b + NORMAL + 1)
                    n2 = n2 + w * L.spread(work, b + NORMAL + 2)
                    c0 = c0 + w * L.spread(work, b + VALUES)
                    c1 = c1 + w * L.spread(work, b + VALUES + 1)
                    c2 = c2 + w * L.spread(work, b + VALUES + 2)
                    T = T - w
                    L.store(work, WEIGHTS + k * 16, L.load(work, WEIGHTS + k * 16) + w)
                    if channels > 3:
                        L.store(work, SHARES + used * 16, w)
                        picks[u64(used)] = k
                    drawn = L.count(hit)
                    contributing += drawn
                    # 16 if there are any: no second test of the mask.
                    shaded += (drawn + 15) & 16
                    used += 1
                    alive = stop < T
                    if not L.some(alive):
                        ended |= 1 << q
                        reached = max(reached, places[u64(k)] - begin + 1)
                        break
                    if left == 0:
                        break
                L.store(buf, TT * PIXELS + s, T)
                L.store(buf, AA * PIXELS + s, A)
                L.store(buf, DD * PIXELS + s, D)
                L.store(buf, M1 * PIXELS + s, sum1)
                L.store(buf, M2 * PIXELS + s, sum2)
                L.store(buf, L1 * PIXELS + s, pairs)
                L.store(buf, NX * PIXELS + s, n0)
                L.store(buf, NY * PIXELS + s, n1)
                L.store(buf, NZ * PIXELS + s, n2)
                L.store(buf, C_0 * PIXELS + s, c0)
                L.store(buf, C_1 * PIXELS + s, c1)
                L.store(buf, C_2 * PIXELS + s, c2)
                L.store(buf, ZREF * PIXELS + s, zref)
                L.store(buf, IREF * PIXELS + s, iref)
                L.store(buf, MED * PIXELS + s, med)
                L.store(buf, MEDK * PIXELS + s, medk)
                L.store(buf, LAST * PIXELS + s, final)
                tested += 16 * used
                for c in range(3, channels):
                    sums = L.load(buf, (C_0 + c) * PIXELS + s)
                    for k in range(used):
                        f = features[u64(entries[u64(places[picks[u64(k)]])] & PLACE), u64(c)]
                        sums = sums + L.load(work, SHARES + k * 16) * f
                    L.store(buf, (C_0 + c) * PIXELS + s, sums)
            for k in range(0, size, 16):
                b = WEIGHTS + k * 16
                sums = L.totals(
                    L.load(work, b), L.load(work, b + 16), L.load(work, b + 32), L.load(work, b + 48),
                    L.load(work, b + 64), L.load(work, b + 80), L.load(work, b + 96), L.load(work, b + 112),
                    L.load(work, b + 128), L.load(work, b + 144), L.load(work, b + 160), L.load(work, b + 176),
                    L.load(work, b + 192), L.load(work, b + 208), L.load(work, b + 224), L.load(work, b + 240),
                )  # fmt: skip
                L.store(work, SHARES, sums)
                for j in range(min(16, size - k)):
                    seen[u64(places[u64(k + j)])] = work[u64(SHARES + j)]
        full[t] = ended == EVERY
        done[t] = reached if ended == EVERY else end - begin
        tested_in[t] = tested
        shaded_in[t] = shaded
        drawn_in[t] = contributing
        for p in range(0, PIXELS, 16):
            A, a1 = L.load(buf, AA * PIXELS + p), L.load(buf, M1 * PIXELS + p)
            covered = f32(0.0) < A
            inverse = L.where(covered, L.inverse(A), f32(0.0))
            spread = L.most(L.load(buf, M2 * PIXELS + p) - a1 * a1 * inverse, f32(0.0))
            L.store(buf, AL * PIXELS + p, spread)
            L.store(buf, M2 * PIXELS + p, A * spread * f32(ndc_scale))
            L.store(buf, M1 * PIXELS + p, L.load(buf, IREF * PIXELS + p) + a1 * inverse)
            mean = L.load(buf, ZREF * PIXELS + p) + L.load(buf, DD * PIXELS + p) * inverse
            L.store(buf, DD * PIXELS + p, L.where(covered, mean, f32(np.nan)))
            L.store(
                buf, MED * PIXELS + p, L.where(covered, L.load(buf, MED * PIXELS + p), f32(np.nan))
            )
            L.store(buf, L1 * PIXELS + p, L.load(buf, L1 * PIXELS + p) * f32(2.0))
            through = f32(1.0) - A
            for c in range(channels):
                at = (C_0 + c) * PIXELS + p
                L.store(buf, at, L.load(buf, at) + through * background[c])
        if rows == TILE and cols == TILE and channels == 3:
            for k in range(PIXELS // 4):
                r, q = k // SIDE, k % SIDE
                p = (r // 4 * SIDE + q) * 16 + r % 4 * 4
                to = (ty * TILE + r) * width + tx * TILE + q * 4
                L.copy4(alpha, to, buf, AA * PIXELS + p)
                L.copy4(depth, to, buf, DD * PIXELS + p)
                L.copy4(median, to, buf, MED * PIXELS + p)
                L.copy4(l1, to, buf, L1 * PIXELS + p)
                L.copy4(l2, to, buf, M2 * PIXELS + p)
                L.interleave4(color, 3 * to, buf, C_0 * PIXELS + p, PIXELS)
                L.interleave4(normal, 3 * to, buf, NX * PIXELS + p, PIXELS)
                if keep:
                    L.copy4(state, to, buf, TT * PIXELS + p)
                    L.copy4(state, to + height * width, buf, LAST * PIXELS + p)
                    L.copy4(state, to + 2 * height * width, buf, MEDK * PIXELS + p)
                    L.copy4(state, to + 3 * height * width, buf, M1 * PIXELS + p)
                    L.copy4(state, to + 4 * height * width, buf, AL * PIXELS + p)
            continue
        for r in range(rows):
            for k in range(cols):
                p = u64((r // 4 * SIDE + k // 4) * 16 + r % 4 * 4 + k % 4)
                y, x = u64(ty * TILE + r), u64(tx * TILE + k)
                alpha[y, x], depth[y, x], median[y, x] = (
                    buf[AA * PIXELS + p],
                    buf[DD * PIXELS + p],
                    buf[MED * PIXELS + p],
                )
                l1[y, x], l2[y, x] = buf[L1 * PIXELS + p], buf[M2 * PIXELS + p]
                for c in range(channels):
                    color[y, x, u64(c)] = buf[u64((C_0 + c) * PIXELS) + p]
                for c in range(3):
                    normal[y, x, u64(c)] = buf[u64((NX + c) * PIXELS) + p]
                if keep:
                    state[0, y, x], state[1, y, x] = buf[TT * PIXELS + p], buf[LAST * PIXELS + p]
                    state[2, y, x] = buf[MEDK * PIXELS + p]
                    state[3, y, x], state[4, y, x] = buf[M1 * PIXELS + p], buf[AL * PIXELS + p]


@bare
def hand_out(order, sums, weight):
    """``weight`` of each splat from the sums, in WEIGHT_UNIT, by place in the order of depth."""
    for place in range(order.shape[0]):
        weight[u64(order[u64(place)])] = sums[u64(place)] * WEIGHT_UNIT


@bare
def settle(ended, starts, done, entries, seen, weight, offset, places, kept):
    """Of the tiles that have ``ended``: add the entries' weights to their splats' (by place in the
    order of depth), and, if there is room in ``kept``, keep what was worked off; tile t's from
    places[t] - ``offset`` on.

    Weights are summed as whole numbers of WEIGHT_UNIT: the same bits in whatever order tiles end.
    """
    at = 0
    keep = kept.shape[0] > 0
    for t in range(done.shape[0]):
        if ended[t]:
            places[t] = offset + at
            for e in range(starts[t], starts[t] + done[t]):
                weight[entries[u64(e)] & PLACE] += int(f64(seen[u64(e)]) * (1 / WEIGHT_UNIT))
                if keep:
                    # Of what is nowhere drawn, no square is of interest to the backward pass.
                    kept[at] = entries[u64(e)] if seen[u64(e)] > 0 else entries[u64(e)] & PLACE
                    at += 1
