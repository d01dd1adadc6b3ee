# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Backward pass of the projection: from gradients in the table to parameters and the pose.

The vector-Jacobian product of :func:`attnwarp.render._kernels.projection.project`, every step of it
in reverse, one splat after another in float64. Gradients of the loss are named "d_", in a step's
own values "g".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from attnwarp.render._kernels.compilation import bare, f64, inlined, prefetch
from attnwarp.render._kernels.layout import (
    DISC,
    ELLIPSOID,
    ELLIPSOID_GRADIENT,
    GRADIENTS,
    SPLAT,
    View,
)
from attnwarp.render._kernels.projection import harmonics
from attnwarp.render.constants import (
    COMPENSATION_MIN,
    EDGE_ON,
    EXTENT_SIGMAS,
    JACOBIAN_MARGIN,
)
from attnwarp.render.harmonics import C1, C2, C3


class ViewColumns(NamedTuple):
    """A ``View`` as one row of float64, as :func:`view_row` makes it."""

    rotation: int = 0  # (9)
    translation: int = 9  # (3)
    fx: int = 12
    skew: int = 13
    fy: int = 14
    cx: int = 15
    cy: int = 16
    width: int = 17
    height: int = 18
    near: int = 19
    discs: int = 20  # flags: 0 or 1, as the rest are
    by_center: int = 21
    antialiased: int = 22
    harmonic: int = 23
    blur: int = 24


VIEW = ViewColumns()


def view_row(view: View) -> np.ndarray:
    """(25,) the view for :func:`project_backward`.

    One row: with separate values LLVM adds in another order, and the last bits of the gradients
    move.
    """
    return np.array([*view.rotation.reshape(-1), *view.translation, *view[2:]], np.float64)


@inlined
def _rotation(quats, i, Q):
    """Rotation of quaternion i into Q; returns the quaternion's length."""
    w, x, y, z = f64(quats[i, 0]), f64(quats[i, 1]), f64(quats[i, 2]), f64(quats[i, 3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = 1 / length
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    Q[0, 0], Q[0, 1], Q[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    Q[1, 0], Q[1, 1], Q[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    Q[2, 0], Q[2, 1], Q[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return length


@inlined
def _direction_backward(degree, x, y, z, d_basis):
    """Backward of the harmonics to the direction (x, y, z), as if it were free."""
    dx, dy, dz = 0.0, 0.0, 0.0
    if degree > 0:
        dx -= C1 * d_basis[3]
        dy -= C1 * d_basis[1]
        dz += C1 * d_basis[2]
    if degree > 1:
        dx += (
            C2[0] * y * d_basis[4]
            - 2 * C2[2] * x * d_basis[6]
            + C2[3] * z * d_basis[7]
            + 2 * C2[4] * x * d_basis[8]
        )
        dy += (
            C2[0] * x * d_basis[4]
            + C2[1] * z * d_basis[5]
            - 2 * C2[2] * y * d_basis[6]
            - 2 * C2[4] * y * d_basis[8]
        )
        dz += C2[1] * y * d_basis[5] + 4 * C2[2] * z * d_basis[6] + C2[3] * x * d_basis[7]
    if degree > 2:
        d = d_basis
        dx += C3[0] * 6 * x * y * d[9] + C3[1] * y * z * d[10] - C3[2] * 2 * x * y * d[11]
        dx += -C3[3] * 6 * x * z * d[12] + C3[4] * (4 * z * z - 3 * x * x - y * y) * d[13]
        dx += C3[5] * 2 * x * z * d[14] + C3[6] * 3 * (x * x - y * y) * d[15]
        dy += C3[0] * 3 * (x * x - y * y) * d[9] + C3[1] * x * z * d[10]
        dy += C3[2] * (4 * z * z - x * x - 3 * y * y) * d[11] - C3[3] * 6 * y * z * d[12]
        dy += -C3[4] * 2 * x * y * d[13] - C3[5] * 2 * y * z * d[14] - C3[6] * 6 * x * y * d[15]
        dz += C3[1] * x * y * d[10] + C3[2] * 8 * y * z * d[11]
        dz += C3[3] * 3 * (2 * z * z - x * x - y * y) * d[12] + C3[4] * 8 * x * z * d[13]
        dz += C3[5] * (x * x - y * y) * d[14]
    return dx, dy, dz


@inlined
def _quaternion_backward(quats, i, size, d_Q, d_quats):
    """Backward of the rotation of quaternion i, which has the length ``size``."""
    w, x, y, z = (
        f64(quats[i, 0]) / size,
        f64(quats[i, 1]) / size,
        f64(quats[i, 2]) / size,
        f64(quats[i, 3]) / size,
    )
    dw = 2 * (
        x * (d_Q[2, 1] - d_Q[1, 2]) + y * (d_Q[0, 2] - d_Q[2, 0]) + z * (d_Q[1, 0] - d_Q[0, 1])
    )
    yx, zx, zy = d_Q[0, 1] + d_Q[1, 0], d_Q[0, 2] + d_Q[2, 0], d_Q[1, 2] + d_Q[2, 1]
    dx = 2 * (-2 * x * (d_Q[1, 1] + d_Q[2, 2]) + y * yx + z * zx + w * (d_Q[2, 1] - d_Q[1, 2]))
    dy = 2 * (x * yx - 2 * y * (d_Q[0, 0] + d_Q[2, 2]) + z * zy + w * (d_Q[0, 2] - d_Q[2, 0]))
    dz = 2 * (x * zx + y * zy - 2 * z * (d_Q[0, 0] + d_Q[1, 1]) + w * (d_Q[1, 0] - d_Q[0, 1]))
    along = w * dw + x * dx + y * dy + z * dz
    d_quats[i, 0], d_quats[i, 1] = (dw - w * along) / size, (dx - x * along) / size
    d_quats[i, 2], d_quats[i, 3] = (dy - y * along) / size, (dz - z * along) / size


class Workspace(NamedTuple):
    """Memory of one job of :func:`project_backward`, for one splat after another."""

    camera: np.ndarray  # (3, 3) its rotation
    splat: np.ndarray  # (3, 3) rotation of the splat
    axes: np.ndarray  # (3, 3) the splat's axes in columns, in the camera's frame
    mean: np.ndarray  # (3) world
    center: np.ndarray  # (3) camera's frame
    scales: np.ndarray  # (3)
    g_camera: np.ndarray  # (3, 3) summed over splats, as the next is
    g_translation: np.ndarray  # (3)
    g_splat: np.ndarray  # (3, 3)
    g_axes: np.ndarray  # (3, 3)
    g_center: np.ndarray  # (3)
    g_scales: np.ndarray  # (3)
    basis: np.ndarray  # (16) harmonics
    g_basis: np.ndarray  # (16)
    vectors: np.ndarray  # (2, 3) for one step
    matrices: np.ndarray  # (3, 3, 3) for one step


def workspace() -> Workspace:
    """Memory for one job."""
    square, three, harmonic = (3, 3), (3,), (16,)
    shapes = (
        square, square, square, three, three, three,
        square, three, square, square, three, three,
        harmonic, harmonic, (2, 3), (3, 3, 3),
    )  # fmt: skip
    return Workspace(*(np.zeros(shape) for shape in shapes))


@inlined
def _disc_backward(g, inverse, length, work):
    """Backward of a disc's plane; returns the gradient in the distance of its centre."""
    kx, ky, kxy = inverse
    a, c, s = work.axes, work.center, work.scales
    ga, gc, g_s = work.g_axes, work.g_center, work.g_scales
    h, gh = work.vectors[0], work.vectors[1]
    nc = a[0, 2] * c[0] + a[1, 2] * c[1] + a[2, 2] * c[2]
    floor = EDGE_ON * length
    tilted = abs(nc) < floor
    sign = -1.0 if nc < 0 else 1.0
    if tilted:
        nc = sign * floor
    g_depth, g_nc, g_length = g[SPLAT.depth], 0.0, 0.0
    for k in range(2):
        tc = (a[0, k] * c[0] + a[1, k] * c[1] + a[2, k] * c[2]) / nc
        scale = c[2] / s[k]
        for r in range(3):
            h[r] = a[r, k] - tc * a[r, 2]
        gh[0] = g[DISC.u_x + 2 * k] * kx + g[DISC.u_y + 2 * k] * kxy
        gh[1] = g[DISC.u_y + 2 * k] * ky
        gh[2] = 0.0
        g_scale = gh[0] * h[0] + gh[1] * h[1]
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
    scale = c[2] / nc
    gh[0] = g[DISC.w_x] * kx + g[DISC.w_y] * kxy
    gh[1] = g[DISC.w_y] * ky
    g_scale = 0.0
    for r in range(2):
        g_scale += gh[r] * a[r, 2]
        ga[r, 2] += scale * gh[r]
    g_depth += g_scale / nc
    g_nc -= g_scale * scale / nc
    if tilted:
        g_length += sign * EDGE_ON * g_nc
    else:
        for r in range(3):
            ga[r, 2] += g_nc * c[r]
            gc[r] += g_nc * a[r, 2]
    gc[2] += g_depth
    return g_length


@inlined
def _ellipsoid_backward(view, g, row, opacities, i, work):
    """Backward of an ellipsoid's footprint, ``row`` of the table; returns the gradient in the
    opacity.

    The opacity is read where it is used: as a number handed in, LLVM multiplies in another order.
    """
    fx, skew, fy = view[VIEW.fx], view[VIEW.skew], view[VIEW.fy]
    cx, cy = view[VIEW.cx], view[VIEW.cy]
    a, c, s = work.axes, work.center, work.scales
    ga, gc, g_s = work.g_axes, work.g_center, work.g_scales
    in_sharp = work.matrices[0]
    wide, tall = work.vectors[0], work.vectors[1]
    g_opacity = g[SPLAT.opacity]
    limit = JACOBIAN_MARGIN * view[VIEW.width] / 2 / fx
    low, high = -cx / fx - limit, (view[VIEW.width] - cx) / fx + limit
    free_x = low <= c[0] / c[2] <= high
    px = min(max(c[0] / c[2], low), high)
    limit = JACOBIAN_MARGIN * view[VIEW.height] / 2 / fy
    low, high = -cy / fy - limit, (view[VIEW.height] - cy) / fy + limit
    free_y = low <= c[1] / c[2] <= high
    py = min(max(c[1] / c[2], low), high)
    # As _ellipsoid has it, by the axes in the picture.
    blur = view[VIEW.blur]
    xx, yy, square = blur, blur, 0.0
    sxy = 0.0
    for k in range(3):
        f = s[k] / c[2]
        wide[k] = (fx * (a[0, k] - px * a[2, k]) + skew * (a[1, k] - py * a[2, k])) * f
        tall[k] = fy * (a[1, k] - py * a[2, k]) * f
        xx += wide[k] * wide[k]
        sxy += wide[k] * tall[k]
        square += tall[k] * tall[k]
    yy += square
    sharp = 0.0
    for k in range(3):
        # Half of what sharp changes by with both of axis k, and what is left of its minors.
        in_sharp[k, 0], in_sharp[k, 1], in_sharp[k, 2] = 0.0, 0.0, 0.0
        for j in range(3):
            minor = wide[k] * tall[j] - tall[k] * wide[j]
            in_sharp[k, 0] += minor * tall[j]
            in_sharp[k, 1] -= minor * wide[j]
            in_sharp[k, 2] += minor * minor
        sharp += 0.5 * in_sharp[k, 2]
    det = sharp + blur * (xx + square)
    factor_xx = row[ELLIPSOID.factor_xx]
    factor_xy = row[ELLIPSOID.factor_xy]
    factor_yy = row[ELLIPSOID.factor_yy]
    uu, uv = g[ELLIPSOID_GRADIENT.shape], g[ELLIPSOID_GRADIENT.shape + 1]
    vv = g[ELLIPSOID_GRADIENT.shape + 2]
    blurring, sharpening = 0.0, 0.0
    if view[VIEW.antialiased] > 0:
        ratio = sharp / det
        factor = math.sqrt(max(ratio, COMPENSATION_MIN))
        if ratio >= COMPENSATION_MIN:
            # Of log(sharp / det), with det / sharp - 1 in place of a difference of logs.
            g_ratio = g_opacity * opacities[i] * factor / det
            blurring = -g_ratio * blur
            sharpening = g_ratio * blur * (xx + square) / sharp
        g_opacity *= factor
    g_px, g_py = 0.0, 0.0
    for k in range(3):
        f = s[k] / c[2]
        # The axis in units of the footprint, F M. Its gradient is F^T (sums of w w^T) F M,
        # since Sigma^-1 = F^T F and rho = w.w.
        u = factor_xx / yy * (in_sharp[k, 0] + blur * wide[k])
        v = factor_yy * tall[k]
        gu, gv = uu * u + uv * v, uv * u + vv * v
        ux, uy = factor_xx * gu, factor_xy * gu + factor_yy * gv
        ux += blurring * wide[k] + sharpening * in_sharp[k, 0]
        uy += blurring * tall[k] + sharpening * in_sharp[k, 1]
        # By the length alone; ux wide + uy tall, without the cancellation.
        along = gu * u + gv * v + sharpening * in_sharp[k, 2]
        along += blurring * (wide[k] * wide[k] + tall[k] * tall[k])
        ga[0, k] += ux * fx * f
        ga[1, k] += (ux * skew + uy * fy) * f
        ga[2, k] -= (ux * (fx * px + skew * py) + uy * fy * py) * f
        g_px -= ux * fx * a[2, k] * f
        g_py -= (ux * skew + uy * fy) * a[2, k] * f
        g_s[k] += along / s[k]
        gc[2] -= along / c[2]
    if free_x:
        gc[0] += g_px / c[2]
        gc[2] -= g_px * c[0] / (c[2] * c[2])
    if free_y:
        gc[1] += g_py / c[2]
        gc[2] -= g_py * c[1] / (c[2] * c[2])
    return g_opacity


@inlined
def _peak_backward(g, kx, work):
    """Backward of an ellipsoid's depth where it is largest along a pixel's ray."""
    a, c, s = work.axes, work.center, work.scales
    ga, gc, g_s = work.g_axes, work.g_center, work.g_scales
    T, H, D = work.matrices[0], work.matrices[1], work.matrices[2]
    # As _peak has it: z = depth (g.r) / (r.r), and r = |g| (l, p, q) in the frame T of
    # g, of what is left of X, and of g x X. A pixel's ray does not change, so z depends
    # on the axes, the scales and the centre through g and r alone.
    length_g, across = 0.0, 0.0
    for k in range(3):
        down = a[1, k] - a[2, k] * c[1] / c[2]
        T[k, 0] = (a[0, k] * c[0] + a[1, k] * c[1] + a[2, k] * c[2]) / (c[2] * s[k])
        T[k, 2] = down * s[k]
        length_g += T[k, 0] ** 2
        across += T[k, 2] ** 2
    length_g, across = math.sqrt(length_g), math.copysign(math.sqrt(across), kx)
    for k in range(3):
        T[k, 0] /= length_g
        T[k, 2] /= across
    for k in range(3):
        j, r = (k + 1) % 3, (k + 2) % 3
        T[k, 1] = T[j, 2] * T[r, 0] - T[r, 2] * T[j, 0]
    column = ELLIPSOID_GRADIENT.linear
    gl, gp, gq = g[column], g[column + 1], g[column + 2]
    column = ELLIPSOID_GRADIENT.square
    lp, lq, pp, pq = g[column], g[column + 1], g[column + 2], g[column + 3]
    qq = g[ELLIPSOID_GRADIENT.square_last]
    # Gradients in what scales and turns the ray and g together, symmetric.
    H[0, 0] = 2 * (pp + qq)
    H[0, 1] = H[1, 0] = gp - 2 * lp
    H[0, 2] = H[2, 0] = gq - 2 * lq
    H[1, 1], H[2, 2] = -2 * pp, -2 * qq
    H[1, 2] = H[2, 1] = -2 * pq
    for k in range(3):
        for j in range(3):
            D[k, j] = 0.0
            for r in range(3):
                turned = H[r, 0] * T[j, 0] + H[r, 1] * T[j, 1] + H[r, 2] * T[j, 2]
                D[k, j] += T[k, r] * turned
    for k in range(3):
        g_s[k] -= D[k, k] / s[k]
        in_center = T[k, 0] * gl + T[k, 1] * gp + T[k, 2] * gq
        in_center /= c[2] * length_g * s[k]
        for r in range(3):
            gc[r] += in_center * a[r, k]
            for j in range(3):
                ga[r, k] += a[r, j] * D[k, j] * (s[j] / s[k])


@inlined
def _extent_backward(g, count, by_center, near, work):
    """Backward of the nearest and the farthest depth of a splat with ``count`` scales."""
    a, c, s = work.axes, work.center, work.scales
    ga, gc, g_s = work.g_axes, work.g_center, work.g_scales
    spread = (s[0] * a[2, 0]) ** 2 + (s[1] * a[2, 1]) ** 2
    if count == 3:
        spread += (s[2] * a[2, 2]) ** 2
    spread = math.sqrt(spread)
    if by_center:
        gc[2] += g[SPLAT.depth_low] + g[SPLAT.depth_high]
    else:
        g_spread = 0.0
        if c[2] - EXTENT_SIGMAS * spread > near:
            gc[2] += g[SPLAT.depth_low]
            g_spread -= EXTENT_SIGMAS * g[SPLAT.depth_low]
        gc[2] += g[SPLAT.depth_high]
        g_spread += EXTENT_SIGMAS * g[SPLAT.depth_high]
        if spread > 0:
            for k in range(count):
                g_s[k] += g_spread * s[k] * a[2, k] ** 2 / spread
                ga[2, k] += g_spread * s[k] ** 2 * a[2, k] / spread


@inlined
def _normal_backward(g, discs, work):
    """Backward of the normal: a disc's axis or that of the smallest scale, turned to the camera."""
    a, c, s, gQ = work.axes, work.center, work.scales, work.g_splat
    axis = 2
    if not discs:
        axis = 0
        if s[1] < s[axis]:
            axis = 1
        if s[2] < s[axis]:
            axis = 2
    facing = a[0, axis] * c[0] + a[1, axis] * c[1] + a[2, axis] * c[2]
    flip = -1.0 if facing > 0 else 1.0
    for k in range(3):
        gQ[k, axis] += flip * g[GRADIENTS + k]


@inlined
def _harmonics_backward(g, degree, length, values, i, d_values, work):
    """Backward of the colour in splat i's harmonics and in the direction to the splat."""
    R, c, Y = work.camera, work.center, work.basis
    gR, gc, gY, h = work.g_camera, work.g_center, work.g_basis, work.vectors[0]
    x = (R[0, 0] * c[0] + R[1, 0] * c[1] + R[2, 0] * c[2]) / length
    y = (R[0, 1] * c[0] + R[1, 1] * c[1] + R[2, 1] * c[2]) / length
    z = (R[0, 2] * c[0] + R[1, 2] * c[1] + R[2, 2] * c[2]) / length
    harmonics(degree, x, y, z, Y)
    bases = (degree + 1) ** 2
    for j in range(bases):
        gY[j] = 0.0
    for k in range(3):
        shade = 0.5
        for j in range(bases):
            shade += Y[j] * values[i, 3 * j + k]
        if shade >= 0:
            for j in range(bases):
                d_values[i, 3 * j + k] = g[GRADIENTS + 3 + k] * Y[j]
                gY[j] += g[GRADIENTS + 3 + k] * values[i, 3 * j + k]
    dx, dy, dz = _direction_backward(degree, x, y, z, gY)
    along = x * dx + y * dy + z * dz
    h[0], h[1], h[2] = (
        (dx - x * along) / length,
        (dy - y * along) / length,
        (dz - z * along) / length,
    )
    for r in range(3):
        for k in range(3):
            gc[r] += R[r, k] * h[k]
            gR[r, k] += c[r] * h[k]


@bare
def project_backward(
    first,
    last,
    view,  # (24,) float64, see ViewColumns
    splats,
    order,  # (M,) int32
    channels,
    projected,
    total,  # (M, GRADIENTS + 3 + max(3, C)) float64
    gradients,
    g_view,  # (12,) float64
    work,  # Workspace
):
    """Gradients in the parameters of the splats order[first:last] from those in their projection,
    ``total``.

    The vector-Jacobian product of :func:`project`, in float64, every step of it in reverse.
    ``g_view`` (12) receives the sums for R and t.
    """
    m, q, sizes, o, values = (
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        splats.values,
    )
    d_means, d_quats, d_scales = gradients.means, gradients.quats, gradients.scales
    d_opacities, d_values = gradients.opacities, gradients.values
    table = projected.doubles
    R, Q, a, mean, c, s = work.camera, work.splat, work.axes, work.mean, work.center, work.scales
    gR, gt, gQ = work.g_camera, work.g_translation, work.g_splat
    ga, gc, g_s = work.g_axes, work.g_center, work.g_scales
    fx, skew, fy = view[VIEW.fx], view[VIEW.skew], view[VIEW.fy]
    cx, cy, near = view[VIEW.cx], view[VIEW.cy], view[VIEW.near]
    discs, by_center = view[VIEW.discs] > 0, view[VIEW.by_center] > 0
    degree = round(math.sqrt(values.shape[1] / 3)) - 1
    inverse = (1 / fx, 1 / fy, -skew / (fx * fy))
    for r in range(3):
        gt[r] = 0.0
        for k in range(3):
            R[r, k] = view[3 * r + k]
            gR[r, k] = 0.0
    for place in range(first, last):
        later = order[min(place + 12, last - 1)]
        prefetch(m, later * 3)
        prefetch(q, later * 4)
        prefetch(sizes, later * sizes.shape[1])
        prefetch(values, later * values.shape[1])
        i = order[place]
        g = total[place]
        contributes = False
        for k in range(g.shape[0]):
            contributes |= g[k] != 0.0
        if not contributes:
            # Never seen, or not even projected: its row of the table may hold anything.
            continue
        for k in range(sizes.shape[1]):
            s[k] = sizes[i, k]
            g_s[k] = 0.0
        for r in range(3):
            mean[r] = m[i, r]
        for r in range(3):
            c[r] = (
                R[r, 0] * mean[0]
                + R[r, 1] * mean[1]
                + R[r, 2] * mean[2]
                + view[VIEW.translation + r]
            )
        size = _rotation(q, i, Q)
        for r in range(3):
            for k in range(3):
                a[r, k] = R[r, 0] * Q[0, k] + R[r, 1] * Q[1, k] + R[r, 2] * Q[2, k]
        for r in range(3):
            gc[r] = 0.0
            for k in range(3):
                ga[r, k], gQ[r, k] = 0.0, 0.0
        g_length = 0.0
        length = math.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
        gc[0] += g[SPLAT.center_x] * fx / c[2]
        gc[1] += (g[SPLAT.center_x] * skew + g[SPLAT.center_y] * fy) / c[2]
        gc[2] -= (
            g[SPLAT.center_x] * (table[place, SPLAT.center_x] - cx)
            + g[SPLAT.center_y] * (table[place, SPLAT.center_y] - cy)
        ) / c[2]
        g_opacity = g[SPLAT.opacity]
        if discs:
            g_length = _disc_backward(g, inverse, length, work)
        else:
            g_opacity = _ellipsoid_backward(view, g, table[place], o, i, work)
            if not by_center:
                _peak_backward(g, inverse[0], work)
        _extent_backward(g, sizes.shape[1], by_center, near, work)
        d_opacities[i] = g_opacity
        _normal_backward(g, discs, work)
        if view[VIEW.harmonic] > 0:
            _harmonics_backward(g, degree, length, values, i, d_values, work)
        else:
            for k in range(channels):
                d_values[i, k] = g[GRADIENTS + 3 + k]
        for r in range(3):
            gc[r] += g_length * c[r] / length
        for r in range(3):
            for k in range(3):
                for j in range(3):
                    gQ[j, k] += R[r, j] * ga[r, k]
                    gR[r, j] += ga[r, k] * Q[j, k]
        for k in range(3):
            d_means[i, k] = R[0, k] * gc[0] + R[1, k] * gc[1] + R[2, k] * gc[2]
        for k in range(sizes.shape[1]):
            d_scales[i, k] = g_s[k]
        for r in range(3):
            gt[r] += gc[r]
            for k in range(3):
                gR[r, k] += gc[r] * mean[k]
        _quaternion_backward(q, i, size, gQ, d_quats)
    for r in range(3):
        g_view[9 + r] = gt[r]
        for k in range(3):
            g_view[3 * r + k] = gR[r, k]
