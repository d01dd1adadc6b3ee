# mypy: ignore-errors
"""Backward pass of the projection: from gradients in the tables to parameters and the pose.

The vector-Jacobian product of :func:`attnwarp.render._gpu.projection.project`, every step of it in
reverse, one thread a splat in float64. Gradients of the loss are named "g".
"""

from __future__ import annotations

from typing import Any

import warp as wp

from attnwarp.render._gpu.lanes import COLUMNS, add_double
from attnwarp.render._gpu.layout import At, DiscSum, EllipsoidSum, Of, Sum, View
from attnwarp.render._gpu.projection import (
    COMPENSATION_MIN,
    EDGE_ON,
    EXTENT,
    HALF,
    MARGIN,
    ONE,
    TWO,
    Y1,
    Y20,
    Y21,
    Y22,
    Y23,
    Y24,
    Y30,
    Y31,
    Y32,
    Y33,
    Y34,
    Y35,
    Y36,
    ZERO,
    Basis,
    harmonics,
    of_type,
    rotation_of,
    shortest_axis,
)

f64 = wp.float64
THREE, FOUR, SIX, EIGHT = f64(3.0), f64(4.0), f64(6.0), f64(8.0)


@wp.struct
class Gradient:
    """Gradients in what the projection makes of a splat's parameters and the camera."""

    axes: wp.mat33d  # the splat's, in the camera's frame
    splat: wp.mat33d  # rotation of the splat
    camera: wp.mat33d  # rotation of the camera
    center: wp.vec3d  # camera's frame
    scales: wp.vec3d
    length: wp.float64  # distance of the centre
    opacity: wp.float64


@wp.func
def disc_backward(
    g: Gradient, total: wp.array2d(dtype=wp.float64), i: wp.int32, view: View, a: wp.mat33d,
    c: wp.vec3d, s: wp.vec3d, length: wp.float64,
) -> Gradient:  # fmt: skip
    """Backward of a disc's plane."""
    kx, ky, kxy = ONE / view.fx, ONE / view.fy, -view.skew / (view.fx * view.fy)
    n = wp.vec3d(a[0, 2], a[1, 2], a[2, 2])
    nc = wp.dot(n, c)
    floor = EDGE_ON * length
    tilted = wp.abs(nc) < floor
    sign = wp.where(nc < ZERO, -ONE, ONE)
    if tilted:
        nc = sign * floor
    g_depth, g_nc = f64(total[i, DiscSum.depth]), f64(0.0)
    for k in range(2):
        t = wp.vec3d(a[0, k], a[1, k], a[2, k])
        column = DiscSum.u + 3 * k
        tc = wp.dot(t, c) / nc
        scale = c[2] / s[k]
        h = t - tc * n
        gh = wp.vec3d(
            total[i, column] * kx + total[i, column + 1] * kxy,
            total[i, column + 1] * ky,
            ZERO,
        )
        g_scale = wp.dot(gh, h)
        gh = gh * scale
        g_tc = -wp.dot(gh, n)
        for r in range(3):
            g.axes[r, k] = g.axes[r, k] + gh[r] + g_tc * c[r] / nc
            g.axes[r, 2] = g.axes[r, 2] - tc * gh[r]
        g.center = g.center + t * (g_tc / nc)
        g_nc -= g_tc * tc / nc
        g_depth += g_scale / s[k]
        g.scales[k] = g.scales[k] - g_scale * scale / s[k]
    scale = c[2] / nc
    gh = wp.vec3d(
        total[i, DiscSum.w] * kx + total[i, DiscSum.w + 1] * kxy,
        total[i, DiscSum.w + 1] * ky,
        ZERO,
    )
    g_scale = wp.dot(gh, n)
    for r in range(3):
        g.axes[r, 2] = g.axes[r, 2] + scale * gh[r]
    g_depth += g_scale / nc
    g_nc -= g_scale * scale / nc
    if tilted:
        g.length = g.length + sign * EDGE_ON * g_nc
    else:
        for r in range(3):
            g.axes[r, 2] = g.axes[r, 2] + g_nc * c[r]
        g.center = g.center + n * g_nc
    g.center[2] = g.center[2] + g_depth
    return g


@wp.func
def ellipsoid_backward(
    g: Gradient, total: wp.array2d(dtype=wp.float64), i: wp.int32, view: View,
    doubles: wp.array2d(dtype=wp.float64), opacity: wp.float64, a: wp.mat33d, c: wp.vec3d,
    s: wp.vec3d,
) -> Gradient:  # fmt: skip
    """Backward of an ellipsoid's footprint."""
    limit = MARGIN * f64(view.width) / TWO / view.fx
    low, high = -view.cx / view.fx - limit, (f64(view.width) - view.cx) / view.fx + limit
    free_x = low <= c[0] / c[2] and c[0] / c[2] <= high
    px = wp.clamp(c[0] / c[2], low, high)
    limit = MARGIN * f64(view.height) / TWO / view.fy
    low, high = -view.cy / view.fy - limit, (f64(view.height) - view.cy) / view.fy + limit
    free_y = low <= c[1] / c[2] and c[1] / c[2] <= high
    py = wp.clamp(c[1] / c[2], low, high)
    wide, tall = wp.vec3d(), wp.vec3d()
    for k in range(3):
        f = s[k] / c[2]
        down = a[1, k] - py * a[2, k]
        wide[k] = ((a[0, k] - px * a[2, k]) * view.fx + down * view.skew) * f
        tall[k] = down * view.fy * f
    square = wp.dot(tall, tall)
    xx, yy = wp.dot(wide, wide) + view.blur, square + view.blur
    # For each axis half of what sharp changes by with both of it, and what is left of its minors.
    in_wide, in_tall, minors = wp.vec3d(), wp.vec3d(), wp.vec3d()
    for k in range(3):
        for j in range(3):
            minor = wide[k] * tall[j] - tall[k] * wide[j]
            in_wide[k] = in_wide[k] + minor * tall[j]
            in_tall[k] = in_tall[k] - minor * wide[j]
            minors[k] = minors[k] + minor * minor
    sharp = HALF * (minors[0] + minors[1] + minors[2])
    det = sharp + view.blur * (xx + square)
    factor_xx, factor_xy = doubles[i, At.factor_xx], doubles[i, At.factor_xy]
    factor_yy = doubles[i, At.factor_yy]
    uu, uv = total[i, EllipsoidSum.shape], total[i, EllipsoidSum.shape + 1]
    vv = total[i, EllipsoidSum.shape + 2]
    blurring, sharpening = f64(0.0), f64(0.0)
    if view.antialiased:
        ratio = sharp / det
        factor = wp.sqrt(wp.max(ratio, COMPENSATION_MIN))
        if ratio >= COMPENSATION_MIN:
            # Of log(sharp / det), with det / sharp - 1 in place of a difference of logs.
            g_ratio = g.opacity * opacity * factor / det
            blurring = -g_ratio * view.blur
            sharpening = g_ratio * view.blur * (xx + square) / sharp
        g.opacity = g.opacity * factor
    g_px, g_py = f64(0.0), f64(0.0)
    for k in range(3):
        f = s[k] / c[2]
        # The axis in units of the footprint, F M. Its gradient is F^T (sums of w w^T) F M, since
        # Sigma^-1 = F^T F and rho = w.w.
        u = factor_xx / yy * (in_wide[k] + view.blur * wide[k])
        v = factor_yy * tall[k]
        gu, gv = uu * u + uv * v, uv * u + vv * v
        ux = factor_xx * gu + blurring * wide[k] + sharpening * in_wide[k]
        uy = factor_xy * gu + factor_yy * gv + blurring * tall[k] + sharpening * in_tall[k]
        # By the length alone; ux wide + uy tall, without the cancellation.
        along = gu * u + gv * v + sharpening * minors[k]
        along += blurring * (wide[k] * wide[k] + tall[k] * tall[k])
        g.axes[0, k] = g.axes[0, k] + ux * view.fx * f
        g.axes[1, k] = g.axes[1, k] + (ux * view.skew + uy * view.fy) * f
        g.axes[2, k] = g.axes[2, k] - (
            ux * (view.fx * px + view.skew * py) + uy * view.fy * py
        ) * f  # fmt: skip
        g_px -= ux * view.fx * a[2, k] * f
        g_py -= (ux * view.skew + uy * view.fy) * a[2, k] * f
        g.scales[k] = g.scales[k] + along / s[k]
        g.center[2] = g.center[2] - along / c[2]
    if free_x:
        g.center[0] = g.center[0] + g_px / c[2]
        g.center[2] = g.center[2] - g_px * c[0] / (c[2] * c[2])
    if free_y:
        g.center[1] = g.center[1] + g_py / c[2]
        g.center[2] = g.center[2] - g_py * c[1] / (c[2] * c[2])
    return g


@wp.func
def peak_backward(
    g: Gradient, total: wp.array2d(dtype=wp.float64), i: wp.int32, view: View, a: wp.mat33d,
    c: wp.vec3d, s: wp.vec3d,
) -> Gradient:  # fmt: skip
    """Backward of an ellipsoid's depth where it is largest along a pixel's ray.

    As the projection has it, z = depth (g.r) / (r.r), and r = |g| (l, p, q) in the frame T of g, of
    what is left of X, and of g x X. A pixel's ray does not change, so z depends on the axes, the
    scales and the centre through g and r alone.
    """
    T, H, D = wp.mat33d(), wp.mat33d(), wp.mat33d()
    length_g, across = f64(0.0), f64(0.0)
    for k in range(3):
        T[k, 0] = (a[0, k] * c[0] + a[1, k] * c[1] + a[2, k] * c[2]) / (c[2] * s[k])
        T[k, 2] = (a[1, k] - a[2, k] * c[1] / c[2]) * s[k]
        length_g += T[k, 0] * T[k, 0]
        across += T[k, 2] * T[k, 2]
    length_g, across = wp.sqrt(length_g), wp.sqrt(across)
    if view.fx < ZERO:
        across = -across
    for k in range(3):
        T[k, 0] = T[k, 0] / length_g
        T[k, 2] = T[k, 2] / across
    for k in range(3):
        j, r = (k + 1) % 3, (k + 2) % 3
        T[k, 1] = T[j, 2] * T[r, 0] - T[r, 2] * T[j, 0]
    linear, column = EllipsoidSum.linear, EllipsoidSum.square
    gl, gp, gq = total[i, linear], total[i, linear + 1], total[i, linear + 2]
    lp, lq, pp = total[i, column], total[i, column + 1], total[i, column + 2]
    pq, qq = total[i, column + 3], total[i, column + 4]
    # Gradients in what scales and turns the ray and g together, symmetric.
    H[0, 0] = TWO * (pp + qq)
    H[0, 1] = gp - TWO * lp
    H[1, 0] = H[0, 1]
    H[0, 2] = gq - TWO * lq
    H[2, 0] = H[0, 2]
    H[1, 1] = -TWO * pp
    H[2, 2] = -TWO * qq
    H[1, 2] = -TWO * pq
    H[2, 1] = H[1, 2]
    D = T * H * wp.transpose(T)
    for k in range(3):
        g.scales[k] = g.scales[k] - D[k, k] / s[k]
        in_center = (T[k, 0] * gl + T[k, 1] * gp + T[k, 2] * gq) / (c[2] * length_g * s[k])
        for r in range(3):
            g.center[r] = g.center[r] + in_center * a[r, k]
            for j in range(3):
                g.axes[r, k] = g.axes[r, k] + a[r, j] * D[k, j] * (s[j] / s[k])
    return g


@wp.func
def extent_backward(
    g: Gradient, in_low: wp.float64, in_high: wp.float64, view: View, a: wp.mat33d, c: wp.vec3d,
    s: wp.vec3d,
) -> Gradient:  # fmt: skip
    """Backward of the nearest and the farthest depth of a splat."""
    if view.by_center:
        g.center[2] = g.center[2] + in_low + in_high
        return g
    square = f64(0.0)
    for k in range(3):
        square += s[k] * a[2, k] * s[k] * a[2, k]
    spread = wp.sqrt(square)
    g_spread = f64(0.0)
    if c[2] - EXTENT * spread > view.near:
        g.center[2] = g.center[2] + in_low
        g_spread -= EXTENT * in_low
    g.center[2] = g.center[2] + in_high
    g_spread += EXTENT * in_high
    if spread > ZERO:
        for k in range(3):
            g.scales[k] = g.scales[k] + g_spread * s[k] * a[2, k] * a[2, k] / spread
            g.axes[2, k] = g.axes[2, k] + g_spread * s[k] * s[k] * a[2, k] / spread
    return g


@wp.func
def direction_backward(degree: wp.int32, x: wp.float64, y: wp.float64, z: wp.float64, d: Basis):
    """Backward of the harmonics to the direction (x, y, z), as if it were free."""
    dx, dy, dz = f64(0.0), f64(0.0), f64(0.0)
    if degree > 0:
        dx -= Y1 * d[3]
        dy -= Y1 * d[1]
        dz += Y1 * d[2]
    if degree > 1:
        dx += Y20 * y * d[4] - TWO * Y22 * x * d[6] + Y23 * z * d[7] + TWO * Y24 * x * d[8]
        dy += Y20 * x * d[4] + Y21 * z * d[5] - TWO * Y22 * y * d[6] - TWO * Y24 * y * d[8]
        dz += Y21 * y * d[5] + FOUR * Y22 * z * d[6] + Y23 * x * d[7]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        dx += Y30 * SIX * x * y * d[9] + Y31 * y * z * d[10] - Y32 * TWO * x * y * d[11]
        dx += -Y33 * SIX * x * z * d[12] + Y34 * (FOUR * zz - THREE * xx - yy) * d[13]
        dx += Y35 * TWO * x * z * d[14] + Y36 * THREE * (xx - yy) * d[15]
        dy += Y30 * THREE * (xx - yy) * d[9] + Y31 * x * z * d[10]
        dy += Y32 * (FOUR * zz - xx - THREE * yy) * d[11] - Y33 * SIX * y * z * d[12]
        dy += -Y34 * TWO * x * y * d[13] - Y35 * TWO * y * z * d[14] - Y36 * SIX * x * y * d[15]
        dz += Y31 * x * y * d[10] + Y32 * EIGHT * y * z * d[11]
        dz += Y33 * THREE * (TWO * zz - xx - yy) * d[12] + Y34 * EIGHT * x * z * d[13]
        dz += Y35 * (xx - yy) * d[14]
    return wp.vec3d(dx, dy, dz)


@wp.func
def harmonics_backward(
    g: Gradient, total: wp.array2d(dtype=wp.float64), i: wp.int32, view: View,
    values: wp.array2d(dtype=wp.float32), d_values: wp.array2d(dtype=wp.float32), c: wp.vec3d,
    length: wp.float64,
) -> Gradient:  # fmt: skip
    """Backward of the colour in a splat's harmonics and in the direction to the splat."""
    R = view.rotation
    to = wp.transpose(R) * c / length
    Y = harmonics(view.degree, to[0], to[1], to[2])
    in_basis = Basis()
    bases = (view.degree + 1) * (view.degree + 1)
    for k in range(3):
        shade = f64(0.5)
        for j in range(bases):
            shade += Y[j] * f64(values[i, 3 * j + k])
        if shade >= ZERO:
            part = total[i, Sum.values + k]
            for j in range(bases):
                d_values[i, 3 * j + k] = wp.float32(part * Y[j])
                in_basis[j] = in_basis[j] + part * f64(values[i, 3 * j + k])
    d = direction_backward(view.degree, to[0], to[1], to[2], in_basis)
    h = (d - to * wp.dot(to, d)) / length
    g.center = g.center + R * h
    g.camera = g.camera + wp.outer(c, h)
    return g


@wp.func
def quaternion_backward(
    w: wp.float64, x: wp.float64, y: wp.float64, z: wp.float64, d: wp.mat33d
) -> wp.vec4d:
    """Backward of the rotation of a unit quaternion, as if it were free to change its length too:
    without the part along it."""
    dw = TWO * (x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1]))
    yx, zx, zy = d[0, 1] + d[1, 0], d[0, 2] + d[2, 0], d[1, 2] + d[2, 1]
    dx = TWO * (-TWO * x * (d[1, 1] + d[2, 2]) + y * yx + z * zx + w * (d[2, 1] - d[1, 2]))
    dy = TWO * (x * yx - TWO * y * (d[0, 0] + d[2, 2]) + z * zy + w * (d[0, 2] - d[2, 0]))
    dz = TWO * (x * zx + y * zy - TWO * z * (d[0, 0] + d[1, 1]) + w * (d[1, 0] - d[0, 1]))
    along = w * dw + x * dx + y * dy + z * dz
    return wp.vec4d(dw - w * along, dx - x * along, dy - y * along, dz - z * along)


@wp.kernel(enable_backward=False)
def project_backward(
    view: View,
    count: wp.int32,
    with_pose: wp.bool,
    means: wp.array2d(dtype=Any),
    quats: wp.array2d(dtype=Any),
    scales: wp.array2d(dtype=Any),
    opacities: wp.array(dtype=Any),
    values: wp.array2d(dtype=wp.float32),
    doubles: wp.array2d(dtype=wp.float64),
    singles: wp.array2d(dtype=wp.float32),
    total: wp.array2d(dtype=wp.float64),
    d_means: wp.array2d(dtype=Any),
    d_quats: wp.array2d(dtype=Any),
    d_scales: wp.array2d(dtype=Any),
    d_opacities: wp.array(dtype=Any),
    d_values: wp.array2d(dtype=wp.float32),
    d_pose: wp.array(dtype=wp.float64),  # (12,) of the rotation and the translation
):
    """Gradients in a splat's parameters from its row of ``total``, and in the pose.

    The threads are those of whole warps, as the pose's gradient is summed among them.
    """
    thread = wp.tid()
    i = wp.min(thread, count - 1)
    contributes = wp.bool(False)
    if thread < count:
        for k in range(total.shape[1]):
            if total[i, k] != ZERO:
                contributes = True
    g = Gradient()
    if contributes:
        R = view.rotation
        mean = wp.vec3d(f64(means[i, 0]), f64(means[i, 1]), f64(means[i, 2]))
        c = R * mean + view.translation
        w, x, y, z = f64(quats[i, 0]), f64(quats[i, 1]), f64(quats[i, 2]), f64(quats[i, 3])
        size = wp.sqrt(w * w + x * x + y * y + z * z)
        q = rotation_of(w, x, y, z)
        a = R * q
        s = wp.vec3d(f64(scales[i, 0]), f64(scales[i, 1]), ZERO)
        opacity = f64(opacities[i])
        length = wp.length(c)
        in_x, in_y, in_low, in_high = f64(0.0), f64(0.0), f64(0.0), f64(0.0)
        axis = wp.int32(2)
        # The gradient in the exponent is alpha times that in alpha.
        g.opacity = total[i, 0] / f64(singles[i, Of.opacity])
        if view.discs:
            in_low, in_high = f64(total[i, DiscSum.low]), f64(total[i, DiscSum.high])
            du, dv, dw = total[i, DiscSum.u + 2], total[i, DiscSum.v + 2], total[i, DiscSum.w + 2]
            in_x = -(doubles[i, At.u_x] * du + doubles[i, At.v_x] * dv + doubles[i, At.w_x] * dw)
            in_y = -(doubles[i, At.u_y] * du + doubles[i, At.v_y] * dv + doubles[i, At.w_y] * dw)
            in_x -= total[i, DiscSum.center]
            in_y -= total[i, DiscSum.center + 1]
            g = disc_backward(g, total, i, view, a, c, s, length)
        else:
            s[2] = f64(scales[i, 2])
            in_low, in_high = f64(total[i, EllipsoidSum.low]), f64(total[i, EllipsoidSum.high])
            u, v = total[i, EllipsoidSum.uv], total[i, EllipsoidSum.uv + 1]
            in_x = doubles[i, At.factor_xx] * u
            in_y = doubles[i, At.factor_xy] * u + doubles[i, At.factor_yy] * v
            g = ellipsoid_backward(g, total, i, view, doubles, opacity, a, c, s)
            if not view.by_center:
                g = peak_backward(g, total, i, view, a, c, s)
            axis = shortest_axis(s)
        g.center[0] = g.center[0] + in_x * view.fx / c[2]
        g.center[1] = g.center[1] + (in_x * view.skew + in_y * view.fy) / c[2]
        offset_x = doubles[i, At.center_x] - view.cx
        offset_y = doubles[i, At.center_y] - view.cy
        g.center[2] = g.center[2] - (in_x * offset_x + in_y * offset_y) / c[2]
        g = extent_backward(g, in_low, in_high, view, a, c, s)
        facing = a[0, axis] * c[0] + a[1, axis] * c[1] + a[2, axis] * c[2]
        flip = wp.where(facing > ZERO, -ONE, ONE)
        for k in range(3):
            g.splat[k, axis] = g.splat[k, axis] + flip * total[i, Sum.normal + k]
        if view.harmonic:
            g = harmonics_backward(g, total, i, view, values, d_values, c, length)
        else:
            for k in range(view.channels):
                if k < 3:
                    d_values[i, k] = wp.float32(total[i, Sum.values + k])
                else:
                    d_values[i, k] = wp.float32(total[i, COLUMNS + k - 3])
        g.center = g.center + c * (g.length / length)
        g.splat = g.splat + wp.transpose(R) * g.axes
        g.camera = g.camera + g.axes * wp.transpose(q) + wp.outer(g.center, mean)
        in_mean = wp.transpose(R) * g.center
        in_quat = quaternion_backward(w / size, x / size, y / size, z / size, g.splat) / size
        for k in range(3):
            d_means[i, k] = d_means.dtype(in_mean[k])
        for k in range(4):
            d_quats[i, k] = d_quats.dtype(in_quat[k])
        for k in range(scales.shape[1]):
            d_scales[i, k] = d_scales.dtype(g.scales[k])
        d_opacities[i] = d_opacities.dtype(g.opacity)
    if with_pose:
        for r in range(3):
            for k in range(3):
                add_double(g.camera[r, k], d_pose, 3 * r + k)
            add_double(g.center[r], d_pose, 9 + r)


PROJECT_BACKWARD = {
    real: of_type(
        project_backward,
        real,
        ("means", "quats", "scales", "d_means", "d_quats", "d_scales"),
        ("opacities", "d_opacities"),
    )
    for real in (wp.float32, wp.float64)
}
"""``project_backward`` by the type of the splats."""
