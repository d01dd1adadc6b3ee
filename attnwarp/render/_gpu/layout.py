"""Data shared by the GPU kernels: the view, and the columns of a projected splat."""

from __future__ import annotations

import warp as wp

TILE = 8
"""Edge of a tile in pixels: two warps of 8 x 4. It is smaller than the CPU backend's: no tile is
loaded as a unit, and small tiles exclude more pixels outside a splat.
"""
PIXELS = TILE * TILE
MIDDLE = 3.5
"""Middle of a tile, from its first pixel's centre."""

DOUBLES = 10
SINGLES = 32
TERMS = 5
NOWHERE = 1e30
WEIGHT_UNIT = 2.0**36
"""Weights are summed as integer multiples of 1 / WEIGHT_UNIT."""


class At:
    """Columns of the float64 table: the reference point, and a splat's linear terms about it.

    The reference point is the projected centre. Of a 2D splat u = U / W, v = V / W and z = depth /
    W, with U = u_x dx + u_y dy, V = v_x dx + v_y dy and W = 1 + w_x dx + w_y dy. Of a 3D splat rho
    = u^2 + v^2 and z = depth l / (l^2 + p^2 + q^2), with u = factor_xx dx + factor_xy dy, v =
    factor_yy dy, l = 1 + peak_x dx + peak_y dy, p = peak_xx dx + peak_xy dy and q = peak_yy dy:
    sums of squares, as the forms they equal lose a needle's digits.
    """

    center_x = 0
    center_y = 1
    u_x = 2
    u_y = 3
    v_x = 4
    v_y = 5
    w_x = 6
    w_y = 7
    factor_xx = 2
    factor_xy = 3
    factor_yy = 4
    peak_x = 5
    peak_y = 6
    peak_xx = 7
    peak_xy = 8
    peak_yy = 9


class Of:
    """Columns of the float32 table: a splat's outline first, then its appearance."""

    u_x = 0
    u_y = 1
    v_x = 2
    v_y = 3
    w_x = 4
    w_y = 5
    factor_xx = 0
    factor_xy = 1
    factor_yy = 2
    peak_x = 3
    peak_y = 4
    peak_xx = 5
    peak_xy = 6
    peak_yy = 7
    w_low = 6  # bounds of W within a 2D splat's extent
    w_high = 7
    cut = 8  # drawn where rho <= cut; -1: nowhere
    w_most = 10  # the plane is nearer than near where W is larger
    opacity = 11
    depth = 12  # of the centre
    depth_low = 14  # bounds of z at a pixel: the splat's extent, and near
    depth_high = 15
    normal = 17  # (3) in world axes
    values = 20  # (3) the first three channels
    is_ellipse = 23  # its outline is one


class DiscSum:
    """Columns of a 2D splat's row of gradients, up to their sign."""

    exponent = 0  # in rho / 2
    u = 1  # (3) in U: times the pixel's x and y from the reference point, and alone
    v = 4
    w = 7
    center = 10  # (2) through the screen filter
    depth = 12
    low = 13
    high = 14


class EllipsoidSum:
    """Columns of a 3D splat's row of gradients.

    With k the gradient in z times z / l, moments of it in the numbers that z is made of, and of the
    gradient in -rho / 2 in u and v. They are free of the pixel's position, which may be far from
    the centre.
    """

    exponent = 0
    uv = 1  # (2) in rho / 2, times u and v
    shape = 3  # (3) times u^2, u v, v^2
    low = 6
    high = 7
    linear = 8  # (3) k l, k p, k q
    square = 11  # (5) k l z / depth times p l, q l, p^2, p q, q^2


class Sum:
    """Columns of both kinds' rows of gradients."""

    normal = 16  # (3)
    values = 19  # (3), then the channels from the fourth on


@wp.struct
class View:
    """The camera, and which picture is asked for."""

    rotation: wp.mat33d  # world to camera
    translation: wp.vec3d  # with the splats' origin moved in
    fx: wp.float64
    skew: wp.float64
    fy: wp.float64
    cx: wp.float64
    cy: wp.float64
    near: wp.float64
    blur: wp.float64  # px^2 that the screen filter adds to a 3D splat's variance
    width: wp.int32
    height: wp.int32
    across: wp.int32  # tiles
    down: wp.int32
    discs: wp.bool  # kind "2d", else "3d"
    by_center: wp.bool  # a splat's depth is its centre's
    antialiased: wp.bool
    harmonic: wp.bool  # values are spherical harmonics, else features
    degree: wp.int32  # of the harmonics
    channels: wp.int32
