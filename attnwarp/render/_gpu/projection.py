# mypy: ignore-errors
"""Projection: splats as the camera sees them, one thread a splat, in float64.

The formulas are those of :mod:`attnwarp.render._kernels.projection`.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from attnwarp.render import constants
from attnwarp.render._gpu.layout import At, Of, View
from attnwarp.render.harmonics import C0, C1, C2, C3

f32, f64 = wp.float32, wp.float64

ZERO, HALF, ONE, TWO = f64(0.0), f64(0.5), f64(1.0), f64(2.0)
TINY = f64(1e-300)
ALPHA_MIN = f64(constants.ALPHA_MIN)
EDGE_ON = f64(constants.EDGE_ON)
EXTENT = f64(constants.EXTENT_SIGMAS)
MARGIN = f64(constants.JACOBIAN_MARGIN)
COMPENSATION_MIN = f64(constants.COMPENSATION_MIN)
WIDER = f64(1.0 + 1e-6)
SLACK = f64(1e-4)
ROUNDING = f64(1e-6)
FRONT = f64(1e-3)
SOLID = f64(1e-12)
SIDE = 8
EDGE = f64(8.0)
NOT_SHOWN = f32(float("inf"))

Y0 = f64(C0)
Y1 = f64(C1)
Y20, Y21, Y22, Y23, Y24 = (f64(c) for c in C2)
Y30, Y31, Y32, Y33, Y34, Y35, Y36 = (f64(c) for c in C3)

Basis = wp.types.vector(length=16, dtype=wp.float64)
Peak = wp.types.vector(length=5, dtype=wp.float64)


@wp.struct
class Outline:
    """A splat's outline rho <= cut, in pixels from the reference point: an ellipse A x^2 + 2 B x y
    + C y^2 <= h about the middle, and for 2D splats the disc of the screen filter. First and last
    row of tiles; none if the last is less."""

    is_ellipse: wp.bool
    x0: wp.float64
    y0: wp.float64
    cut: wp.float64
    middle_x: wp.float64
    middle_y: wp.float64
    top: wp.float64  # half height
    half_width: wp.float64
    half_chord: wp.float64  # half of the chord through the middle
    lean: wp.float64  # how far the chords' middles move to the right a pixel down
    tip: wp.float64  # y of the rightmost point, from the middle
    radius: wp.float64  # of the disc
    slack_x: wp.float64
    slack_y: wp.float64
    first: wp.int32
    last: wp.int32


@wp.func
def rotation_of(w0: wp.float64, x0: wp.float64, y0: wp.float64, z0: wp.float64) -> wp.mat33d:
    """Rotation matrix of a quaternion of any length but zero."""
    inverse = ONE / wp.sqrt(w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0)
    w, x, y, z = w0 * inverse, x0 * inverse, y0 * inverse, z0 * inverse
    return wp.mat33d(
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@wp.func
def harmonics(degree: wp.int32, x: wp.float64, y: wp.float64, z: wp.float64) -> Basis:
    """Values of the (degree + 1)^2 harmonics; see :mod:`attnwarp.render.harmonics`."""
    b = Basis()
    b[0] = Y0
    if degree > 0:
        b[1] = -Y1 * y
        b[2] = Y1 * z
        b[3] = -Y1 * x
    if degree > 1:
        b[4] = Y20 * x * y
        b[5] = Y21 * y * z
        b[6] = Y22 * (TWO * z * z - x * x - y * y)
        b[7] = Y23 * x * z
        b[8] = Y24 * (x * x - y * y)
    if degree > 2:
        four, three = f64(4.0), f64(3.0)
        b[9] = Y30 * y * (three * x * x - y * y)
        b[10] = Y31 * x * y * z
        b[11] = Y32 * y * (four * z * z - x * x - y * y)
        b[12] = Y33 * z * (TWO * z * z - three * x * x - three * y * y)
        b[13] = Y34 * x * (four * z * z - x * x - y * y)
        b[14] = Y35 * z * (x * x - y * y)
        b[15] = Y36 * x * (x * x - three * y * y)
    return b


@wp.func
def root(x: wp.float64) -> wp.float64:
    """Square root; of a negative number that of almost nothing."""
    return wp.sqrt(wp.max(x, TINY))


@wp.func
def depth_spread(a: wp.mat33d, s: wp.vec3d) -> wp.float64:
    """Sigma along the optical axis of a splat with the axes ``a`` in camera axes."""
    u, v, w = s[0] * a[2, 0], s[1] * a[2, 1], s[2] * a[2, 2]
    return wp.sqrt(u * u + v * v + w * w)


@wp.func
def shortest_axis(s: wp.vec3d) -> wp.int32:
    """Index of the smallest scale, the first of equal ones."""
    axis = wp.int32(0)
    if s[1] < s[0]:
        axis = 1
    if s[2] < s[axis]:
        axis = 2
    return axis


@wp.func
def disc_side(
    doubles: wp.array2d(dtype=wp.float64), singles: wp.array2d(dtype=wp.float32), i: wp.int32,
    column: wp.int32, single: wp.int32, k: wp.int32, a: wp.mat33d, c: wp.vec3d,
    s: wp.float64, nc: wp.float64, step: wp.vec3d,
):  # fmt: skip
    """U or V: the tangent in column k of ``a``, less its part along the ray."""
    tc = (a[0, k] * c[0] + a[1, k] * c[1] + a[2, k] * c[2]) / nc
    scale = c[2] / s
    gx = scale * (a[0, k] - tc * a[0, 2])
    slope_x = gx * step[0]
    slope_y = scale * (a[1, k] - tc * a[1, 2]) * step[1] + gx * step[2]
    doubles[i, column] = slope_x
    doubles[i, column + 1] = slope_y
    singles[i, single] = f32(slope_x)
    singles[i, single + 1] = f32(slope_y)


@wp.func
def disc(
    doubles: wp.array2d(dtype=wp.float64), singles: wp.array2d(dtype=wp.float32), i: wp.int32,
    view: View, a: wp.mat33d, c: wp.vec3d, s: wp.vec3d, length: wp.float64, spread: wp.float64,
):  # fmt: skip
    """The plane of a 2D splat as U, V and W."""
    step = wp.vec3d(ONE / view.fx, ONE / view.fy, -view.skew / (view.fx * view.fy))
    nc = a[0, 2] * c[0] + a[1, 2] * c[1] + a[2, 2] * c[2]
    least = length * EDGE_ON
    if wp.abs(nc) < least:
        nc = wp.where(nc < ZERO, -least, least)
    disc_side(doubles, singles, i, At.u_x, Of.u_x, 0, a, c, s[0], nc, step)
    disc_side(doubles, singles, i, At.v_x, Of.v_x, 1, a, c, s[1], nc, step)
    scale = c[2] / nc
    wx = scale * a[0, 2] * step[0]
    wy = scale * (a[1, 2] * step[1] + a[0, 2] * step[2])
    doubles[i, At.w_x] = wx
    doubles[i, At.w_y] = wy
    singles[i, Of.w_x] = f32(wx)
    singles[i, Of.w_y] = f32(wy)
    singles[i, Of.w_most] = f32(c[2] / view.near)
    # Where it shows by its intersection, z lies between these.
    reach = spread * EXTENT
    singles[i, Of.w_high] = f32(c[2] / wp.max(c[2] - reach, view.near))
    singles[i, Of.w_low] = f32(c[2] / (c[2] + reach))


@wp.func
def ellipsoid(
    doubles: wp.array2d(dtype=wp.float64), singles: wp.array2d(dtype=wp.float32), i: wp.int32,
    view: View, a: wp.mat33d, c: wp.vec3d, s: wp.vec3d,
) -> wp.float64:  # fmt: skip
    """The projection of a 3D splat (EWA); returns det (Sigma) over det (Sigma + blur I).

    Sigma = M M^T with M the splat's axes in the picture. Its determinant is taken from the minors
    of M (Cauchy-Binet), as a sum of squares.
    """
    limit = MARGIN * f64(view.width) / TWO / view.fx
    px = wp.clamp(c[0] / c[2], -view.cx / view.fx - limit,
                  (f64(view.width) - view.cx) / view.fx + limit)  # fmt: skip
    limit = MARGIN * f64(view.height) / TWO / view.fy
    py = wp.clamp(c[1] / c[2], -view.cy / view.fy - limit,
                  (f64(view.height) - view.cy) / view.fy + limit)  # fmt: skip
    wide, tall = wp.vec3d(), wp.vec3d()
    for k in range(3):
        f = s[k] / c[2]
        down = a[1, k] - py * a[2, k]
        wide[k] = ((a[0, k] - px * a[2, k]) * view.fx + down * view.skew) * f
        tall[k] = down * view.fy * f
    minors = wp.cross(wide, tall)
    sharp = wp.dot(minors, minors)
    square = wp.dot(tall, tall)
    xx, xy, yy = wp.dot(wide, wide) + view.blur, wp.dot(wide, tall), square + view.blur
    det = sharp + (xx + square) * view.blur
    edge = wp.sqrt(yy / det)
    factor_xy, factor_yy = -xy / det / edge, ONE / wp.sqrt(yy)
    doubles[i, At.factor_xx] = edge
    doubles[i, At.factor_xy] = factor_xy
    doubles[i, At.factor_yy] = factor_yy
    singles[i, Of.factor_xx] = f32(edge)
    singles[i, Of.factor_xy] = f32(factor_xy)
    singles[i, Of.factor_yy] = f32(factor_yy)
    return sharp / det


@wp.func
def peak(
    doubles: wp.array2d(dtype=wp.float64), singles: wp.array2d(dtype=wp.float32), i: wp.int32,
    view: View, a: wp.mat33d, c: wp.vec3d, s: wp.vec3d,
):  # fmt: skip
    """The depth at which a 3D splat is largest along a ray.

    In the splat's own axes and scales the ray through its centre is g, with z = 1, and that of a
    pixel r = g + X dx + Y dy; z = depth (g.r) / (r.r), by Lagrange's identity a sum of squares.
    """
    px, py = c[0] / c[2], c[1] / c[2]
    kx, ky, kxy = ONE / view.fx, ONE / view.fy, -view.skew / (view.fx * view.fy)
    g = wp.vec3d()
    for k in range(3):
        g[k] = (a[0, k] * px + a[1, k] * py + a[2, k]) / s[k]
    square = wp.dot(g, g)
    over = ONE / square
    x, y = f64(0.0), f64(0.0)
    for k in range(3):
        f = g[k] / s[k] * over
        x += f * a[0, k]
        y += f * a[1, k]
    over = over / s[0] / s[1] / s[2]
    across, below = wp.vec3d(), wp.vec3d()
    for k in range(3):
        down = a[1, k] - py * a[2, k]
        across[k] = down * s[k] * (over * kx)
        below[k] = (down * kxy - (a[0, k] - px * a[2, k]) * ky) * s[k] * over
    edge = ONE / wp.sqrt(wp.dot(across, across))
    values = Peak(
        x * kx, y * ky + x * kxy, wp.dot(across, across) * edge, wp.dot(across, below) * edge,
        over * (kx * ky) / wp.sqrt(square) * edge,
    )  # fmt: skip
    for k in range(5):
        doubles[i, At.peak_x + k] = values[k]
        singles[i, Of.peak_x + k] = f32(values[k])


@wp.func
def outline_of(
    doubles: wp.array2d(dtype=wp.float64), singles: wp.array2d(dtype=wp.float32), i: wp.int32,
    view: View,
) -> Outline:  # fmt: skip
    """The outline of a projected splat, a little wider than it is drawn for the roundings of what
    follows."""
    o = Outline()
    o.x0 = doubles[i, At.center_x]
    o.y0 = doubles[i, At.center_y]
    o.cut = f64(singles[i, Of.cut]) * WIDER
    o.is_ellipse = singles[i, Of.is_ellipse] > f32(0.0)
    o.first = 0
    o.last = -1
    if o.cut < ZERO:
        return o
    if not o.is_ellipse:
        o.last = view.down - 1
        return o
    A, B, C, h = f64(0.0), f64(0.0), f64(0.0), f64(o.cut)
    if view.discs:
        ux, uy = doubles[i, At.u_x], doubles[i, At.u_y]
        vx, vy = doubles[i, At.v_x], doubles[i, At.v_y]
        wx, wy = doubles[i, At.w_x], doubles[i, At.w_y]
        A = ux * ux + vx * vx - o.cut * wx * wx
        B = ux * uy + vx * vy - o.cut * wx * wy
        C = uy * uy + vy * vy - o.cut * wy * wy
        det = A * C - B * B
        o.middle_x = (C * wx - B * wy) / det * o.cut
        o.middle_y = (A * wy - B * wx) / det * o.cut
        h = o.cut * (wx * o.middle_x + wy * o.middle_y + ONE)
        scale = h / det
        o.radius = wp.sqrt(o.cut * HALF)
        o.top = root(A * scale)
        o.half_width = root(C * scale)
    else:
        xx, xy = doubles[i, At.factor_xx], doubles[i, At.factor_xy]
        yy = doubles[i, At.factor_yy]
        A, B = xx * xx, xx * xy
        C = xy * xy + yy * yy
        # det = (xx yy)^2: no difference of products.
        o.top = root(h) / yy
        o.half_width = root(C * h) / (xx * yy)
    o.half_chord = root(A * h) / A
    o.lean = -B / A
    o.tip = -B * o.half_width / C
    o.slack_x = (o.half_width + wp.abs(o.middle_x) + wp.abs(o.x0)) * ROUNDING + SLACK
    o.slack_y = (o.top + wp.abs(o.middle_y) + wp.abs(o.y0)) * ROUNDING + SLACK
    begin = o.y0 - HALF - o.slack_y + wp.min(o.middle_y - o.top, -o.radius)
    end = o.y0 - HALF + o.slack_y + wp.max(o.middle_y + o.top, o.radius)
    bottom = f64(view.height - 1)
    if end >= ZERO and begin <= bottom:
        o.first = wp.int32(wp.ceil(wp.max(begin, ZERO))) / SIDE
        o.last = wp.int32(wp.min(end, bottom)) / SIDE
    return o


@wp.func
def columns_of(o: Outline, view: View, row: wp.int32) -> wp.vec2i:
    """First and last column of the tiles that an ellipse and its disc show in, in a row of tiles;
    none if the last is less."""
    # From the ellipse's middle.
    y1 = f64(row * SIDE) + HALF - o.y0 - o.slack_y
    y2 = f64(wp.min(row * SIDE + SIDE, view.height)) - HALF - o.y0 + o.slack_y
    e1, e2 = wp.max(y1 - o.middle_y, -o.top), wp.min(y2 - o.middle_y, o.top)
    left, right = f64(1e30), f64(-1e30)
    if e1 <= e2:
        t1, t2 = e1 / o.top, e2 / o.top
        chord1 = wp.sqrt(wp.max(ONE - t1 * t1, ZERO)) * o.half_chord
        chord2 = wp.sqrt(wp.max(ONE - t2 * t2, ZERO)) * o.half_chord
        right = wp.max(o.lean * e1 + chord1, o.lean * e2 + chord2)
        left = wp.min(o.lean * e1 - chord1, o.lean * e2 - chord2)
        if e1 <= o.tip and o.tip <= e2:
            right = o.half_width
        if e1 <= -o.tip and -o.tip <= e2:
            left = -o.half_width
        left += o.middle_x
        right += o.middle_x
    if view.discs:
        near = wp.max(wp.max(y1, -y2), ZERO)
        if near < o.radius:
            chord = wp.sqrt(o.radius * o.radius - near * near)
            left, right = wp.min(left, -chord), wp.max(right, chord)
    left = wp.ceil(wp.max(left + o.x0 - HALF - o.slack_x, ZERO))
    right = wp.floor(wp.min(right + o.x0 - HALF + o.slack_x, f64(view.width - 1)))
    result = wp.vec2i(0, -1)
    if left <= right:
        result = wp.vec2i(wp.int32(left) / SIDE, wp.int32(right) / SIDE)
    return result


@wp.func
def overlaps(
    doubles: wp.array2d(dtype=wp.float64), singles: wp.array2d(dtype=wp.float32), i: wp.int32,
    o: Outline, view: View, row: wp.int32, column: wp.int32,
) -> wp.bool:  # fmt: skip
    """Return True if a 2D splat of any outline may show in a tile, by interval arithmetic."""
    x1 = f64(column * SIDE) + HALF - o.x0 - SLACK
    x2 = f64(wp.min(column * SIDE + SIDE, view.width)) - HALF - o.x0 + SLACK
    y1 = f64(row * SIDE) + HALF - o.y0 - SLACK
    y2 = f64(wp.min(row * SIDE + SIDE, view.height)) - HALF - o.y0 + SLACK
    hx, hy, mx, my = (x2 - x1) * HALF, (y2 - y1) * HALF, (x1 + x2) * HALF, (y1 + y2) * HALF
    ux, uy = doubles[i, At.u_x], doubles[i, At.u_y]
    vx, vy = doubles[i, At.v_x], doubles[i, At.v_y]
    wx, wy = doubles[i, At.w_x], doubles[i, At.w_y]
    w = ONE + wx * mx + wy * my + wp.abs(wx) * hx + wp.abs(wy) * hy
    shows = wp.bool(False)
    if w > ZERO:
        w = wp.min(w, f64(singles[i, Of.w_most]))
        u = wp.max(wp.abs(ux * mx + uy * my) - wp.abs(ux) * hx - wp.abs(uy) * hy, ZERO)
        v = wp.max(wp.abs(vx * mx + vy * my) - wp.abs(vx) * hx - wp.abs(vy) * hy, ZERO)
        shows = u * u + v * v <= o.cut * w * w
    if not shows:
        dx, dy = wp.max(wp.abs(mx) - hx, ZERO), wp.max(wp.abs(my) - hy, ZERO)
        shows = TWO * (dx * dx + dy * dy) <= o.cut
    return shows


@wp.func
def write_values(
    singles: wp.array2d(dtype=wp.float32), i: wp.int32, view: View,
    values: wp.array2d(dtype=wp.float32), direction: wp.vec3d,
):  # fmt: skip
    """Colour, or the first three features, of a splat seen along ``direction``, in world axes."""
    if view.harmonic:
        b = harmonics(view.degree, direction[0], direction[1], direction[2])
        for k in range(3):
            total = f64(0.5)
            for j in range((view.degree + 1) * (view.degree + 1)):
                total += b[j] * f64(values[i, 3 * j + k])
            singles[i, Of.values + k] = f32(wp.max(total, ZERO))
    else:
        for k in range(3):
            if k < view.channels:
                singles[i, Of.values + k] = values[i, k]
            else:
                singles[i, Of.values + k] = f32(0.0)


@wp.kernel(enable_backward=False)
def project(
    view: View,
    means: wp.array2d(dtype=Any),
    quats: wp.array2d(dtype=Any),
    scales: wp.array2d(dtype=Any),
    opacities: wp.array(dtype=Any),
    values: wp.array2d(dtype=wp.float32),
    doubles: wp.array2d(dtype=wp.float64),
    singles: wp.array2d(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
    counts: wp.array(dtype=wp.int32),
):
    """Project each splat to a row of the tables; its depth, infinite if it shows nowhere; and how
    many tiles it may show in."""
    i = wp.tid()
    depths[i] = NOT_SHOWN
    counts[i] = 0
    R = view.rotation
    c = R * wp.vec3d(f64(means[i, 0]), f64(means[i, 1]), f64(means[i, 2])) + view.translation
    opacity = f64(opacities[i])
    if opacity < ALPHA_MIN or c[2] <= view.near:
        return
    q = rotation_of(f64(quats[i, 0]), f64(quats[i, 1]), f64(quats[i, 2]), f64(quats[i, 3]))
    a = R * q
    s = wp.vec3d(f64(scales[i, 0]), f64(scales[i, 1]), ZERO)
    if not view.discs:
        s[2] = f64(scales[i, 2])
    spread = depth_spread(a, s)
    doubles[i, At.center_x] = (c[0] * view.fx + c[1] * view.skew) / c[2] + view.cx
    doubles[i, At.center_y] = c[1] * view.fy / c[2] + view.cy
    length = wp.length(c)
    axis = wp.int32(2)
    if view.discs:
        disc(doubles, singles, i, view, a, c, s, length, spread)
    else:
        ratio = ellipsoid(doubles, singles, i, view, a, c, s)
        if view.antialiased:
            opacity *= wp.sqrt(wp.max(ratio, COMPENSATION_MIN))
        if not view.by_center:
            peak(doubles, singles, i, view, a, c, s)
        axis = shortest_axis(s)
    if opacity < ALPHA_MIN:
        return
    cut = f32(TWO * wp.log(opacity / ALPHA_MIN))
    reach = spread * EXTENT
    low, high = wp.max(c[2] - reach, view.near), c[2] + reach
    if view.by_center:
        low = c[2]
        high = c[2]
    n = wp.vec3d(a[0, axis], a[1, axis], a[2, axis])
    flip = wp.where(wp.dot(n, c) > ZERO, -ONE, ONE)
    singles[i, Of.cut] = cut
    singles[i, Of.opacity] = f32(opacity)
    singles[i, Of.depth] = f32(c[2])
    singles[i, Of.depth_low] = f32(low)
    singles[i, Of.depth_high] = f32(high)
    for k in range(3):
        singles[i, Of.normal + k] = f32(flip * q[k, axis])
    singles[i, Of.is_ellipse] = f32(1.0)
    if view.discs:
        # An ellipse only if the whole disc lies in front of the camera plane.
        wider = f64(cut) * WIDER
        ux, uy = doubles[i, At.u_x], doubles[i, At.u_y]
        vx, vy = doubles[i, At.v_x], doubles[i, At.v_y]
        wx, wy = doubles[i, At.w_x], doubles[i, At.w_y]
        A = ux * ux + vx * vx - wider * wx * wx
        B = ux * uy + vx * vy - wider * wx * wy
        C = uy * uy + vy * vy - wider * wy * wy
        solid = A > ZERO and C > ZERO and A * C - B * B > A * C * SOLID
        if not (solid and c[2] * FRONT < c[2] - wp.sqrt(wp.max(wider, ZERO)) * spread):
            singles[i, Of.is_ellipse] = f32(0.0)
    write_values(singles, i, view, values, wp.transpose(R) * c / length)
    o = outline_of(doubles, singles, i, view)
    count = wp.int32(0)
    for row in range(o.first, o.last + 1):
        if o.is_ellipse:
            span = columns_of(o, view, row)
            count += span[1] - span[0] + 1
        else:
            for column in range(view.across):
                if overlaps(doubles, singles, i, o, view, row, column):
                    count += 1
    counts[i] = count
    if count > 0:
        # Without the sign of a zero: depths that are equal compare as equal.
        depths[i] = f32(c[2]) + f32(0.0)


def of_type(kernel: wp.Kernel, real: type, tables: tuple[str, ...], columns: tuple[str, ...] = ()):
    """A kernel for splats of float32 or of float64: the arguments of these names are theirs."""
    table, column = wp.array2d(dtype=real), wp.array(dtype=real)
    return wp.overload(kernel, {**dict.fromkeys(tables, table), **dict.fromkeys(columns, column)})


PROJECT = {
    real: of_type(project, real, ("means", "quats", "scales"), ("opacities",))
    for real in (wp.float32, wp.float64)
}
"""``project`` by the type of the splats."""
