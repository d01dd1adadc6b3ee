# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""The numba kernels of the CPU backend; :mod:`attnwarp.render.cpu` calls them, and says how they fit together.

Compositing, forward and backward, is written in vectors of 16 pixels (``_lanes.py``), a square of 4 x 4, with its
sums in registers: forward the sums of a square while a block of splats goes by, backward those of a splat while the
squares of its tile go by. exp is a polynomial, since LLVM has no vector exp here. Every sum that crosses tiles is formed
in a fixed order, or in whole numbers, so the bits never depend on the number of threads. No kernel starts threads: they
release the GIL and are handed ranges of work.
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
f64 = np.float64
u64 = np.uint64
TILE = K.TILE
PIXELS = TILE * TILE
CHUNK = 2048  # splats set up at once: their rows stay in the second-level cache

# A projected splat is a row of 192 bytes, three cache lines: WIDE columns of float64, then float32. The table is passed
# twice, as float64 (M, COLUMNS) and as float32 (M, 2 COLUMNS), "thin", in which column c >= WIDE stands at c + WIDE.
# The reference point is the projected centre, or the principal point for a 2D splat whose centre is not in front;
# coefficients are per pixel of offset from it, and are moved to each tile's middle in float64.
X0, Y0 = 0, 1
UX, UY, U0, VX, VY, V0, WX, WY, W0 = 2, 3, 4, 5, 6, 7, 8, 9, 10  # 2D: u = U / W, v = V / W, z = Z0 / W
CA, CB, CC, LX, LY, RXX, RXY, RYY = 2, 3, 4, 5, 6, 7, 8, 9  # 3D: conic; z = Z0 l / (l^2 + r)
WIDE = 11
Z0, ZLO, ZHI, OPACITY = 11, 12, 13, 14
GRADIENTS = 15  # columns up to here carry gradients
FILTER, SHUT, WMAX, CUT = 15, 16, 17, 18  # screen rho = FILTER |x - centre|^2 + SHUT; nothing shows if CUT < 0
IZ0, IZLO, IZHI = 19, 20, 21  # 1 over Z0, ZLO, ZHI
NORMAL, VALUES = 22, 25  # world normal, and the first three channels
BOUNDED = 28
COLUMNS = 24

# A block of splats as the forward pass works on them: for each a row of float32, with the table's columns and its
# place among the tile's; then its weights at the 16 pixels of all squares, and of the square at hand.
BLOCK = 32
AHEAD = 32
ROW = 32
STEP = 28
WEIGHTS = BLOCK * ROW
SHARES = WEIGHTS + BLOCK * 16
WORK = SHARES + BLOCK * 16

# An entry of a tile's list is a splat's place in the order of depth, and above it one bit for each of the tile's four
# squares of 4 x 4 pixels that the splat may show in.
PLACE_BITS = 28
PLACE = (1 << PLACE_BITS) - 1
WEIGHT_UNIT = 2.0**-36
# A run of tiles: the first one, how many, and which columns of squares in the upper and in the lower half, from the
# run's first one on, as first | last << 16.
RUN = 4
NOTES = 64
NONE = 32767 | (-1 << 16)

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


def _asking(write: int) -> Any:
    @intrinsic
    def prefetch(typing: Any, array: Any, item: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = cgutils.create_struct_proxy(signature.args[0])(context, builder, args[0]).data
            pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
            word = ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), word, word, word])
            call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            builder.call(call, [pointer, word(write), word(3), word(1)])
            return word(0)

        return nb.int32(array, nb.int64), codegen

    return prefetch


# Ask for the cache line of an array's item (counted flat) before it is needed, to be read or to be written.
_prefetch, _prefetch_to_write = _asking(0), _asking(1)


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
    w, x, y, z = f64(q[i, 0]), f64(q[i, 1]), f64(q[i, 2]), f64(q[i, 3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = 1 / length
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
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
def depths(first, last, view, m, q, s, o, key, listed):
    """The depth of each of the splats first..last, to ``key``; NaN where nothing can show.

    ``listed`` (1) gets a guess at how many tiles will list them: rectangles of 5 sigmas, their centres in the picture.
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
            a0 = r0 * (square - 2 * (y * y + z * z)) + r1 * 2 * (x * y + w * z) + r2 * 2 * (x * z - w * y)
            a1 = r0 * 2 * (x * y - w * z) + r1 * (square - 2 * (x * x + z * z)) + r2 * 2 * (y * z + w * x)
            spread = math.sqrt((f64(s[i, 0]) * a0) ** 2 + (f64(s[i, 1]) * a1) ** 2) / square
            shows = c2 + K.EXTENT_SIGMAS * spread > near
        shows = shows and o[i] >= K.ALPHA_MIN
        key[i] = c2 if shows else np.nan
        if shows and c2 > near:
            c0 = view[0] * f64(m[i, 0]) + view[1] * f64(m[i, 1]) + view[2] * f64(m[i, 2]) + view[TX]
            c1 = view[3] * f64(m[i, 0]) + view[4] * f64(m[i, 1]) + view[5] * f64(m[i, 2]) + view[TX + 1]
            x, y = fx * c0 / c2 + px, fy * c1 / c2 + py
            if 0 < x < wide and 0 < y < tall:
                first_side = min(1 + 5 * fx * f64(s[i, 0]) / c2, wide)
                second_side = min(1 + 5 * fy * f64(s[i, 1]) / c2, tall)
                guess += first_side * second_side
    listed[0] = guess


@inlined
def _reaches(view, c0, c1, c2, size, wanted):
    """Whether a splat may show in a wanted tile, by a rectangle that holds it whatever its rotation.

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
        # A sphere holds it: (c0 + d0) / (c2 + d2) - c0 / c2 is at most |d| (1 + |c0 / c2|) / (c2 - |d|). And 2.4
        # pixels hold the disc of the screen filter.
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


@jit
def project(first, last, order, view, m, q, s, o, values, channels, wanted, table, thin, features):
    """The splats order[first:last] to the rows first..last of the table, and of ``features`` (M, channels) if there
    are more than three.

    ``wanted`` (tiles_y + 1, tiles_x + 1) holds how many tiles are wanted above and left of each tile's corner: a splat
    that cannot show in a wanted one gets a negative CUT, and the rest of its row is left as it was.
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
    sizes = np.empty(3)
    kx, ky, kxy = 1 / fx, 1 / fy, -skew / (fx * fy)
    for j in range(first, last):
        later = order[min(j + 12, last - 1)]
        _prefetch(m, later * 3)
        _prefetch(q, later * 4)
        _prefetch(s, later * s.shape[1])
        _prefetch(o, later)
        _prefetch(values, later * values.shape[1])
        i = order[j]
        m0, m1, m2 = f64(m[i, 0]), f64(m[i, 1]), f64(m[i, 2])
        s0, s1, s2 = f64(s[i, 0]), f64(s[i, 1]), 0.0 if flat else f64(s[i, s.shape[1] - 1])
        sizes[0], sizes[1], sizes[2] = s0, s1, s2
        c0 = R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2 + view[TX]
        c1 = R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2 + view[TX + 1]
        c2 = R[2, 0] * m0 + R[2, 1] * m1 + R[2, 2] * m2 + view[TX + 2]
        if not _reaches(view, c0, c1, c2, max(s0, s1, s2), wanted):
            thin[j, WIDE + CUT] = f32(-1.0)
            continue
        _axes(q, i, Q)
        for r in range(3):
            for k in range(3):
                a[r, k] = R[r, 0] * Q[0, k] + R[r, 1] * Q[1, k] + R[r, 2] * Q[2, k]
        ahead = c2 > near
        opacity = f64(o[i])
        spread = math.sqrt((s0 * a[2, 0]) ** 2 + (s1 * a[2, 1]) ** 2 + (s2 * a[2, 2]) ** 2)
        axis = 2
        if not flat:
            axis = 0
            if s1 < s0:
                axis = 1
            if s2 < sizes[axis]:
                axis = 2
        ic = 1 / c2
        if ahead:
            table[j, X0], table[j, Y0] = (fx * c0 + skew * c1) * ic + cx, fy * c1 * ic + cy
        else:
            table[j, X0], table[j, Y0] = cx, cy
        depth = c2
        filtered, unfiltered, most = 0.0, 0.0, 0.0
        if flat:
            n0, n1, n2 = a[0, 2], a[1, 2], a[2, 2]
            length = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            nc = n0 * c0 + n1 * c1 + n2 * c2
            if abs(nc) < K.EDGE_ON * length:
                nc = -K.EDGE_ON * length if nc < 0 else K.EDGE_ON * length
            depth = c2 if ahead else length
            inverse = 1 / nc
            for k in range(2):
                tc = (a[0, k] * c0 + a[1, k] * c1 + a[2, k] * c2) * inverse
                scale = depth / sizes[k]
                gx, gy = scale * (a[0, k] - tc * n0), scale * (a[1, k] - tc * n1)
                table[j, UX + 3 * k] = gx * kx
                table[j, UY + 3 * k] = gy * ky + gx * kxy
                table[j, U0 + 3 * k] = 0.0 if ahead else scale * (a[2, k] - tc * n2)
            scale = depth * inverse
            table[j, WX] = scale * n0 * kx
            table[j, WY] = scale * (n1 * ky + n0 * kxy)
            table[j, W0] = 1.0 if ahead else scale * n2
            filtered, unfiltered = (2.0, 0.0) if ahead else (0.0, HUGE)
            most = depth / near
        else:
            limit = K.JACOBIAN_MARGIN * view[WIDTH] / 2 / fx
            px = min(max(c0 / c2, -cx / fx - limit), (view[WIDTH] - cx) / fx + limit)
            limit = K.JACOBIAN_MARGIN * view[HEIGHT] / 2 / fy
            py = min(max(c1 / c2, -cy / fy - limit), (view[HEIGHT] - cy) / fy + limit)
            sxx, sxy, syy = 0.0, 0.0, 0.0
            for k in range(3):
                gx = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * sizes[k] * ic
                gy = fy * (a[1, k] - py * a[2, k]) * sizes[k] * ic
                sxx += gx * gx
                sxy += gx * gy
                syy += gy * gy
            sharp = sxx * syy - sxy * sxy
            sxx += K.BLUR_3D
            syy += K.BLUR_3D
            det = sxx * syy - sxy * sxy
            inverse = 1 / det
            table[j, CA], table[j, CB], table[j, CC] = syy * inverse, -sxy * inverse, sxx * inverse
            for k in range(LX, WIDE):
                table[j, k] = 0.0
            if view[ANTIALIASED] > 0:
                opacity *= math.sqrt(max(sharp / det, K.COMPENSATION_MIN))
            if not center:
                q0 = 0.0
                for r in range(3):
                    for k in range(3):
                        S[r, k] = (
                            a[r, 0] * a[k, 0] / (s0 * s0)
                            + a[r, 1] * a[k, 1] / (s1 * s1)
                            + a[r, 2] * a[k, 2] / (s2 * s2)
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
                table[j, LX], table[j, LY] = lx * kx, ly * ky + lx * kxy
                table[j, RXX] = rxx * kx * kx
                table[j, RXY] = kx * (rxx * kxy + rxy * ky)
                table[j, RYY] = rxx * kxy * kxy + 2 * rxy * kxy * ky + ryy * ky * ky
        low = high = max(c2, near)
        if not center:
            low = max(c2 - K.EXTENT_SIGMAS * spread, near)
            high = max(c2 + K.EXTENT_SIGMAS * spread, near)
        cut = 2 * math.log(opacity / K.ALPHA_MIN) if opacity >= K.ALPHA_MIN else -1.0
        thin[j, WIDE + Z0], thin[j, WIDE + ZLO], thin[j, WIDE + ZHI], thin[j, WIDE + OPACITY] = (
            depth,
            low,
            high,
            opacity,
        )
        thin[j, WIDE + FILTER], thin[j, WIDE + SHUT], thin[j, WIDE + WMAX], thin[j, WIDE + CUT] = (
            filtered,
            unfiltered,
            most,
            cut,
        )
        thin[j, WIDE + IZ0], thin[j, WIDE + IZLO], thin[j, WIDE + IZHI] = 1 / depth, 1 / low, 1 / high
        # The outline is an ellipse only if the whole disc lies in front of the camera plane.
        bounded = not flat or (ahead and c2 - math.sqrt(max(cut, 0.0)) * spread > 1e-3 * c2)
        thin[j, WIDE + BOUNDED] = 1.0 if bounded else 0.0
        facing = a[0, axis] * c0 + a[1, axis] * c1 + a[2, axis] * c2
        flip = -1.0 if facing > 0 else 1.0
        for k in range(3):
            thin[j, WIDE + NORMAL + k] = flip * Q[k, axis]
        if view[HARMONIC] > 0:
            length = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
            x = (R[0, 0] * c0 + R[1, 0] * c1 + R[2, 0] * c2) / length
            y = (R[0, 1] * c0 + R[1, 1] * c1 + R[2, 1] * c2) / length
            z = (R[0, 2] * c0 + R[1, 2] * c1 + R[2, 2] * c2) / length
            _harmonics(degree, x, y, z, Y)
            for k in range(3):
                total = 0.5
                for b in range((degree + 1) ** 2):
                    total += Y[b] * values[i, 3 * b + k]
                thin[j, WIDE + VALUES + k] = max(total, 0.0)
        else:
            for k in range(3):
                thin[j, WIDE + VALUES + k] = values[i, k] if k < channels else f32(0.0)
            if channels > 3:
                for k in range(channels):
                    features[j, k] = values[i, k]


@jit
def radix_order(key, index, other, bits, spare):
    """Indices of the keys that are not NaN, ascending, equal ones in their order of input (LSD radix sort of bits);
    and the places in them of keys that are equal to one beside them. All arrays are as long as ``key``; the results
    lie in ``index`` and ``other``."""
    raw = key.view(np.uint32)
    n = 0
    for i in range(key.shape[0]):
        if key[i] == key[i]:
            b = raw[i] if key[i] != 0 else np.uint32(0)
            # Flipping makes the order of the bits that of the numbers: all bits of a negative, the sign of a positive.
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


@inlined
def _overlaps(row, x1, x2, y1, y2, cut, most, filtered):
    """Whether a 2D splat of any outline may show in a rectangle (relative to its reference point), by intervals."""
    hx, hy, mx, my = (x2 - x1) / 2, (y2 - y1) / 2, (x1 + x2) / 2, (y1 + y2) / 2
    w = row[W0] + row[WX] * mx + row[WY] * my + abs(row[WX]) * hx + abs(row[WY]) * hy
    if w > 0:
        w = min(w, most)
        u = max(abs(row[U0] + row[UX] * mx + row[UY] * my) - abs(row[UX]) * hx - abs(row[UY]) * hy, 0.0)
        v = max(abs(row[V0] + row[VX] * mx + row[VY] * my) - abs(row[VX]) * hx - abs(row[VY]) * hy, 0.0)
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
            if tx < tiles_x and _overlaps(row, x1, x2, y1, y2, cut, slim[WIDE + WMAX], slim[WIDE + FILTER] > 0):
                run += 1
            elif run > 0:
                if used < spans.shape[0]:
                    tile = ty * tiles_x + tx - run
                    spans[used, 0], spans[used, 1] = tile, run
                    spans[used, 2] = spans[used, 3] = (2 * run - 1) << 16
                    change[tile] += 1
                    change[tile + run] -= 1
                counts[k] += 1
                used += 1
                run = 0
    return used


@bare
def _emit(notes, shapes, noted, flat, columns, width, tiles_x, before, spans, used, counts, change):
    """The runs of the pieces of ellipses that are noted; see :func:`outline`.

    In steps, each for all notes: what finds the columns waits for no branch, and the branches (how many rows has a
    splat) wait for no root or division.
    """
    steps = L.load(columns, 0)
    zero, far = f32(0.0), f32(1e9)
    for j in range(noted):
        at = j * 16
        # From the ellipse's middle; rows that the image ends within are taken whole.
        y1 = steps + L.spread(shapes, at)
        y2 = y1 + L.spread(shapes, at + 13)
        top, shrink, half = L.spread(shapes, at + 2), L.spread(shapes, at + 3), L.spread(shapes, at + 4)
        lean, stretch, tip = L.spread(shapes, at + 5), L.spread(shapes, at + 6), L.spread(shapes, at + 7)
        e1, e2 = L.most(y1 - L.spread(shapes, at + 1), -top), L.least(y2 - L.spread(shapes, at + 1), top)
        t1, t2 = e1 * shrink, e2 * shrink
        # 5e-7: what 1 - t^2 may be rounded by; at the tips its root is much.
        chord1 = L.rough_root(L.most(f32(1.0) - t1 * t1, zero) + f32(5e-7)) * half
        chord2 = L.rough_root(L.most(f32(1.0) - t2 * t2, zero) + f32(5e-7)) * half
        right = L.where((e1 <= tip) & (tip <= e2), stretch, L.most(lean * e1 + chord1, lean * e2 + chord2))
        left = L.where((e1 <= -tip) & (-tip <= e2), -stretch, L.least(lean * e1 - chord1, lean * e2 - chord2))
        meets = e1 <= e2
        middle = L.spread(shapes, at + 8)
        left, right = L.where(meets, left + middle, far), L.where(meets, right + middle, -far)
        if flat:
            # The disc of the screen filter is joined to the ellipse.
            near = L.most(L.most(y1, -y2), zero)
            chord = L.rough_root(L.most(L.spread(shapes, at + 9) - near * near, f32(1e-12)))
            meets = near < L.spread(shapes, at + 10)
            left = L.where(meets, L.least(left, -chord), left)
            right = L.where(meets, L.most(right, chord), right)
        left = L.up(L.most(left + L.spread(shapes, at + 11), zero))
        right = L.down(L.least(right + L.spread(shapes, at + 12), f32(width - 1)))
        shows = left <= right
        L.store(columns, 16 + j * 32, L.where(shows, L.down(left * f32(0.25)), f32(32767.0)))
        L.store(columns, 32 + j * 32, L.where(shows, L.down(right * f32(0.25)), f32(-1.0)))
    room = spans.shape[0]
    for j in range(noted):
        k, ty = notes[j, 0], notes[j, 1]
        begin, at = used, u64(16 + j * 32)
        for pair in range(notes[j, 2]):
            u1, l1 = int(columns[at + u64(2 * pair)]), int(columns[at + u64(2 * pair + 1)])
            u2, l2 = int(columns[at + u64(2 * pair + 16)]), int(columns[at + u64(2 * pair + 17)])
            end = max(u2, l2)
            if end >= 0:
                tx = min(u1, l1) >> 1
                run = (end >> 1) - tx + 1
                tile = (ty + pair) * tiles_x + tx
                if before[u64(tile)] == before[u64(tile + run)]:
                    continue
                if used < room:
                    spans[used, 0], spans[used, 1] = tile, run
                    spans[used, 2] = NONE if u2 < 0 else (u1 - 2 * tx) | (u2 - 2 * tx) << 16
                    spans[used, 3] = NONE if l2 < 0 else (l1 - 2 * tx) | (l2 - 2 * tx) << 16
                    change[tile] += 1
                    change[tile + run] -= 1
                used += 1
        counts[k] += used - begin
    return used


@bare
def outline(first, last, table, thin, view, tiles_x, tiles_y, before, spans, counts, change, columns, shapes, notes):
    """Write the runs of tiles that the splats first..last (places in the order of depth) may show in to ``spans``.

    Exact for ellipses, down to the tiles' squares of 4 x 4 pixels: a square is taken if and only if the outline rho <=
    cut meets the rectangle of its pixel centres (but for roundings, which only add). Sixteen rows of squares are done
    at once. Splat k has ``counts[k]`` runs, which follow those of k - 1; a run is (first tile, number of tiles, columns
    of squares in the upper half, in the lower half), see RUN. ``change`` (tiles + 1) gets 1 added where a run begins and
    taken away behind its end. Returns the rows needed; where they are more than fit, nothing of this counts.
    Runs without a tile that is wanted, by ``before`` (tiles + 1), the number of them before each, are left out.
    ``columns`` (16 + 32 NOTES), ``shapes`` (16 NOTES), both float32, and ``notes`` (NOTES, 3) are for work: ellipses are
    noted in pieces of 16 rows of squares, NOTES of them, and then worked off together.
    """
    flat = view[FLAT] > 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    for k in range(16):
        columns[k] = f32(4 * k)
    used, noted = 0, 0
    for k in range(first, last):
        row, slim = table[k], thin[k]
        x0, y0, cut = row[X0], row[Y0], f64(slim[WIDE + CUT]) * (1 + 1e-6)
        counts[k] = 0
        if cut < 0:
            continue
        ellipse = slim[WIDE + BOUNDED] > 0
        A, B, C, h, ex, ey = row[CA], row[CB], row[CC], cut, 0.0, 0.0
        if flat and ellipse:
            ux, uy, vx, vy, wx, wy = row[UX], row[UY], row[VX], row[VY], row[WX], row[WY]
            A = ux * ux + vx * vx - cut * wx * wx
            B = ux * uy + vx * vy - cut * wx * wy
            C = uy * uy + vy * vy - cut * wy * wy
            det = A * C - B * B
            if not (A > 0 and C > 0 and det > 1e-12 * A * C):
                ellipse = False
            else:
                inverse = cut / det
                ex = (C * wx - B * wy) * inverse
                ey = (A * wy - B * wx) * inverse
                h = cut * (1 + wx * ex + wy * ey)
        if not ellipse:
            # In the order of the splats: what has been noted comes first.
            used = _emit(notes, shapes, noted, flat, columns, width, tiles_x, before, spans, used, counts, change)
            noted = 0
            used = _intervals(row, slim, k, width, height, tiles_x, tiles_y, cut, spans, used, counts, change)
            continue
        square = cut / 2 if flat else 0.0
        radius = math.sqrt(square)
        inverse = h / (A * C - B * B)
        top, wide = math.sqrt(A * inverse), math.sqrt(C * inverse)
        tip = -B * wide / C
        low, high = y0 - 0.5 - 1e-4 + min(ey - top, -radius), y0 - 0.5 + 1e-4 + max(ey + top, radius)
        if high < 0 or low > height - 1:
            continue
        r1 = math.ceil(max(low, 0.0)) // 8 * 2
        r2 = int(min(high, height - 1.0)) // 4
        # Float32 from here on: what a far or large splat's numbers are rounded by is added on all sides.
        slack = 1e-4 + 1e-6 * (wide + abs(ex) + abs(x0))
        slack_y = 1e-4 + 5e-7 * (top + abs(ey) + abs(y0))
        half, lean, shrink = math.sqrt(A * h) / A, -B / A, 1 / top
        while r1 <= r2:
            if noted == NOTES:
                used = _emit(notes, shapes, noted, flat, columns, width, tiles_x, before, spans, used, counts, change)
                noted = 0
            at = u64(noted * 16)
            shapes[at], shapes[at + u64(1)], shapes[at + u64(2)] = 4 * r1 + 0.5 - slack_y - y0, ey, top
            shapes[at + u64(3)], shapes[at + u64(4)], shapes[at + u64(5)] = shrink, half, lean
            shapes[at + u64(6)], shapes[at + u64(7)], shapes[at + u64(8)] = wide, tip, ex
            shapes[at + u64(9)], shapes[at + u64(10)] = square, radius
            shapes[at + u64(11)], shapes[at + u64(12)] = x0 - 0.5 - slack, x0 - 0.5 + slack
            shapes[at + u64(13)] = 3 + 2 * slack_y
            notes[noted, 0], notes[noted, 1], notes[noted, 2] = k, r1 // 2, min(8, r2 // 2 - r1 // 2 + 1)
            noted += 1
            r1 += 16
    return _emit(notes, shapes, noted, flat, columns, width, tiles_x, before, spans, used, counts, change)


@bare
def place_cursors(changes, live, cursors, starts):
    """Where each chunk of splats puts its entries: from the changes (chunks, tiles + 1) that its runs make, to
    ``cursors`` of the same shape and ``starts`` (tiles + 1); nothing goes to tiles that are not live."""
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
def _bits(code):
    """A half run, as :func:`outline` writes it, as one bit for each column of squares; up to 31 tiles."""
    begin, end = code & 0xFFFF, code >> 16
    return ((2 << end) - (1 << begin)) if end >= 0 else 0


@inlined
def _columns(code, column):
    """Bits 0 and 1: whether a half run holds this column of squares and the next."""
    begin, end = code & 0xFFFF, code >> 16
    return int((begin <= column) & (column <= end)) | int((begin <= column + 1) & (column + 1 <= end)) << 1


@bare
def scatter(first, last, spans, counts, live, before, cursor, entries):
    """Write the entries of the splats first..last to the tiles that are live, each at its ``cursor``.

    Args:
        spans: their runs, in order. before: (tiles + 1) live tiles before each.
    """
    every = before[-1] == live.shape[0]
    at = u64(0)
    for place in range(first, last):
        for _ in range(counts[place]):
            tile, run = u64(spans[at, 0]), spans[at, 1]
            upper, lower = int(spans[at, 2]), int(spans[at, 3])
            at += u64(1)
            if every and run < 31:
                top, bottom = _bits(upper), _bits(lower) << 2
                for t in range(tile, tile + u64(run)):
                    c = u64(cursor[t])
                    entries[c] = place | ((top & 3) | (bottom & 12)) << PLACE_BITS
                    cursor[t] = int(c) + 1
                    top >>= 2
                    bottom >>= 2
                continue
            if before[tile] == before[tile + u64(run)]:
                continue
            for k in range(run):
                t = tile + u64(k)
                if every or live[t]:
                    bits = _columns(upper, 2 * k) | _columns(lower, 2 * k) << 2
                    entries[u64(cursor[t])] = place | bits << PLACE_BITS
                    cursor[t] += 1


@inlined
def _place(work, at, table, thin, i, ox, oy, flat):
    """Row i of the table as float32 to ``work`` from ``at`` on, its coefficients moved to the tile's middle (ox,
    oy)."""
    i, b = u64(i), u64(at)
    L.narrow(work, at, table, i * u64(COLUMNS))
    L.store(work, at + WIDE, L.load(thin, i * u64(2 * COLUMNS) + u64(2 * WIDE)))
    work[b + u64(VALUES + 2)] = thin[i, u64(WIDE + VALUES + 2)]
    sx, sy = ox - table[i, X0], oy - table[i, Y0]
    work[b + u64(X0)], work[b + u64(Y0)] = sx, sy
    if flat:
        work[b + u64(U0)] = table[i, U0] + table[i, UX] * sx + table[i, UY] * sy
        work[b + u64(V0)] = table[i, V0] + table[i, VX] * sx + table[i, VY] * sy
        work[b + u64(W0)] = table[i, W0] + table[i, WX] * sx + table[i, WY] * sy
        work[b + u64(WX)], work[b + u64(WY)] = table[i, WX], table[i, WY]
    else:
        work[b + u64(RXY)], work[b + u64(RYY)] = table[i, RXY], table[i, RYY]


@inlined
def _shade(work, at, x, y, flat, peak):
    """Of a splat at 16 pixels: where it is drawn, and its alpha (anything elsewhere), z and 1 / z."""
    low, high = L.spread(work, at + ZLO), L.spread(work, at + ZHI)
    ex, ey = x + L.spread(work, at + X0), y + L.spread(work, at + Y0)
    if flat:
        w = L.spread(work, at + W0) + L.spread(work, at + WX) * x + L.spread(work, at + WY) * y
        u = L.spread(work, at + U0) + L.spread(work, at + UX) * x + L.spread(work, at + UY) * y
        v = L.spread(work, at + V0) + L.spread(work, at + VX) * x + L.spread(work, at + VY) * y
        r = L.inverse(w)
        # Below 1e-30 r may be NaN, and z would be farther than anything.
        ahead = f32(1e-30) < w
        meets = ahead & (w <= L.spread(work, at + WMAX))
        screen = (ex * ex + ey * ey) * L.spread(work, at + FILTER) + L.spread(work, at + SHUT)
        rho = L.least(L.where(meets, (u * u + v * v) * (r * r), f32(HUGE)), screen)
        z = L.where(ahead, L.least(L.most(L.spread(work, at + Z0) * r, low), high), high)
        iz = L.least(L.most(w * L.spread(work, at + IZ0), L.spread(work, at + IZHI)), L.spread(work, at + IZLO))
    else:
        rho = (L.spread(work, at + CA) * ex + L.spread(work, at + CB) * ey * f32(2.0)) * ex
        rho = L.most(rho + L.spread(work, at + CC) * ey * ey, f32(0.0))
        z, iz = low, L.spread(work, at + IZLO)
        if peak:
            along = L.spread(work, at + LX) * ex + L.spread(work, at + LY) * ey + f32(1.0)
            form = (L.spread(work, at + RXX) * ex + L.spread(work, at + RXY) * ey * f32(2.0)) * ex
            across = along * along + L.most(form + L.spread(work, at + RYY) * ey * ey, f32(0.0))
            z = L.spread(work, at + Z0) * along * L.inverse(L.most(across, f32(1e-30)))
            z = L.least(L.most(z, low), high)
            iz = L.inverse(z)
    inside = rho <= L.spread(work, at + CUT)
    alpha = L.least(L.spread(work, at + OPACITY) * _gauss(rho), f32(K.ALPHA_MAX))
    return inside, alpha, z, iz


@bare
def forward(first, last, visit, view, tiles_x, live, starts, entries, table, thin, features, background, ndc_scale,
            color, alpha, depth, median, normal, l1, l2, state, done, tested_in, shaded_in, drawn_in, full, seen, buf,
            work, picks):  # fmt: skip
    """Composite those of the tiles visit[first:last] that are live.

    A tile's 64 pixels are four squares of 16. Splats come in blocks: their coefficients are laid out once for the tile;
    each square then picks those that its list says may show in it, and composites them with its sums in registers.

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
    for visited in range(first, last):
        t = visit[visited]
        if not live[t]:
            continue
        begin, end = starts[t], starts[t + 1]
        tested, shaded, contributing = 0, 0, 0
        ty, tx = t // tiles_x, t % tiles_x
        ox, oy = tx * TILE + 4.0, ty * TILE + 4.0
        rows, cols = min(TILE, height - ty * TILE), min(TILE, width - tx * TILE)
        for r in range(rows):
            # They will be written when the tile is done: the memory has time until then.
            to = (ty * TILE + r) * width + tx * TILE
            _prefetch_to_write(alpha, to)
            _prefetch_to_write(depth, to)
            _prefetch_to_write(median, to)
            _prefetch_to_write(l1, to)
            _prefetch_to_write(l2, to)
            _prefetch_to_write(normal, 3 * to)
            _prefetch_to_write(normal, 3 * to + 3 * cols - 1)
            _prefetch_to_write(color, channels * to)
            _prefetch_to_write(color, channels * (to + cols) - 1)
            if keep:
                for k in range(5):
                    _prefetch_to_write(state, k * height * width + to)
        for p in range(0, PIXELS, 16):
            L.store(buf, TT * 64 + p, f32(1.0))
        if rows < TILE or cols < TILE:
            # Pixels outside of the image are opaque from the start: they take no part and never delay the stop.
            for p in range(PIXELS):
                if not ((buf[XS * 64 + p] + f32(4.0) < cols) & (buf[YS * 64 + p] + f32(4.0) < rows)):
                    buf[TT * 64 + p] = f32(0.0)
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
                ahead = entries[min(e + k + AHEAD, end - 1)] & PLACE
                _prefetch(table, ahead * COLUMNS)
                _prefetch(table, ahead * COLUMNS + 8)
                _prefetch(table, ahead * COLUMNS + 16)
                entry = entries[e + k]
                picks[u64(BLOCK + k)] = entry >> PLACE_BITS
                _place(work, k * ROW, table, thin, entry & PLACE, ox, oy, flat)
                work[u64(k * ROW + STEP)] = f32(e - begin + k + 1)
                L.store(work, WEIGHTS + k * 16, f32(0.0))
            for q in range(4):
                if ended >> q & 1:
                    continue
                s = q * 16
                x, y = L.load(buf, XS * 64 + s), L.load(buf, YS * 64 + s)
                picked = 0
                for k in range(size):
                    picks[u64(picked)] = k
                    picked += picks[u64(BLOCK + k)] >> q & 1
                T, A, D = L.load(buf, TT * 64 + s), L.load(buf, AA * 64 + s), L.load(buf, DD * 64 + s)
                sum1, sum2, pairs = L.load(buf, M1 * 64 + s), L.load(buf, M2 * 64 + s), L.load(buf, L1 * 64 + s)
                n0, n1, n2 = L.load(buf, NX * 64 + s), L.load(buf, NY * 64 + s), L.load(buf, NZ * 64 + s)
                c0, c1, c2 = L.load(buf, C_0 * 64 + s), L.load(buf, C_1 * 64 + s), L.load(buf, C_2 * 64 + s)
                zref, iref = L.load(buf, ZREF * 64 + s), L.load(buf, IREF * 64 + s)
                med, medk, final = L.load(buf, MED * 64 + s), L.load(buf, MEDK * 64 + s), L.load(buf, LAST * 64 + s)
                # Once no pixel is, what only the first splats of a pixel decide is over: for a block at a time, so that
                # it costs no branch that goes both ways.
                undecided = L.some(half < T)
                alive = stop < T
                used = 0
                while used < picked:
                    k = picks[u64(used)]
                    b = k * ROW
                    inside, a, z, iz = _shade(work, b, x, y, flat, peak)
                    hit = inside & alive
                    w = L.where(hit, a * T, f32(0.0))
                    step = L.spread(work, b + STEP)
                    if keep:
                        final = L.where(hit, step, final)
                    if undecided:
                        opens, first_hit = hit & (half < T), hit & (f32(1.0) <= T)
                        med, medk = L.where(opens, z, med), L.where(opens, step, medk)
                        # Depths are summed relative to the pixel's first, which keeps the digits of thin layers far
                        # away.
                        zref, iref = L.where(first_hit, z, zref), L.where(first_hit, iz, iref)
                    z, m = z - zref, iz - iref
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
                    drawn = L.count(hit)
                    contributing += drawn
                    shaded += 16 if drawn > 0 else 0
                    used += 1
                    alive = stop < T
                    if not L.some(alive):
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
                tested += 16 * used
                for c in range(3, channels):
                    sums = L.load(buf, (C_0 + c) * 64 + s)
                    for k in range(used):
                        f = features[u64(entries[e + picks[u64(k)]] & PLACE), u64(c)]
                        sums = sums + L.load(work, SHARES + k * 16) * f
                    L.store(buf, (C_0 + c) * 64 + s, sums)
            for k in range(0, size, 16):
                b = WEIGHTS + k * 16
                sums = L.totals(
                    L.load(work, b), L.load(work, b + 16), L.load(work, b + 32), L.load(work, b + 48),
                    L.load(work, b + 64), L.load(work, b + 80), L.load(work, b + 96), L.load(work, b + 112),
                    L.load(work, b + 128), L.load(work, b + 144), L.load(work, b + 160), L.load(work, b + 176),
                    L.load(work, b + 192), L.load(work, b + 208), L.load(work, b + 224), L.load(work, b + 240),
                )  # fmt: skip
                if k + 16 <= size:
                    L.store(seen, e + k, sums)
                else:
                    L.store(work, SHARES, sums)
                    for j in range(size - k):
                        seen[u64(e + k + j)] = work[u64(SHARES + j)]
            e += size
        full[t] = ended == 15
        done[t] = reached if ended == 15 else end - begin
        tested_in[t] = tested
        shaded_in[t] = shaded
        drawn_in[t] = contributing
        for p in range(0, PIXELS, 16):
            A, a1 = L.load(buf, AA * 64 + p), L.load(buf, M1 * 64 + p)
            covered = f32(0.0) < A
            inverse = L.where(covered, L.inverse(A), f32(0.0))
            spread = L.most(L.load(buf, M2 * 64 + p) - a1 * a1 * inverse, f32(0.0))
            L.store(buf, AL * 64 + p, spread)
            L.store(buf, M2 * 64 + p, A * spread * f32(ndc_scale))
            L.store(buf, M1 * 64 + p, L.load(buf, IREF * 64 + p) + a1 * inverse)
            mean = L.load(buf, ZREF * 64 + p) + L.load(buf, DD * 64 + p) * inverse
            L.store(buf, DD * 64 + p, L.where(covered, mean, f32(np.nan)))
            L.store(buf, MED * 64 + p, L.where(covered, L.load(buf, MED * 64 + p), f32(np.nan)))
            L.store(buf, L1 * 64 + p, L.load(buf, L1 * 64 + p) * f32(2.0))
            through = f32(1.0) - A
            for c in range(channels):
                at = (C_0 + c) * 64 + p
                L.store(buf, at, L.load(buf, at) + through * background[c])
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
def settle(ended, starts, done, entries, seen, weight, offset, places, kept):
    """Of the tiles that have ``ended``: add the entries' weights to their splats' (by place in the order of depth),
    and, if there is room in ``kept``, keep what was worked off; tile t's from places[t] - ``offset`` on.

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
                    kept[at] = entries[u64(e)]
                    at += 1


# Slots of the backward pass: gradients of the loss in what a pixel sums up, and sums over the splats behind.
BXS, BYS = 0, 1  # as in the forward pass
(BT, BLAST, BMEDK, BZREF, BIREF, GW, GD, GM2, GL1, GMED, TOTA, BEHA, BEHD, BEHQ, GNX, GNY, GNZ, GC0, GC1,
 GC2) = range(2, 22)  # fmt: skip
BACK_SLOTS = 22
SUMS = ROW  # in the backward pass's work, behind the splat's row: what is summed over the tile
BACK_WORK = SUMS + 32


@inlined
def _rows_flat(work, row, rows, sx, sy, line):
    """A 2D splat's row of gradients from its sums; ``row`` is its row of the table, moved by (sx, sy) to the tile."""
    b = u64(SUMS)
    tu, tux, tuy = f64(work[b + u64(7)]), f64(work[b + u64(8)]), f64(work[b + u64(9)])
    tv, tvx, tvy = f64(work[b + u64(10)]), f64(work[b + u64(11)]), f64(work[b + u64(12)])
    tw, twx, twy = f64(work[b + u64(13)]), f64(work[b + u64(14)]), f64(work[b + u64(15)])
    rows[line, X0] = -(row[UX] * tu + row[VX] * tv + row[WX] * tw) - work[b + u64(16)]
    rows[line, Y0] = -(row[UY] * tu + row[VY] * tv + row[WY] * tw) - work[b + u64(17)]
    rows[line, UX], rows[line, UY], rows[line, U0] = tux + sx * tu, tuy + sy * tu, tu
    rows[line, VX], rows[line, VY], rows[line, V0] = tvx + sx * tv, tvy + sy * tv, tv
    rows[line, WX], rows[line, WY], rows[line, W0] = twx + sx * tw, twy + sy * tw, tw
    rows[line, Z0], rows[line, ZLO], rows[line, ZHI] = work[b + u64(18)], work[b + u64(19)], work[b + u64(20)]


@inlined
def _rows_round(work, row, rows, line):
    """A 3D splat's row of gradients from its sums."""
    b = u64(SUMS)
    dx, dy, xx, xy, yy = (
        f64(work[b + u64(7)]), f64(work[b + u64(8)]), work[b + u64(9)], work[b + u64(10)], work[b + u64(11)],
    )  # fmt: skip
    gl, rx, ry = f64(work[b + u64(15)]), f64(work[b + u64(18)]), f64(work[b + u64(19)])
    rows[line, X0] = row[CA] * dx + row[CB] * dy - gl * row[LX] - 2 * (row[RXX] * rx + row[RXY] * ry)
    rows[line, Y0] = row[CB] * dx + row[CC] * dy - gl * row[LY] - 2 * (row[RXY] * rx + row[RYY] * ry)
    rows[line, CA], rows[line, CB], rows[line, CC] = f32(-0.5) * xx, -xy, f32(-0.5) * yy
    rows[line, LX], rows[line, LY] = work[b + u64(16)], work[b + u64(17)]
    rows[line, RXX], rows[line, RXY] = work[b + u64(20)], f32(2.0) * work[b + u64(21)]
    rows[line, RYY], rows[line, 10] = work[b + u64(22)], f32(0.0)
    rows[line, Z0], rows[line, ZLO], rows[line, ZHI] = work[b + u64(14)], work[b + u64(12)], work[b + u64(13)]


@bare
def backward(first, last, visit, view, tiles_x, starts, done, entries, table, thin, features, background, ndc_scale,
             alpha, depth, state, g_color, g_alpha, g_depth, g_median, g_normal, g_l1, g_l2, g_weight, place, rows,
             buf, work):  # fmt: skip
    """Gradients of the tiles visit[first:last], one row of ``rows`` for each entry worked off, from place[tile] on.

    A row holds the gradient in the first GRADIENTS columns of the splat's ``table`` row, then in its normal and
    values. Splats are visited back to front: the transmittance before each is recovered by division from what the
    forward pass left. A splat's sums stay in registers while its squares go by.
    """
    flat, peak = view[FLAT] > 0, view[CENTER] == 0
    width, height = int(view[WIDTH]), int(view[HEIGHT])
    channels = background.shape[0]
    scale = f32(ndc_scale)
    zero, one, two = f32(0.0), f32(1.0), f32(2.0)
    for p in range(PIXELS):
        buf[BXS * 64 + p] = f32(p // 16 % 2 * 4 + p % 4) - f32(3.5)
        buf[BYS * 64 + p] = f32(p // 32 * 4 + p // 4 % 4) - f32(3.5)
    for visited in range(first, last):
        t = visit[visited]
        begin, count = starts[t], done[t]
        if count == 0:
            continue
        ty, tx = t // tiles_x, t % tiles_x
        ox, oy = tx * TILE + 4.0, ty * TILE + 4.0
        cols, tall = min(TILE, width - tx * TILE), min(TILE, height - ty * TILE)
        for p in range(BT * 64, buf.shape[0], 16):
            L.store(buf, p, zero)
        for r in range(tall):
            for k in range(cols):
                p = u64(r // 4 * 32 + k // 4 * 16 + r % 4 * 4 + k % 4)
                y, x = u64(ty * TILE + r), u64(tx * TILE + k)
                A = alpha[y, x]
                if state[1, y, x] == 0:
                    continue
                buf[u64(BT * 64) + p] = state[0, y, x]
                buf[u64(BLAST * 64) + p] = state[1, y, x]
                buf[u64(BMEDK * 64) + p] = state[2, y, x]
                # Relative to the means, the first moments vanish, and with them most terms.
                buf[u64(BZREF * 64) + p] = depth[y, x]
                buf[u64(BIREF * 64) + p] = state[3, y, x]
                gd = g_depth[y, x] / A
                g2 = scale * g_l2[y, x]
                gw = g_alpha[y, x] + g2 * state[4, y, x]
                for c in range(channels):
                    gw -= g_color[y, x, u64(c)] * background[c]
                    buf[u64((GC0 + c) * 64) + p] = g_color[y, x, u64(c)]
                for c in range(3):
                    buf[u64((GNX + c) * 64) + p] = g_normal[y, x, u64(c)]
                buf[u64(GW * 64) + p] = gw
                buf[u64(GD * 64) + p] = gd
                buf[u64(GM2 * 64) + p] = g2 * A
                buf[u64(GL1 * 64) + p] = two * g_l1[y, x]
                buf[u64(GMED * 64) + p] = g_median[y, x]
                buf[u64(TOTA * 64) + p] = A
        for back in range(count):
            e = begin + count - 1 - back
            entry = entries[e]
            i = entry & PLACE
            ahead = entries[max(e - 8, begin)] & PLACE
            _prefetch(table, ahead * COLUMNS)
            _prefetch(table, ahead * COLUMNS + 8)
            _prefetch(table, ahead * COLUMNS + 16)
            _place(work, 0, table, thin, i, ox, oy, flat)
            line = place[t] + count - 1 - back
            step = f32(e - begin + 1)
            gi = g_weight[i]
            if channels > 3:
                for c in range(3, channels):
                    rows[line, GRADIENTS + 3 + c] = zero
            s0 = s1 = s2 = s3 = s4 = s5 = L.spread(work, X0) * zero
            b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = b8 = b9 = s0
            b10 = b11 = b12 = b13 = b14 = b15 = b16 = s0
            hits = 0
            for q in range(4):
                if not (entry >> PLACE_BITS) >> q & 1:
                    continue
                s = q * 16
                x, y = L.load(buf, BXS * 64 + s), L.load(buf, BYS * 64 + s)
                inside, a, z, iz = _shade(work, 0, x, y, flat, peak)
                hit = inside & (step <= L.load(buf, BLAST * 64 + s))
                if not L.some(hit):
                    continue
                hits += 1
                a = L.where(hit, a, zero)
                rest = L.inverse(one - a)
                T = L.load(buf, BT * 64 + s) * rest
                w = a * T
                dz, m = z - L.load(buf, BZREF * 64 + s), iz - L.load(buf, BIREF * 64 + s)
                gn0, gn1, gn2 = L.load(buf, GNX * 64 + s), L.load(buf, GNY * 64 + s), L.load(buf, GNZ * 64 + s)
                gc0, gc1, gc2 = L.load(buf, GC0 * 64 + s), L.load(buf, GC1 * 64 + s), L.load(buf, GC2 * 64 + s)
                gd, gl1 = L.load(buf, GD * 64 + s), L.load(buf, GL1 * 64 + s)
                gm = L.load(buf, GM2 * 64 + s) * m
                behind_a, behind_d = L.load(buf, BEHA * 64 + s), L.load(buf, BEHD * 64 + s)
                behind_q = L.load(buf, BEHQ * 64 + s)
                g = L.load(buf, GW * 64 + s) + gi + gd * dz + gm * m
                g = g + gn0 * L.spread(work, NORMAL) + gn1 * L.spread(work, NORMAL + 1)
                g = g + gn2 * L.spread(work, NORMAL + 2) + gc0 * L.spread(work, VALUES)
                g = g + gc1 * L.spread(work, VALUES + 1) + gc2 * L.spread(work, VALUES + 2)
                if channels > 3:
                    for c in range(3, channels):
                        upstream = L.load(buf, (GC0 + c) * 64 + s)
                        g = g + upstream * features[u64(i), u64(c)]
                        rows[line, GRADIENTS + 3 + c] += L.total(w * upstream)
                # In front minus behind, of the weights and of the weighted depths.
                wz = w * dz
                lean = L.load(buf, TOTA * 64 + s) - w - two * behind_a
                g = g + gl1 * (dz * lean + wz + two * behind_d)
                in_z = w * (gd + gl1 * lean)
                in_z = in_z + L.where(step == L.load(buf, BMEDK * 64 + s), L.load(buf, GMED * 64 + s), zero)
                # What 1 / z is blamed for, as a gradient in z.
                in_z = in_z - two * w * gm * iz * iz
                in_a = L.where(hit & (a < f32(K.ALPHA_MAX)), (T * g - behind_q * rest) * a, zero)
                L.store(buf, BT * 64 + s, T)
                L.store(buf, BEHQ * 64 + s, behind_q + w * g)
                L.store(buf, BEHA * 64 + s, behind_a + w)
                L.store(buf, BEHD * 64 + s, behind_d + wz)
                s0, s1, s2 = s0 + w * gn0, s1 + w * gn1, s2 + w * gn2
                s3, s4, s5 = s3 + w * gc0, s4 + w * gc1, s5 + w * gc2
                b0 = b0 + in_a
                ex, ey = x + L.spread(work, X0), y + L.spread(work, Y0)
                low, high, z0 = L.spread(work, ZLO), L.spread(work, ZHI), L.spread(work, Z0)
                if flat:
                    # As in _shade.
                    v_w = L.spread(work, W0) + L.spread(work, WX) * x + L.spread(work, WY) * y
                    u = L.spread(work, U0) + L.spread(work, UX) * x + L.spread(work, UY) * y
                    v = L.spread(work, V0) + L.spread(work, VX) * x + L.spread(work, VY) * y
                    r = L.inverse(v_w)
                    front = f32(1e-30) < v_w
                    screen = (ex * ex + ey * ey) * L.spread(work, FILTER) + L.spread(work, SHUT)
                    meets = front & (v_w <= L.spread(work, WMAX)) & ((u * u + v * v) * (r * r) <= screen)
                    # Selected, not multiplied by 0: r may be infinite.
                    rs = L.where(meets, r, zero)
                    u, v = u * rs, v * rs
                    blame = in_a * rs
                    gu, gv = blame * u, blame * v
                    gw = gu * u + gv * v
                    screened = L.where(meets, zero, in_a) * L.spread(work, FILTER)
                    meant = z0 * r
                    over = L.flipped(front) | (high < meant)
                    under = front & (meant <= low)
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
            L.store(work, SUMS, L.totals(s0, s1, s2, s3, s4, s5, b0, b1, b2, b3, b4, b5, b6, b7, b8, b9))
            L.store(work, SUMS + 16, L.totals8(b10, b11, b12, b13, b14, b15, b16, b16))
            for c in range(6):
                rows[line, GRADIENTS + c] = work[u64(SUMS + c)]
            rows[line, OPACITY] = work[u64(SUMS + 6)] / work[u64(OPACITY)]
            if flat:
                _rows_flat(work, table[i], rows, f64(work[u64(X0)]), f64(work[u64(Y0)]), line)
            else:
                _rows_round(work, table[i], rows, line)


@jit
def reduce_rows(low, high, first, last, visit, starts, done, entries, place, rows, total):
    """Add the rows of the tiles visit[first:last] to those of the splats low..high in ``total``, in their order."""
    columns = rows.shape[1]
    for visited in range(first, last):
        t = visit[visited]
        for k in range(done[t]):
            i = entries[starts[t] + k] & PLACE
            if low <= i < high:
                row = place[t] + k
                for c in range(columns):
                    total[i, c] += rows[row, c]


@jit
def project_backward(first, last, order, view, m, q, sizes, o, values, channels, table, total,
                     gm, gq, gs, go, gv, g_view):  # fmt: skip
    """Gradients in the parameters of the splats order[first:last] from those in their projection, ``total``.

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
        _prefetch(m, later * 3)
        _prefetch(q, later * 4)
        _prefetch(sizes, later * sizes.shape[1])
        _prefetch(values, later * values.shape[1])
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
        for k in range(3):
            gm[i, k] = R[0, k] * gc[0] + R[1, k] * gc[1] + R[2, k] * gc[2]
        for k in range(sizes.shape[1]):
            gs[i, k] = g_s[k]
        for r in range(3):
            gt[r] += gc[r]
            for k in range(3):
                gR[r, k] += gc[r] * at[k]
        w, x, y, z = f64(q[i, 0]) / size, f64(q[i, 1]) / size, f64(q[i, 2]) / size, f64(q[i, 3]) / size
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
