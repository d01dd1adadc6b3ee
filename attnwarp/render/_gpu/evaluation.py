# mypy: ignore-errors
"""One splat at one pixel: its coverage, alpha and depth.

Shared by the forward and the backward pass. :mod:`attnwarp.render._kernels.evaluation` explains the
bounds of the depth.
"""

from __future__ import annotations

import warp as wp

from attnwarp.render import constants
from attnwarp.render._gpu.lanes import fma
from attnwarp.render._gpu.layout import NOWHERE, Of, View

f32 = wp.float32
ALPHA_MAX = f32(constants.ALPHA_MAX)
FAR = f32(NOWHERE)
HALF = f32(0.5)
SMALLEST = f32(1e-30)


@wp.struct
class Pair:
    """Splat at a pixel. The depth of a 2D splat is in units of its column ``depth``, except its
    centre's depth, which ``depth_from`` reads from the splat's row."""

    drawn: wp.bool
    alpha: wp.float32  # anything where not drawn
    z: wp.float32
    # Of 2D splats U, V and W; of 3D splats u, v and l.
    u: wp.float32
    v: wp.float32
    w: wp.float32
    # Of 3D splats p, q and 1 / (l^2 + p^2 + q^2); of 2D splats 1 if the ray meets the plane.
    p: wp.float32
    q: wp.float32
    over: wp.float32


@wp.func
def evaluate(
    view: View, singles: wp.array2d(dtype=wp.float32), terms: wp.array2d(dtype=wp.float32),
    i: wp.int32, e: wp.int32, x: wp.float32, y: wp.float32,
) -> Pair:  # fmt: skip
    """Evaluate splat i, entry e, at a pixel (x, y) relative to its tile's middle."""
    r = Pair()
    rho = FAR
    if view.discs:
        r.u = terms[e, 0] + (singles[i, Of.u_x] * x + singles[i, Of.u_y] * y)
        r.v = terms[e, 1] + (singles[i, Of.v_x] * x + singles[i, Of.v_y] * y)
        r.w = terms[e, 2] + (singles[i, Of.w_x] * x + singles[i, Of.w_y] * y)
        r.z = f32(1.0) / wp.min(wp.max(r.w, singles[i, Of.w_low]), singles[i, Of.w_high])
        ex, ey = x + terms[e, 3], y + terms[e, 4]
        screen = f32(2.0) * (ex * ex + ey * ey)
        if r.w <= singles[i, Of.w_most]:
            rho = (r.u * r.u + r.v * r.v) * (r.z * r.z)
            if rho <= screen:
                r.over = f32(1.0)
        rho = wp.min(rho, screen)
    else:
        r.u = terms[e, 0] + (singles[i, Of.factor_xx] * x + singles[i, Of.factor_xy] * y)
        r.v = terms[e, 1] + singles[i, Of.factor_yy] * y
        rho = r.u * r.u + r.v * r.v
        r.z = singles[i, Of.depth_low]
        if not view.by_center:
            r.w = terms[e, 2] + (singles[i, Of.peak_x] * x + singles[i, Of.peak_y] * y)
            r.p = terms[e, 3] + (singles[i, Of.peak_xx] * x + singles[i, Of.peak_xy] * y)
            r.q = terms[e, 4] + singles[i, Of.peak_yy] * y
            square = r.w * r.w + (r.p * r.p + r.q * r.q)
            r.over = f32(1.0) / wp.max(square, SMALLEST)
            z = singles[i, Of.depth] * r.w * r.over
            r.z = wp.min(wp.max(z, singles[i, Of.depth_low]), singles[i, Of.depth_high])
    r.drawn = rho <= singles[i, Of.cut]
    if r.drawn:
        r.alpha = wp.min(singles[i, Of.opacity] * wp.exp(-HALF * rho), ALPHA_MAX)
    return r


@wp.func
def depth_from(
    view: View, singles: wp.array2d(dtype=wp.float32), i: wp.int32, r: Pair, z0: wp.float32
) -> wp.float32:
    """Compute z - z0 of a splat."""
    if view.by_center:
        return singles[i, Of.depth_low] - z0
    if view.discs:
        return fma(singles[i, Of.depth], r.z, -z0)
    return r.z - z0
