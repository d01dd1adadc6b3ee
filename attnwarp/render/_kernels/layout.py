# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""What the kernels of the CPU backend hand to one another: rows of the table of splats, lists, the
camera as numbers.

And the decorators that every module of kernels is compiled by.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from attnwarp.render import constants as K

# NaN and infinity are left to IEEE rules: selects rely on comparisons with them.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def fingerprint(folder: Path = Path(__file__).parent) -> str:
    """SHA-256 of all that is compiled here: the modules of ``folder``, and the constants beside
    it."""
    files = [*sorted(folder.glob("*.py")), folder.parent / "constants.py"]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


FINGERPRINT = fingerprint()


def _compiled(**options: Any) -> Any:
    """numba's decorator, with a cache on disk that is thrown away when any of the modules changes.
    Left to itself numba looks at the function's own file only, and would go on with what was
    inlined from others."""

    def decorate(function: Any) -> Any:
        dispatcher = nb.njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, **options)(
            function
        )
        # There is none where numba is told to compile nothing.
        file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if file is not None:
            file._source_stamp = FINGERPRINT
        return dispatcher

    return decorate


jit = _compiled()
# Without numba's reference counts: LLVM cannot remove those of arrays passed to inlined functions,
# and two threads that count the same array up and down for every splat spend a third of their time
# on it. Such kernels allocate nothing.
bare = _compiled(_nrt=False)
inlined = _compiled(inline="always")

f32 = np.float32
f64 = np.float64
u64 = np.uint64

TILE = K.TILE
PIXELS = TILE * TILE
SIDE = TILE // 4  # squares of 4 x 4 pixels along a tile
SQUARES = SIDE * SIDE
EVERY = (1 << SQUARES) - 1  # a bit for each

# A projected splat is a row of 192 bytes, three cache lines: WIDE columns of float64, then float32.
# The table is passed twice, as float64 (M, COLUMNS) and as float32 (M, 2 COLUMNS), "thin", in which
# column c >= WIDE stands at c + WIDE. The reference point is the projected centre, or the principal
# point for a 2D splat whose centre is not in front; coefficients are per pixel of offset from it,
# and are moved to each quarter of a tile in float64.
X0, Y0 = 0, 1
UX, UY, U0, VX, VY, V0, WX, WY, W0 = (
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
    10,
)  # 2D: u = U / W, v = V / W, z = Z0 / W
CA, CB, CC, LX, LY, RXX, RXY, RYY = 2, 3, 4, 5, 6, 7, 8, 9  # 3D: conic; z = Z0 l / (l^2 + r)
WIDE = 11
Z0, ZLO, ZHI, OPACITY = 11, 12, 13, 14
GRADIENTS = 15  # columns up to here carry gradients
FILTER, WMAX, CUT = (
    15,
    17,
    18,
)  # whether there is a screen filter; nothing shows where W > WMAX, or if CUT < 0
IZ0, WTOP, WLOW = 19, 20, 21  # 2D: 1 / z = IZ0 W, with W no more than WTOP and no less than WLOW
IZLO = 20  # 3D: 1 / ZLO
NORMAL, VALUES = 22, 25  # world normal, and the first three channels
COLUMNS = 24
F11, F12, F22 = (
    20,
    21,
    22,
)  # 3D: rho = (F11 dx + F12 dy)^2 + (F22 dy)^2, float64 behind the others; no cancellation

# A splat as it is laid out for a tile: a row of float32 with the table's columns; and what depends
# on where pixels are counted from, which is kept in float64 for the tile's middle, followed by its
# slopes in x and y: 8 numbers each.
ROW = 32
EXACT = 24
AT_U, AT_V, AT_W, SCREEN_X, SCREEN_Y, AT_X, AT_Y = range(7)  # SCREEN: X and Y times the root of 2
QUARTER = 0x33  # its squares, as bits, from its first one on
CORNER = 10  # the bits that the number of a square has in common with its quarter's first one

# An entry of a tile's list is a splat's place in the order of depth, and above it one bit for each
# of the tile's squares of 4 x 4 pixels that the splat may show in.
PLACE_BITS = 32
PLACE = (1 << PLACE_BITS) - 1

# A run of tiles: the first one, how many, and its first column of squares; from CODES on, for each
# row of squares, its columns as first | last << 16.
RUN, CODES = 8, 4
HUGE = 1e30
ROOT2 = math.sqrt(2)


def _asking(write: int) -> Any:
    @intrinsic
    def ask(typing: Any, array: Any, item: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = cgutils.create_struct_proxy(signature.args[0])(context, builder, args[0]).data
            pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
            word = ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), word, word, word])
            call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            builder.call(call, [pointer, word(write), word(3), word(1)])
            return word(0)

        return nb.int32(array, nb.int64), codegen

    return ask


# Ask for the cache line of an array's item (counted flat) before it is needed, to be read or to be
# written.
prefetch, prefetch_to_write = _asking(0), _asking(1)

# view: the camera as numbers, float64. Rows of R, then t (with the splats' origin moved in), then
# the intrinsics.
R00, TX, FX, SKEW, FY, CX, CY, WIDTH, HEIGHT, NEAR, FLAT, CENTER, ANTIALIASED, HARMONIC = (
    0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23,
)  # fmt: skip
VIEW = 24

# A splat's outline, as :func:`project` leaves it for :func:`outline`: a row of 16 float32, in
# pixels from (X0, Y0). Where its first row of squares begins, less Y0 and what is above that row;
# the ellipse's middle in y, top, 1 / top; half of the chord through its middle, how far the chords'
# middles move to the right a row, half width, height of its right tip, middle in x; the squared
# radius of the filter's disc, and the radius; what is added to a left and to a right end, for its
# place in the picture; a row's height. Then the first and the last row of squares: none if the last
# is above the first, and no ellipse if the first is negative.
(SHAPE_Y, SHAPE_EY, SHAPE_TOP, SHAPE_SHRINK, SHAPE_HALF, SHAPE_LEAN, SHAPE_WIDE, SHAPE_TIP, SHAPE_EX, SHAPE_SQUARE,
 SHAPE_RADIUS, SHAPE_LEFT, SHAPE_RIGHT, SHAPE_HIGH, SHAPE_FIRST, SHAPE_LAST) = range(16)  # fmt: skip
