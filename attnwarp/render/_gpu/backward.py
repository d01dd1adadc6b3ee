# mypy: ignore-errors
"""Backward pass of the compositing, one thread a pixel: its splats back to front.

A splat's gradients from the pixels of a warp are summed among the threads, and added to the splat's
row of gradients in float64. Only the order of those additions is not fixed.
"""

from __future__ import annotations

import warp as wp

from attnwarp.render import constants
from attnwarp.render._gpu.compositing import Plane, pixel_of
from attnwarp.render._gpu.evaluation import ALPHA_MAX, depth_from, evaluate
from attnwarp.render._gpu.lanes import (
    COLUMNS,
    Sums,
    add_columns,
    add_single,
    any_lane,
    most_of_lanes,
)
from attnwarp.render._gpu.layout import DiscSum, EllipsoidSum, Of, Sum, View

f32 = wp.float32
GAP_MIN = f32(constants.GAP_MIN)


@wp.kernel(enable_backward=False)
def composite_backward(
    view: View,
    singles: wp.array2d(dtype=wp.float32),
    features: wp.array2d(dtype=wp.float32),
    terms: wp.array2d(dtype=wp.float32),
    splats: wp.array(dtype=wp.int32),
    bounds: wp.array2d(dtype=wp.int32),
    background: wp.array(dtype=wp.float32),
    alpha: wp.array2d(dtype=wp.float32),
    depth: wp.array2d(dtype=wp.float32),
    state: wp.array2d(dtype=wp.float32),
    steps: wp.array3d(dtype=wp.int32),
    d_color: wp.array3d(dtype=wp.float32),
    d_alpha: wp.array2d(dtype=wp.float32),
    d_depth: wp.array2d(dtype=wp.float32),
    d_median: wp.array2d(dtype=wp.float32),
    d_normal: wp.array3d(dtype=wp.float32),
    d_ordered: wp.array2d(dtype=wp.float32),
    d_weight: wp.array(dtype=wp.float32),
    total: wp.array2d(dtype=wp.float64),
):
    """Add the gradients of a pixel in its splats to their rows of ``total``.

    The transmittance before each splat is recovered by division from the forward pass's state.
    "behind" marks sums over the splats behind the current one.
    """
    here = pixel_of(view, wp.tid())
    row, column = here.row, here.column
    last, median_step = wp.int32(0), wp.int32(0)
    T, A, mean = f32(1.0), f32(1.0), f32(0.0)
    in_depth, in_ordered, in_median = f32(0.0), f32(0.0), f32(0.0)
    in_normal, in_color = wp.vec3f(), wp.vec3f()
    behind_alpha, behind_depth = f32(0.0), f32(0.0)
    # Each splat's part with the sign of its gap.
    signed_alpha, signed_depth = f32(0.0), f32(0.0)
    # Begins with minus the gradient in alpha times the transmittance, which is all that alpha
    # changes with: where a pixel is opaque, a difference of sums of weights has no digits of it.
    behind_loss = f32(0.0)
    if here.inside:
        last = steps[Plane.last, row, column]
    # Elsewhere depth is NaN, and gradients may be anything.
    if last > 0:
        median_step = steps[Plane.median, row, column]
        T, A = f32(state[row, column]), f32(alpha[row, column])
        mean = depth[row, column]
        in_depth = d_depth[row, column] / A
        in_alpha = d_alpha[row, column]
        for k in range(view.channels):
            in_alpha -= d_color[row, column, k] * background[k]
            if k < 3:
                in_color[k] = d_color[row, column, k]
        for k in range(3):
            in_normal[k] = d_normal[row, column, k]
        behind_loss = -in_alpha * T
        in_ordered = f32(2.0) * d_ordered[row, column]
        in_median = d_median[row, column]
    begin = bounds[here.tile, 0]
    most = most_of_lanes(last)
    for back in range(most):
        step = most - back
        e = begin + step - 1
        i = splats[e]
        r = evaluate(view, singles, terms, i, e, here.x, here.y)
        drawn = r.drawn and step <= last
        if any_lane(drawn):
            sums = Sums()
            w = f32(0.0)
            if drawn:
                rest = f32(1.0) / (f32(1.0) - r.alpha)
                T *= rest
                w = r.alpha * T
                z = depth_from(view, singles, i, r, mean)
                # The gradient in the weight.
                g = in_depth * z + d_weight[i]
                for k in range(3):
                    g += in_normal[k] * singles[i, Of.normal + k]
                    g += in_color[k] * singles[i, Of.values + k]
                for k in range(3, view.channels):
                    g += d_color[row, column, k] * features[i, k]
                # In front the weights sum up to ``front``, and the gaps from there, times the
                # weights, to ``gap``: first moments vanish about the mean.
                w_depth = w * z
                front = A - w - behind_alpha
                gap = z * front + w_depth + behind_depth
                sign = f32(0.0)
                if wp.abs(gap) > GAP_MIN * (z + mean):
                    sign = wp.sign(gap)
                g += in_ordered * (sign * gap + signed_depth - z * signed_alpha)
                in_z = w * (in_depth + in_ordered * (sign * front - signed_alpha))
                if step == median_step:
                    in_z += in_median
                in_exponent = f32(0.0)
                if r.alpha < ALPHA_MAX:
                    in_exponent = (T * g - behind_loss * rest) * r.alpha
                behind_loss += w * g
                behind_alpha += w
                behind_depth += w_depth
                signed_alpha += sign * w
                signed_depth += sign * w_depth
                for k in range(3):
                    sums[Sum.normal + k] = w * in_normal[k]
                    sums[Sum.values + k] = w * in_color[k]
                sums[0] = in_exponent
                if view.discs:
                    ex, ey = here.x + terms[e, 3], here.y + terms[e, 4]
                    in_w = f32(0.0)
                    if r.over > f32(0.0):
                        u, v, scaled_in = r.u * r.z, r.v * r.z, in_exponent * r.z
                        in_u, in_v = scaled_in * u, scaled_in * v
                        in_w = in_u * u + in_v * v
                        sums[DiscSum.u] = -in_u * ex
                        sums[DiscSum.u + 1] = -in_u * ey
                        sums[DiscSum.u + 2] = -in_u
                        sums[DiscSum.v] = -in_v * ex
                        sums[DiscSum.v + 1] = -in_v * ey
                        sums[DiscSum.v + 2] = -in_v
                    else:
                        sums[DiscSum.center] = -f32(2.0) * in_exponent * ex
                        sums[DiscSum.center + 1] = -f32(2.0) * in_exponent * ey
                    # Strictly: a splat that faces the camera has w_low = w_high = W, and its depth
                    # is its plane's.
                    if view.by_center or r.w > singles[i, Of.w_high]:
                        sums[DiscSum.low] = in_z
                    elif r.w < singles[i, Of.w_low]:
                        sums[DiscSum.high] = in_z
                    else:
                        along = in_z * r.z
                        sums[DiscSum.depth] = along
                        in_w -= along * singles[i, Of.depth] * r.z
                    sums[DiscSum.w] = in_w * ex
                    sums[DiscSum.w + 1] = in_w * ey
                    sums[DiscSum.w + 2] = in_w
                else:
                    in_u, in_v = in_exponent * r.u, in_exponent * r.v
                    sums[EllipsoidSum.uv] = in_u
                    sums[EllipsoidSum.uv + 1] = in_v
                    sums[EllipsoidSum.shape] = in_u * r.u
                    sums[EllipsoidSum.shape + 1] = in_u * r.v
                    sums[EllipsoidSum.shape + 2] = in_v * r.v
                    unbounded = singles[i, Of.depth] * r.w * r.over
                    if view.by_center or unbounded <= singles[i, Of.depth_low]:
                        sums[EllipsoidSum.low] = in_z
                    elif unbounded > singles[i, Of.depth_high]:
                        sums[EllipsoidSum.high] = in_z
                    else:
                        k1 = in_z * singles[i, Of.depth] * r.over
                        k2 = k1 * r.w * r.over
                        sums[EllipsoidSum.linear] = k1 * r.w
                        sums[EllipsoidSum.linear + 1] = k1 * r.p
                        sums[EllipsoidSum.linear + 2] = k1 * r.q
                        sums[EllipsoidSum.square] = k2 * r.p * r.w
                        sums[EllipsoidSum.square + 1] = k2 * r.q * r.w
                        sums[EllipsoidSum.square + 2] = k2 * r.p * r.p
                        sums[EllipsoidSum.square + 3] = k2 * r.p * r.q
                        sums[EllipsoidSum.square + 4] = k2 * r.q * r.q
            add_columns(sums, total, i)
            for k in range(3, view.channels):
                share = f32(0.0)
                if drawn:
                    share = w * d_color[row, column, k]
                add_single(share, total, i, COLUMNS + k - 3)
