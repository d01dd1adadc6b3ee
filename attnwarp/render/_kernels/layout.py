"""The data that the CPU kernels share: named structures of arrays, and the layout of their rows.

A structure is a ``NamedTuple`` of arrays: numba passes its members one by one, at no cost. A row's
layout is a ``NamedTuple`` of column numbers, so that ``row[SPLAT.cut]`` reads as what it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from attnwarp.render import constants

# A tile is SQUARES squares of 4 x 4 pixels; a square's 16 pixels are the lanes of one vector.
TILE = constants.TILE
PIXELS = TILE * TILE
SIDE = TILE // 4  # squares along a tile's edge
SQUARES = SIDE * SIDE
EVERY_SQUARE = (1 << SQUARES) - 1  # one bit each
# Squares as bits: those of the tile's first quarter (2 x 2 squares); and the bits that the number
# of a square has in common with the first square of its quarter.
QUARTER = 0x33
QUARTER_CORNER = 10

# An entry of a tile's list: a splat's place in the order of depth, and above it one bit for each
# of the tile's squares that the splat may show in.
PLACE_BITS = 32
PLACE = (1 << PLACE_BITS) - 1

ROOT2 = math.sqrt(2)


class View(NamedTuple):
    """The camera, and which picture is asked for."""

    rotation: np.ndarray  # (3, 3) float64, world to camera
    translation: np.ndarray  # (3,) float64, world to camera, with the splats' origin moved in
    fx: float
    skew: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float
    discs: bool  # kind "2d", else "3d"
    by_center: bool  # a splat's depth is its centre's
    antialiased: bool
    harmonic: bool  # values are spherical harmonics, else features
    blur: float  # px^2 that the screen filter adds to a 3D splat's variance


class Splats(NamedTuple):
    """N splats as they come in; gradients in them have the same form."""

    means: np.ndarray  # (N, 3)
    quats: np.ndarray  # (N, 4) wxyz
    scales: np.ndarray  # (N, 2 or 3)
    opacities: np.ndarray  # (N,)
    values: np.ndarray  # (N, 3 K) float32 harmonics or (N, C) features


class Tiles(NamedTuple):
    """The grid of tiles."""

    across: int
    down: int
    order: np.ndarray  # (tiles,) int64, the order in which tiles are visited


class Table(NamedTuple):
    """Projected splats in the order of depth: rows of three cache lines, seen in two types.

    Columns below SINGLE are float64: column c is ``doubles[k, c]``. Columns from SINGLE on are
    float32: column c is ``singles[k, SINGLE + c]``.
    """

    doubles: np.ndarray  # (M, ROW_DOUBLES) float64
    singles: np.ndarray  # (M, 2 ROW_DOUBLES) float32, the same memory
    features: np.ndarray  # (M, C) float32 if there are more than 3 channels, else no rows


ROW_DOUBLES = 24
SINGLE = 11
GRADIENTS = 16  # columns below this one carry gradients


class SplatColumns(NamedTuple):
    """Columns of the table that both kinds have. Lengths in pixels or scene units.

    The reference point is the projected centre. Coefficients are per pixel of offset from it.
    """

    center_x: int = 0  # the reference point
    center_y: int = 1
    depth: int = 11  # of the centre
    depth_low: int = 12  # bounds of z at a pixel: the splat's own extent, and near
    depth_high: int = 13
    opacity: int = 14
    cut: int = 18  # drawn where rho <= cut; -1: nowhere
    normal: int = 22  # (3) in world axes
    values: int = 25  # (3) the first three channels


class DiscColumns(NamedTuple):
    """Columns of a 2D splat: u = U / W, v = V / W, z = depth / W, with U = u_x dx + u_y dy, V = v_x
    dx + v_y dy and W = 1 + w_x dx + w_y dy."""

    u_x: int = 2
    u_y: int = 3
    v_x: int = 4
    v_y: int = 5
    w_x: int = 6
    w_y: int = 7
    w_most: int = 17  # the plane is nearer than near where W is larger
    w_high: int = 20  # bounds of W within the splat's extent
    w_low: int = 21


class EllipsoidColumns(NamedTuple):
    """Columns of a 3D splat: rho = u^2 + v^2 and z = depth l / (l^2 + p^2 + q^2), each of u, v, l,
    p and q linear.

    Sums of squares: the quadratic forms that they are equal to lose all digits of a needle.
    """

    factor_xx: int = 2  # u = factor_xx dx + factor_xy dy
    factor_xy: int = 3
    factor_yy: int = 4  # v = factor_yy dy
    peak_x: int = 5  # l = 1 + peak_x dx + peak_y dy
    peak_y: int = 6
    peak_xx: int = 7  # p = peak_xx dx + peak_xy dy
    peak_xy: int = 8
    peak_yy: int = 9  # q = peak_yy dy


class EllipsoidGradients(NamedTuple):
    """Columns of a 3D splat's row of gradients that are not gradients in the table's columns.

    With k the gradient in z times z / l, moments of it in the numbers that z is made of, and of the
    gradient in -rho / 2 in u and v. They are free of the pixel's position, which may be far from
    the centre.
    """

    shape: int = 2  # (3) in u^2, u v, v^2
    linear: int = 5  # (3) k l, k p, k q
    square: int = 8  # (4) k l z / depth times p l, q l, p^2, p q
    square_last: int = 15  # times q^2


SPLAT, DISC, ELLIPSOID = SplatColumns(), DiscColumns(), EllipsoidColumns()
ELLIPSOID_GRADIENT = EllipsoidGradients()


class RowColumns(NamedTuple):
    """A splat laid out for a tile: ROW float32, the table's columns and these."""

    step: int = 28  # 1 + its place in the tile's list


ROW = 32
TILE_ROW = RowColumns()


class LinearTerms(NamedTuple):
    """Terms that are linear in a pixel's position: of 2D splats u, v, w and the screen's, of 3D
    splats u, v, l (along), p and q; see :class:`EllipsoidColumns`.
    """

    u: int = 0
    v: int = 1
    w: int = 2
    along: int = 2
    screen_x: int = 3  # x and y times the root of 2
    p: int = 3
    screen_y: int = 4
    q: int = 4
    x: int = 5  # offset from the reference point
    y: int = 6


# In float64 for the middle of a tile: 8 values, their slopes in x, their slopes in y. In float32
# for the middle of a quarter: 8 values.
LINEAR = LinearTerms()
SLOPE_X, SLOPE_Y = 8, 16
MOMENTS = 24
NOWHERE = 1e30  # rho where nothing is drawn


class OutlineColumns(NamedTuple):
    """A splat's outline, 16 float32 in pixels from the reference point: an ellipse, and for 2D
    splats the disc of the screen filter."""

    row_y: int = 0  # top of the picture's first row of squares
    middle_y: int = 1  # of the ellipse
    top: int = 2  # half height
    inverse_top: int = 3
    half_chord: int = 4  # half of the chord through the middle
    lean: int = 5  # how far the chords' middles move to the right a pixel down
    half_width: int = 6
    tip_y: int = 7  # of the rightmost point, from the middle
    middle_x: int = 8
    radius_squared: int = 9  # of the disc
    radius: int = 10
    left: int = 11  # added to a left end and to a right end: the reference point, and the slack
    right: int = 12
    row_height: int = 13
    first_row: int = 14  # rows of squares; NO_ELLIPSE in place of the first if it is none
    last_row: int = 15  # less than the first if it shows nowhere


OUTLINE = OutlineColumns()
OUTLINE_SIZE = 16
NO_ELLIPSE = -1


class RunColumns(NamedTuple):
    """A run of tiles in a row that a splat may show in: RUN_SIZE int32."""

    tile: int = 0  # the first one
    tiles: int = 1  # how many
    column: int = 2  # its first column of squares
    intervals: int = 4  # (SIDE) for each row of squares its columns, first | last << 16


RUN = RunColumns()
RUN_SIZE = 8


class Runs(NamedTuple):
    """The runs of consecutive splats, and what they change in the lengths of the tiles' lists."""

    runs: np.ndarray  # (room, RUN_SIZE) int32
    counts: np.ndarray  # (M,) int32, runs of each splat
    changes: np.ndarray  # (tiles + 1,) int32: 1 added where a run begins, taken away behind its end


class Lists(NamedTuple):
    """The splats of each tile: tile t's are entries[starts[t] : starts[t] + counts[t]]."""

    starts: np.ndarray  # (tiles,) int64
    counts: np.ndarray  # (tiles,) int64
    entries: np.ndarray  # (.) int64, see PLACE


class Pictures(NamedTuple):
    """Drawn pictures, and the state that the backward pass needs; H x W pixels, float32."""

    color: np.ndarray  # (H, W, C)
    alpha: np.ndarray  # (H, W)
    depth: np.ndarray  # (H, W)
    median: np.ndarray  # (H, W)
    normal: np.ndarray  # (H, W, 3)
    ordered: np.ndarray  # (H, W)
    state: np.ndarray  # (3, H, W), see STATE; (3, 0, W) if there is no backward pass


class StatePlanes(NamedTuple):
    """The planes of ``Pictures.state``."""

    transmittance: int = 0  # behind all splats
    last_step: int = 1  # 1 + place in the list of the last splat drawn; 0: none
    median_step: int = 2


STATE = StatePlanes()


class Progress(NamedTuple):
    """Counts of the work done in each tile, and the weights of the lists' entries."""

    processed: np.ndarray  # (tiles,) int64, entries of its list
    tested: np.ndarray  # (tiles,) int64, pairs whose intersection was computed
    composited: np.ndarray  # (tiles,) int64, pairs in a square that the splat draws to
    contributing: np.ndarray  # (tiles,) int64, pairs drawn
    opaque: np.ndarray  # (tiles,) bool, every pixel has ended
    weights: np.ndarray  # (entries,) float32


class Upstream(NamedTuple):
    """Gradients of the loss in the outputs, float32."""

    color: np.ndarray  # (H, W, C)
    alpha: np.ndarray  # (H, W)
    depth: np.ndarray  # (H, W)
    median: np.ndarray  # (H, W)
    normal: np.ndarray  # (H, W, 3)
    ordered: np.ndarray  # (H, W)
    weight: np.ndarray  # (M,), in the order of depth


class Rows(NamedTuple):
    """A row of gradients for each entry of a group of tiles."""

    starts: np.ndarray  # (tiles,) int64, a tile's first row
    rows: np.ndarray  # (., GRADIENTS + 3 + max(3, C)) float32: columns, normal, values
