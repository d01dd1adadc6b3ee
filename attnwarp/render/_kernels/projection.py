# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Splats as the camera sees them: their order, outline, depth and colour, eight at once in
float64."""

from __future__ import annotations

import math

import numpy as np

from attnwarp.render import constants as K
from attnwarp.render._kernels import lanes as L

# isort: off
from attnwarp.render._kernels.layout import (
    ANTIALIASED, CA, CB, CC, CENTER, CUT, CX, CY, F11, FILTER, FLAT, FX, FY, HARMONIC, HEIGHT, IZ0, IZLO, LX, LY, NEAR,
    NORMAL, OPACITY, RXX, RXY, RYY, SHAPE_EX, SHAPE_EY, SHAPE_FIRST, SHAPE_HALF, SHAPE_HIGH, SHAPE_LAST, SHAPE_LEAN,
    SHAPE_LEFT, SHAPE_RADIUS, SHAPE_RIGHT, SHAPE_SHRINK, SHAPE_SQUARE, SHAPE_TIP, SHAPE_TOP, SHAPE_WIDE, SHAPE_Y, SIDE, SKEW,
    TILE, TX, U0, UX, UY, V0, VALUES, VX, VY, W0, WIDE, WIDTH, WLOW, WMAX, WTOP, WX, WY, X0, Y0, Z0, ZHI, ZLO, prefetch,
    bare, f32, f64, inlined, jit, u64,
)  # fmt: skip
# isort: on

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C20, C21, C22, C23, C24 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
C30, C31, C32, C33 = -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154
C34, C35, C36 = -0.4570457994644658, 1.445305721320277, -0.5900435899266435


@inlined
def _root(x):
    """The square root of eight float64 >= 0, to the last bits; anything where they are negative or
    infinite.
    """
    return x * L.inverse_root(L.most(x, 1e-300))


@inlined
def _log(x):
    """The natural logarithm of eight float64, to 1e-12, for x > 0 that are not denormal: with x = f
    2^k and f about 1, 2 artanh((f - 1) / (f + 1)) + k log 2."""
    f, k = L.fraction(x), L.exponent(x)
    large = f > 1.4142135623730951
    f, k = L.where(large, f * 0.5, f), L.where(large, k + 1.0, k)
    z = (f - 1.0) / (f + 1.0)
    s = z * z
    series = (
        s
        * (
            s * (s * (s * (s * (s * (s * (1 / 15) + 1 / 13) + 1 / 11) + 1 / 9) + 1 / 7) + 1 / 5)
            + 1 / 3
        )
        + 1.0
    )
    return k * 0.6931471805599453 + z * series * 2.0


@inlined
def harmonics(degree, x, y, z, out):
    out[0] = C0
    if degree > 0:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if degree > 1:
        out[4], out[5], out[6] = C20 * x * y, C21 * y * z, C22 * (2 * z * z - x * x - y * y)
        out[7], out[8] = C23 * x * z, C24 * (x * x - y * y)
    if degree > 2:
        out[9], out[10], out[11] = (
            C30 * y * (3 * x * x - y * y),
            C31 * x * y * z,
            C32 * y * (4 * z * z - x * x - y * y),
        )
        out[12] = C33 * z * (2 * z * z - 3 * x * x - 3 * y * y)
        out[13], out[14] = C34 * x * (4 * z * z - x * x - y * y), C35 * z * (x * x - y * y)
        out[15] = C36 * x * (x * x - 3 * y * y)


@inlined
def axes(q, i, Q):
    """Rotation of quaternion i into Q; returns the quaternion's length."""
    w, x, y, z = f64(q[i, 0]), f64(q[i, 1]), f64(q[i, 2]), f64(q[i, 3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = 1 / length
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    Q[0, 0], Q[0, 1], Q[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    Q[1, 0], Q[1, 1], Q[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    Q[2, 0], Q[2, 1], Q[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return length


@jit
def depths(first, last, view, m, q, s, o, key, listed):
    """The depth of each of the splats first..last, to ``key``; NaN where nothing can show.

    ``listed`` (1) gets a guess at how many tiles will list them: rectangles of 5 sigmas, their
    centres in the picture.
    """
    fx, fy = view[FX] / TILE, view[FY] / TILE
    wide, tall = view[WIDTH] / TILE, view[HEIGHT] / TILE
    px, py = view[CX] / TILE, view[CY] / TILE
    guess = 0.0
    r0, r1, r2, t = view[6], view[7], view[8], view[TX + 2]
    near, flat = view[NEAR], view[FLAT] > 0
    for i in range(first, last):
        c2 = r0 * f64(m[i, 0]) + r1 * f64(m[i, 1]) + r2 * f64(m[i, 2]) + t
        shows = c2 > near
        if flat and not shows:
            w, x, y, z = f64(q[i, 0]), f64(q[i, 1]), f64(q[i, 2]), f64(q[i, 3])
            square = w * w + x * x + y * y + z * z
            a0 = (
                r0 * (square - 2 * (y * y + z * z))
                + r1 * 2 * (x * y + w * z)
                + r2 * 2 * (x * z - w * y)
            )
            a1 = (
                r0 * 2 * (x * y - w * z)
                + r1 * (square - 2 * (x * x + z * z))
                + r2 * 2 * (y * z + w * x)
            )
            spread = math.sqrt((f64(s[i, 0]) * a0) ** 2 + (f64(s[i, 1]) * a1) ** 2) / square
            shows = c2 + K.EXTENT_SIGMAS * spread > near
        shows = shows and o[i] >= K.ALPHA_MIN
        key[i] = c2 if shows else np.nan
        if shows and c2 > near:
            c0 = view[0] * f64(m[i, 0]) + view[1] * f64(m[i, 1]) + view[2] * f64(m[i, 2]) + view[TX]
            c1 = (
                view[3] * f64(m[i, 0])
                + view[4] * f64(m[i, 1])
                + view[5] * f64(m[i, 2])
                + view[TX + 1]
            )
            x, y = fx * c0 / c2 + px, fy * c1 / c2 + py
            if 0 < x < wide and 0 < y < tall:
                first_side = min(1 + 5 * fx * f64(s[i, 0]) / c2, wide)
                second_side = min(1 + 5 * fy * f64(s[i, 1]) / c2, tall)
                guess += first_side * second_side
    listed[0] = guess


@inlined
def _reaches(view, c0, c1, c2, size, wanted):
    """Whether a splat may show in a wanted tile, by a rectangle that holds it whatever its
    rotation.

    c: its centre in camera axes. size: its largest sigma.
    """
    fx, skew, fy, near = view[FX], view[SKEW], view[FY], view[NEAR]
    ic = 1 / c2
    x, y = c0 * ic, c1 * ic
    at_x, at_y = fx * x + skew * y + view[CX], fy * y + view[CY]
    every = wanted[-1, -1] == (wanted.shape[0] - 1) * (wanted.shape[1] - 1)
    if every & (at_x > 0) & (at_x < view[WIDTH]) & (at_y > 0) & (at_y < view[HEIGHT]) & (c2 > near):
        return True
    if view[FLAT] > 0:
        # A sphere holds it: (c0 + d0) / (c2 + d2) - c0 / c2 is at most |d| (1 + |c0 / c2|) / (c2 -
        # |d|). And 2.4 pixels hold the disc of the screen filter.
        reach = K.EXTENT_SIGMAS * size
        if c2 - reach <= near:
            return True
        scale, blur = reach / (c2 - reach), 2.4
    else:
        # As the projection is linearised, no wider than |J| sigma; then blurred.
        x_most, y_most = (
            1.0 + abs(view[CX] / fx) + 2 * view[WIDTH] / fx,
            1.0 + abs(view[CY] / fy) + 2 * view[HEIGHT] / fy,
        )
        x, y = min(max(x, -x_most), x_most), min(max(y, -y_most), y_most)
        scale, blur = K.EXTENT_SIGMAS * size * ic, K.EXTENT_SIGMAS * math.sqrt(K.BLUR_3D)
    tall = scale * fy * (1 + abs(y)) + blur
    wide = scale * (fx * (1 + abs(x)) + abs(skew) * (1 + abs(y))) + blur
    x1, x2, y1, y2 = at_x - wide, at_x + wide, at_y - tall, at_y + tall
    if not ((x2 > 0) & (y2 > 0) & (x1 < view[WIDTH]) & (y1 < view[HEIGHT])):
        return False
    t1, t2 = int(max(x1, 0.0)) // TILE, int(min(x2, view[WIDTH] - 1)) // TILE + 1
    r1, r2 = int(max(y1, 0.0)) // TILE, int(min(y2, view[HEIGHT] - 1)) // TILE + 1
    return wanted[r2, t2] - wanted[r1, t2] - wanted[r2, t1] + wanted[r1, t1] > 0


# What eight splats are worked off in, rows of eight: in float64 their parameters, their centres in
# camera axes, and the first columns of their rows of the table; in float32 the table's other
# columns, then the outline's.
IN_Q, IN_S, IN_O, IN_C, OUT = 3, 7, 10, 11, 14
FACTOR = 8 * (OUT + WIDE)
SETUP = FACTOR + 24
SHAPES = VALUES - WIDE
SETUP_NARROW = 8 * (SHAPES + 16)


@bare
def project(
    first,
    last,
    order,
    view,
    m,
    q,
    s,
    o,
    values,
    channels,
    wanted,
    table,
    thin,
    features,
    shapes,
    work,
    slim,
    Y,
):
    """The splats order[first:last] to the rows first..last of the table, and of ``features`` (M,
    channels) if there are more than three; and their outlines to the rows 0..last - first of
    ``shapes`` (., 16).

    ``wanted`` (tiles_y + 1, tiles_x + 1) holds how many tiles are wanted above and left of each
    tile's corner: a splat that cannot show in a wanted one gets a negative CUT and no outline, and
    the rest of its row is left as it was. ``work`` (SETUP), ``slim`` (SETUP_NARROW) and ``Y`` (16)
    are for work. Eight splats are done at once, in float64.
    """
    R00, R01, R02, R10, R11, R12 = view[0], view[1], view[2], view[3], view[4], view[5]
    R20, R21, R22 = view[6], view[7], view[8]
    fx, skew, fy, cx, cy, near = view[FX], view[SKEW], view[FY], view[CX], view[CY], view[NEAR]
    width, height = view[WIDTH], view[HEIGHT]
    flat, center, harmonic = view[FLAT] > 0, view[CENTER] > 0, view[HARMONIC] > 0
    degree = round(math.sqrt(values.shape[1] / 3)) - 1
    kx, ky, kxy = 1 / fx, 1 / fy, -skew / (fx * fy)
    every = wanted[-1, -1] == (wanted.shape[0] - 1) * (wanted.shape[1] - 1)
    for j in range(first, last, 8):
        here = min(8, last - j)
        for lane in range(8):
            later = order[min(j + lane + 16, last - 1)]
            prefetch(m, later * 3)
            prefetch(q, later * 4)
            prefetch(s, later * s.shape[1])
            prefetch(o, later)
            prefetch(values, later * values.shape[1])
            i, at = u64(order[min(j + lane, last - 1)]), u64(lane)
            for k in range(3):
                work[at + u64(8 * k)] = m[i, u64(k)]
            for k in range(4):
                work[at + u64(8 * (IN_Q + k))] = q[i, u64(k)]
            work[at + u64(8 * IN_S)], work[at + u64(8 * IN_S + 8)] = s[i, u64(0)], s[i, u64(1)]
            work[at + u64(8 * IN_S + 16)] = 0.0 if flat else s[i, u64(s.shape[1] - 1)]
            work[at + u64(8 * IN_O)] = o[i]
        m0, m1, m2 = L.load8(work, 0), L.load8(work, 8), L.load8(work, 16)
        s0, s1, s2 = (
            L.load8(work, 8 * IN_S),
            L.load8(work, 8 * IN_S + 8),
            L.load8(work, 8 * IN_S + 16),
        )
        c0 = m0 * R00 + m1 * R01 + m2 * R02 + view[TX]
        c1 = m0 * R10 + m1 * R11 + m2 * R12 + view[TX + 1]
        c2 = m0 * R20 + m1 * R21 + m2 * R22 + view[TX + 2]
        ic = L.inverse(c2)
        ahead = near < c2
        at_x, at_y = (c0 * fx + c1 * skew) * ic + cx, c1 * fy * ic + cy
        kept = 255 >> (8 - here)
        inside = (
            L.as_bits(ahead & (at_x > 0.0) & (at_x < width) & (at_y > 0.0) & (at_y < height))
            if every
            else 0
        )
        if kept & ~inside:
            L.store8(work, 8 * IN_C, c0)
            L.store8(work, 8 * IN_C + 8, c1)
            L.store8(work, 8 * IN_C + 16, c2)
            for lane in range(here):
                if inside >> lane & 1:
                    continue
                at = u64(lane)
                size = max(
                    work[at + u64(8 * IN_S)],
                    work[at + u64(8 * IN_S + 8)],
                    work[at + u64(8 * IN_S + 16)],
                )
                b = at + u64(8 * IN_C)
                if not _reaches(view, work[b], work[b + u64(8)], work[b + u64(16)], size, wanted):
                    kept &= ~(1 << lane)
                    thin[u64(j + lane), u64(WIDE + CUT)] = f32(-1.0)
                    shapes[u64(j + lane - first), u64(SHAPE_FIRST)] = f32(1.0)
                    shapes[u64(j + lane - first), u64(SHAPE_LAST)] = f32(0.0)
            if kept == 0:
                continue
        w, x, y, z = (
            L.load8(work, 8 * IN_Q), L.load8(work, 8 * IN_Q + 8), L.load8(work, 8 * IN_Q + 16),
            L.load8(work, 8 * IN_Q + 24),
        )  # fmt: skip
        inverse = L.inverse_root(w * w + x * x + y * y + z * z)
        w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
        q00, q01, q02 = 1.0 - (y * y + z * z) * 2.0, (x * y - w * z) * 2.0, (x * z + w * y) * 2.0
        q10, q11, q12 = (x * y + w * z) * 2.0, 1.0 - (x * x + z * z) * 2.0, (y * z - w * x) * 2.0
        q20, q21, q22 = (x * z - w * y) * 2.0, (y * z + w * x) * 2.0, 1.0 - (x * x + y * y) * 2.0
        a00 = q00 * R00 + q10 * R01 + q20 * R02
        a10 = q00 * R10 + q10 * R11 + q20 * R12
        a20 = q00 * R20 + q10 * R21 + q20 * R22
        a01 = q01 * R00 + q11 * R01 + q21 * R02
        a11 = q01 * R10 + q11 * R11 + q21 * R12
        a21 = q01 * R20 + q11 * R21 + q21 * R22
        a02 = q02 * R00 + q12 * R01 + q22 * R02
        a12 = q02 * R10 + q12 * R11 + q22 * R12
        a22 = q02 * R20 + q12 * R21 + q22 * R22
        opacity = L.load8(work, 8 * IN_O)
        spread = _root(s0 * a20 * (s0 * a20) + s1 * a21 * (s1 * a21) + s2 * a22 * (s2 * a22))
        x0, y0 = at_x, at_y
        if flat:
            x0, y0 = L.where(ahead, at_x, cx), L.where(ahead, at_y, cy)
        L.store8(work, 8 * (OUT + X0), x0)
        L.store8(work, 8 * (OUT + Y0), y0)
        length = _root(c0 * c0 + c1 * c1 + c2 * c2)
        depth = c2
        if flat:
            n0, n1, n2, p0, p1, p2 = a02, a12, a22, q02, q12, q22
            nc = n0 * c0 + n1 * c1 + n2 * c2
            facing = nc
            floor = length * K.EDGE_ON
            nc = L.where(L.magnitude(nc) < floor, L.where(nc < 0.0, -floor, floor), nc)
            depth = L.where(ahead, c2, length)
            inverse = L.inverse(nc)
            tc = (a00 * c0 + a10 * c1 + a20 * c2) * inverse
            scale = depth * L.inverse(s0)
            gx = scale * (a00 - tc * n0)
            ux, uy = gx * kx, scale * (a10 - tc * n1) * ky + gx * kxy
            L.store8(work, 8 * (OUT + U0), L.where(ahead, 0.0, scale * (a20 - tc * n2)))
            tc = (a01 * c0 + a11 * c1 + a21 * c2) * inverse
            scale = depth * L.inverse(s1)
            gx = scale * (a01 - tc * n0)
            vx, vy = gx * kx, scale * (a11 - tc * n1) * ky + gx * kxy
            L.store8(work, 8 * (OUT + V0), L.where(ahead, 0.0, scale * (a21 - tc * n2)))
            scale = depth * inverse
            wx, wy = scale * n0 * kx, scale * (n1 * ky + n0 * kxy)
            L.store8(work, 8 * (OUT + W0), L.where(ahead, 1.0, scale * n2))
            L.store8(work, 8 * (OUT + UX), ux)
            L.store8(work, 8 * (OUT + UY), uy)
            L.store8(work, 8 * (OUT + VX), vx)
            L.store8(work, 8 * (OUT + VY), vy)
            L.store8(work, 8 * (OUT + WX), wx)
            L.store8(work, 8 * (OUT + WY), wy)
            L.store8(slim, 8 * (FILTER - WIDE), L.where(ahead, 1.0, 0.0))
            L.store8(slim, 8 * (FILTER + 1 - WIDE), 0.0)
            L.store8(slim, 8 * (WMAX - WIDE), depth * (1.0 / near))
        else:
            limit = K.JACOBIAN_MARGIN * width / 2 / fx
            px = L.least(L.most(c0 * ic, -cx / fx - limit), (width - cx) / fx + limit)
            limit = K.JACOBIAN_MARGIN * height / 2 / fy
            py = L.least(L.most(c1 * ic, -cy / fy - limit), (height - cy) / fy + limit)
            scale = s0 * ic
            gx, gy = (
                ((a00 - px * a20) * fx + (a10 - py * a20) * skew) * scale,
                (a10 - py * a20) * fy * scale,
            )
            sxx, sxy, syy = gx * gx, gx * gy, gy * gy
            scale = s1 * ic
            gx, gy = (
                ((a01 - px * a21) * fx + (a11 - py * a21) * skew) * scale,
                (a11 - py * a21) * fy * scale,
            )
            sxx, sxy, syy = sxx + gx * gx, sxy + gx * gy, syy + gy * gy
            scale = s2 * ic
            gx, gy = (
                ((a02 - px * a22) * fx + (a12 - py * a22) * skew) * scale,
                (a12 - py * a22) * fy * scale,
            )
            sxx, sxy, syy = sxx + gx * gx, sxy + gx * gy, syy + gy * gy
            sharp = sxx * syy - sxy * sxy
            sxx, syy = sxx + K.BLUR_3D, syy + K.BLUR_3D
            inverse = L.inverse(sxx * syy - sxy * sxy)
            A, B, C = syy * inverse, -sxy * inverse, sxx * inverse
            L.store8(work, 8 * (OUT + CA), A)
            L.store8(work, 8 * (OUT + CB), B)
            L.store8(work, 8 * (OUT + CC), C)
            edge = L.inverse_root(A)
            L.store8(work, FACTOR, A * edge)
            L.store8(work, FACTOR + 8, B * edge)
            L.store8(work, FACTOR + 16, L.inverse_root(syy))
            if view[ANTIALIASED] > 0:
                opacity = opacity * _root(L.most(sharp * inverse, K.COMPENSATION_MIN))
            L.store8(slim, 8 * (WLOW - WIDE), 0.0)
            for k in range(FILTER, CUT):
                L.store8(slim, 8 * (k - WIDE), 0.0)
            for k in range(LX, WIDE):
                L.store8(work, 8 * (OUT + k), 0.0)
            if not center:
                i0, i1, i2 = L.inverse(s0 * s0), L.inverse(s1 * s1), L.inverse(s2 * s2)
                S00 = a00 * a00 * i0 + a01 * a01 * i1 + a02 * a02 * i2
                S01 = a00 * a10 * i0 + a01 * a11 * i1 + a02 * a12 * i2
                S02 = a00 * a20 * i0 + a01 * a21 * i1 + a02 * a22 * i2
                S11 = a10 * a10 * i0 + a11 * a11 * i1 + a12 * a12 * i2
                S12 = a10 * a20 * i0 + a11 * a21 * i1 + a12 * a22 * i2
                S22 = a20 * a20 * i0 + a21 * a21 * i1 + a22 * a22 * i2
                f0 = S00 * c0 + S01 * c1 + S02 * c2
                f1 = S01 * c0 + S11 * c1 + S12 * c2
                f2 = S02 * c0 + S12 * c1 + S22 * c2
                scale = c2 * L.inverse(f0 * c0 + f1 * c1 + f2 * c2)
                gx, gy = scale * f0, scale * f1
                # Denominator minus l^2: positive semidefinite, so the difference of large numbers
                # is taken here in float64.
                xx, xy, yy = (
                    scale * c2 * S00 - gx * gx,
                    scale * c2 * S01 - gx * gy,
                    scale * c2 * S11 - gy * gy,
                )
                L.store8(work, 8 * (OUT + LX), gx * kx)
                L.store8(work, 8 * (OUT + LY), gy * ky + gx * kxy)
                L.store8(work, 8 * (OUT + RXX), xx * (kx * kx))
                L.store8(work, 8 * (OUT + RXY), (xx * kxy + xy * ky) * kx)
                L.store8(
                    work, 8 * (OUT + RYY), xx * (kxy * kxy) + xy * (2 * kxy * ky) + yy * (ky * ky)
                )
            # The normal is the shortest axis.
            second = s1 < s0
            third = s2 < L.where(second, s1, s0)
            p0 = L.where(third, q02, L.where(second, q01, q00))
            p1 = L.where(third, q12, L.where(second, q11, q10))
            p2 = L.where(third, q22, L.where(second, q21, q20))
            n0 = L.where(third, a02, L.where(second, a01, a00))
            n1 = L.where(third, a12, L.where(second, a11, a10))
            n2 = L.where(third, a22, L.where(second, a21, a20))
            facing = n0 * c0 + n1 * c1 + n2 * c2
        reach = spread * K.EXTENT_SIGMAS
        low, high = L.most(c2 - reach, near), L.most(c2 + reach, near)
        if flat:
            # Where it shows by its intersection, z lies between these; 1e-20: if its centre is not
            # in front, W must be positive, else it may be anything, see shade.
            L.store8(slim, 8 * (WTOP - WIDE), depth * L.inverse(low))
            L.store8(slim, 8 * (WLOW - WIDE), L.where(ahead, depth * L.inverse(high), 1e-20))
        if center:
            low = high = L.most(c2, near)
        if not flat:
            L.store8(slim, 8 * (IZLO - WIDE), L.inverse(low))
        L.store8(slim, 8 * (IZ0 - WIDE), L.inverse(low if center else depth))
        drawn = opacity >= K.ALPHA_MIN
        cut = L.where(drawn, _log(L.most(opacity, K.ALPHA_MIN) * (1 / K.ALPHA_MIN)) * 2.0, -1.0)
        flip = L.where(facing > 0.0, -1.0, 1.0)
        L.store8(slim, 8 * (Z0 - WIDE), depth)
        L.store8(slim, 8 * (ZLO - WIDE), low)
        L.store8(slim, 8 * (ZHI - WIDE), high)
        L.store8(slim, 8 * (OPACITY - WIDE), opacity)
        L.store8(slim, 8 * (CUT - WIDE), cut)
        L.store8(slim, 8 * (NORMAL - WIDE), flip * p0)
        L.store8(slim, 8 * (NORMAL + 1 - WIDE), flip * p1)
        L.store8(slim, 8 * (NORMAL + 2 - WIDE), flip * p2)
        # The outline.
        cut = cut * (1 + 1e-6)
        if flat:
            # An ellipse only if the whole disc lies in front of the camera plane.
            ellipse = ahead & (c2 * 1e-3 < c2 - _root(L.most(cut, 0.0)) * spread)
            A = ux * ux + vx * vx - cut * wx * wx
            B = ux * uy + vx * vy - cut * wx * wy
            C = uy * uy + vy * vy - cut * wy * wy
            det = A * C - B * B
            ellipse = ellipse & (A > 0.0) & (C > 0.0) & (det > A * C * 1e-12)
            inverse = L.inverse(det)
            ex, ey = (C * wx - B * wy) * inverse * cut, (A * wy - B * wx) * inverse * cut
            h = cut * (wx * ex + wy * ey + 1.0)
            square = cut * 0.5
            inverse = h * inverse
        else:
            ex = ey = square = cut * 0.0
            h, ellipse = cut, drawn
            inverse = h * L.inverse(A * C - B * B)
        radius, top, wide = _root(square), _root(A * inverse), _root(C * inverse)
        over = L.inverse(A)
        begin = y0 - (0.5 + 1e-4) + L.least(ey - top, -radius)
        end = y0 - (0.5 - 1e-4) + L.most(ey + top, radius)
        # Float32 from here on: what a far or large splat's numbers are rounded by is added on all
        # sides.
        slack = (wide + L.magnitude(ex) + L.magnitude(x0)) * 1e-6 + 1e-4
        slack_y = (top + L.magnitude(ey) + L.magnitude(y0)) * 5e-7 + 1e-4
        shows = drawn & (end >= 0.0) & (begin <= height - 1.0)
        row1 = L.down(L.up(L.most(begin, 0.0)) * (1 / TILE)) * SIDE
        row2 = L.down(L.least(end, height - 1.0) * 0.25)
        # What is drawn but is no ellipse begins in row -1.
        row1, row2 = L.where(shows, row1, 1.0), L.where(shows, row2, -2.0)
        row1 = L.where(ellipse | L.flipped(drawn), row1, -1.0)
        b = 8 * SHAPES
        L.store8(slim, b + 8 * SHAPE_Y, 0.5 - slack_y)
        L.store8(slim, b + 8 * SHAPE_EY, ey)
        L.store8(slim, b + 8 * SHAPE_TOP, top)
        L.store8(slim, b + 8 * SHAPE_SHRINK, L.inverse(top))
        L.store8(slim, b + 8 * SHAPE_HALF, _root(A * h) * over)
        L.store8(slim, b + 8 * SHAPE_LEAN, -B * over)
        L.store8(slim, b + 8 * SHAPE_WIDE, wide)
        L.store8(slim, b + 8 * SHAPE_TIP, -B * wide * L.inverse(C))
        L.store8(slim, b + 8 * SHAPE_EX, ex)
        L.store8(slim, b + 8 * SHAPE_SQUARE, square)
        L.store8(slim, b + 8 * SHAPE_RADIUS, radius)
        L.store8(slim, b + 8 * SHAPE_LEFT, x0 - 0.5 - slack)
        L.store8(slim, b + 8 * SHAPE_RIGHT, x0 - 0.5 + slack)
        L.store8(slim, b + 8 * SHAPE_HIGH, slack_y * 2.0 + 3.0)
        L.store8(slim, b + 8 * SHAPE_FIRST, row1)
        L.store8(slim, b + 8 * SHAPE_LAST, row2)
        if harmonic and degree > 0:
            over = L.inverse(length)
            L.store8(work, 0, (c0 * R00 + c1 * R10 + c2 * R20) * over)
            L.store8(work, 8, (c0 * R01 + c1 * R11 + c2 * R21) * over)
            L.store8(work, 16, (c0 * R02 + c1 * R12 + c2 * R22) * over)
        for lane in range(here):
            if not kept >> lane & 1:
                continue
            to, at = u64(j + lane), u64(lane)
            i = u64(order[to])
            for k in range(WIDE):
                table[to, u64(k)] = work[at + u64(8 * (OUT + k))]
            if not flat:
                for k in range(3):
                    table[to, u64(F11 + k)] = work[at + u64(FACTOR + 8 * k)]
            for k in range(WIDE, VALUES):
                thin[to, u64(WIDE + k)] = slim[at + u64(8 * (k - WIDE))]
            for k in range(16):
                shapes[to - u64(first), u64(k)] = slim[at + u64(8 * (SHAPES + k))]
            if harmonic:
                if degree > 0:
                    # Where the splat's parameters were, which are not needed any more.
                    harmonics(degree, work[at], work[at + u64(8)], work[at + u64(16)], Y)
                for k in range(3):
                    total = 0.5 + C0 * values[i, u64(k)]
                    for b in range(1, (degree + 1) ** 2):
                        total += Y[u64(b)] * values[i, u64(3 * b + k)]
                    thin[to, u64(WIDE + VALUES + k)] = max(total, 0.0)
            else:
                for k in range(3):
                    thin[to, u64(WIDE + VALUES + k)] = (
                        values[i, u64(k)] if k < channels else f32(0.0)
                    )
                if channels > 3:
                    for k in range(channels):
                        features[to, u64(k)] = values[i, u64(k)]


@jit
def radix_order(key, index, other, bits, spare):
    """Indices of the keys that are not NaN, ascending, equal ones in their order of input (LSD
    radix sort of bits); and the places in them of keys that are equal to one beside them. All
    arrays are as long as ``key``; the results lie in ``index`` and ``other``."""
    raw = key.view(np.uint32)
    n = 0
    for i in range(key.shape[0]):
        if key[i] == key[i]:
            b = raw[i] if key[i] != 0 else np.uint32(0)
            # Flipping makes the order of the bits that of the numbers: all bits of a negative, the
            # sign of a positive.
            bits[n] = ~b if b >> np.uint32(31) else b | np.uint32(0x80000000)
            index[n] = i
            n += 1
    counts = np.empty(2048, np.int64)
    for shift in (0, 11, 22):
        counts[:] = 0
        for i in range(n):
            counts[(bits[i] >> np.uint32(shift)) & np.uint32(2047)] += 1
        if n == 0 or counts[(bits[0] >> np.uint32(shift)) & np.uint32(2047)] == n:
            continue
        total = 0
        for i in range(2048):
            here = counts[i]
            counts[i] = total
            total += here
        for i in range(n):
            d = (bits[i] >> np.uint32(shift)) & np.uint32(2047)
            spare[counts[d]] = bits[i]
            other[counts[d]] = index[i]
            counts[d] += 1
        bits, spare = spare, bits
        index, other = other, index
    ties = 0
    for i in range(n):
        other[ties] = i
        ties += (i > 0 and bits[i] == bits[i - 1]) or (i + 1 < n and bits[i] == bits[i + 1])
    return index[:n], other[:ties]
