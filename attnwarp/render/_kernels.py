# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""The numba kernels of the CPU backend; :mod:`attnwarp.render.cpu` calls them, and says how they fit together.

The forward pass is written in vectors of 16 pixels (``_lanes.py``) with its sums in registers. The backward pass is
written so that LLVM vectorises it: the innermost loop runs over the 64 pixels of a tile, holds no branch and no call,
and touches one flat buffer at constant offsets, so that no alias check is needed. exp is a polynomial, since LLVM has
no vector exp here. Every sum that crosses tiles is formed in a fixed order, so the bits never depend on the
number of threads. No kernel starts threads: they release the GIL and are handed ranges of work.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from attnwarp.render import _lanes as L
from attnwarp.render import constants as K

# NaN and infinity are left to IEEE rules: the selects below rely on comparisons with them.
FAST = {"contract", "reassoc", "nsz", "arcp"}
jit = nb.njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
# Without numba's reference counts: LLVM cannot remove those of arrays passed to inlined functions, and two threads
# that count the same array up and down for every splat spend a third of their time on it. Such kernels allocate
# nothing.
bare = nb.njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, _nrt=False)  # type: ignore[call-overload]
inlined = nb.njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")

f32 = np.float32
u64 = np.uint64
TILE = K.TILE
PIXELS = TILE * TILE
CHUNK = 2048  # splats set up at once: their rows stay in the second-level cache

# Columns of the table of projected splats, float64. The reference point is the projected centre, or the principal
# point for a 2D splat whose centre is not in front; coefficients are per pixel of offset from it.
X0, Y0 = 0, 1
UX, UY, U0, VX, VY, V0, WX, WY, W0 = 2, 3, 4, 5, 6, 7, 8, 9, 10  # 2D: u = U / W, v = V / W, z = Z0 / W
CA, CB, CC, LX, LY, RXX, RXY, RYY = 2, 3, 4, 5, 6, 7, 8, 9  # 3D: conic; z = Z0 l / (l^2 + r)
Z0, ZLO, ZHI, OPACITY = 11, 12, 13, 14
GRADIENTS = 15  # columns up to here carry gradients
FILTER, SHUT, WMAX, CUT, BOUNDED = 15, 16, 17, 18, 19  # screen rho = FILTER |x - centre|^2 + SHUT
IZ0, IZLO, IZHI = 20, 21, 22  # 1 over Z0, ZLO, ZHI
COLUMNS = 24

# A block of splats as the forward pass works on them: for each a row of float32, with the table's columns, 6 features
# and its place among the tile's; then its weights at the 16 pixels of all squares, and of the square at hand.
BLOCK = 32
AHEAD = 32
ROW = 32
WEIGHTS = BLOCK * ROW
SHARES = WEIGHTS + BLOCK * 16
WORK = SHARES + BLOCK * 16

# Slots of a tile's buffer, each 64 floats.
(XS, YS, AL, ZZ, IZ, TT, AA, DD, M1, M2, L1, MED, MEDK, LAST, ZREF, IREF, WW, NX, NY, NZ, C_0, C_1,
 C_2) = range(23)  # fmt: skip
SLOTS = 23  # and one more for each channel from the fourth on

HUGE = 1e30
LOG2E_HALF = f32(0.5 * math.log2(math.e))
# exp2(x) on [-0.5, 0.5], the polynomial of degree 5 that is 1 at 0 with the least relative error, 9.1e-8.
E1, E2, E3, E4, E5 = (
    f32(c)
    for c in (0.6931469775373009, 0.24022242044016756, 0.05550733832514562, 0.009671514536030823, 0.0013264700286626865)
)
ROUND = f32(1.5 * 2**23)

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


@intrinsic
def _prefetch(typing: Any, array: Any, item: Any) -> Any:
    """Ask for the cache line of ``array``'s item (counted flat) before it is needed."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = cgutils.create_struct_proxy(signature.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), word, word, word])
        call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(call, [pointer, word(0), word(3), word(1)])
        return word(0)

    return nb.int32(array, nb.int64), codegen


@inlined
def _gauss(rho):
    """exp(-rho / 2), relative error 1.5e-7, for rho from 0 to 88; beyond, anything."""
    # Adding 1.5 2^23 rounds to an integer and leaves it in the lowest bits.
    shifted = L.fma(rho, -LOG2E_HALF, ROUND)
    f = L.fma(rho, -LOG2E_HALF, ROUND - shifted)
    return L.times_power(f * (f * (f * (f * (f * E5 + E4) + E3) + E2) + E1) + f32(1.0), shifted)


@inlined
def _harmonics(degree, x, y, z, out):
    out[0] = C0
    if degree > 0:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if degree > 1:
        out[4], out[5], out[6] = C20 * x * y, C21 * y * z, C22 * (2 * z * z - x * x - y * y)
        out[7], out[8] = C23 * x * z, C24 * (x * x - y * y)
    if degree > 2:
        out[9], out[10], out[11] = C30 * y * (3 * x * x - y * y), C31 * x * y * z, C32 * y * (4 * z * z - x * x - y * y)
        out[12] = C33 * z * (2 * z * z - 3 * x * x - 3 * y * y)
        out[13], out[14] = C34 * x * (4 * z * z - x * x - y * y), C35 * z * (x * x - y * y)
        out[15] = C36 * x * (x * x - 3 * y * y)


@inlined
def _axes(q, i, Q):
    """Rotation of quaternion i into Q; returns the quaternion's length."""
    w, x, y, z = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    Q[0, 0], Q[0, 1], Q[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    Q[1, 0], Q[1, 1], Q[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    Q[2, 0], Q[2, 1], Q[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return length


# view: the camera as numbers, float64. Rows of R, then t (with the splats' origin moved in), then the intrinsics.
R00, TX, FX, SKEW, FY, CX, CY, WIDTH, HEIGHT, NEAR, FLAT, CENTER, ANTIALIASED, HARMONIC = (
    0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23,
)  # fmt: skip
VIEW = 24


@jit
def project(first, last, view, m, q, s, o, values, channels, table, features, key):
    """Splats first..last to their rows of ``table``, ``features`` and ``key``; the key is NaN where nothing can
    show."""
    R = view[:9].copy().reshape(3, 3)
    fx, skew, fy, cx, cy, near = view[FX], view[SKEW], view[FY], view[CX], view[CY], view[NEAR]
    flat, center = view[FLAT] > 0, view[CENTER] > 0
    degree = round(math.sqrt(values.shape[1] / 3)) - 1
    Q = np.empty((3, 3))
    a = np.empty((3, 3))
    S = np.empty((3, 3))
    PC = np.empty(3)
    Y = np.empty(16)
    kx, ky, kxy = 1 / fx, 1 / fy, -skew / (fx * fy)
    for i in range(first, last):
        key[i] = np.nan
        if o[i] < K.ALPHA_MIN:
            continue
        c0 = R[0, 0] * m[i, 0] + R[0, 1] * m[i, 1] + R[0, 2] * m[i, 2] + view[TX]
        c1 = R[1, 0] * m[i, 0] + R[1, 1] * m[i, 1] + R[1, 2] * m[i, 2] + view[TX + 1]
        c2 = R[2, 0] * m[i, 0] + R[2, 1] * m[i, 1] + R[2, 2] * m[i, 2] + view[TX + 2]
        _axes(q, i, Q)
        for r in range(3):
            for k in range(3):
                a[r, k] = R[r, 0] * Q[0, k] + R[r, 1] * Q[1, k] + R[r, 2] * Q[2, k]
        ahead = c2 > near
        opacity = o[i]
        spread = (s[i, 0] * a[2, 0]) ** 2 + (s[i, 1] * a[2, 1]) ** 2
        if not flat:
            spread += (s[i, 2] * a[2, 2]) ** 2
        spread = math.sqrt(spread)
        if not ahead and (not flat or c2 + K.EXTENT_SIGMAS * spread <= near):
            continue
        axis = 2
        if not flat:
            axis = 0
            if s[i, 1] < s[i, axis]:
                axis = 1
            if s[i, 2] < s[i, axis]:
                axis = 2
        for k in range(COLUMNS):
            table[i, k] = 0.0
        if ahead:
            table[i, X0], table[i, Y0] = (fx * c0 + skew * c1) / c2 + cx, fy * c1 / c2 + cy
        else:
            table[i, X0], table[i, Y0] = cx, cy
        table[i, Z0] = c2
        if flat:
            n0, n1, n2 = a[0, 2], a[1, 2], a[2, 2]
            length = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            nc = n0 * c0 + n1 * c1 + n2 * c2
            if abs(nc) < K.EDGE_ON * length:
                nc = -K.EDGE_ON * length if nc < 0 else K.EDGE_ON * length
            depth = c2 if ahead else length
            table[i, Z0] = depth
            for k in range(2):
                tc = (a[0, k] * c0 + a[1, k] * c1 + a[2, k] * c2) / nc
                scale = depth / s[i, k]
                gx, gy = scale * (a[0, k] - tc * n0), scale * (a[1, k] - tc * n1)
                table[i, UX + 3 * k] = gx * kx
                table[i, UY + 3 * k] = gy * ky + gx * kxy
                table[i, U0 + 3 * k] = 0.0 if ahead else scale * (a[2, k] - tc * n2)
            scale = depth / nc
            table[i, WX] = scale * n0 * kx
            table[i, WY] = scale * (n1 * ky + n0 * kxy)
            table[i, W0] = 1.0 if ahead else scale * n2
            table[i, FILTER], table[i, SHUT] = (2.0, 0.0) if ahead else (0.0, HUGE)
            table[i, WMAX] = depth / near
        else:
            limit = K.JACOBIAN_MARGIN * view[WIDTH] / 2 / fx
            px = min(max(c0 / c2, -cx / fx - limit), (view[WIDTH] - cx) / fx + limit)
            limit = K.JACOBIAN_MARGIN * view[HEIGHT] / 2 / fy
            py = min(max(c1 / c2, -cy / fy - limit), (view[HEIGHT] - cy) / fy + limit)
            sxx, sxy, syy = 0.0, 0.0, 0.0
            for k in range(3):
                gx = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * s[i, k] / c2
                gy = fy * (a[1, k] - py * a[2, k]) * s[i, k] / c2
                sxx += gx * gx
                sxy += gx * gy
                syy += gy * gy
            sharp = sxx * syy - sxy * sxy
            sxx += K.BLUR_3D
            syy += K.BLUR_3D
            det = sxx * syy - sxy * sxy
            table[i, CA], table[i, CB], table[i, CC] = syy / det, -sxy / det, sxx / det
            if view[ANTIALIASED] > 0:
                opacity *= math.sqrt(max(sharp / det, K.COMPENSATION_MIN))
                if opacity < K.ALPHA_MIN:
                    continue
            if not center:
                q0 = 0.0
                for r in range(3):
                    for k in range(3):
                        S[r, k] = (
                            a[r, 0] * a[k, 0] / s[i, 0] ** 2
                            + a[r, 1] * a[k, 1] / s[i, 1] ** 2
                            + a[r, 2] * a[k, 2] / s[i, 2] ** 2
                        )
                for r in range(3):
                    PC[r] = S[r, 0] * c0 + S[r, 1] * c1 + S[r, 2] * c2
                q0 = PC[0] * c0 + PC[1] * c1 + PC[2] * c2
                lx, ly = c2 * PC[0] / q0, c2 * PC[1] / q0
                # Denominator minus l^2: positive semidefinite, so the difference of large numbers is taken here in
                # float64.
                rxx, rxy, ryy = (
                    c2 * c2 * S[0, 0] / q0 - lx * lx,
                    c2 * c2 * S[0, 1] / q0 - lx * ly,
                    c2 * c2 * S[1, 1] / q0 - ly * ly,
                )
                table[i, LX], table[i, LY] = lx * kx, ly * ky + lx * kxy
                table[i, RXX] = rxx * kx * kx
                table[i, RXY] = kx * (rxx * kxy + rxy * ky)
                table[i, RYY] = rxx * kxy * kxy + 2 * rxy * kxy * ky + ryy * ky * ky
        if center:
            table[i, ZLO] = max(c2, near)
            table[i, ZHI] = table[i, ZLO]
        else:
            table[i, ZLO] = max(c2 - K.EXTENT_SIGMAS * spread, near)
            table[i, ZHI] = max(c2 + K.EXTENT_SIGMAS * spread, near)
        table[i, IZ0], table[i, IZLO], table[i, IZHI] = 1 / table[i, Z0], 1 / table[i, ZLO], 1 / table[i, ZHI]
        table[i, OPACITY] = opacity
        cut = 2 * math.log(opacity / K.ALPHA_MIN)
        table[i, CUT] = cut
        # The outline is an ellipse only if the whole disc lies in front of the camera plane.
        table[i, BOUNDED] = 1.0 if not flat or (ahead and c2 - math.sqrt(cut) * spread > 1e-3 * c2) else 0.0
        facing = a[0, axis] * c0 + a[1, axis] * c1 + a[2, axis] * c2
        flip = -1.0 if facing > 0 else 1.0
        for k in range(3):
            features[i, k] = flip * Q[k, axis]
        if view[HARMONIC] > 0:
            length = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            x = (R[0, 0] * c0 + R[1, 0] * c1 + R[2, 0] * c2) / length
            y = (R[0, 1] * c0 + R[1, 1] * c1 + R[2, 1] * c2) / length
            z = (R[0, 2] * c0 + R[1, 2] * c1 + R[2, 2] * c2) / length
            _harmonics(degree, x, y, z, Y)
            for k in range(3):
                total = 0.5
                for j in range((degree + 1) ** 2):
                    total += Y[j] * values[i, 3 * j + k]
                features[i, 3 + k] = max(total, 0.0)
        else:
            for k in range(channels):
                features[i, 3 + k] = values[i, k]
            for k in range(channels, 3):
                features[i, 3 + k] = 0.0
        key[i] = c2


@jit
def radix_order(key):
    """Indices of the keys that are not NaN, ascending, equal ones in their order of input (LSD radix sort of bits)."""
    n = 0
    for i in range(key.shape[0]):
        if key[i] == key[i]:
            n += 1
    index = np.empty(n, np.int32)
    other = np.empty(n, np.int32)
    bits = np.empty(n, np.uint32)
    spare = np.empty(n, np.uint32)
    raw = key.view(np.uint32)
    j = 0
    for i in range(key.shape[0]):
        if key[i] == key[i]:
            b = raw[i] if key[i] != 0 else np.uint32(0)
            # Flipping makes the order of the bits that of the numbers: all bits of a negative, the sign of a positive.
            bits[j] = ~b if b >> np.uint32(31) else b | np.uint32(0x80000000)
            index[j] = i
            j += 1
    counts = np.empty(2048, np.int64)
    for shift in (0, 11, 22):
        counts[:] = 0
        for i in range(n):
            counts[(bits[i] >> np.uint32(shift)) & np.uint32(2047)] += 1
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
    return index


@inlined
def _overlaps(table, i, x1, x2, y1, y2):
    """Whether a 2D splat of any outline may show in a rectangle (relative to its reference point), by intervals."""
    hx, hy, mx, my = (x2 - x1) / 2, (y2 - y1) / 2, (x1 + x2) / 2, (y1 + y2) / 2
    w = table[i, W0] + table[i, WX] * mx + table[i, WY] * my + abs(table[i, WX]) * hx + abs(table[i, WY]) * hy
    if w > 0:
        w = min(w, table[i, WMAX])
        u = max(
            abs(table[i, U0] + table[i, UX] * mx + table[i, UY] * my) - abs(table[i, UX]) * hx - abs(table[i, UY]) * hy,
            0.0,
        )
        v = max(
            abs(table[i, V0] + table[i, VX] * mx + table[i, VY] * my) - abs(table[i, VX]) * hx - abs(table[i, VY]) * hy,
            0.0,
        )
        if u * u + v * v <= table[i, CUT] * w * w * (1 + 1e-9):
            return True
    if table[i, FILTER] > 0:
        dx, dy = max(abs(mx) - hx, 0.0), max(abs(my) - hy, 0.0)
        return 2 * (dx * dx + dy * dy) <= table[i, CUT] * (1 + 1e-9)
    return False


@bare
def outline(first, last, key, table, view, tiles_x, tiles_y, spans, begins, counts):
    """Write the runs of tiles that splats first..last may show in to ``spans``, as (first tile, number of tiles).

    Exact for ellipses: a tile is taken if and only if the outline rho <= cut meets the rectangle of its pixel centres.
    Splat i has ``counts[i]`` runs from row ``begins[i]`` on. Returns the rows needed; what does not fit is not written.
    """
    flat = view[FLAT] > 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    slack = 1e-4  # pixels; covers the rounding of the outline, adds nothing that can be measured
    used = 0
    for i in range(first, last):
        begins[i] = used
        counts[i] = 0
        if np.isnan(key[i]):
            continue
        x0, y0, cut = table[i, X0], table[i, Y0], table[i, CUT]
        ellipse = table[i, BOUNDED] > 0
        A, B, C, h, ex, ey = table[i, CA], table[i, CB], table[i, CC], cut, 0.0, 0.0
        if flat and ellipse:
            ux, uy, vx, vy = table[i, UX], table[i, UY], table[i, VX], table[i, VY]
            wx, wy = table[i, WX], table[i, WY]
            A = ux * ux + vx * vx - cut * wx * wx
            B = ux * uy + vx * vy - cut * wx * wy
            C = uy * uy + vy * vy - cut * wy * wy
            det = A * C - B * B
            if not (A > 0 and C > 0 and det > 1e-12 * A * C):
                ellipse = False
            else:
                ex = cut * (C * wx - B * wy) / det
                ey = cut * (A * wy - B * wx) / det
                h = cut * (1 + wx * ex + wy * ey)
        if not ellipse:
            for ty in range(tiles_y):
                y1 = ty * TILE + 0.5 - y0 - slack
                y2 = min(ty * TILE + TILE, height) - 0.5 - y0 + slack
                run = 0
                for tx in range(tiles_x + 1):
                    x1 = tx * TILE + 0.5 - x0 - slack
                    x2 = min(tx * TILE + TILE, width) - 0.5 - x0 + slack
                    if tx < tiles_x and _overlaps(table, i, x1, x2, y1, y2):
                        run += 1
                    elif run > 0:
                        if used < spans.shape[0]:
                            spans[used, 0] = ty * tiles_x + tx - run
                            spans[used, 1] = run
                        used += 1
                        counts[i] += 1
                        run = 0
            continue
        # The disc of the screen filter is joined to the ellipse.
        radius = math.sqrt(cut / 2) if flat else 0.0
        det = A * C - B * B
        top = math.sqrt(h * A / det)
        wide = math.sqrt(h * C / det)
        at = -B * wide / C
        inverse = 1 / A
        low, high = y0 - 0.5 - slack + min(ey - top, -radius), y0 - 0.5 + slack + max(ey + top, radius)
        if high < 0 or low > height - 1:
            continue
        ty1 = math.ceil(max(low, 0.0)) // TILE
        ty2 = int(min(high, height - 1.0)) // TILE
        for ty in range(ty1, ty2 + 1):
            y1 = ty * TILE + 0.5 - y0 - slack
            y2 = min(ty * TILE + TILE, height) - 0.5 - y0 + slack
            left, right = 1e300, -1e300
            e1, e2 = max(y1 - ey, -top), min(y2 - ey, top)
            if e1 <= e2:
                s1 = math.sqrt(max(A * h - det * e1 * e1, 0.0))
                s2 = math.sqrt(max(A * h - det * e2 * e2, 0.0))
                right = ex + (wide if e1 <= at <= e2 else max(s1 - B * e1, s2 - B * e2) * inverse)
                left = ex + (-wide if e1 <= -at <= e2 else min(-B * e1 - s1, -B * e2 - s2) * inverse)
            near = max(max(y1, -y2), 0.0)
            if near < radius:
                chord = math.sqrt(radius * radius - near * near)
                left, right = min(left, -chord), max(right, chord)
            low, high = left + x0 - 0.5 - slack, right + x0 - 0.5 + slack
            if right < left or high < 0 or low > width - 1:
                continue
            p1 = math.ceil(max(low, 0.0))
            p2 = int(min(high, width - 1.0))
            if p1 > p2:
                continue
            if used < spans.shape[0]:
                spans[used, 0] = ty * tiles_x + p1 // TILE
                spans[used, 1] = p2 // TILE - p1 // TILE + 1
            used += 1
            counts[i] += 1
    return used


@bare
def scatter(first, last, order, base, begins, counts, spans, live, before, fill, cursor, entries):
    """Count (fill = False) or write (True) the entries of the splats order[first:last] in each tile that is live.

    ``base`` (chunks) is where the runs of each chunk of splats begin, ``before`` (tiles + 1) the number of live tiles
    before each; ``cursor`` counts per tile, or holds the place in
    ``entries`` of the next one.
    """
    every = before[-1] == len(live)
    for place in range(first, last):
        i = order[place]
        # In the order of depth, every access is a cache miss: ask early, for the runs' place first, then for the runs.
        later, soon = order[min(place + 16, last - 1)], order[min(place + 6, last - 1)]
        _prefetch(begins, later)
        _prefetch(counts, later)
        _prefetch(spans, 2 * (base[soon // CHUNK] + begins[soon]))
        begin = base[i // CHUNK] + begins[i]
        for k in range(begin, begin + counts[i]):
            left, right = u64(spans[k, 0]), u64(spans[k, 0] + spans[k, 1])
            if every and not fill:
                # Only where the run begins and ends; summed up below.
                cursor[left] += 1
                cursor[right] -= 1
            elif every or before[left] != before[right]:
                for t in range(left, right):
                    if every or live[t]:
                        if fill:
                            entries[u64(cursor[t])] = i
                        cursor[t] += 1
    if every and not fill:
        for t in range(1, cursor.shape[0]):
            cursor[t] += cursor[t - 1]


@bare
def place_cursors(counts, starts):
    """Turn counts (chunk, tile) into the place of each chunk's first entry in each tile; fill ``starts`` (tiles +
    1)."""
    total = 0
    for t in range(starts.shape[0] - 1):
        starts[t] = total
        for c in range(counts.shape[0]):
            here = counts[c, t]
            counts[c, t] = total
            total += here
    starts[-1] = total


@inlined
def _place(work, at, table, i, ox, oy, flat):
    """Row i of the table as float32 to ``work`` from ``at`` on, its coefficients moved to the tile's middle (ox,
    oy)."""
    i, b = u64(i), u64(at)
    L.narrow(work, at, table, i * u64(COLUMNS))
    L.narrow(work, at + 8, table, i * u64(COLUMNS) + u64(8))
    L.narrow(work, at + 16, table, i * u64(COLUMNS) + u64(16))
    sx, sy = ox - table[i, X0], oy - table[i, Y0]
    work[b + u64(X0)], work[b + u64(Y0)] = sx, sy
    if flat:
        work[b + u64(U0)] = table[i, U0] + table[i, UX] * sx + table[i, UY] * sy
        work[b + u64(V0)] = table[i, V0] + table[i, VX] * sx + table[i, VY] * sy
        work[b + u64(W0)] = table[i, W0] + table[i, WX] * sx + table[i, WY] * sy


@inlined
def _meet_flat(work, at, x, y):
    """Of a 2D splat at 16 pixels: where its outline holds them, where its plane is met, w, (u^2 + v^2) w^2, screen
    rho."""
    w = L.spread(work, at + W0) + L.spread(work, at + WX) * x + L.spread(work, at + WY) * y
    u = L.spread(work, at + U0) + L.spread(work, at + UX) * x + L.spread(work, at + UY) * y
    v = L.spread(work, at + V0) + L.spread(work, at + VX) * x + L.spread(work, at + VY) * y
    ex, ey = x + L.spread(work, at + X0), y + L.spread(work, at + Y0)
    cut = L.spread(work, at + CUT)
    square = u * u + v * v
    screen = (ex * ex + ey * ey) * L.spread(work, at + FILTER) + L.spread(work, at + SHUT)
    meets = (f32(0.0) < w) & (w <= L.spread(work, at + WMAX))
    # No division: this is asked of many more pixels than are drawn.
    inside = (meets & (square <= cut * (w * w))) | (screen <= cut)
    return inside, meets, w, square, screen


@inlined
def _meet_round(work, at, x, y):
    """Of a 3D splat at 16 pixels: where its outline holds them, and rho."""
    ex, ey = x + L.spread(work, at + X0), y + L.spread(work, at + Y0)
    rho = (L.spread(work, at + CA) * ex + L.spread(work, at + CB) * ey * f32(2.0)) * ex
    rho = L.most(rho + L.spread(work, at + CC) * ey * ey, f32(0.0))
    return rho <= L.spread(work, at + CUT), rho


@inlined
def _shade(work, at, x, y, flat, peak):
    """Of a splat at 16 pixels: where it is drawn, and its alpha (anything elsewhere), z and 1 / z."""
    low, high = L.spread(work, at + ZLO), L.spread(work, at + ZHI)
    if flat:
        inside, meets, w, square, screen = _meet_flat(work, at, x, y)
        r = f32(1.0) / w
        rho = L.least(L.where(meets, square * (r * r), f32(HUGE)), screen)
        z = L.where(f32(0.0) < w, L.least(L.most(L.spread(work, at + Z0) * r, low), high), high)
        iz = L.least(L.most(w * L.spread(work, at + IZ0), L.spread(work, at + IZHI)), L.spread(work, at + IZLO))
    else:
        inside, rho = _meet_round(work, at, x, y)
        z, iz = low, L.spread(work, at + IZLO)
        if peak:
            ex, ey = x + L.spread(work, at + X0), y + L.spread(work, at + Y0)
            along = L.spread(work, at + LX) * ex + L.spread(work, at + LY) * ey + f32(1.0)
            form = (L.spread(work, at + RXX) * ex + L.spread(work, at + RXY) * ey * f32(2.0)) * ex
            across = along * along + L.most(form + L.spread(work, at + RYY) * ey * ey, f32(0.0))
            z = L.least(L.most(L.spread(work, at + Z0) * along / L.most(across, f32(1e-30)), low), high)
            iz = f32(1.0) / z
    alpha = L.least(L.spread(work, at + OPACITY) * _gauss(rho), f32(K.ALPHA_MAX))
    return inside, alpha, z, iz


@bare
def forward(first, last, view, tiles_x, live, starts, entries, table, features, background, ndc_scale, color, alpha,
            depth, median, normal, l1, l2, state, done, tested_in, shaded_in, drawn_in, full, seen, buf, work,
            picks):  # fmt: skip
    """Composite those of the tiles first..last that are live.

    A tile's 64 pixels are four squares of 16. Splats come in blocks: their coefficients are laid out once for the tile;
    each square then picks those whose outline holds a pixel of it, and composites them with its sums in registers.

    ``state`` (5, H, W) keeps what the backward pass needs: transmittance, last and median entry, mean and spread of
    1 / z; of no height if there will be none. Per tile, ``done`` is the number of entries worked off, ``tested_in``
    that of pairs whose intersection was computed, ``shaded_in`` of those in a square that the splat draws to,
    ``drawn_in`` of contributing pairs, ``full`` whether every
    pixel has ended; ``seen`` is the sum of weights of each entry.
    """
    flat, peak = view[FLAT] > 0, view[CENTER] == 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    channels = background.shape[0]
    keep = state.shape[1] > 0
    for p in range(PIXELS):
        # From the tile's middle: offsets are small, and so is what they round.
        buf[XS * 64 + p] = f32(p // 16 % 2 * 4 + p % 4) - f32(3.5)
        buf[YS * 64 + p] = f32(p // 32 * 4 + p // 4 % 4) - f32(3.5)
    stop, half = f32(K.TRANSMITTANCE_STOP), f32(K.MEDIAN_TRANSMITTANCE)
    for t in range(first, last):
        if not live[t]:
            continue
        begin, end = starts[t], starts[t + 1]
        tested, shaded, contributing = 0, 0, 0
        ty, tx = t // tiles_x, t % tiles_x
        ox, oy = tx * TILE + 4.0, ty * TILE + 4.0
        for p in range(PIXELS):
            x, y = buf[XS * 64 + p] + ox, buf[YS * 64 + p] + oy
            # Pixels outside of the image are opaque from the start: they take no part and never delay the stop.
            buf[TT * 64 + p] = f32(1.0) if (x < width) & (y < height) else f32(0.0)
        for p in range(AA * 64, buf.shape[0], 16):
            L.store(buf, p, f32(0.0))
        ended, reached = 0, 0
        for q in range(4):
            if not L.some(stop < L.load(buf, TT * 64 + q * 16)):
                ended |= 1 << q
        e = begin
        while e < end and ended < 15:
            size = min(BLOCK, end - e)
            for k in range(size):
                # The rows are anywhere in a table larger than the cache.
                ahead = entries[min(e + k + AHEAD, end - 1)]
                _prefetch(table, ahead * COLUMNS)
                _prefetch(table, ahead * COLUMNS + 8)
                _prefetch(table, ahead * COLUMNS + 16)
                _prefetch(features, ahead * features.shape[1])
                i = entries[e + k]
                _place(work, k * ROW, table, i, ox, oy, flat)
                for c in range(6):
                    work[u64(k * ROW + COLUMNS + c)] = features[u64(i), u64(c)]
                work[u64(k * ROW + COLUMNS + 6)] = f32(e - begin + k + 1)
                L.store(work, WEIGHTS + k * 16, f32(0.0))
            for q in range(4):
                if ended >> q & 1:
                    continue
                s = q * 16
                x, y = L.load(buf, XS * 64 + s), L.load(buf, YS * 64 + s)
                picked = 0
                for k in range(size):
                    picks[u64(picked)] = k
                    if flat:
                        picked += L.some(_meet_flat(work, k * ROW, x, y)[0])
                    else:
                        picked += L.some(_meet_round(work, k * ROW, x, y)[0])
                tested += 16 * size
                T, A, D = L.load(buf, TT * 64 + s), L.load(buf, AA * 64 + s), L.load(buf, DD * 64 + s)
                sum1, sum2, pairs = L.load(buf, M1 * 64 + s), L.load(buf, M2 * 64 + s), L.load(buf, L1 * 64 + s)
                n0, n1, n2 = L.load(buf, NX * 64 + s), L.load(buf, NY * 64 + s), L.load(buf, NZ * 64 + s)
                c0, c1, c2 = L.load(buf, C_0 * 64 + s), L.load(buf, C_1 * 64 + s), L.load(buf, C_2 * 64 + s)
                zref, iref = L.load(buf, ZREF * 64 + s), L.load(buf, IREF * 64 + s)
                med, medk, final = L.load(buf, MED * 64 + s), L.load(buf, MEDK * 64 + s), L.load(buf, LAST * 64 + s)
                used = 0
                while used < picked:
                    k = picks[u64(used)]
                    b = k * ROW
                    inside, a, z, iz = _shade(work, b, x, y, flat, peak)
                    hit = inside & (stop < T)
                    w = L.where(hit, a * T, f32(0.0))
                    step = L.spread(work, b + COLUMNS + 6)
                    opens, first_hit = hit & (half < T), hit & (f32(1.0) <= T)
                    med, medk = L.where(opens, z, med), L.where(opens, step, medk)
                    final = L.where(hit, step, final)
                    # Depths are summed relative to the pixel's first, which keeps the digits of thin layers far away.
                    zref, iref = L.where(first_hit, z, zref), L.where(first_hit, iz, iref)
                    z, m = z - zref, iz - iref
                    wz, wm = w * z, w * m
                    pairs = pairs + wz * A - w * D
                    A, D = A + w, D + wz
                    sum1, sum2 = sum1 + wm, sum2 + wm * m
                    n0 = n0 + w * L.spread(work, b + COLUMNS)
                    n1 = n1 + w * L.spread(work, b + COLUMNS + 1)
                    n2 = n2 + w * L.spread(work, b + COLUMNS + 2)
                    c0 = c0 + w * L.spread(work, b + COLUMNS + 3)
                    c1 = c1 + w * L.spread(work, b + COLUMNS + 4)
                    c2 = c2 + w * L.spread(work, b + COLUMNS + 5)
                    T = T - w
                    L.store(work, WEIGHTS + k * 16, L.load(work, WEIGHTS + k * 16) + w)
                    if channels > 3:
                        L.store(work, SHARES + used * 16, w)
                    contributing += L.count(hit)
                    used += 1
                    if not L.some(stop < T):
                        ended |= 1 << q
                        reached = max(reached, e - begin + k + 1)
                        break
                L.store(buf, TT * 64 + s, T)
                L.store(buf, AA * 64 + s, A)
                L.store(buf, DD * 64 + s, D)
                L.store(buf, M1 * 64 + s, sum1)
                L.store(buf, M2 * 64 + s, sum2)
                L.store(buf, L1 * 64 + s, pairs)
                L.store(buf, NX * 64 + s, n0)
                L.store(buf, NY * 64 + s, n1)
                L.store(buf, NZ * 64 + s, n2)
                L.store(buf, C_0 * 64 + s, c0)
                L.store(buf, C_1 * 64 + s, c1)
                L.store(buf, C_2 * 64 + s, c2)
                L.store(buf, ZREF * 64 + s, zref)
                L.store(buf, IREF * 64 + s, iref)
                L.store(buf, MED * 64 + s, med)
                L.store(buf, MEDK * 64 + s, medk)
                L.store(buf, LAST * 64 + s, final)
                shaded += 16 * used
                for c in range(3, channels):
                    sums = L.load(buf, (C_0 + c) * 64 + s)
                    for k in range(used):
                        f = features[u64(entries[e + picks[u64(k)]]), u64(3 + c)]
                        sums = sums + L.load(work, SHARES + k * 16) * f
                    L.store(buf, (C_0 + c) * 64 + s, sums)
            for k in range(size):
                seen[e + k] = L.total(L.load(work, WEIGHTS + k * 16))
            e += size
        full[t] = ended == 15
        done[t] = reached if ended == 15 else end - begin
        tested_in[t] = tested
        shaded_in[t] = shaded
        drawn_in[t] = contributing
        for p in range(PIXELS):
            A, a1 = buf[AA * 64 + p], buf[M1 * 64 + p]
            covered = buf[LAST * 64 + p] > 0
            inverse = f32(1.0) / A if covered else f32(0.0)
            spread = max(buf[M2 * 64 + p] - a1 * a1 * inverse, f32(0.0))
            buf[AL * 64 + p] = spread
            buf[M2 * 64 + p] = f32(ndc_scale) * A * spread
            buf[M1 * 64 + p] = buf[IREF * 64 + p] + a1 * inverse
            buf[DD * 64 + p] = buf[ZREF * 64 + p] + buf[DD * 64 + p] * inverse if covered else f32(np.nan)
            buf[MED * 64 + p] = buf[MED * 64 + p] if covered else f32(np.nan)
            buf[L1 * 64 + p] *= f32(2.0)
        for c in range(channels):
            for p in range(PIXELS):
                buf[u64((C_0 + c) * 64 + p)] += (f32(1.0) - buf[AA * 64 + p]) * background[c]
        rows, cols = min(TILE, height - ty * TILE), min(TILE, width - tx * TILE)
        if rows == TILE and cols == TILE and channels == 3:
            for k in range(16):
                p = k // 8 * 32 + k % 2 * 16 + k // 2 % 4 * 4
                to = (ty * TILE + k // 2) * width + tx * TILE + k % 2 * 4
                L.copy4(alpha, to, buf, AA * 64 + p)
                L.copy4(depth, to, buf, DD * 64 + p)
                L.copy4(median, to, buf, MED * 64 + p)
                L.copy4(l1, to, buf, L1 * 64 + p)
                L.copy4(l2, to, buf, M2 * 64 + p)
                L.interleave4(color, 3 * to, buf, C_0 * 64 + p, 64)
                L.interleave4(normal, 3 * to, buf, NX * 64 + p, 64)
                if keep:
                    L.copy4(state, to, buf, TT * 64 + p)
                    L.copy4(state, to + height * width, buf, LAST * 64 + p)
                    L.copy4(state, to + 2 * height * width, buf, MEDK * 64 + p)
                    L.copy4(state, to + 3 * height * width, buf, M1 * 64 + p)
                    L.copy4(state, to + 4 * height * width, buf, AL * 64 + p)
            continue
        for r in range(rows):
            for k in range(cols):
                p = u64(r // 4 * 32 + k // 4 * 16 + r % 4 * 4 + k % 4)
                y, x = u64(ty * TILE + r), u64(tx * TILE + k)
                alpha[y, x], depth[y, x], median[y, x] = buf[AA * 64 + p], buf[DD * 64 + p], buf[MED * 64 + p]
                l1[y, x], l2[y, x] = buf[L1 * 64 + p], buf[M2 * 64 + p]
                for c in range(channels):
                    color[y, x, u64(c)] = buf[u64((C_0 + c) * 64) + p]
                for c in range(3):
                    normal[y, x, u64(c)] = buf[u64((NX + c) * 64) + p]
                if keep:
                    state[0, y, x], state[1, y, x] = buf[TT * 64 + p], buf[LAST * 64 + p]
                    state[2, y, x] = buf[MEDK * 64 + p]
                    state[3, y, x], state[4, y, x] = buf[M1 * 64 + p], buf[AL * 64 + p]


@bare
def gather_weights(starts, done, entries, seen, weight):
    """Add the entries' weights to their splats', tile by tile."""
    for t in range(done.shape[0]):
        for e in range(starts[t], starts[t] + done[t]):
            weight[entries[e]] += seen[e]


# Further slots of the backward pass: gradients of the loss in what a pixel sums up, and sums over the splats behind.
BXS, BYS, BAL, BZZ, BIZ = 0, 1, 2, 3, 4  # as in the forward pass: the same code fills them
(BT, BLAST, BMEDK, BZREF, BIREF, GW, GD, GM2, GL1, GMED, TOTA, BEHA, BEHD, BEHQ, DA, DZ, DI, BW, QF,
 GNX, GNY, GNZ, GC0, GC1, GC2) = range(5, 30)  # fmt: skip
BACK_SLOTS = 30


@inlined
def _blame_flat(buf, table, i, ox, oy, rows, row):
    """Gradients in a 2D splat's table row from those in alpha, z and 1 / z at the 64 pixels."""
    sx, sy = ox - table[i, X0], oy - table[i, Y0]
    ux, uy, u0 = f32(table[i, UX]), f32(table[i, UY]), f32(table[i, U0] + table[i, UX] * sx + table[i, UY] * sy)
    vx, vy, v0 = f32(table[i, VX]), f32(table[i, VY]), f32(table[i, V0] + table[i, VX] * sx + table[i, VY] * sy)
    wx, wy, w0 = f32(table[i, WX]), f32(table[i, WY]), f32(table[i, W0] + table[i, WX] * sx + table[i, WY] * sy)
    dx, dy = f32(sx), f32(sy)
    z0, zlo, zhi, wmax = f32(table[i, Z0]), f32(table[i, ZLO]), f32(table[i, ZHI]), f32(table[i, WMAX])
    filtered, unfiltered = f32(table[i, FILTER]), f32(table[i, SHUT])
    o1 = o2 = o3 = o4 = o5 = o6 = f32(0.0)
    tu = tux = tuy = tv = tvx = tvy = tw = twx = twy = f32(0.0)
    for p in range(PIXELS):
        x = buf[BXS * 64 + p]
        y = buf[BYS * 64 + p]
        w = w0 + wx * x + wy * y
        r = f32(1.0) / w
        u = (u0 + ux * x + uy * y) * r
        v = (v0 + vx * x + vy * y) * r
        rho = u * u + v * v
        ex = x + dx
        ey = y + dy
        screen = filtered * (ex * ex + ey * ey) + unfiltered
        # Selected, not multiplied by 0: r may be infinite.
        meets = (w > f32(0.0)) & (w <= wmax) & (rho <= screen)
        rs = r if meets else f32(0.0)
        u = (u0 + ux * x + uy * y) * rs
        v = (v0 + vx * x + vy * y) * rs
        a = buf[BAL * 64 + p]
        da = buf[DA * 64 + p] * a * (f32(1.0) if a < f32(K.ALPHA_MAX) else f32(0.0))
        o1 += da
        gu = -da * u * rs
        gv = -da * v * rs
        gw = -(gu * u + gv * v)
        screened = f32(0.0) if meets else -da * filtered
        o2 += screened * ex
        o3 += screened * ey
        iz = buf[BIZ * 64 + p]
        gz = buf[DZ * 64 + p] - buf[DI * 64 + p] * iz * iz
        z = z0 * r
        over = (w <= f32(0.0)) | (z > zhi)
        under = (w > f32(0.0)) & (z <= zlo)
        inside = f32(0.0) if over | under else gz
        rz = f32(0.0) if over | under else r
        o4 += inside * rz
        gw -= inside * z0 * rz * rz
        o5 += gz if under else f32(0.0)
        o6 += gz if over else f32(0.0)
        tu += gu
        tux += gu * x
        tuy += gu * y
        tv += gv
        tvx += gv * x
        tvy += gv * y
        tw += gw
        twx += gw * x
        twy += gw * y
    rows[row, X0] = -(table[i, UX] * tu + table[i, VX] * tv + table[i, WX] * tw) - o2
    rows[row, Y0] = -(table[i, UY] * tu + table[i, VY] * tv + table[i, WY] * tw) - o3
    rows[row, UX], rows[row, UY], rows[row, U0] = tux + sx * tu, tuy + sy * tu, tu
    rows[row, VX], rows[row, VY], rows[row, V0] = tvx + sx * tv, tvy + sy * tv, tv
    rows[row, WX], rows[row, WY], rows[row, W0] = twx + sx * tw, twy + sy * tw, tw
    rows[row, Z0], rows[row, ZLO], rows[row, ZHI] = o4, o5, o6
    rows[row, OPACITY] = o1 / table[i, OPACITY]


@inlined
def _blame_round(buf, table, i, ox, oy, rows, row, peak):
    """Gradients in a 3D splat's table row from those in alpha, z and 1 / z at the 64 pixels."""
    dx, dy = f32(ox - table[i, X0]), f32(oy - table[i, Y0])
    ca, cb, cc = f32(table[i, CA]), f32(table[i, CB]), f32(table[i, CC])
    o1 = o2 = o3 = o4 = o5 = o6 = f32(0.0)
    for p in range(PIXELS):
        x = buf[BXS * 64 + p] + dx
        y = buf[BYS * 64 + p] + dy
        a = buf[BAL * 64 + p]
        da = buf[DA * 64 + p] * a * (f32(1.0) if a < f32(K.ALPHA_MAX) else f32(0.0))
        o1 += da
        o2 += da * (ca * x + cb * y)
        o3 += da * (cb * x + cc * y)
        o4 += da * x * x
        o5 += da * x * y
        o6 += da * y * y
    gx, gy = o2, o3
    rows[row, OPACITY] = o1 / table[i, OPACITY]
    rows[row, CA], rows[row, CB], rows[row, CC] = f32(-0.5) * o4, -o5, f32(-0.5) * o6
    o1 = o2 = o3 = o4 = o5 = o6 = f32(0.0)
    s1 = s2 = s3 = f32(0.0)
    if peak:
        lx, ly = f32(table[i, LX]), f32(table[i, LY])
        rxx, rxy, ryy = f32(table[i, RXX]), f32(table[i, RXY]), f32(table[i, RYY])
        z0, zlo, zhi = f32(table[i, Z0]), f32(table[i, ZLO]), f32(table[i, ZHI])
        for p in range(PIXELS):
            x = buf[BXS * 64 + p] + dx
            y = buf[BYS * 64 + p] + dy
            iz = buf[BIZ * 64 + p]
            gz = buf[DZ * 64 + p] - buf[DI * 64 + p] * iz * iz
            along = f32(1.0) + lx * x + ly * y
            across = along * along + max(rxx * x * x + f32(2.0) * rxy * x * y + ryy * y * y, f32(0.0))
            inverse = f32(1.0) / max(across, f32(1e-30))
            z = z0 * along * inverse
            s1 += gz if z <= zlo else f32(0.0)
            s2 += gz if z > zhi else f32(0.0)
            gz = gz if (z > zlo) & (z <= zhi) else f32(0.0)
            s3 += gz * along * inverse
            gl = gz * z0 * inverse * (f32(1.0) - f32(2.0) * along * along * inverse)
            gr = -gz * z * inverse
            o1 += gl * x
            o2 += gl * y
            o3 += gr * x * x
            o4 += gr * x * y
            o5 += gr * y * y
            gx -= gl * lx + f32(2.0) * gr * (rxx * x + rxy * y)
            gy -= gl * ly + f32(2.0) * gr * (rxy * x + ryy * y)
    else:
        for p in range(PIXELS):
            iz = buf[BIZ * 64 + p]
            s1 += buf[DZ * 64 + p] - buf[DI * 64 + p] * iz * iz
    rows[row, X0], rows[row, Y0] = gx, gy
    rows[row, LX], rows[row, LY] = o1, o2
    rows[row, RXX], rows[row, RXY], rows[row, RYY] = o3, f32(2.0) * o4, o5
    rows[row, 10] = f32(0.0)
    rows[row, Z0], rows[row, ZLO], rows[row, ZHI] = s3, s1, s2


@bare
def backward(first, last, view, tiles_x, starts, done, entries, table, features, background, ndc_scale, alpha, depth,
state,
             g_color, g_alpha, g_depth, g_median, g_normal, g_l1, g_l2, g_weight, place, rows, buf, work):  # fmt: skip
    """Gradients of the tiles first..last, one row of ``rows`` for each entry worked off, from place[tile] on.

    A row holds the gradient in the first GRADIENTS columns of the splat's ``table`` row, then in its ``features``.
    Splats are visited back to front: the transmittance before each is recovered by division from what the forward pass
    left.
    """
    flat, peak = view[FLAT] > 0, view[CENTER] == 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    channels = background.shape[0]
    scale = f32(ndc_scale)
    for p in range(PIXELS):
        buf[BXS * 64 + p] = f32(p % TILE) - f32(3.5)
        buf[BYS * 64 + p] = f32(p // TILE) - f32(3.5)
    for t in range(first, last):
        begin, count = starts[t], done[t]
        if count == 0:
            continue
        ty, tx = t // tiles_x, t % tiles_x
        ox, oy = tx * TILE + 4.0, ty * TILE + 4.0
        cols, tall = min(TILE, width - tx * TILE), min(TILE, height - ty * TILE)
        for p in range(BT * 64, buf.shape[0]):
            buf[p] = f32(0.0)
        for r in range(tall):
            for k in range(cols):
                p = r * TILE + k
                y, x = ty * TILE + r, tx * TILE + k
                A = alpha[y, x]
                if state[1, y, x] == 0:
                    continue
                buf[BT * 64 + p] = state[0, y, x]
                buf[BLAST * 64 + p] = state[1, y, x]
                buf[BMEDK * 64 + p] = state[2, y, x]
                # Relative to the means, the first moments vanish, and with them most terms.
                buf[BZREF * 64 + p] = depth[y, x]
                buf[BIREF * 64 + p] = state[3, y, x]
                gd = g_depth[y, x] / A
                g2 = scale * g_l2[y, x]
                gw = g_alpha[y, x] + g2 * state[4, y, x]
                for c in range(channels):
                    gw -= g_color[y, x, c] * background[c]
                    buf[(GC0 + c) * 64 + p] = g_color[y, x, c]
                for c in range(3):
                    buf[(GNX + c) * 64 + p] = g_normal[y, x, c]
                buf[GW * 64 + p] = gw
                buf[GD * 64 + p] = gd
                buf[GM2 * 64 + p] = g2 * A
                buf[GL1 * 64 + p] = f32(2.0) * g_l1[y, x]
                buf[GMED * 64 + p] = g_median[y, x]
                buf[TOTA * 64 + p] = A
        for back in range(count):
            e = begin + count - 1 - back
            i = entries[e]
            ahead = entries[max(e - 2, begin)]
            _prefetch(table, ahead * COLUMNS)
            _prefetch(table, ahead * COLUMNS + 8)
            _prefetch(table, ahead * COLUMNS + 16)
            _prefetch(features, ahead * features.shape[1])
            _place(work, 0, table, i, ox, oy, flat)
            for p in range(0, PIXELS, 16):
                drawn, a, z, iz = _shade(work, 0, L.load(buf, BXS * 64 + p), L.load(buf, BYS * 64 + p), flat, peak)
                L.store(buf, BAL * 64 + p, L.where(drawn, a, f32(0.0)))
                L.store(buf, BZZ * 64 + p, z)
                L.store(buf, BIZ * 64 + p, iz)
            row = place[t] + count - 1 - back
            step = f32(e - begin + 1)
            gi = g_weight[i]
            f0, f1, f2, f3, f4, f5 = (
                features[i, 0], features[i, 1], features[i, 2], features[i, 3], features[i, 4], features[i, 5],
            )  # fmt: skip
            for c in range(3, channels):
                f = features[i, 3 + c]
                slot = u64((GC0 + c) * 64)
                for p in range(PIXELS):
                    buf[QF * 64 + p] = (buf[QF * 64 + p] if c > 3 else f32(0.0)) + buf[slot + u64(p)] * f
            s0, s1, s2, s3, s4, s5 = f32(0.0), f32(0.0), f32(0.0), f32(0.0), f32(0.0), f32(0.0)
            for p in range(PIXELS):
                a = buf[BAL * 64 + p] * (f32(1.0) if step <= buf[BLAST * 64 + p] else f32(0.0))
                rest = f32(1.0) / (f32(1.0) - a)
                T = buf[BT * 64 + p] * rest
                w = a * T
                z = buf[BZZ * 64 + p] - buf[BZREF * 64 + p]
                m = buf[BIZ * 64 + p] - buf[BIREF * 64 + p]
                gn0, gn1, gn2 = buf[GNX * 64 + p], buf[GNY * 64 + p], buf[GNZ * 64 + p]
                gc0, gc1, gc2 = buf[GC0 * 64 + p], buf[GC1 * 64 + p], buf[GC2 * 64 + p]
                gd, gm2, gl1 = buf[GD * 64 + p], buf[GM2 * 64 + p], buf[GL1 * 64 + p]
                behind_a, behind_d = buf[BEHA * 64 + p], buf[BEHD * 64 + p]
                q = buf[GW * 64 + p] + gi + gd * z + gm2 * m * m + buf[QF * 64 + p]
                q += gn0 * f0 + gn1 * f1 + gn2 * f2 + gc0 * f3 + gc1 * f4 + gc2 * f5
                # In front minus behind, of the weights and of the weighted depths.
                lean = buf[TOTA * 64 + p] - w - behind_a - behind_a
                lean_d = -w * z - behind_d - behind_d
                q += gl1 * (z * lean - lean_d)
                median = f32(1.0) if step == buf[BMEDK * 64 + p] else f32(0.0)
                buf[DZ * 64 + p] = w * (gd + gl1 * lean) + median * buf[GMED * 64 + p]
                buf[DI * 64 + p] = f32(2.0) * w * gm2 * m
                kept = f32(1.0) if a > f32(0.0) else f32(0.0)
                behind_q = buf[BEHQ * 64 + p]
                buf[DA * 64 + p] = kept * (T * q - behind_q * rest)
                buf[BEHQ * 64 + p] = behind_q + w * q
                buf[BEHA * 64 + p] = behind_a + w
                buf[BEHD * 64 + p] = behind_d + w * z
                buf[BT * 64 + p] = T
                buf[BW * 64 + p] = w
                s0 += w * gn0
                s1 += w * gn1
                s2 += w * gn2
                s3 += w * gc0
                s4 += w * gc1
                s5 += w * gc2
            rows[row, GRADIENTS], rows[row, GRADIENTS + 1], rows[row, GRADIENTS + 2] = s0, s1, s2
            rows[row, GRADIENTS + 3], rows[row, GRADIENTS + 4], rows[row, GRADIENTS + 5] = s3, s4, s5
            for c in range(3, channels):
                total = f32(0.0)
                slot = u64((GC0 + c) * 64)
                for p in range(PIXELS):
                    total += buf[BW * 64 + p] * buf[slot + u64(p)]
                rows[row, GRADIENTS + 3 + c] = total
            if flat:
                _blame_flat(buf, table, i, ox, oy, rows, row)
            else:
                _blame_round(buf, table, i, ox, oy, rows, row, peak)


@jit
def reduce_rows(low, high, first, last, starts, done, entries, place, rows, total):
    """Add the rows of the tiles first..last to those of the splats low..high in ``total``, in the order of the
    tiles."""
    columns = rows.shape[1]
    for t in range(first, last):
        for k in range(done[t]):
            i = entries[starts[t] + k]
            if low <= i < high:
                row = place[t] + k
                for c in range(columns):
                    total[i, c] += rows[row, c]


@jit
def project_backward(first, last, view, m, q, s, o, values, channels, visible, table, total,
                     gm, gq, gs, go, gv, g_view):  # fmt: skip
    """Gradients in the parameters of splats first..last from those in their projection, ``total``.

    The vector-Jacobian product of :func:`project`, in float64, every step of it in reverse. ``g_view`` (12) receives
    the sums for R and t.
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
    h = np.empty(3)
    gh = np.empty(3)
    gR = np.zeros((3, 3))
    gt = np.zeros(3)
    kx, ky, kxy = 1 / fx, 1 / fy, -skew / (fx * fy)
    for i in range(first, last):
        if not visible[i]:
            continue
        g = total[i]
        for r in range(3):
            c[r] = R[r, 0] * m[i, 0] + R[r, 1] * m[i, 1] + R[r, 2] * m[i, 2] + view[TX + r]
        size = _axes(q, i, Q)
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
            gc[2] -= (g[X0] * (table[i, X0] - cx) + g[Y0] * (table[i, Y0] - cy)) / c[2]
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
                scale = depth / s[i, k]
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
                g_depth += g_scale / s[i, k]
                gs[i, k] -= g_scale * scale / s[i, k]
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
                gx = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * s[i, k] / c[2]
                gy = fy * (a[1, k] - py * a[2, k]) * s[i, k] / c[2]
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
                f = s[i, k] / c[2]
                gx = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * f
                gy = fy * (a[1, k] - py * a[2, k]) * f
                ux = 2 * g_xx * gx + g_xy * gy
                uy = 2 * g_yy * gy + g_xy * gx
                ga[0, k] += ux * fx * f
                ga[1, k] += (ux * skew + uy * fy) * f
                ga[2, k] -= (ux * (fx * px + skew * py) + uy * fy * py) * f
                g_px -= ux * fx * a[2, k] * f
                g_py -= (ux * skew + uy * fy) * a[2, k] * f
                gs[i, k] += (ux * gx + uy * gy) / s[i, k]
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
                            S[r, k] += a[r, j] * a[k, j] / (s[i, j] * s[i, j])
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
                    inverse = 1 / (s[i, k] * s[i, k])
                    along = 0.0
                    for r in range(3):
                        for j in range(3):
                            ga[r, k] += (gS[r, j] + gS[j, r]) * a[j, k] * inverse
                            along += a[r, k] * gS[r, j] * a[j, k]
                    gs[i, k] -= 2 * along * inverse / s[i, k]
        spread = (s[i, 0] * a[2, 0]) ** 2 + (s[i, 1] * a[2, 1]) ** 2
        if not flat:
            spread += (s[i, 2] * a[2, 2]) ** 2
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
                for k in range(s.shape[1]):
                    gs[i, k] += g_spread * s[i, k] * a[2, k] ** 2 / spread
                    ga[2, k] += g_spread * s[i, k] ** 2 * a[2, k] / spread
        go[i] = g_opacity
        axis = 2
        if not flat:
            axis = 0
            if s[i, 1] < s[i, axis]:
                axis = 1
            if s[i, 2] < s[i, axis]:
                axis = 2
        facing = a[0, axis] * c[0] + a[1, axis] * c[1] + a[2, axis] * c[2]
        flip = -1.0 if facing > 0 else 1.0
        for k in range(3):
            gQ[k, axis] += flip * g[GRADIENTS + k]
        if view[HARMONIC] > 0:
            x = (R[0, 0] * c[0] + R[1, 0] * c[1] + R[2, 0] * c[2]) / length
            y = (R[0, 1] * c[0] + R[1, 1] * c[1] + R[2, 1] * c[2]) / length
            z = (R[0, 2] * c[0] + R[1, 2] * c[1] + R[2, 2] * c[2]) / length
            _harmonics(degree, x, y, z, Y)
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
                dy += -C34 * 2 * x * y * gY[13] - C35 * 2 * y * z * gY[14] - C36 * 6 * x * y * gY[15]
                dz += C31 * x * y * gY[10] + C32 * 8 * y * z * gY[11]
                dz += C33 * 3 * (2 * z * z - x * x - y * y) * gY[12] + C34 * 8 * x * z * gY[13]
                dz += C35 * (x * x - y * y) * gY[14]
            along = x * dx + y * dy + z * dz
            h[0], h[1], h[2] = (dx - x * along) / length, (dy - y * along) / length, (dz - z * along) / length
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
        for r in range(3):
            gt[r] += gc[r]
            for k in range(3):
                gm[i, k] += R[r, k] * gc[r]
                gR[r, k] += gc[r] * m[i, k]
        w, x, y, z = q[i, 0] / size, q[i, 1] / size, q[i, 2] / size, q[i, 3] / size
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
