# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Gradients: the tiles back to front, then each splat's sums, then the parameters and the pose.

In vectors of 16 pixels, a square of 4 x 4, with the sums of a splat in registers while the squares
of its tile go by.
"""

from __future__ import annotations

import math

import numpy as np

from attnwarp.render import constants as K
from attnwarp.render._kernels import lanes as L
from attnwarp.render._kernels.rasterization import (
    depth_less,
    lay_out,
    refer,
    shade,
    slopes,
)

# isort: off
from attnwarp.render._kernels.layout import (
    ANTIALIASED, AT_U, AT_V, AT_W, AT_X, AT_Y, CA, CB, CC, CENTER, COLUMNS, CORNER, CX, CY, FLAT, FX, FY, GRADIENTS, HARMONIC,
    HEIGHT, LX, LY, NEAR, NORMAL, OPACITY, PIXELS, PLACE, PLACE_BITS, QUARTER, ROOT2, ROW, RXX, RXY, RYY, SCREEN_X, SCREEN_Y,
    SIDE, SKEW, TILE, TX, U0, UX, UY, V0, VALUES, VX, VY, W0, WIDTH, WLOW, WMAX, WTOP, WX, WY, X0, Y0, Z0, ZHI, ZLO,
    prefetch, bare, f32, f64, inlined, jit, u64,
)  # fmt: skip
from attnwarp.render._kernels.projection import (
    C1, C20, C21, C22, C23, C24, C30, C31, C32, C33, C34, C35, C36, axes, harmonics,
)  # fmt: skip
# isort: on

# Slots of the backward pass: gradients of the loss in what a pixel sums up, and sums over the
# splats behind.
BXS, BYS = 0, 1  # as in the forward pass
(BT, BLAST, BMEDK, BZREF, BIREF, GW, GD, GM2, GL1, GMED, TOTA, BEHA, BEHD, BEHQ, GNX, GNY, GNZ, GC0, GC1,
 GC2) = range(2, 22)  # fmt: skip
BACK_SLOTS = 22

# In the backward pass's work, behind the splat's row: what is summed over the tile, and as PLACED
# above.
SUMS, BACK_PLACED = ROW, ROW + 32
BACK_WORK = BACK_PLACED + 16


@inlined
def _rows_flat(work, row, rows, sx, sy, line):
    """A 2D splat's row of gradients from its sums; ``row`` is its row of the table, moved by (sx,
    sy) to the tile.
    """
    b = u64(SUMS)
    tu, tux, tuy = f64(work[b + u64(7)]), f64(work[b + u64(8)]), f64(work[b + u64(9)])
    tv, tvx, tvy = f64(work[b + u64(10)]), f64(work[b + u64(11)]), f64(work[b + u64(12)])
    tw, twx, twy = f64(work[b + u64(13)]), f64(work[b + u64(14)]), f64(work[b + u64(15)])
    rows[line, X0] = -(row[UX] * tu + row[VX] * tv + row[WX] * tw) - work[b + u64(16)]
    rows[line, Y0] = -(row[UY] * tu + row[VY] * tv + row[WY] * tw) - work[b + u64(17)]
    rows[line, UX], rows[line, UY], rows[line, U0] = tux + sx * tu, tuy + sy * tu, tu
    rows[line, VX], rows[line, VY], rows[line, V0] = tvx + sx * tv, tvy + sy * tv, tv
    rows[line, WX], rows[line, WY], rows[line, W0] = twx + sx * tw, twy + sy * tw, tw
    rows[line, Z0], rows[line, ZLO], rows[line, ZHI] = (
        work[b + u64(18)],
        work[b + u64(19)],
        work[b + u64(20)],
    )


@inlined
def _rows_round(work, row, rows, line):
    """A 3D splat's row of gradients from its sums."""
    b = u64(SUMS)
    dx, dy, xx, xy, yy = (
        f64(work[b + u64(7)]), f64(work[b + u64(8)]), work[b + u64(9)], work[b + u64(10)], work[b + u64(11)],
    )  # fmt: skip
    gl, rx, ry = f64(work[b + u64(15)]), f64(work[b + u64(18)]), f64(work[b + u64(19)])
    rows[line, X0] = (
        row[CA] * dx + row[CB] * dy - gl * row[LX] - 2 * (row[RXX] * rx + row[RXY] * ry)
    )
    rows[line, Y0] = (
        row[CB] * dx + row[CC] * dy - gl * row[LY] - 2 * (row[RXY] * rx + row[RYY] * ry)
    )
    rows[line, CA], rows[line, CB], rows[line, CC] = f32(-0.5) * xx, -xy, f32(-0.5) * yy
    rows[line, LX], rows[line, LY] = work[b + u64(16)], work[b + u64(17)]
    rows[line, RXX], rows[line, RXY] = work[b + u64(20)], f32(2.0) * work[b + u64(21)]
    rows[line, RYY], rows[line, 10] = work[b + u64(22)], f32(0.0)
    rows[line, Z0], rows[line, ZLO], rows[line, ZHI] = (
        work[b + u64(14)],
        work[b + u64(12)],
        work[b + u64(13)],
    )


@inlined
def _load_tile(buf, corner, width, height, background, scale, alpha, depth, state, g_color, g_alpha, g_depth, g_median,
               g_normal, g_l1, g_l2):  # fmt: skip
    """What the backward pass needs of a whole tile of three channels, whose first pixel is
    ``corner``, to its buffer.
    """
    image = width * height
    for k in range(PIXELS // 4):
        r, q = k // SIDE, k % SIDE
        p = (r // 4 * SIDE + q) * 16 + r % 4 * 4
        at = corner + r * width + q * 4
        L.copy4(buf, BT * PIXELS + p, state, at)
        L.copy4(buf, BLAST * PIXELS + p, state, at + image)
        L.copy4(buf, BMEDK * PIXELS + p, state, at + 2 * image)
        L.copy4(buf, BIREF * PIXELS + p, state, at + 3 * image)
        L.copy4(buf, BEHQ * PIXELS + p, state, at + 4 * image)
        L.copy4(buf, BZREF * PIXELS + p, depth, at)
        L.copy4(buf, TOTA * PIXELS + p, alpha, at)
        L.copy4(buf, GW * PIXELS + p, g_alpha, at)
        L.copy4(buf, GD * PIXELS + p, g_depth, at)
        L.copy4(buf, GM2 * PIXELS + p, g_l2, at)
        L.copy4(buf, GL1 * PIXELS + p, g_l1, at)
        L.copy4(buf, GMED * PIXELS + p, g_median, at)
        L.separate4(buf, GNX * PIXELS + p, PIXELS, g_normal, 3 * at)
        L.separate4(buf, GC0 * PIXELS + p, PIXELS, g_color, 3 * at)
    for p in range(0, PIXELS, 16):
        # Selected, not multiplied: where nothing is drawn, depth is NaN, and gradients may be
        # anything.
        drawn = L.load(buf, BLAST * PIXELS + p) > f32(0.0)
        A = L.where(drawn, L.load(buf, TOTA * PIXELS + p), f32(1.0))
        g2 = L.load(buf, GM2 * PIXELS + p) * scale
        gw = L.load(buf, GW * PIXELS + p) + g2 * L.load(buf, BEHQ * PIXELS + p)
        for c in range(3):
            at = (GC0 + c) * PIXELS + p
            gw = gw - L.load(buf, at) * background[c]
            L.store(buf, at, L.where(drawn, L.load(buf, at), f32(0.0)))
            at = (GNX + c) * PIXELS + p
            L.store(buf, at, L.where(drawn, L.load(buf, at), f32(0.0)))
        L.store(buf, GW * PIXELS + p, L.where(drawn, gw, f32(0.0)))
        L.store(buf, GD * PIXELS + p, L.where(drawn, L.load(buf, GD * PIXELS + p) / A, f32(0.0)))
        L.store(buf, GM2 * PIXELS + p, L.where(drawn, g2 * A, f32(0.0)))
        L.store(
            buf,
            GL1 * PIXELS + p,
            L.where(drawn, L.load(buf, GL1 * PIXELS + p) * f32(2.0), f32(0.0)),
        )
        L.store(buf, GMED * PIXELS + p, L.where(drawn, L.load(buf, GMED * PIXELS + p), f32(0.0)))
        L.store(buf, BZREF * PIXELS + p, L.where(drawn, L.load(buf, BZREF * PIXELS + p), f32(0.0)))
        L.store(buf, TOTA * PIXELS + p, L.where(drawn, A, f32(0.0)))
        L.store(buf, BEHQ * PIXELS + p, f32(0.0))


@bare
def backward(first, last, visit, view, tiles_x, starts, done, entries, table, thin, features, background, ndc_scale,
             alpha, depth, state, g_color, g_alpha, g_depth, g_median, g_normal, g_l1, g_l2, g_weight, place, rows,
             buf, work, exact):  # fmt: skip
    """Gradients of the tiles visit[first:last], one row of ``rows`` for each entry worked off, from
    place[tile] on; none is written for entries without squares, which are nowhere drawn.

    A row holds the gradient in the first GRADIENTS columns of the splat's ``table`` row, then in
    its normal and values. Splats are visited back to front: the transmittance before each is
    recovered by division from what the forward pass left. A splat's sums stay in registers while
    its squares go by.
    """
    flat, peak = view[FLAT] > 0, view[CENTER] == 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    channels = background.shape[0]
    scale = f32(ndc_scale)
    zero, one, two = f32(0.0), f32(1.0), f32(2.0)
    for p in range(PIXELS):
        buf[BXS * PIXELS + p] = f32(p // 16 % SIDE * 4 + p % 4) - f32(TILE / 2 - 0.5)
        buf[BYS * PIXELS + p] = f32(p // (16 * SIDE) * 4 + p // 4 % 4) - f32(TILE / 2 - 0.5)
    zero_lanes = L.load(buf, BXS * PIXELS) * zero
    slopes(exact, 0)
    for visited in range(first, last):
        t = visit[visited]
        begin, count = starts[t], done[t]
        if count == 0:
            continue
        ty, tx = t // tiles_x, t % tiles_x
        ox, oy = tx * TILE + TILE / 2, ty * TILE + TILE / 2
        cols, tall = min(TILE, width - tx * TILE), min(TILE, height - ty * TILE)
        for p in range(BT * PIXELS, buf.shape[0], 16):
            L.store(buf, p, zero)
        if tall == TILE and cols == TILE and channels == 3:
            corner = ty * TILE * width + tx * TILE
            _load_tile(buf, corner, width, height, background, scale, alpha, depth, state, g_color, g_alpha, g_depth, g_median,
                       g_normal, g_l1, g_l2)  # fmt: skip
        else:
            for r in range(tall):
                for k in range(cols):
                    p = u64((r // 4 * SIDE + k // 4) * 16 + r % 4 * 4 + k % 4)
                    y, x = u64(ty * TILE + r), u64(tx * TILE + k)
                    A = alpha[y, x]
                    if state[1, y, x] == 0:
                        continue
                    buf[u64(BT * PIXELS) + p] = state[0, y, x]
                    buf[u64(BLAST * PIXELS) + p] = state[1, y, x]
                    buf[u64(BMEDK * PIXELS) + p] = state[2, y, x]
                    # Relative to the means, the first moments vanish, and with them most terms.
                    buf[u64(BZREF * PIXELS) + p] = depth[y, x]
                    buf[u64(BIREF * PIXELS) + p] = state[3, y, x]
                    gd = g_depth[y, x] / A
                    g2 = scale * g_l2[y, x]
                    gw = g_alpha[y, x] + g2 * state[4, y, x]
                    for c in range(channels):
                        gw -= g_color[y, x, u64(c)] * background[c]
                        buf[u64((GC0 + c) * PIXELS) + p] = g_color[y, x, u64(c)]
                    for c in range(3):
                        buf[u64((GNX + c) * PIXELS) + p] = g_normal[y, x, u64(c)]
                    buf[u64(GW * PIXELS) + p] = gw
                    buf[u64(GD * PIXELS) + p] = gd
                    buf[u64(GM2 * PIXELS) + p] = g2 * A
                    buf[u64(GL1 * PIXELS) + p] = two * g_l1[y, x]
                    buf[u64(GMED * PIXELS) + p] = g_median[y, x]
                    buf[u64(TOTA * PIXELS) + p] = A
        for back in range(count):
            e = begin + count - 1 - back
            entry = entries[e]
            i = entry & PLACE
            line = place[t] + count - 1 - back
            squares = entry >> PLACE_BITS
            ahead = entries[max(e - 8, begin)] & PLACE
            prefetch(table, ahead * COLUMNS)
            prefetch(table, ahead * COLUMNS + 8)
            prefetch(table, ahead * COLUMNS + 16)
            if squares == 0:
                continue
            lay_out(work, 0, exact, 0, table, thin, i, ox, oy, flat)
            step = f32(e - begin + 1)
            gi = g_weight[i]
            if channels > 3:
                for c in range(3, channels):
                    rows[line, GRADIENTS + 3 + c] = zero
            s0 = s1 = s2 = s3 = s4 = s5 = zero_lanes
            b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = b8 = b9 = s0
            b10 = b11 = b12 = b13 = b14 = b15 = b16 = s0
            hits = 0
            quarter, dx, dy = 0, 0.0, 0.0
            while squares != 0:
                if quarter == 0:
                    corner = L.lowest(squares) & CORNER
                    quarter = squares & (QUARTER << corner)
                    dx, dy = (corner & 2) * 4.0 - 4.0, (corner & 8) - 4.0
                    refer(work, BACK_PLACED, exact, 0, dx, dy)
                q = L.lowest(quarter)
                quarter &= quarter - 1
                squares &= ~(1 << q)
                s = q * 16
                x, y = L.load(buf, BXS * PIXELS + s), L.load(buf, BYS * PIXELS + s)
                nx, ny = x - f32(dx), y - f32(dy)
                sx, sy = nx * f32(ROOT2), ny * f32(ROOT2)
                inside, a, p, iq = shade(work, 0, BACK_PLACED, nx, ny, sx, sy, flat, peak)
                z, iz = depth_less(work, 0, p, iq, flat, peak, zero_lanes, zero_lanes)
                hit = inside & (step <= L.load(buf, BLAST * PIXELS + s))
                if not L.some(hit):
                    continue
                hits += 1
                a = L.where(hit, a, zero)
                rest = L.inverse(one - a)
                T = L.load(buf, BT * PIXELS + s) * rest
                w = a * T
                dz, m = z - L.load(buf, BZREF * PIXELS + s), iz - L.load(buf, BIREF * PIXELS + s)
                gn0, gn1 = L.load(buf, GNX * PIXELS + s), L.load(buf, GNY * PIXELS + s)
                gn2 = L.load(buf, GNZ * PIXELS + s)
                gc0, gc1 = L.load(buf, GC0 * PIXELS + s), L.load(buf, GC1 * PIXELS + s)
                gc2 = L.load(buf, GC2 * PIXELS + s)
                gd, gl1 = L.load(buf, GD * PIXELS + s), L.load(buf, GL1 * PIXELS + s)
                gm = L.load(buf, GM2 * PIXELS + s) * m
                behind_a, behind_d = L.load(buf, BEHA * PIXELS + s), L.load(buf, BEHD * PIXELS + s)
                behind_q = L.load(buf, BEHQ * PIXELS + s)
                g = L.load(buf, GW * PIXELS + s) + gi + gd * dz + gm * m
                g = g + gn0 * L.spread(work, NORMAL) + gn1 * L.spread(work, NORMAL + 1)
                g = g + gn2 * L.spread(work, NORMAL + 2) + gc0 * L.spread(work, VALUES)
                g = g + gc1 * L.spread(work, VALUES + 1) + gc2 * L.spread(work, VALUES + 2)
                if channels > 3:
                    for c in range(3, channels):
                        upstream = L.load(buf, (GC0 + c) * PIXELS + s)
                        g = g + upstream * features[u64(i), u64(c)]
                        rows[line, GRADIENTS + 3 + c] += L.total(w * upstream)
                # In front minus behind, of the weights and of the weighted depths.
                wz = w * dz
                lean = L.load(buf, TOTA * PIXELS + s) - w - two * behind_a
                g = g + gl1 * (dz * lean + wz + two * behind_d)
                in_z = w * (gd + gl1 * lean)
                in_z = in_z + L.where(
                    step == L.load(buf, BMEDK * PIXELS + s), L.load(buf, GMED * PIXELS + s), zero
                )
                # What 1 / z is blamed for, as a gradient in z.
                in_z = in_z - two * w * gm * iz * iz
                in_a = L.where(hit & (a < f32(K.ALPHA_MAX)), (T * g - behind_q * rest) * a, zero)
                L.store(buf, BT * PIXELS + s, T)
                L.store(buf, BEHQ * PIXELS + s, behind_q + w * g)
                L.store(buf, BEHA * PIXELS + s, behind_a + w)
                L.store(buf, BEHD * PIXELS + s, behind_d + wz)
                s0, s1, s2 = s0 + w * gn0, s1 + w * gn1, s2 + w * gn2
                s3, s4, s5 = s3 + w * gc0, s4 + w * gc1, s5 + w * gc2
                b0 = b0 + in_a
                ex, ey = (
                    nx + L.spread(work, BACK_PLACED + AT_X),
                    ny + L.spread(work, BACK_PLACED + AT_Y),
                )
                low, high, z0 = L.spread(work, ZLO), L.spread(work, ZHI), L.spread(work, Z0)
                if flat:
                    # As in shade.
                    v_w = (
                        L.spread(work, BACK_PLACED + AT_W)
                        + L.spread(work, WX) * nx
                        + L.spread(work, WY) * ny
                    )
                    u = (
                        L.spread(work, BACK_PLACED + AT_U)
                        + L.spread(work, UX) * nx
                        + L.spread(work, UY) * ny
                    )
                    v = (
                        L.spread(work, BACK_PLACED + AT_V)
                        + L.spread(work, VX) * nx
                        + L.spread(work, VY) * ny
                    )
                    sx, sy = (
                        sx + L.spread(work, BACK_PLACED + SCREEN_X),
                        sy + L.spread(work, BACK_PLACED + SCREEN_Y),
                    )
                    meets = (v_w <= L.spread(work, WMAX)) & (
                        (u * u + v * v) * (p * p) <= sx * sx + sy * sy
                    )
                    r = p
                    # Selected, not multiplied by 0: what it is multiplied with may be infinite.
                    rs = L.where(meets, r, zero)
                    u, v = u * rs, v * rs
                    blame = in_a * rs
                    gu, gv = blame * u, blame * v
                    gw = gu * u + gv * v
                    screened = L.where(meets, zero, in_a) * two
                    # Strictly: a splat that faces the camera has WLOW = WTOP = W, and its depth is
                    # its plane's.
                    under, over = L.spread(work, WTOP) < v_w, v_w < L.spread(work, WLOW)
                    if not peak:
                        under, over = zero_lanes < one, zero_lanes < zero
                    between = L.flipped(over | under)
                    rz = L.where(between, r, zero)
                    along = in_z * rz
                    # The signs of gu, gv, gw and of the screen's are turned at the end.
                    gw = along * z0 * rz - gw
                    b1, b2, b3 = b1 - gu, b2 - gu * x, b3 - gu * y
                    b4, b5, b6 = b4 - gv, b5 - gv * x, b6 - gv * y
                    b7, b8, b9 = b7 - gw, b8 - gw * x, b9 - gw * y
                    b10, b11 = b10 - screened * ex, b11 - screened * ey
                    b12 = b12 + along
                    b13 = b13 + L.where(under, in_z, zero)
                    b14 = b14 + L.where(over, in_z, zero)
                else:
                    b1, b2 = b1 + in_a * ex, b2 + in_a * ey
                    b3, b4, b5 = b3 + in_a * ex * ex, b4 + in_a * ex * ey, b5 + in_a * ey * ey
                    if peak:
                        along = L.spread(work, LX) * ex + L.spread(work, LY) * ey + one
                        form = (L.spread(work, RXX) * ex + L.spread(work, RXY) * ey * two) * ex
                        across = along * along + L.most(form + L.spread(work, RYY) * ey * ey, zero)
                        inverse = L.inverse(L.most(across, f32(1e-30)))
                        meant = z0 * along * inverse
                        under, over = meant <= low, high < meant
                        b6 = b6 + L.where(under, in_z, zero)
                        b7 = b7 + L.where(over, in_z, zero)
                        in_z = L.where(under | over, zero, in_z) * inverse
                        b8 = b8 + in_z * along
                        in_z = in_z * z0
                        gl = in_z * (one - two * along * along * inverse)
                        gr = -(in_z * along * inverse)
                        b9, b10, b11 = b9 + gl, b10 + gl * ex, b11 + gl * ey
                        rx, ry = gr * ex, gr * ey
                        b12, b13 = b12 + rx, b13 + ry
                        b14, b15, b16 = b14 + rx * ex, b15 + rx * ey, b16 + ry * ey
                    else:
                        b6 = b6 + in_z
            if hits == 0:
                for c in range(GRADIENTS + 6):
                    rows[line, c] = zero
                continue
            L.store(
                work, SUMS, L.totals(s0, s1, s2, s3, s4, s5, b0, b1, b2, b3, b4, b5, b6, b7, b8, b9)
            )
            L.store(work, SUMS + 16, L.totals8(b10, b11, b12, b13, b14, b15, b16, b16))
            for c in range(6):
                rows[line, GRADIENTS + c] = work[u64(SUMS + c)]
            rows[line, OPACITY] = work[u64(SUMS + 6)] / work[u64(OPACITY)]
            if flat:
                _rows_flat(work, table[i], rows, exact[u64(AT_X)], exact[u64(AT_Y)], line)
            else:
                _rows_round(work, table[i], rows, line)


@jit
def reduce_rows(low, high, first, last, visit, starts, done, entries, place, rows, total):
    """Add the rows of the tiles visit[first:last] to those of the splats low..high in ``total``, in
    their order.
    """
    columns = rows.shape[1]
    for visited in range(first, last):
        t = visit[visited]
        for k in range(done[t]):
            ahead = (entries[min(starts[t] + k + 8, entries.shape[0] - 1)] & PLACE) * columns
            prefetch(total, ahead)
            prefetch(total, ahead + 8)
            prefetch(total, ahead + 16)
            entry = entries[starts[t] + k]
            i = entry & PLACE
            # What is nowhere drawn has no row.
            if entry > PLACE and low <= i < high:
                row = place[t] + k
                for c in range(columns):
                    total[i, c] += rows[row, c]


@jit
def project_backward(first, last, order, view, m, q, sizes, o, values, channels, table, total,
                     gm, gq, gs, go, gv, g_view):  # fmt: skip
    """Gradients in the parameters of the splats order[first:last] from those in their projection,
    ``total``.

    The vector-Jacobian product of :func:`project`, in float64, every step of it in reverse.
    ``g_view`` (12) receives the sums for R and t.
    """
    R = view[:9].copy().reshape(3, 3)
    fx, skew, fy, cx, cy, near = view[FX], view[SKEW], view[FY], view[CX], view[CY], view[NEAR]
    flat, center = view[FLAT] > 0, view[CENTER] > 0
    degree = round(math.sqrt(values.shape[1] / 3)) - 1
    Q = np.empty((3, 3))
    a = np.empty((3, 3))
    S = np.empty((3, 3))
    PC = np.empty(3)
    Y = np.empty(16)
    c = np.empty(3)
    ga = np.empty((3, 3))
    gQ = np.empty((3, 3))
    gS = np.empty((3, 3))
    gPC = np.empty(3)
    gc = np.empty(3)
    gY = np.empty(16)
    s = np.empty(3)
    g_s = np.empty(3)
    at = np.empty(3)
    h = np.empty(3)
    gh = np.empty(3)
    gR = np.zeros((3, 3))
    gt = np.zeros(3)
    kx, ky, kxy = 1 / fx, 1 / fy, -skew / (fx * fy)
    for place in range(first, last):
        later = order[min(place + 12, last - 1)]
        prefetch(m, later * 3)
        prefetch(q, later * 4)
        prefetch(sizes, later * sizes.shape[1])
        prefetch(values, later * values.shape[1])
        i = order[place]
        g = total[place]
        blamed = False
        for k in range(g.shape[0]):
            blamed |= g[k] != 0.0
        if not blamed:
            # Never seen, or not even projected: its row of the table may hold anything.
            continue
        for k in range(sizes.shape[1]):
            s[k] = sizes[i, k]
            g_s[k] = 0.0
        for r in range(3):
            at[r] = m[i, r]
        for r in range(3):
            c[r] = R[r, 0] * at[0] + R[r, 1] * at[1] + R[r, 2] * at[2] + view[TX + r]
        size = axes(q, i, Q)
        for r in range(3):
            for k in range(3):
                a[r, k] = R[r, 0] * Q[0, k] + R[r, 1] * Q[1, k] + R[r, 2] * Q[2, k]
        ga[:] = 0.0
        gQ[:] = 0.0
        gc[:] = 0.0
        g_length = 0.0
        length = math.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
        ahead = c[2] > near
        if ahead:
            gc[0] += g[X0] * fx / c[2]
            gc[1] += (g[X0] * skew + g[Y0] * fy) / c[2]
            gc[2] -= (g[X0] * (table[place, X0] - cx) + g[Y0] * (table[place, Y0] - cy)) / c[2]
        g_opacity = g[OPACITY]
        if flat:
            depth = c[2] if ahead else length
            nc = a[0, 2] * c[0] + a[1, 2] * c[1] + a[2, 2] * c[2]
            floor = K.EDGE_ON * length
            tilted = abs(nc) < floor
            sign = -1.0 if nc < 0 else 1.0
            if tilted:
                nc = sign * floor
            g_depth, g_nc = g[Z0], 0.0
            for k in range(2):
                tc = (a[0, k] * c[0] + a[1, k] * c[1] + a[2, k] * c[2]) / nc
                scale = depth / s[k]
                for r in range(3):
                    h[r] = a[r, k] - tc * a[r, 2]
                gh[0] = g[UX + 3 * k] * kx + g[UY + 3 * k] * kxy
                gh[1] = g[UY + 3 * k] * ky
                gh[2] = 0.0 if ahead else g[U0 + 3 * k]
                g_scale = gh[0] * h[0] + gh[1] * h[1] + gh[2] * h[2]
                g_tc = 0.0
                for r in range(3):
                    gh[r] *= scale
                    g_tc -= gh[r] * a[r, 2]
                for r in range(3):
                    ga[r, k] += gh[r] + g_tc * c[r] / nc
                    ga[r, 2] -= tc * gh[r]
                    gc[r] += g_tc * a[r, k] / nc
                g_nc -= g_tc * tc / nc
                g_depth += g_scale / s[k]
                g_s[k] -= g_scale * scale / s[k]
            scale = depth / nc
            gh[0] = g[WX] * kx + g[WY] * kxy
            gh[1] = g[WY] * ky
            gh[2] = 0.0 if ahead else g[W0]
            g_scale = 0.0
            for r in range(3):
                g_scale += gh[r] * a[r, 2]
                ga[r, 2] += scale * gh[r]
            g_depth += g_scale / nc
            g_nc -= g_scale * scale / nc
            if tilted:
                g_length += sign * K.EDGE_ON * g_nc
            else:
                for r in range(3):
                    ga[r, 2] += g_nc * c[r]
                    gc[r] += g_nc * a[r, 2]
            if ahead:
                gc[2] += g_depth
            else:
                g_length += g_depth
        else:
            gc[2] += g[Z0]
            limit = K.JACOBIAN_MARGIN * view[WIDTH] / 2 / fx
            low, high = -cx / fx - limit, (view[WIDTH] - cx) / fx + limit
            free_x = low <= c[0] / c[2] <= high
            px = min(max(c[0] / c[2], low), high)
            limit = K.JACOBIAN_MARGIN * view[HEIGHT] / 2 / fy
            low, high = -cy / fy - limit, (view[HEIGHT] - cy) / fy + limit
            free_y = low <= c[1] / c[2] <= high
            py = min(max(c[1] / c[2], low), high)
            sxx, sxy, syy = 0.0, 0.0, 0.0
            for k in range(3):
                gx = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * s[k] / c[2]
                gy = fy * (a[1, k] - py * a[2, k]) * s[k] / c[2]
                sxx += gx * gx
                sxy += gx * gy
                syy += gy * gy
            sharp = sxx * syy - sxy * sxy
            bxx, byy = sxx + K.BLUR_3D, syy + K.BLUR_3D
            det = bxx * byy - sxy * sxy
            # d conic = -conic d Sigma conic
            A, B, C = byy / det, -sxy / det, bxx / det
            p11, p12 = A * g[CA] + B * g[CB] / 2, A * g[CB] / 2 + B * g[CC]
            p21, p22 = B * g[CA] + C * g[CB] / 2, B * g[CB] / 2 + C * g[CC]
            g_xx = -(p11 * A + p12 * B)
            g_xy = -(p11 * B + p12 * C) - (p21 * A + p22 * B)
            g_yy = -(p21 * B + p22 * C)
            if view[ANTIALIASED] > 0:
                ratio = sharp / det
                factor = math.sqrt(max(ratio, K.COMPENSATION_MIN))
                if ratio >= K.COMPENSATION_MIN:
                    g_ratio = g_opacity * o[i] / (2 * factor)
                    g_sharp, g_det = g_ratio / det, -g_ratio * ratio / det
                    g_xx += g_sharp * syy + g_det * byy
                    g_yy += g_sharp * sxx + g_det * bxx
                    g_xy -= 2 * sxy * (g_sharp + g_det)
                g_opacity *= factor
            g_px, g_py = 0.0, 0.0
            for k in range(3):
                f = s[k] / c[2]
                gx = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * f
                gy = fy * (a[1, k] - py * a[2, k]) * f
                ux = 2 * g_xx * gx + g_xy * gy
                uy = 2 * g_yy * gy + g_xy * gx
                ga[0, k] += ux * fx * f
                ga[1, k] += (ux * skew + uy * fy) * f
                ga[2, k] -= (ux * (fx * px + skew * py) + uy * fy * py) * f
                g_px -= ux * fx * a[2, k] * f
                g_py -= (ux * skew + uy * fy) * a[2, k] * f
                g_s[k] += (ux * gx + uy * gy) / s[k]
                gc[2] -= (ux * gx + uy * gy) / c[2]
            if free_x:
                gc[0] += g_px / c[2]
                gc[2] -= g_px * c[0] / (c[2] * c[2])
            if free_y:
                gc[1] += g_py / c[2]
                gc[2] -= g_py * c[1] / (c[2] * c[2])
            if not center:
                for r in range(3):
                    for k in range(3):
                        S[r, k] = 0.0
                        for j in range(3):
                            S[r, k] += a[r, j] * a[k, j] / (s[j] * s[j])
                for r in range(3):
                    PC[r] = S[r, 0] * c[0] + S[r, 1] * c[1] + S[r, 2] * c[2]
                q0 = PC[0] * c[0] + PC[1] * c[1] + PC[2] * c[2]
                lx, ly = c[2] * PC[0] / q0, c[2] * PC[1] / q0
                g_lx = g[LX] * kx + g[LY] * kxy
                g_ly = g[LY] * ky
                g_rxx = g[RXX] * kx * kx + g[RXY] * kx * kxy + g[RYY] * kxy * kxy
                g_rxy = g[RXY] * kx * ky + 2 * g[RYY] * kxy * ky
                g_ryy = g[RYY] * ky * ky
                square = c[2] * c[2] / q0
                gS[:] = 0.0
                gS[0, 0], gS[0, 1], gS[1, 1] = g_rxx * square, g_rxy * square, g_ryy * square
                quadratic = g_rxx * S[0, 0] + g_rxy * S[0, 1] + g_ryy * S[1, 1]
                g_q0 = -quadratic * square / q0
                gc[2] += 2 * c[2] / q0 * quadratic
                g_lx -= 2 * lx * g_rxx + ly * g_rxy
                g_ly -= 2 * ly * g_ryy + lx * g_rxy
                g_q0 -= (g_lx * lx + g_ly * ly) / q0
                gc[2] += (g_lx * PC[0] + g_ly * PC[1]) / q0
                gPC[0], gPC[1], gPC[2] = g_lx * c[2] / q0, g_ly * c[2] / q0, 0.0
                for r in range(3):
                    gPC[r] += g_q0 * c[r]
                    gc[r] += g_q0 * PC[r]
                for r in range(3):
                    for k in range(3):
                        gS[r, k] += gPC[r] * c[k]
                        gc[r] += S[r, k] * gPC[k]
                for k in range(3):
                    inverse = 1 / (s[k] * s[k])
                    along = 0.0
                    for r in range(3):
                        for j in range(3):
                            ga[r, k] += (gS[r, j] + gS[j, r]) * a[j, k] * inverse
                            along += a[r, k] * gS[r, j] * a[j, k]
                    g_s[k] -= 2 * along * inverse / s[k]
        spread = (s[0] * a[2, 0]) ** 2 + (s[1] * a[2, 1]) ** 2
        if not flat:
            spread += (s[2] * a[2, 2]) ** 2
        spread = math.sqrt(spread)
        if center:
            if c[2] > near:
                gc[2] += g[ZLO] + g[ZHI]
        else:
            g_spread = 0.0
            if c[2] - K.EXTENT_SIGMAS * spread > near:
                gc[2] += g[ZLO]
                g_spread -= K.EXTENT_SIGMAS * g[ZLO]
            if c[2] + K.EXTENT_SIGMAS * spread > near:
                gc[2] += g[ZHI]
                g_spread += K.EXTENT_SIGMAS * g[ZHI]
            if spread > 0:
                for k in range(sizes.shape[1]):
                    g_s[k] += g_spread * s[k] * a[2, k] ** 2 / spread
                    ga[2, k] += g_spread * s[k] ** 2 * a[2, k] / spread
        go[i] = g_opacity
        axis = 2
        if not flat:
            axis = 0
            if s[1] < s[axis]:
                axis = 1
            if s[2] < s[axis]:
                axis = 2
        facing = a[0, axis] * c[0] + a[1, axis] * c[1] + a[2, axis] * c[2]
        flip = -1.0 if facing > 0 else 1.0
        for k in range(3):
            gQ[k, axis] += flip * g[GRADIENTS + k]
        if view[HARMONIC] > 0:
            x = (R[0, 0] * c[0] + R[1, 0] * c[1] + R[2, 0] * c[2]) / length
            y = (R[0, 1] * c[0] + R[1, 1] * c[1] + R[2, 1] * c[2]) / length
            z = (R[0, 2] * c[0] + R[1, 2] * c[1] + R[2, 2] * c[2]) / length
            harmonics(degree, x, y, z, Y)
            bases = (degree + 1) ** 2
            for j in range(bases):
                gY[j] = 0.0
            for k in range(3):
                shade = 0.5
                for j in range(bases):
                    shade += Y[j] * values[i, 3 * j + k]
                if shade >= 0:
                    for j in range(bases):
                        gv[i, 3 * j + k] = g[GRADIENTS + 3 + k] * Y[j]
                        gY[j] += g[GRADIENTS + 3 + k] * values[i, 3 * j + k]
            dx, dy, dz = 0.0, 0.0, 0.0
            if degree > 0:
                dx -= C1 * gY[3]
                dy -= C1 * gY[1]
                dz += C1 * gY[2]
            if degree > 1:
                dx += C20 * y * gY[4] - 2 * C22 * x * gY[6] + C23 * z * gY[7] + 2 * C24 * x * gY[8]
                dy += C20 * x * gY[4] + C21 * z * gY[5] - 2 * C22 * y * gY[6] - 2 * C24 * y * gY[8]
                dz += C21 * y * gY[5] + 4 * C22 * z * gY[6] + C23 * x * gY[7]
            if degree > 2:
                dx += C30 * 6 * x * y * gY[9] + C31 * y * z * gY[10] - C32 * 2 * x * y * gY[11]
                dx += -C33 * 6 * x * z * gY[12] + C34 * (4 * z * z - 3 * x * x - y * y) * gY[13]
                dx += C35 * 2 * x * z * gY[14] + C36 * 3 * (x * x - y * y) * gY[15]
                dy += C30 * 3 * (x * x - y * y) * gY[9] + C31 * x * z * gY[10]
                dy += C32 * (4 * z * z - x * x - 3 * y * y) * gY[11] - C33 * 6 * y * z * gY[12]
                dy += (
                    -C34 * 2 * x * y * gY[13] - C35 * 2 * y * z * gY[14] - C36 * 6 * x * y * gY[15]
                )
                dz += C31 * x * y * gY[10] + C32 * 8 * y * z * gY[11]
                dz += C33 * 3 * (2 * z * z - x * x - y * y) * gY[12] + C34 * 8 * x * z * gY[13]
                dz += C35 * (x * x - y * y) * gY[14]
            along = x * dx + y * dy + z * dz
            h[0], h[1], h[2] = (
                (dx - x * along) / length,
                (dy - y * along) / length,
                (dz - z * along) / length,
            )
            for r in range(3):
                for k in range(3):
                    gc[r] += R[r, k] * h[k]
                    gR[r, k] += c[r] * h[k]
        else:
            for k in range(channels):
                gv[i, k] = g[GRADIENTS + 3 + k]
        for r in range(3):
            gc[r] += g_length * c[r] / length
        for r in range(3):
            for k in range(3):
                for j in range(3):
                    gQ[j, k] += R[r, j] * ga[r, k]
                    gR[r, j] += ga[r, k] * Q[j, k]
        for k in range(3):
            gm[i, k] = R[0, k] * gc[0] + R[1, k] * gc[1] + R[2, k] * gc[2]
        for k in range(sizes.shape[1]):
            gs[i, k] = g_s[k]
        for r in range(3):
            gt[r] += gc[r]
            for k in range(3):
                gR[r, k] += gc[r] * at[k]
        w, x, y, z = (
            f64(q[i, 0]) / size,
            f64(q[i, 1]) / size,
            f64(q[i, 2]) / size,
            f64(q[i, 3]) / size,
        )
        gw = 2 * (x * (gQ[2, 1] - gQ[1, 2]) + y * (gQ[0, 2] - gQ[2, 0]) + z * (gQ[1, 0] - gQ[0, 1]))
        yx, zx, zy = gQ[0, 1] + gQ[1, 0], gQ[0, 2] + gQ[2, 0], gQ[1, 2] + gQ[2, 1]
        gx = 2 * (-2 * x * (gQ[1, 1] + gQ[2, 2]) + y * yx + z * zx + w * (gQ[2, 1] - gQ[1, 2]))
        gy = 2 * (x * yx - 2 * y * (gQ[0, 0] + gQ[2, 2]) + z * zy + w * (gQ[0, 2] - gQ[2, 0]))
        gz = 2 * (x * zx + y * zy - 2 * z * (gQ[0, 0] + gQ[1, 1]) + w * (gQ[1, 0] - gQ[0, 1]))
        along = w * gw + x * gx + y * gy + z * gz
        gq[i, 0], gq[i, 1] = (gw - w * along) / size, (gx - x * along) / size
        gq[i, 2], gq[i, 3] = (gy - y * along) / size, (gz - z * along) / size
    for r in range(3):
        g_view[9 + r] = gt[r]
        for k in range(3):
            g_view[3 * r + k] = gR[r, k]
