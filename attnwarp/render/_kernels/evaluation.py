# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""One splat at the 16 pixels of a square: its coverage, alpha and depth.

Shared by the forward and the backward pass. Coefficients are float64 in the table; they are laid
out once for a tile, in float64 about its middle, and moved to the middle of each quarter of it
before they are rounded to float32.
"""

from __future__ import annotations

import math

from attnwarp.render._kernels.compilation import f32, inlined, u64
from attnwarp.render._kernels.lanes import (
    broadcast,
    fma,
    load,
    load8,
    maximum,
    minimum,
    narrow,
    reciprocal,
    select,
    store,
    store8,
    times_power_of_2,
)
from attnwarp.render._kernels.layout import (
    DISC,
    ELLIPSOID,
    LINEAR,
    MOMENTS,
    NOWHERE,
    ROOT2,
    ROW_DOUBLES,
    SINGLE,
    SLOPE_X,
    SLOPE_Y,
    SPLAT,
)
from attnwarp.render.constants import ALPHA_MAX

LOG2E_HALF = f32(0.5 * math.log2(math.e))
# exp2(x) on [-0.5, 0.5], the polynomial of degree 5 that is 1 at 0 with the least relative error,
# 9.1e-8.
EXP2 = tuple(
    f32(c)
    for c in (
        1.0,
        0.6931469775373009,
        0.24022242044016756,
        0.05550733832514562,
        0.009671514536030823,
        0.0013264700286626865,
    )
)
ROUND = f32(1.5 * 2**23)


@inlined
def _gaussian(rho):
    """exp(-rho / 2), relative error 1.5e-7, for rho from 0 to 88; beyond, anything."""
    # Adding 1.5 2^23 rounds to an integer and leaves it in the lowest bits.
    shifted = fma(rho, -LOG2E_HALF, ROUND)
    f = fma(rho, -LOG2E_HALF, ROUND - shifted)
    # In pairs rather than in a row: the products wait less for one another.
    g = f * f
    high, low = (f * EXP2[5] + EXP2[4]) * g, f * EXP2[3] + EXP2[2]
    return times_power_of_2((high + low) * g + (f * EXP2[1] + f32(1.0)), shifted)


@inlined
def prepare_moments(moments, start):
    """Set the slopes in ``moments`` common to all splats; see :func:`lay_out`."""
    for k in range(MOMENTS):
        moments[u64(start + k)] = 0.0
    moments[u64(start + SLOPE_X + LINEAR.screen_x)] = ROOT2
    moments[u64(start + SLOPE_Y + LINEAR.screen_y)] = ROOT2
    moments[u64(start + SLOPE_X + LINEAR.x)] = moments[u64(start + SLOPE_Y + LINEAR.y)] = 1.0


@inlined
def lay_out(work, row, moments, start, table, k, middle_x, middle_y, discs, by_center):
    """Lay out splat k of the table for a tile.

    The splat's float32 row goes to ``work`` from ``row`` on; terms linear in the pixel's position
    go to ``moments`` from ``start`` on: values at the tile's middle, and slopes.
    """
    k, b, m = u64(k), u64(row), u64(start)
    doubles, singles = table.doubles, table.singles
    narrow(work, row, doubles, k * u64(ROW_DOUBLES))
    work[b + u64(8)], work[b + u64(9)] = doubles[k, 8], doubles[k, 9]
    store(work, row + SINGLE, load(singles, k * u64(2 * ROW_DOUBLES) + u64(2 * SINGLE)))
    work[b + u64(SPLAT.values + 2)] = singles[k, u64(SINGLE + SPLAT.values + 2)]
    dx, dy = middle_x - doubles[k, SPLAT.center_x], middle_y - doubles[k, SPLAT.center_y]
    moments[m + u64(LINEAR.x)], moments[m + u64(LINEAR.y)] = dx, dy
    if discs:
        for c in range(3):
            slope_x, slope_y = doubles[k, DISC.u_x + 2 * c], doubles[k, DISC.u_y + 2 * c]
            constant = 1.0 if c == 2 else 0.0
            moments[m + u64(LINEAR.u + c)] = constant + slope_x * dx + slope_y * dy
            moments[m + u64(SLOPE_X + LINEAR.u + c)] = slope_x
            moments[m + u64(SLOPE_Y + LINEAR.u + c)] = slope_y
        moments[m + u64(LINEAR.screen_x)] = ROOT2 * dx
        moments[m + u64(LINEAR.screen_y)] = ROOT2 * dy
    else:
        xx, xy = doubles[k, ELLIPSOID.factor_xx], doubles[k, ELLIPSOID.factor_xy]
        yy = doubles[k, ELLIPSOID.factor_yy]
        moments[m + u64(LINEAR.u)], moments[m + u64(LINEAR.v)] = xx * dx + xy * dy, yy * dy
        moments[m + u64(SLOPE_X + LINEAR.u)] = xx
        moments[m + u64(SLOPE_Y + LINEAR.u)] = xy
        moments[m + u64(SLOPE_Y + LINEAR.v)] = yy
        if not by_center:
            lx, ly = doubles[k, ELLIPSOID.peak_x], doubles[k, ELLIPSOID.peak_y]
            xx, xy = doubles[k, ELLIPSOID.peak_xx], doubles[k, ELLIPSOID.peak_xy]
            yy = doubles[k, ELLIPSOID.peak_yy]
            moments[m + u64(LINEAR.along)] = 1.0 + lx * dx + ly * dy
            moments[m + u64(LINEAR.p)], moments[m + u64(LINEAR.q)] = xx * dx + xy * dy, yy * dy
            moments[m + u64(SLOPE_X + LINEAR.along)], moments[m + u64(SLOPE_Y + LINEAR.along)] = (
                lx,
                ly,
            )
            moments[m + u64(SLOPE_X + LINEAR.p)], moments[m + u64(SLOPE_Y + LINEAR.p)] = xx, xy
            moments[m + u64(SLOPE_Y + LINEAR.q)] = yy


@inlined
def move_to_quarter(work, linear, moments, start, dx, dy):
    """Evaluate ``moments`` (dx, dy) off the tile's middle, as float32 to ``work`` from ``linear``
    on."""
    slope_x, slope_y = load8(moments, start + SLOPE_X), load8(moments, start + SLOPE_Y)
    store8(work, linear, load8(moments, start) + slope_x * dx + slope_y * dy)


@inlined
def linear_at(work, term, row, slope, x, y):
    """Evaluate a linear term at (x, y): value at ``term``, slopes in the row at ``slope``."""
    return (
        broadcast(work, term)
        + broadcast(work, row + slope) * x
        + broadcast(work, row + slope + 1) * y
    )


@inlined
def footprint_terms(work, row, linear, x, y):
    """Compute u and v of a 3D splat at pixels (x, y); see :class:`EllipsoidColumns`."""
    u = linear_at(work, linear + LINEAR.u, row, ELLIPSOID.factor_xx, x, y)
    return u, broadcast(work, linear + LINEAR.v) + broadcast(work, row + ELLIPSOID.factor_yy) * y


@inlined
def peak_terms(work, row, linear, x, y):
    """Compute l, p, q of a 3D splat at pixels (x, y), and 1 / (l^2 + p^2 + q^2); see
    :class:`EllipsoidColumns`."""
    along = linear_at(work, linear + LINEAR.along, row, ELLIPSOID.peak_x, x, y)
    p = linear_at(work, linear + LINEAR.p, row, ELLIPSOID.peak_xx, x, y)
    q = broadcast(work, linear + LINEAR.q) + broadcast(work, row + ELLIPSOID.peak_yy) * y
    square = along * along + (p * p + q * q)
    return along, p, q, reciprocal(maximum(square, f32(1e-30)))


@inlined
def evaluate(work, row, linear, x, y, screen_x, screen_y, discs, by_center):
    """Evaluate a splat at 16 pixels: coverage, alpha (arbitrary if not drawn) and z.

    The depth is scaled: of a 2D splat in units of its column ``depth``, except its centre's
    depth, which is then unused; see :func:`depth_from`.

    A 2D splat's W is clamped to the z that it may have, between w_low and w_high, before anything
    is divided by it. That bounds the z of what its filter draws, and changes nothing that its
    intersection draws, nor adds to it. For take the centre's z as 1: at (u, v) = U / W the plane
    has z = 1 / W = 1 + s u for a slope s, so s U = 1 - W, and w_low = 1 / (1 + E |s|) with E =
    EXTENT_SIGMAS. Where W is less than w_low, |U| > (1 - w_low) / |s| = E w_low: |U| / w_low is
    more than E too, where nothing is drawn. Where W is more than w_high, |U| / w_high is more than
    |U| / W, which is more than E, unless w_high is that of the near plane; this is what w_most is
    for.

    Args:
        row: start of the splat's row in ``work``; see :func:`lay_out`.
        linear: start of the splat's linear terms; see :func:`move_to_quarter`.
        x, y: Lanes, pixels relative to the quarter's middle.
        screen_x, screen_y: x and y times the root of 2.
    """
    if discs:
        w = linear_at(work, linear + LINEAR.w, row, DISC.w_x, x, y)
        u = linear_at(work, linear + LINEAR.u, row, DISC.u_x, x, y)
        v = linear_at(work, linear + LINEAR.v, row, DISC.v_x, x, y)
        bounded = maximum(w, broadcast(work, row + DISC.w_low))
        z = reciprocal(minimum(bounded, broadcast(work, row + DISC.w_high)))
        sx = screen_x + broadcast(work, linear + LINEAR.screen_x)
        sy = screen_y + broadcast(work, linear + LINEAR.screen_y)
        meets = w <= broadcast(work, row + DISC.w_most)
        rho = minimum(select(meets, (u * u + v * v) * (z * z), f32(NOWHERE)), sx * sx + sy * sy)
    else:
        u, v = footprint_terms(work, row, linear, x, y)
        rho = u * u + v * v
        z = broadcast(work, row + SPLAT.depth_low)
        if not by_center:
            low, high = z, broadcast(work, row + SPLAT.depth_high)
            along, _, _, inverse = peak_terms(work, row, linear, x, y)
            z = broadcast(work, row + SPLAT.depth) * along * inverse
            z = minimum(maximum(z, low), high)
    inside = rho <= broadcast(work, row + SPLAT.cut)
    alpha = minimum(broadcast(work, row + SPLAT.opacity) * _gaussian(rho), f32(ALPHA_MAX))
    return inside, alpha, z


@inlined
def depth_from(work, row, z, discs, by_center, z0):
    """Compute z - z0 from the scaled depth of :func:`evaluate`."""
    if discs:
        if by_center:
            return broadcast(work, row + SPLAT.depth_low) - z0
        return fma(broadcast(work, row + SPLAT.depth), z, -z0)
    return z - z0
