# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Projection: splats as the camera sees them, eight at once in float64.

Every ``Wide`` below holds one number of each of eight splats.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from attnwarp.render._kernels.compilation import bare, f32, f64, inlined, prefetch, u64
from attnwarp.render._kernels.lanes import (
    absolute,
    ceil,
    exponent,
    floor,
    fraction,
    invert,
    load8,
    maximum,
    minimum,
    reciprocal,
    reciprocal_sqrt,
    select,
    store8,
    to_bits,
)
from attnwarp.render._kernels.layout import (
    DISC,
    ELLIPSOID,
    NO_ELLIPSE,
    OUTLINE,
    OUTLINE_SIZE,
    SIDE,
    SINGLE,
    SPLAT,
    TILE,
)
from attnwarp.render.constants import (
    ALPHA_MIN,
    COMPENSATION_MIN,
    EDGE_ON,
    EXTENT_SIGMAS,
    JACOBIAN_MARGIN,
)
from attnwarp.render.harmonics import C0, C1, C2, C3


class BatchRows(NamedTuple):
    """Rows of eight float64 that a batch of splats is worked on in."""

    mean: int = 0  # (3)
    quat: int = 3  # (4)
    scale: int = 7  # (3)
    opacity: int = 10
    center: int = 11  # (3) camera axes
    direction: int = 14  # (3) unit vector to the splat, world axes
    doubles: int = 17  # (SINGLE) the table's float64 columns


BATCH = BatchRows()
BATCH_DOUBLES = 8 * (BATCH.doubles + SINGLE)
# Rows of eight float32: the table's columns from SINGLE up to the values, then the outline's.
OUTLINE_ROWS = SPLAT.values - SINGLE
BATCH_SINGLES = 8 * (OUTLINE_ROWS + OUTLINE_SIZE)


class Vector(NamedTuple):
    """Three numbers, or three Wide."""

    x: Any
    y: Any
    z: Any


class Matrix(NamedTuple):
    """A 3 x 3 matrix of numbers, or of Wide."""

    m00: Any
    m01: Any
    m02: Any
    m10: Any
    m11: Any
    m12: Any
    m20: Any
    m21: Any
    m22: Any


class PixelSteps(NamedTuple):
    """K^-1 without its last column: what a pixel to the right and one down add to a ray."""

    x: Any
    y: Any
    xy: Any


class Footprint(NamedTuple):
    """The quadratic form A x^2 + 2 B x y + C y^2 <= h about the middle, and the filter's disc."""

    A: Any
    B: Any
    C: Any
    middle_x: Any
    middle_y: Any
    h: Any
    scale: Any  # h / (A C - B^2)
    radius_squared: Any
    is_ellipse: Any


@inlined
def _sqrt(x):
    """Square root of eight float64 >= 0, to the last bits; anything where negative or infinite."""
    return x * reciprocal_sqrt(maximum(x, 1e-300))


@inlined
def _log(x):
    """Natural logarithm of eight float64, to 1e-12, for x > 0 that are not denormal.

    With x = f 2^k and f about 1: 2 artanh((f - 1) / (f + 1)) + k log 2.
    """
    f, k = fraction(x), exponent(x)
    large = f > 1.4142135623730951
    f, k = select(large, f * 0.5, f), select(large, k + 1.0, k)
    z = (f - 1.0) / (f + 1.0)
    s = z * z
    series = s * (s * (s * (1 / 15) + 1 / 13) + 1 / 11) + 1 / 9
    series = s * (s * (s * (s * series + 1 / 7) + 1 / 5) + 1 / 3) + 1.0
    return k * 0.6931471805599453 + z * series * 2.0


@inlined
def harmonics(degree, x, y, z, out):
    """Values of the (degree + 1)^2 harmonics to ``out``; see :mod:`attnwarp.render.harmonics`."""
    out[0] = C0
    if degree > 0:
        out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if degree > 1:
        out[4], out[5], out[6] = (
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * z * z - x * x - y * y),
        )
        out[7], out[8] = C2[3] * x * z, C2[4] * (x * x - y * y)
    if degree > 2:
        out[9], out[10], out[11] = (
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
        )
        out[12] = C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y)
        out[13], out[14] = C3[4] * x * (4 * z * z - x * x - y * y), C3[5] * z * (x * x - y * y)
        out[15] = C3[6] * x * (x * x - 3 * y * y)


@inlined
def _load3(batch, row):
    return Vector(load8(batch, 8 * row), load8(batch, 8 * row + 8), load8(batch, 8 * row + 16))


@inlined
def _store3(batch, row, x, y, z):
    store8(batch, 8 * row, x)
    store8(batch, 8 * row + 8, y)
    store8(batch, 8 * row + 16, z)


@inlined
def _put(batch, column, value):
    """Store a float64 column of the table."""
    store8(batch, 8 * (BATCH.doubles + column), value)


@inlined
def _put_single(singles, column, value):
    """Store a float32 column of the table."""
    store8(singles, 8 * (column - SINGLE), value)


@inlined
def _put_outline(singles, column, value):
    store8(singles, 8 * (OUTLINE_ROWS + column), value)


@inlined
def _all_wanted(wanted):
    return wanted[-1, -1] == (wanted.shape[0] - 1) * (wanted.shape[1] - 1)


@inlined
def _reaches(view, c0, c1, c2, size, wanted):
    """Return True if a splat may show in a wanted tile, by a rectangle that holds it at any
    rotation.

    Args:
        c0, c1, c2: its centre in camera axes.
        size: its largest sigma.
        wanted: see :func:`project`.
    """
    fx, skew, fy, near = view.fx, view.skew, view.fy, view.near
    width, height = f64(view.width), f64(view.height)
    ic = 1 / c2
    x, y = c0 * ic, c1 * ic
    px, py = fx * x + skew * y + view.cx, fy * y + view.cy
    every = _all_wanted(wanted)
    if every & (px > 0) & (px < width) & (py > 0) & (py < height):
        return True
    if view.discs:
        # A sphere holds it: (c0 + d0) / (c2 + d2) - c0 / c2 is at most |d| (1 + |c0 / c2|) / (c2 -
        # |d|). And 2.4 pixels hold the disc of the screen filter.
        reach = EXTENT_SIGMAS * size
        if c2 - reach <= near:
            return True
        scale, blur = reach / (c2 - reach), 2.4
    else:
        # As the projection is linearised, no wider than |J| sigma; then blurred.
        x_most = 1.0 + abs(view.cx / fx) + 2 * width / fx
        y_most = 1.0 + abs(view.cy / fy) + 2 * height / fy
        x, y = min(max(x, -x_most), x_most), min(max(y, -y_most), y_most)
        scale, blur = EXTENT_SIGMAS * size * ic, EXTENT_SIGMAS * math.sqrt(view.blur)
    tall = scale * fy * (1 + abs(y)) + blur
    wide = scale * (fx * (1 + abs(x)) + abs(skew) * (1 + abs(y))) + blur
    x1, x2, y1, y2 = px - wide, px + wide, py - tall, py + tall
    if not ((x2 > 0) & (y2 > 0) & (x1 < width) & (y1 < height)):
        return False
    t1, t2 = int(max(x1, 0.0)) // TILE, int(min(x2, width - 1)) // TILE + 1
    r1, r2 = int(max(y1, 0.0)) // TILE, int(min(y2, height - 1)) // TILE + 1
    return wanted[r2, t2] - wanted[r1, t2] - wanted[r2, t1] + wanted[r1, t1] > 0


@inlined
def _gather(batch, splats, order, begin, last, discs):
    """The parameters of the splats order[begin : begin + 8] to ``batch``; past ``last`` the last
    one's."""
    means, quats, scales = splats.means, splats.quats, splats.scales
    opacities, values = splats.opacities, splats.values
    for lane in range(8):
        later = order[min(begin + lane + 16, last - 1)]
        prefetch(means, later * 3)
        prefetch(quats, later * 4)
        prefetch(scales, later * scales.shape[1])
        prefetch(opacities, later)
        prefetch(values, later * values.shape[1])
        i, to = u64(order[min(begin + lane, last - 1)]), u64(lane)
        for k in range(3):
            batch[to + u64(8 * (BATCH.mean + k))] = means[i, u64(k)]
        for k in range(4):
            batch[to + u64(8 * (BATCH.quat + k))] = quats[i, u64(k)]
        batch[to + u64(8 * BATCH.scale)] = scales[i, u64(0)]
        batch[to + u64(8 * BATCH.scale + 8)] = scales[i, u64(1)]
        third = 0.0 if discs else scales[i, u64(scales.shape[1] - 1)]
        batch[to + u64(8 * BATCH.scale + 16)] = third
        batch[to + u64(8 * BATCH.opacity)] = opacities[i]


@inlined
def _cull(batch, view, candidates, begin, first, wanted, table, outlines):
    """Mask of those ``candidates``, one bit each, that may show in a wanted tile; the others are
    marked as not drawn.
    """
    visible = candidates
    for lane in range(8):
        if not candidates >> lane & 1:
            continue
        column = u64(lane)
        s = column + u64(8 * BATCH.scale)
        size = max(batch[s], batch[s + u64(8)], batch[s + u64(16)])
        c = column + u64(8 * BATCH.center)
        if not _reaches(view, batch[c], batch[c + u64(8)], batch[c + u64(16)], size, wanted):
            visible &= ~(1 << lane)
            table.singles[u64(begin + lane), u64(SINGLE + SPLAT.cut)] = f32(-1.0)
            outlines[u64(begin + lane - first), u64(OUTLINE.first_row)] = f32(1.0)
            outlines[u64(begin + lane - first), u64(OUTLINE.last_row)] = f32(0.0)
    return visible


@inlined
def _rotations(batch):
    """Rotation matrices of eight quaternions."""
    w, x = load8(batch, 8 * BATCH.quat), load8(batch, 8 * BATCH.quat + 8)
    y, z = load8(batch, 8 * BATCH.quat + 16), load8(batch, 8 * BATCH.quat + 24)
    inverse = reciprocal_sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    return Matrix(
        1.0 - (y * y + z * z) * 2.0, (x * y - w * z) * 2.0, (x * z + w * y) * 2.0,
        (x * y + w * z) * 2.0, 1.0 - (x * x + z * z) * 2.0, (y * z - w * x) * 2.0,
        (x * z - w * y) * 2.0, (y * z + w * x) * 2.0, 1.0 - (x * x + y * y) * 2.0,
    )  # fmt: skip


@inlined
def _axes_in_camera(q, R):
    """R q, its columns a splat's axes in camera axes."""
    return Matrix(
        q.m00 * R.m00 + q.m10 * R.m01 + q.m20 * R.m02,
        q.m01 * R.m00 + q.m11 * R.m01 + q.m21 * R.m02,
        q.m02 * R.m00 + q.m12 * R.m01 + q.m22 * R.m02,
        q.m00 * R.m10 + q.m10 * R.m11 + q.m20 * R.m12,
        q.m01 * R.m10 + q.m11 * R.m11 + q.m21 * R.m12,
        q.m02 * R.m10 + q.m12 * R.m11 + q.m22 * R.m12,
        q.m00 * R.m20 + q.m10 * R.m21 + q.m20 * R.m22,
        q.m01 * R.m20 + q.m11 * R.m21 + q.m21 * R.m22,
        q.m02 * R.m20 + q.m12 * R.m21 + q.m22 * R.m22,
    )


@inlined
def _disc_side(batch, column, t0, t1, t2, n, c, s, inverse_nc, step):
    """U or V, at ``column``: the tangent (t0, t1, t2) of length s, less its part along the ray."""
    tc = (t0 * c.x + t1 * c.y + t2 * c.z) * inverse_nc
    scale = c.z * reciprocal(s)
    gx = scale * (t0 - tc * n.x)
    slope_x, slope_y = gx * step.x, scale * (t1 - tc * n.y) * step.y + gx * step.xy
    _put(batch, column, slope_x)
    _put(batch, column + 1, slope_y)
    return slope_x, slope_y


@inlined
def _disc(batch, singles, view, a, c, s, length, spread, cut, step):
    """The plane of a 2D splat as U, V and W; see :class:`DiscColumns`. Returns its outline."""
    n = Vector(a.m02, a.m12, a.m22)
    nc = n.x * c.x + n.y * c.y + n.z * c.z
    least = length * EDGE_ON
    nc = select(absolute(nc) < least, select(nc < 0.0, -least, least), nc)
    inverse = reciprocal(nc)
    ux, uy = _disc_side(batch, DISC.u_x, a.m00, a.m10, a.m20, n, c, s.x, inverse, step)
    vx, vy = _disc_side(batch, DISC.v_x, a.m01, a.m11, a.m21, n, c, s.y, inverse, step)
    scale = c.z * inverse
    wx, wy = scale * n.x * step.x, scale * (n.y * step.y + n.x * step.xy)
    _put(batch, DISC.w_x, wx)
    _put(batch, DISC.w_y, wy)
    _put_single(singles, DISC.w_most, c.z * (1.0 / view.near))
    # Where it shows by its intersection, z lies between these.
    reach = spread * EXTENT_SIGMAS
    _put_single(singles, DISC.w_high, c.z * reciprocal(maximum(c.z - reach, view.near)))
    _put_single(singles, DISC.w_low, c.z * reciprocal(c.z + reach))
    # An ellipse only if the whole disc lies in front of the camera plane.
    is_ellipse = c.z * 1e-3 < c.z - _sqrt(maximum(cut, 0.0)) * spread
    A = ux * ux + vx * vx - cut * wx * wx
    B = ux * uy + vx * vy - cut * wx * wy
    C = uy * uy + vy * vy - cut * wy * wy
    det = A * C - B * B
    is_ellipse = is_ellipse & (A > 0.0) & (C > 0.0) & (det > A * C * 1e-12)
    inverse = reciprocal(det)
    ex, ey = (C * wx - B * wy) * inverse * cut, (A * wy - B * wx) * inverse * cut
    h = cut * (wx * ex + wy * ey + 1.0)
    return Footprint(A, B, C, ex, ey, h, h * inverse, cut * 0.5, is_ellipse)


@inlined
def _side(a0, a1, a2, px, py, scale, view):
    """An axis of a 3D splat in the picture, in pixels."""
    across, down = a0 - px * a2, a1 - py * a2
    return (across * view.fx + down * view.skew) * scale, down * view.fy * scale


@inlined
def _ellipsoid(batch, view, a, c, ic, s):
    """The projection of a 3D splat (EWA): its factor, to the batch.

    Sigma = M M^T + blur I with the columns of M from :func:`_side`. Its determinant is taken
    from the minors of M (Cauchy-Binet), as a sum of squares: of a needle that is 1e6 pixels long,
    the difference of products would leave nothing.

    Returns:
        The conic Sigma^-1 as xx, xy, yy; the determinant of Sigma; that of M M^T over it.
    """
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    width, height = f64(view.width), f64(view.height)
    limit = JACOBIAN_MARGIN * width / 2 / fx
    px = minimum(maximum(c.x * ic, -cx / fx - limit), (width - cx) / fx + limit)
    limit = JACOBIAN_MARGIN * height / 2 / fy
    py = minimum(maximum(c.y * ic, -cy / fy - limit), (height - cy) / fy + limit)
    x0, y0 = _side(a.m00, a.m10, a.m20, px, py, s.x * ic, view)
    x1, y1 = _side(a.m01, a.m11, a.m21, px, py, s.y * ic, view)
    x2, y2 = _side(a.m02, a.m12, a.m22, px, py, s.z * ic, view)
    m01, m02, m12 = x0 * y1 - x1 * y0, x0 * y2 - x2 * y0, x1 * y2 - x2 * y1
    sharp = m01 * m01 + m02 * m02 + m12 * m12
    xx = x0 * x0 + x1 * x1 + x2 * x2 + view.blur
    xy = x0 * y0 + x1 * y1 + x2 * y2
    square = y0 * y0 + y1 * y1 + y2 * y2
    yy = square + view.blur
    det = sharp + (xx + square) * view.blur
    inverse = reciprocal(det)
    A, B, C = yy * inverse, -xy * inverse, xx * inverse
    edge = reciprocal_sqrt(A)
    _put(batch, ELLIPSOID.factor_xx, A * edge)
    _put(batch, ELLIPSOID.factor_xy, B * edge)
    _put(batch, ELLIPSOID.factor_yy, reciprocal_sqrt(yy))
    return A, B, C, det, sharp * inverse


@inlined
def _peak(batch, a, c, ic, s, step):
    """The depth at which a 3D splat is largest along a ray; see :class:`EllipsoidColumns`.

    In the splat's own axes and scales the ray through its centre is g, with z = 1, and that of
    a pixel r = g + X dx + Y dy. Where it is nearest to the centre, z = depth (g.r) / (r.r). With
    l = g.r / g.g that is depth l / (l^2 + |g x r|^2 / (g.g)^2) (Lagrange). The columns of the cross
    product, g x X and g x Y, need no difference of products: their part along axis k is s_k times
    the axis in the picture. Its QR factor gives p and q.
    """
    px, py = c.x * ic, c.y * ic
    kx, ky, kxy = step.x, step.y, step.xy
    i0, i1, i2 = reciprocal(s.x), reciprocal(s.y), reciprocal(s.z)
    g0 = (a.m00 * px + a.m10 * py + a.m20) * i0
    g1 = (a.m01 * px + a.m11 * py + a.m21) * i1
    g2 = (a.m02 * px + a.m12 * py + a.m22) * i2
    square = g0 * g0 + g1 * g1 + g2 * g2
    over = reciprocal(square)
    f0, f1, f2 = g0 * i0 * over, g1 * i1 * over, g2 * i2 * over
    x = f0 * a.m00 + f1 * a.m01 + f2 * a.m02
    y = f0 * a.m10 + f1 * a.m11 + f2 * a.m12
    _put(batch, ELLIPSOID.peak_x, x * kx)
    _put(batch, ELLIPSOID.peak_y, y * ky + x * kxy)
    over = over * i0 * i1 * i2
    across0, across1, across2 = a.m00 - px * a.m20, a.m01 - px * a.m21, a.m02 - px * a.m22
    down0, down1, down2 = a.m10 - py * a.m20, a.m11 - py * a.m21, a.m12 - py * a.m22
    x0, x1, x2 = down0 * s.x * (over * kx), down1 * s.y * (over * kx), down2 * s.z * (over * kx)
    y0 = (down0 * kxy - across0 * ky) * s.x * over
    y1 = (down1 * kxy - across1 * ky) * s.y * over
    y2 = (down2 * kxy - across2 * ky) * s.z * over
    xx = x0 * x0 + x1 * x1 + x2 * x2
    edge = reciprocal_sqrt(xx)
    _put(batch, ELLIPSOID.peak_xx, xx * edge)
    _put(batch, ELLIPSOID.peak_xy, (x0 * y0 + x1 * y1 + x2 * y2) * edge)
    _put(batch, ELLIPSOID.peak_yy, over * (kx * ky) * reciprocal_sqrt(square) * edge)


@inlined
def _shortest_axis(s, M):
    """The column of M, a matrix of axes, whose scale is the smallest."""
    second = s.y < s.x
    third = s.z < select(second, s.y, s.x)
    return Vector(
        select(third, M.m02, select(second, M.m01, M.m00)),
        select(third, M.m12, select(second, M.m11, M.m10)),
        select(third, M.m22, select(second, M.m21, M.m20)),
    )


@inlined
def _outline(singles, x0, y0, height, drawn, shape):
    """The outline rho <= cut, for :func:`attnwarp.render._kernels.binning.find_runs`."""
    A, B, C, ex, ey, h = shape.A, shape.B, shape.C, shape.middle_x, shape.middle_y, shape.h
    radius = _sqrt(shape.radius_squared)
    top, half_width = _sqrt(A * shape.scale), _sqrt(C * shape.scale)
    over = reciprocal(A)
    begin = y0 - (0.5 + 1e-4) + minimum(ey - top, -radius)
    end = y0 - (0.5 - 1e-4) + maximum(ey + top, radius)
    # Float32 from here on: what a far or large splat's numbers are rounded by is added on all
    # sides.
    slack = (half_width + absolute(ex) + absolute(x0)) * 1e-6 + 1e-4
    slack_y = (top + absolute(ey) + absolute(y0)) * 5e-7 + 1e-4
    shows = drawn & (end >= 0.0) & (begin <= height - 1.0)
    first = floor(ceil(maximum(begin, 0.0)) * (1 / TILE)) * SIDE
    last = floor(minimum(end, height - 1.0) * 0.25)
    first, last = select(shows, first, 1.0), select(shows, last, -2.0)
    first = select(shape.is_ellipse | invert(drawn), first, f64(NO_ELLIPSE))
    _put_outline(singles, OUTLINE.row_y, 0.5 - slack_y)
    _put_outline(singles, OUTLINE.middle_y, ey)
    _put_outline(singles, OUTLINE.top, top)
    _put_outline(singles, OUTLINE.inverse_top, reciprocal(top))
    _put_outline(singles, OUTLINE.half_chord, _sqrt(A * h) * over)
    _put_outline(singles, OUTLINE.lean, -B * over)
    _put_outline(singles, OUTLINE.half_width, half_width)
    _put_outline(singles, OUTLINE.tip_y, -B * half_width * reciprocal(C))
    _put_outline(singles, OUTLINE.middle_x, ex)
    _put_outline(singles, OUTLINE.radius_squared, shape.radius_squared)
    _put_outline(singles, OUTLINE.radius, radius)
    _put_outline(singles, OUTLINE.left, x0 - 0.5 - slack)
    _put_outline(singles, OUTLINE.right, x0 - 0.5 + slack)
    _put_outline(singles, OUTLINE.row_height, slack_y * 2.0 + 3.0)
    _put_outline(singles, OUTLINE.first_row, first)
    _put_outline(singles, OUTLINE.last_row, last)


@inlined
def _project_batch(batch, singles, view, R, c, ic, x0, y0, step):
    """Project the eight splats of ``batch``, centres c, to its columns of the table."""
    discs, by_center, near = view.discs, view.by_center, view.near
    s = _load3(batch, BATCH.scale)
    q = _rotations(batch)
    a = _axes_in_camera(q, R)
    opacity = load8(batch, 8 * BATCH.opacity)
    spread = _sqrt(
        s.x * a.m20 * (s.x * a.m20) + s.y * a.m21 * (s.y * a.m21) + s.z * a.m22 * (s.z * a.m22)
    )
    _put(batch, SPLAT.center_x, x0)
    _put(batch, SPLAT.center_y, y0)
    length = _sqrt(c.x * c.x + c.y * c.y + c.z * c.z)
    if not discs:
        A, B, C, det, ratio = _ellipsoid(batch, view, a, c, ic, s)
        if view.antialiased:
            opacity = opacity * _sqrt(maximum(ratio, COMPENSATION_MIN))
        if not by_center:
            _peak(batch, a, c, ic, s, step)
    drawn = opacity >= ALPHA_MIN
    cut = select(drawn, _log(maximum(opacity, ALPHA_MIN) * (1 / ALPHA_MIN)) * 2.0, -1.0)
    # The outline takes a little more, for the roundings of what follows.
    wider = cut * (1 + 1e-6)
    # One by one, not as a structure: the two kinds' are joined in registers then.
    if discs:
        n0, n1, n2, p0, p1, p2 = a.m02, a.m12, a.m22, q.m02, q.m12, q.m22
        A, B, C, ex, ey, h, scale, radius_squared, is_ellipse = _disc(
            batch, singles, view, a, c, s, length, spread, wider, step
        )
    else:
        n0, n1, n2 = _shortest_axis(s, a)
        p0, p1, p2 = _shortest_axis(s, q)
        h, is_ellipse = wider, drawn
        ex = ey = radius_squared = wider * 0.0
        scale = h * det
    reach = spread * EXTENT_SIGMAS
    low, high = maximum(c.z - reach, near), c.z + reach
    if by_center:
        low = high = c.z
    facing = n0 * c.x + n1 * c.y + n2 * c.z
    flip = select(facing > 0.0, -1.0, 1.0)
    _put_single(singles, SPLAT.depth, c.z)
    _put_single(singles, SPLAT.depth_low, low)
    _put_single(singles, SPLAT.depth_high, high)
    _put_single(singles, SPLAT.opacity, opacity)
    _put_single(singles, SPLAT.cut, cut)
    _put_single(singles, SPLAT.normal, flip * p0)
    _put_single(singles, SPLAT.normal + 1, flip * p1)
    _put_single(singles, SPLAT.normal + 2, flip * p2)
    shape = Footprint(A, B, C, ex, ey, h, scale, radius_squared, is_ellipse)
    _outline(singles, x0, y0, f64(view.height), drawn, shape)
    return length


@inlined
def _write_values(table, to, splats, i, view, channels, degree, batch, column, basis):
    """Colour or features of splat i to row ``to`` of the table."""
    values, singles, features = splats.values, table.singles, table.features
    if view.harmonic:
        if degree > 0:
            d = column + u64(8 * BATCH.direction)
            harmonics(degree, batch[d], batch[d + u64(8)], batch[d + u64(16)], basis)
        for k in range(3):
            total = 0.5 + C0 * values[i, u64(k)]
            for b in range(1, (degree + 1) ** 2):
                total += basis[u64(b)] * values[i, u64(3 * b + k)]
            singles[to, u64(SINGLE + SPLAT.values + k)] = max(total, 0.0)
    else:
        for k in range(3):
            value = values[i, u64(k)] if k < channels else f32(0.0)
            singles[to, u64(SINGLE + SPLAT.values + k)] = value
        if channels > 3:
            for k in range(channels):
                features[to, u64(k)] = values[i, u64(k)]


@inlined
def _write_row(table, outlines, to, local, batch, singles, column):
    """A splat of the batch to row ``to`` of the table, its outline to row ``local``."""
    for k in range(SINGLE):
        table.doubles[to, u64(k)] = batch[column + u64(8 * (BATCH.doubles + k))]
    for k in range(SINGLE, SPLAT.values):
        table.singles[to, u64(SINGLE + k)] = singles[column + u64(8 * (k - SINGLE))]
    for k in range(OUTLINE_SIZE):
        outlines[local, u64(k)] = singles[column + u64(8 * (OUTLINE_ROWS + k))]


@bare
def project(
    first,
    last,
    view,
    splats,
    order,  # (M,) int32
    channels,
    wanted,  # (tiles down + 1, tiles across + 1) int32
    table,
    outlines,  # (last - first, OUTLINE_SIZE) float32
    batch,  # (BATCH_DOUBLES,) float64, for work
    singles,  # (BATCH_SINGLES,) float32, for work
    basis,  # (16,) float64, for work
):
    """Project the splats order[first:last] to the rows first..last of the table, and outline them.

    ``wanted`` holds how many tiles are wanted above and left of each tile's corner. A splat that
    cannot show in a wanted one gets a negative cut and no outline, and the rest of its row is left
    as it was.
    """
    rotation, translation = view.rotation, view.translation
    R = Matrix(
        rotation[0, 0], rotation[0, 1], rotation[0, 2],
        rotation[1, 0], rotation[1, 1], rotation[1, 2],
        rotation[2, 0], rotation[2, 1], rotation[2, 2],
    )  # fmt: skip
    t0, t1, t2 = translation[0], translation[1], translation[2]
    fx, skew, fy, cx, cy = view.fx, view.skew, view.fy, view.cx, view.cy
    width, height = f64(view.width), f64(view.height)
    degree = round(math.sqrt(splats.values.shape[1] / 3)) - 1
    step = PixelSteps(1 / fx, 1 / fy, -skew / (fx * fy))
    every = _all_wanted(wanted)
    # Columns that the kind or the mode has no use for stay 0.
    batch[:] = 0.0
    singles[:] = 0.0
    for begin in range(first, last, 8):
        _gather(batch, splats, order, begin, last, view.discs)
        m = _load3(batch, BATCH.mean)
        c0 = m.x * R.m00 + m.y * R.m01 + m.z * R.m02 + t0
        c1 = m.x * R.m10 + m.y * R.m11 + m.z * R.m12 + t1
        c2 = m.x * R.m20 + m.y * R.m21 + m.z * R.m22 + t2
        ic = reciprocal(c2)
        px, py = (c0 * fx + c1 * skew) * ic + cx, c1 * fy * ic + cy
        visible = 255 >> (8 - min(8, last - begin))
        inside = 0
        if every:
            inside = to_bits((px > 0.0) & (px < width) & (py > 0.0) & (py < height))
        if visible & ~inside:
            _store3(batch, BATCH.center, c0, c1, c2)
            candidates = visible & ~inside
            visible &= inside | _cull(
                batch, view, candidates, begin, first, wanted, table, outlines
            )
            if visible == 0:
                continue
        c = Vector(c0, c1, c2)
        length = _project_batch(batch, singles, view, R, c, ic, px, py, step)
        if view.harmonic and degree > 0:
            over = reciprocal(length)
            _store3(
                batch,
                BATCH.direction,
                (c0 * R.m00 + c1 * R.m10 + c2 * R.m20) * over,
                (c0 * R.m01 + c1 * R.m11 + c2 * R.m21) * over,
                (c0 * R.m02 + c1 * R.m12 + c2 * R.m22) * over,
            )
        for lane in range(8):
            if not visible >> lane & 1:
                continue
            to, column = u64(begin + lane), u64(lane)
            local, i = to - u64(first), u64(order[to])
            _write_row(table, outlines, to, local, batch, singles, column)
            _write_values(table, to, splats, i, view, channels, degree, batch, column, basis)
