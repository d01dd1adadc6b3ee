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
SIDE = TILE // 4  # squares of 4 x 4 pixels along a tile
SQUARES = SIDE * SIDE
EVERY = (1 << SQUARES) - 1  # a bit for each
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
FILTER, WMAX, CUT = 15, 17, 18  # whether there is a screen filter; nothing shows where W > WMAX, or if CUT < 0
IZ0, WTOP, WLOW = 19, 20, 21  # 2D: 1 / z = IZ0 W, with W no more than WTOP and no less than WLOW
IZLO = 20  # 3D: 1 / ZLO
NORMAL, VALUES = 22, 25  # world normal, and the first three channels
COLUMNS = 24
F11, F12, F22 = 20, 21, 22  # 3D: rho = (F11 dx + F12 dy)^2 + (F22 dy)^2, float64 behind the others; no cancellation

# A block of splats as the forward pass works on them: for each a row of float32, with the table's columns and its
# place among the tile's; then its weights at the 16 pixels of all squares, and of the square at hand; then what depends on
# where pixels are counted from, at the middle of the quarter of the tile at hand. This is kept in float64 too, for the middle
# of the tile, followed by its slopes in x and y: 8 numbers each.
BLOCK = 32
AHEAD = 32
ROW = 32
STEP = 28
WEIGHTS = BLOCK * ROW
SHARES = WEIGHTS + BLOCK * 16
PLACED = SHARES + BLOCK * 16
WORK = PLACED + BLOCK * 8
EXACT = 24
AT_U, AT_V, AT_W, SCREEN_X, SCREEN_Y, AT_X, AT_Y = range(7)  # SCREEN: X and Y times the root of 2
QUARTER = 0x33  # its squares, as bits, from its first one on
CORNER = 10  # the bits that the number of a square has in common with its quarter's first one

# An entry of a tile's list is a splat's place in the order of depth, and above it one bit for each of the tile's
# squares of 4 x 4 pixels that the splat may show in.
PLACE_BITS = 32
PLACE = (1 << PLACE_BITS) - 1
WEIGHT_UNIT = 2.0**-36
# A run of tiles: the first one, how many, and its first column of squares; from CODES on, for each row of squares, its
# columns as first | last << 16.
RUN, CODES = 8, 4
NOTES = 64

# Slots of a tile's buffer, each PIXELS floats.
(XS, YS, AL, ZZ, IZ, TT, AA, DD, M1, M2, L1, MED, MEDK, LAST, ZREF, IREF, WW, NX, NY, NZ, C_0, C_1,
 C_2) = range(23)  # fmt: skip
SLOTS = 23  # and one more for each channel from the fourth on

HUGE = 1e30
FAR = 1e15  # its square is HUGE
ROOT2 = math.sqrt(2)
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
    # In pairs rather than in a row: the products wait less for one another.
    g = f * f
    return L.times_power(((f * E5 + E4) * g + (f * E3 + E2)) * g + (f * E1 + f32(1.0)), shifted)


@inlined
def _root(x):
    """The square root of eight float64 >= 0, to the last bits; NaN where they are negative or infinite."""
    return x * L.inverse_root(L.most(x, 1e-300))


@inlined
def _log(x):
    """The natural logarithm of eight float64, to 1e-12, for x > 0 that are not denormal: with x = f 2^k and f about 1,
    2 artanh((f - 1) / (f + 1)) + k log 2."""
    f, k = L.fraction(x), L.exponent(x)
    large = f > 1.4142135623730951
    f, k = L.where(large, f * 0.5, f), L.where(large, k + 1.0, k)
    z = (f - 1.0) / (f + 1.0)
    s = z * z
    series = s * (s * (s * (s * (s * (s * (s * (1 / 15) + 1 / 13) + 1 / 11) + 1 / 9) + 1 / 7) + 1 / 5) + 1 / 3) + 1.0
    return k * 0.6931471805599453 + z * series * 2.0


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


# A splat's outline, as :func:`project` leaves it for :func:`outline`: a row of 16 float32, in pixels from (X0, Y0). Where its
# first row of squares begins, less Y0 and what is above that row; the ellipse's middle in y, top, 1 / top; half of the chord
# through its middle, how far the chords' middles move to the right a row, half width, height of its right tip, middle in x;
# the squared radius of the filter's disc, and the radius; what is added to a left and to a right end, for its place in the
# picture; a row's height. Then the first and the last row of squares: none if the last is above the first, and no ellipse
# if the first is negative.
(SHAPE_Y, SHAPE_EY, SHAPE_TOP, SHAPE_SHRINK, SHAPE_HALF, SHAPE_LEAN, SHAPE_WIDE, SHAPE_TIP, SHAPE_EX, SHAPE_SQUARE,
 SHAPE_RADIUS, SHAPE_LEFT, SHAPE_RIGHT, SHAPE_HIGH, SHAPE_FIRST, SHAPE_LAST) = range(16)  # fmt: skip

# What eight splats are worked off in, rows of eight: in float64 their parameters, their centres in camera axes, and the
# first columns of their rows of the table; in float32 the table's other columns, then the outline's.
IN_Q, IN_S, IN_O, IN_C, OUT = 3, 7, 10, 11, 14
FACTOR = 8 * (OUT + WIDE)
SETUP = FACTOR + 24
SHAPES = VALUES - WIDE
SETUP_NARROW = 8 * (SHAPES + 16)


@bare
def project(
    first, last, order, view, m, q, s, o, values, channels, wanted, table, thin, features, shapes, work, slim, Y
):
    """The splats order[first:last] to the rows first..last of the table, and of ``features`` (M, channels) if there
    are more than three; and their outlines to the rows 0..last - first of ``shapes`` (., 16).

    ``wanted`` (tiles_y + 1, tiles_x + 1) holds how many tiles are wanted above and left of each tile's corner: a splat
    that cannot show in a wanted one gets a negative CUT and no outline, and the rest of its row is left as it was.
    ``work`` (SETUP), ``slim`` (SETUP_NARROW) and ``Y`` (16) are for work. Eight splats are done at once, in float64.
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
            _prefetch(m, later * 3)
            _prefetch(q, later * 4)
            _prefetch(s, later * s.shape[1])
            _prefetch(o, later)
            _prefetch(values, later * values.shape[1])
            i, at = u64(order[min(j + lane, last - 1)]), u64(lane)
            for k in range(3):
                work[at + u64(8 * k)] = m[i, u64(k)]
            for k in range(4):
                work[at + u64(8 * (IN_Q + k))] = q[i, u64(k)]
            work[at + u64(8 * IN_S)], work[at + u64(8 * IN_S + 8)] = s[i, u64(0)], s[i, u64(1)]
            work[at + u64(8 * IN_S + 16)] = 0.0 if flat else s[i, u64(s.shape[1] - 1)]
            work[at + u64(8 * IN_O)] = o[i]
        m0, m1, m2 = L.load8(work, 0), L.load8(work, 8), L.load8(work, 16)
        s0, s1, s2 = L.load8(work, 8 * IN_S), L.load8(work, 8 * IN_S + 8), L.load8(work, 8 * IN_S + 16)
        c0 = m0 * R00 + m1 * R01 + m2 * R02 + view[TX]
        c1 = m0 * R10 + m1 * R11 + m2 * R12 + view[TX + 1]
        c2 = m0 * R20 + m1 * R21 + m2 * R22 + view[TX + 2]
        ic = L.inverse(c2)
        ahead = near < c2
        at_x, at_y = (c0 * fx + c1 * skew) * ic + cx, c1 * fy * ic + cy
        kept = 255 >> (8 - here)
        inside = L.as_bits(ahead & (at_x > 0.0) & (at_x < width) & (at_y > 0.0) & (at_y < height)) if every else 0
        if kept & ~inside:
            L.store8(work, 8 * IN_C, c0)
            L.store8(work, 8 * IN_C + 8, c1)
            L.store8(work, 8 * IN_C + 16, c2)
            for lane in range(here):
                if inside >> lane & 1:
                    continue
                at = u64(lane)
                size = max(work[at + u64(8 * IN_S)], work[at + u64(8 * IN_S + 8)], work[at + u64(8 * IN_S + 16)])
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
            gx, gy = ((a00 - px * a20) * fx + (a10 - py * a20) * skew) * scale, (a10 - py * a20) * fy * scale
            sxx, sxy, syy = gx * gx, gx * gy, gy * gy
            scale = s1 * ic
            gx, gy = ((a01 - px * a21) * fx + (a11 - py * a21) * skew) * scale, (a11 - py * a21) * fy * scale
            sxx, sxy, syy = sxx + gx * gx, sxy + gx * gy, syy + gy * gy
            scale = s2 * ic
            gx, gy = ((a02 - px * a22) * fx + (a12 - py * a22) * skew) * scale, (a12 - py * a22) * fy * scale
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
                # Denominator minus l^2: positive semidefinite, so the difference of large numbers is taken here in
                # float64.
                xx, xy, yy = scale * c2 * S00 - gx * gx, scale * c2 * S01 - gx * gy, scale * c2 * S11 - gy * gy
                L.store8(work, 8 * (OUT + LX), gx * kx)
                L.store8(work, 8 * (OUT + LY), gy * ky + gx * kxy)
                L.store8(work, 8 * (OUT + RXX), xx * (kx * kx))
                L.store8(work, 8 * (OUT + RXY), (xx * kxy + xy * ky) * kx)
                L.store8(work, 8 * (OUT + RYY), xx * (kxy * kxy) + xy * (2 * kxy * ky) + yy * (ky * ky))
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
            # Where it shows by its intersection, z lies between these; 1e-30: if its centre is not in front, W must
            # be positive, else it may be anything, see _shade.
            L.store8(slim, 8 * (WTOP - WIDE), depth * L.inverse(low))
            L.store8(slim, 8 * (WLOW - WIDE), L.where(ahead, depth * L.inverse(high), 1e-30))
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
        # Float32 from here on: what a far or large splat's numbers are rounded by is added on all sides.
        slack = (wide + L.magnitude(ex) + L.magnitude(x0)) * 1e-6 + 1e-4
        slack_y = (top + L.magnitude(ey) + L.magnitude(y0)) * 5e-7 + 1e-4
        shows = drawn & (end >= 0.0) & (begin <= height - 1.0)
        row1 = L.down(L.up(L.most(begin, 0.0)) * (1 / TILE)) * SIDE
        row2 = L.down(L.least(end, height - 1.0) * 0.25)
        # What is drawn but is no ellipse begins in row -1.
        row1, row2 = L.where(ellipse | L.flipped(drawn), row1, -1.0), L.where(shows, row2, -2.0)
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
                    _harmonics(degree, work[at], work[at + u64(8)], work[at + u64(16)], Y)
                for k in range(3):
                    total = 0.5 + C0 * values[i, u64(k)]
                    for b in range(1, (degree + 1) ** 2):
                        total += Y[u64(b)] * values[i, u64(3 * b + k)]
                    thin[to, u64(WIDE + VALUES + k)] = max(total, 0.0)
            else:
                for k in range(3):
                    thin[to, u64(WIDE + VALUES + k)] = values[i, u64(k)] if k < channels else f32(0.0)
                if channels > 3:
                    for k in range(channels):
                        features[to, u64(k)] = values[i, u64(k)]


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
def _emit(notes, pieces, noted, flat, steps, codes, width, tiles_x, before, spans, used, counts, change):
    """The runs of the pieces of ellipses that are noted; see :func:`outline`.

    In steps, each for all notes: what finds the columns waits for no branch, and the branches (how many rows has a
    splat) wait for no root or division.
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
        e1, e2 = L.most(y1 - L.spread(pieces, at + SHAPE_EY), -top), L.least(y2 - L.spread(pieces, at + SHAPE_EY), top)
        t1, t2 = e1 * shrink, e2 * shrink
        # 5e-7: what 1 - t^2 may be rounded by; at the tips its root is much.
        chord1 = L.rough_root(L.most(f32(1.0) - t1 * t1, zero) + f32(5e-7)) * half
        chord2 = L.rough_root(L.most(f32(1.0) - t2 * t2, zero) + f32(5e-7)) * half
        right = L.where((e1 <= tip) & (tip <= e2), stretch, L.most(lean * e1 + chord1, lean * e2 + chord2))
        left = L.where((e1 <= -tip) & (-tip <= e2), -stretch, L.least(lean * e1 - chord1, lean * e2 - chord2))
        meets = e1 <= e2
        middle = L.spread(pieces, at + SHAPE_EX)
        left, right = L.where(meets, left + middle, far), L.where(meets, right + middle, -far)
        if flat:
            # The disc of the screen filter is joined to the ellipse.
            near = L.most(L.most(y1, -y2), zero)
            chord = L.rough_root(L.most(L.spread(pieces, at + SHAPE_SQUARE) - near * near, f32(1e-12)))
            meets = near < L.spread(pieces, at + SHAPE_RADIUS)
            left = L.where(meets, L.least(left, -chord), left)
            right = L.where(meets, L.most(right, chord), right)
        left = L.up(L.most(left + L.spread(pieces, at + SHAPE_LEFT), zero))
        right = L.down(L.least(right + L.spread(pieces, at + SHAPE_RIGHT), f32(width - 1)))
        shows = left <= right
        left, right = L.where(shows, left * f32(0.25), f32(32767.0)), L.where(shows, right * f32(0.25), f32(-1.0))
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
    """Write the runs of tiles that the splats first..last (places in the order of depth) may show in to ``spans``.

    Exact for ellipses, down to the tiles' squares of 4 x 4 pixels: a square is taken if and only if the outline rho <=
    cut meets the rectangle of its pixel centres (but for roundings, which only add). Sixteen rows of squares are done
    at once. Splat k has ``counts[k]`` runs, which follow those of k - 1; a run is (first tile, number of tiles, columns
    of squares in each row of them), see RUN. ``change`` (tiles + 1) gets 1 added where a run begins and taken away
    behind its end. Returns the rows needed; where they are more than fit, nothing of this counts. Runs without a tile
    that is wanted, by ``before`` (tiles + 1), the number of them before each, are left out.
    ``shapes`` are the outlines, from :func:`project`. ``codes`` (48 NOTES, int32), ``pieces`` (16 NOTES, float32) and
    ``notes`` (NOTES, 3) are for work: ellipses are noted in pieces of 16 rows of squares, NOTES of them, and then
    worked off together.
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
            used = _emit(notes, pieces, noted, flat, steps, codes, width, tiles_x, before, spans, used, counts, change)
            noted = 0
            row, slim = table[k], thin[k]
            cut = f64(slim[WIDE + CUT]) * (1 + 1e-6)
            used = _intervals(row, slim, k, width, height, tiles_x, tiles_y, cut, spans, used, counts, change)
            continue
        start = f64(shapes[shape, u64(SHAPE_Y)]) - table[k, Y0]
        while r1 <= r2:
            if noted == NOTES:
                used = _emit(
                    notes, pieces, noted, flat, steps, codes, width, tiles_x, before, spans, used, counts, change
                )
                noted = 0
            L.store(pieces, noted * 16, L.load(shapes, (k - first) * 16))
            pieces[u64(noted * 16)] = start + 4 * r1
            notes[noted, 0], notes[noted, 1] = k, r1 // SIDE
            notes[noted, 2] = min(16 // SIDE, r2 // SIDE - r1 // SIDE + 1)
            noted += 1
            r1 += 16
    return _emit(notes, pieces, noted, flat, steps, codes, width, tiles_x, before, spans, used, counts, change)


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
def _bits(code, begin):
    """A row of a run, as :func:`outline` writes it, as one bit for each column of squares from ``begin`` on; up to 58
    columns."""
    low, high = (code & 0xFFFF) - begin, (code >> 16) - begin
    return ((2 << high) - (1 << low)) if code >= 0 else 0


@inlined
def _columns(code, column):
    """Of a row of a run, the bits of SIDE columns of squares from this one on."""
    begin, end = max((code & 0xFFFF) - column, 0), min((code >> 16) - column, SIDE - 1)
    return ((2 << end) - (1 << begin)) if end >= begin else 0


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


@inlined
def _slopes(exact, at):
    """What is the same for all splats in ``exact``; see :func:`_place`."""
    for k in range(EXACT):
        exact[u64(at + k)] = 0.0
    exact[u64(at + 8 + SCREEN_X)] = exact[u64(at + 16 + SCREEN_Y)] = ROOT2
    exact[u64(at + 8 + AT_X)] = exact[u64(at + 16 + AT_Y)] = 1.0


@inlined
def _place(work, at, exact, begin, table, thin, i, ox, oy, flat):
    """Row i of the table as float32 to ``work`` from ``at`` on; and to ``exact`` from ``begin`` on what it is at the tile's
    middle (ox, oy), and its slopes."""
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
        exact[e + u64(8 + AT_U)], exact[e + u64(16 + AT_U)], exact[e + u64(16 + AT_V)] = f11, f12, f22


@inlined
def _refer(work, at, exact, begin, dx, dy):
    """What depends on where pixels are counted from, as float32 to ``work`` from ``at`` on: counted from (dx, dy) off the
    tile's middle."""
    slope_x, slope_y = L.load8(exact, begin + 8), L.load8(exact, begin + 16)
    L.store8(work, at, L.load8(exact, begin) + slope_x * dx + slope_y * dy)


@inlined
def _shade(work, at, off, x, y, screen_x, screen_y, flat, peak):
    """Of a splat at 16 pixels: where it is drawn, and its alpha (anything elsewhere); and p, q, which :func:`_depth`
    makes its z and 1 / z of. ``at``: its row. ``off``: what :func:`_refer` made. ``screen_x`` and ``screen_y`` are x and
    y times the root of 2.

    A 2D splat's W is clamped to the z that it may have, between WLOW and WTOP, before anything is divided by it. That bounds
    the z of what its filter draws, and changes nothing that its intersection draws, nor adds to it. For take its centre in
    front, and the centre's z as 1: at (u, v) = U / W the plane has z = 1 / W = 1 + s u for a slope s, so s U = 1 - W, and
    WLOW = 1 / (1 + E |s|) with E = EXTENT_SIGMAS. Where W is less than WLOW, |U| > (1 - WLOW) / |s| = E WLOW: |U| / WLOW is
    more than E too, where nothing is drawn. Where W is more than WTOP, |U| / WTOP is more than |U| / W, which is more than E,
    unless WTOP is that of the near plane; this is what WMAX is for.
    """
    if flat:
        w = L.spread(work, off + AT_W) + L.spread(work, at + WX) * x + L.spread(work, at + WY) * y
        u = L.spread(work, off + AT_U) + L.spread(work, at + UX) * x + L.spread(work, at + UY) * y
        v = L.spread(work, off + AT_V) + L.spread(work, at + VX) * x + L.spread(work, at + VY) * y
        q = L.least(L.most(w, L.spread(work, at + WLOW)), L.spread(work, at + WTOP))
        p = L.inverse(q)
        ex, ey = screen_x + L.spread(work, off + SCREEN_X), screen_y + L.spread(work, off + SCREEN_Y)
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
def _depth(work, at, p, q, flat, peak, z, iz):
    """z and 1 / z of a splat from what :func:`_shade` says, less these."""
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

    A tile is 16 squares of 16 pixels. Splats come in blocks of those that show in a square that is not opaque yet: their
    coefficients are laid out once for the tile; each square then picks those that its list says may show in it, and
    composites them with its sums in registers.

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
        # From the middle of the tile's quarter: offsets are small, and so is what they round.
        buf[XS * PIXELS + p] = f32(p // 16 % 2 * 4 + p % 4) - f32(3.5)
        buf[YS * PIXELS + p] = f32(p // (16 * SIDE) % 2 * 4 + p // 4 % 4) - f32(3.5)
    for k in range(BLOCK):
        _slopes(exact, k * EXACT)
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
            L.store(buf, TT * PIXELS + p, f32(1.0))
        if rows < TILE or cols < TILE:
            # Pixels outside of the image are opaque from the start: they take no part and never delay the stop.
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
                _prefetch(table, ahead * COLUMNS)
                _prefetch(table, ahead * COLUMNS + 8)
                _prefetch(table, ahead * COLUMNS + 16)
                entry = entries[e]
                squares = entry >> PLACE_BITS & ~ended
                if squares == 0:
                    seen[u64(e)] = f32(0.0)
                else:
                    places[u64(size)], masks[u64(size)] = e, squares
                    _place(work, size * ROW, exact, size * EXACT, table, thin, entry & PLACE, ox, oy, flat)
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
                    left = L.having(masks, 0, QUARTER << corner) | L.having(masks, 16, QUARTER << corner) << 16
                    while left != 0:
                        k = L.lowest(left)
                        left &= left - 1
                        _refer(work, PLACED + k * 8, exact, k * EXACT, dx, dy)
                q = corner + (turn << 1 & 4) + (turn & 1)
                if ended >> q & 1:
                    continue
                left = L.having(masks, 0, 1 << q) | L.having(masks, 16, 1 << q) << 16
                if left == 0:
                    continue
                s = q * 16
                x, y = L.load(buf, XS * PIXELS + s), L.load(buf, YS * PIXELS + s)
                sx, sy = x * f32(ROOT2), y * f32(ROOT2)
                T, A, D = L.load(buf, TT * PIXELS + s), L.load(buf, AA * PIXELS + s), L.load(buf, DD * PIXELS + s)
                sum1, sum2 = L.load(buf, M1 * PIXELS + s), L.load(buf, M2 * PIXELS + s)
                pairs, final = L.load(buf, L1 * PIXELS + s), L.load(buf, LAST * PIXELS + s)
                n0, n1 = L.load(buf, NX * PIXELS + s), L.load(buf, NY * PIXELS + s)
                n2, c0 = L.load(buf, NZ * PIXELS + s), L.load(buf, C_0 * PIXELS + s)
                c1, c2 = L.load(buf, C_1 * PIXELS + s), L.load(buf, C_2 * PIXELS + s)
                zref, iref = L.load(buf, ZREF * PIXELS + s), L.load(buf, IREF * PIXELS + s)
                med, medk = L.load(buf, MED * PIXELS + s), L.load(buf, MEDK * PIXELS + s)
                # Once no pixel is, what only the first splats of a pixel decide is over: for a block at a time, so that
                # it costs no branch that goes both ways.
                undecided = L.some(half < T)
                alive = stop < T
                used = 0
                following = L.lowest(left)
                inside_then, a_then, p_then, q_then = _shade(
                    work, following * ROW, PLACED + following * 8, x, y, sx, sy, flat, peak
                )
                while True:
                    k, inside, a, p, iq = following, inside_then, a_then, p_then, q_then
                    b = k * ROW
                    left &= left - 1
                    if left != 0:
                        # One splat ahead: a long chain of operations that wait for each other, while the sums of the
                        # one at hand wait for nothing.
                        following = L.lowest(left)
                        inside_then, a_then, p_then, q_then = _shade(
                            work, following * ROW, PLACED + following * 8, x, y, sx, sy, flat, peak
                        )
                    hit = inside & alive
                    w = L.where(hit, a * T, f32(0.0))
                    step = L.spread(work, b + STEP)
                    if keep:
                        final = L.where(hit, step, final)
                    if undecided:
                        z, iz = _depth(work, b, p, iq, flat, peak, zero, zero)
                        opens, first_hit = hit & (half < T), hit & (f32(1.0) <= T)
                        med, medk = L.where(opens, z, med), L.where(opens, step, medk)
                        # Depths are summed relative to the pixel's first, which keeps the digits of thin layers far
                        # away.
                        zref, iref = L.where(first_hit, z, zref), L.where(first_hit, iz, iref)
                    z, m = _depth(work, b, p, iq, flat, peak, zref, iref)
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
            L.store(buf, MED * PIXELS + p, L.where(covered, L.load(buf, MED * PIXELS + p), f32(np.nan)))
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
                    # Of what is nowhere drawn, no square is of interest to the backward pass.
                    kept[at] = entries[u64(e)] if seen[u64(e)] > 0 else entries[u64(e)] & PLACE
                    at += 1


# Slots of the backward pass: gradients of the loss in what a pixel sums up, and sums over the splats behind.
BXS, BYS = 0, 1  # as in the forward pass
(BT, BLAST, BMEDK, BZREF, BIREF, GW, GD, GM2, GL1, GMED, TOTA, BEHA, BEHD, BEHQ, GNX, GNY, GNZ, GC0, GC1,
 GC2) = range(2, 22)  # fmt: skip
BACK_SLOTS = 22
# In the backward pass's work, behind the splat's row: what is summed over the tile, and as PLACED above.
SUMS, BACK_PLACED = ROW, ROW + 32
BACK_WORK = BACK_PLACED + 16


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
             buf, work, exact):  # fmt: skip
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
        buf[BXS * PIXELS + p] = f32(p // 16 % SIDE * 4 + p % 4) - f32(TILE / 2 - 0.5)
        buf[BYS * PIXELS + p] = f32(p // (16 * SIDE) * 4 + p // 4 % 4) - f32(TILE / 2 - 0.5)
    zero_lanes = L.load(buf, BXS * PIXELS) * zero
    _slopes(exact, 0)
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
            _prefetch(table, ahead * COLUMNS)
            _prefetch(table, ahead * COLUMNS + 8)
            _prefetch(table, ahead * COLUMNS + 16)
            if squares == 0:
                continue
            _place(work, 0, exact, 0, table, thin, i, ox, oy, flat)
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
                    _refer(work, BACK_PLACED, exact, 0, dx, dy)
                q = L.lowest(quarter)
                quarter &= quarter - 1
                squares &= ~(1 << q)
                s = q * 16
                x, y = L.load(buf, BXS * PIXELS + s), L.load(buf, BYS * PIXELS + s)
                nx, ny = x - f32(dx), y - f32(dy)
                sx, sy = nx * f32(ROOT2), ny * f32(ROOT2)
                inside, a, p, iq = _shade(work, 0, BACK_PLACED, nx, ny, sx, sy, flat, peak)
                z, iz = _depth(work, 0, p, iq, flat, peak, zero_lanes, zero_lanes)
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
                in_z = in_z + L.where(step == L.load(buf, BMEDK * PIXELS + s), L.load(buf, GMED * PIXELS + s), zero)
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
                ex, ey = nx + L.spread(work, BACK_PLACED + AT_X), ny + L.spread(work, BACK_PLACED + AT_Y)
                low, high, z0 = L.spread(work, ZLO), L.spread(work, ZHI), L.spread(work, Z0)
                if flat:
                    # As in _shade.
                    v_w = L.spread(work, BACK_PLACED + AT_W) + L.spread(work, WX) * nx + L.spread(work, WY) * ny
                    u = L.spread(work, BACK_PLACED + AT_U) + L.spread(work, UX) * nx + L.spread(work, UY) * ny
                    v = L.spread(work, BACK_PLACED + AT_V) + L.spread(work, VX) * nx + L.spread(work, VY) * ny
                    sx, sy = sx + L.spread(work, BACK_PLACED + SCREEN_X), sy + L.spread(work, BACK_PLACED + SCREEN_Y)
                    meets = (v_w <= L.spread(work, WMAX)) & ((u * u + v * v) * (p * p) <= sx * sx + sy * sy)
                    r = p
                    # Selected, not multiplied by 0: what it is multiplied with may be infinite.
                    rs = L.where(meets, r, zero)
                    u, v = u * rs, v * rs
                    blame = in_a * rs
                    gu, gv = blame * u, blame * v
                    gw = gu * u + gv * v
                    screened = L.where(meets, zero, in_a) * two
                    under, over = L.spread(work, WTOP) <= v_w, v_w <= L.spread(work, WLOW)
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
            L.store(work, SUMS, L.totals(s0, s1, s2, s3, s4, s5, b0, b1, b2, b3, b4, b5, b6, b7, b8, b9))
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
    """Add the rows of the tiles visit[first:last] to those of the splats low..high in ``total``, in their order."""
    columns = rows.shape[1]
    for visited in range(first, last):
        t = visit[visited]
        for k in range(done[t]):
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
