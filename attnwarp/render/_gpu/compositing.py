# mypy: ignore-errors
"""Compositing, one thread a pixel: the pictures front to back."""

from __future__ import annotations

import warp as wp

from attnwarp.render import constants
from attnwarp.render._gpu.evaluation import depth_from, evaluate
from attnwarp.render._gpu.lanes import add_whole, any_lane
from attnwarp.render._gpu.layout import MIDDLE, PIXELS, TILE, WEIGHT_UNIT, Of, View

f32 = wp.float32
STOP = f32(constants.TRANSMITTANCE_STOP)
MEDIAN = f32(constants.MEDIAN_TRANSMITTANCE)
UNIT = wp.float64(WEIGHT_UNIT)
CENTER = f32(MIDDLE)
NAN = f32(float("nan"))


class Plane:
    """Planes of the steps saved by the forward pass."""

    last = 0  # 1 + place in the tile's list of the last splat drawn; 0: none
    median = 1


@wp.struct
class Pixel:
    """Pixel of a thread: its position in the picture, and relative to its tile's middle."""

    tile: wp.int32
    column: wp.int32
    row: wp.int32
    inside: wp.bool  # of the picture
    x: wp.float32
    y: wp.float32


@wp.func
def pixel_of(view: View, thread: wp.int32) -> Pixel:
    """Find the pixel of a thread: a warp covers 8 x 4 pixels of one tile."""
    r = Pixel()
    r.tile = thread / PIXELS
    k = thread % PIXELS
    column, row = k % TILE, k / TILE
    r.column = (r.tile % view.across) * TILE + column
    r.row = (r.tile / view.across) * TILE + row
    r.inside = r.column < view.width and r.row < view.height
    r.x = f32(column) - CENTER
    r.y = f32(row) - CENTER
    return r


@wp.kernel(enable_backward=False)
def composite(
    view: View,
    singles: wp.array2d(dtype=wp.float32),
    features: wp.array2d(dtype=wp.float32),  # (N, C), read from the fourth channel on
    terms: wp.array2d(dtype=wp.float32),
    splats: wp.array(dtype=wp.int32),
    bounds: wp.array2d(dtype=wp.int32),
    background: wp.array(dtype=wp.float32),
    color: wp.array3d(dtype=wp.float32),
    alpha: wp.array2d(dtype=wp.float32),
    depth: wp.array2d(dtype=wp.float32),
    median: wp.array2d(dtype=wp.float32),
    normal: wp.array3d(dtype=wp.float32),
    ordered: wp.array2d(dtype=wp.float32),
    state: wp.array2d(dtype=wp.float32),
    steps: wp.array3d(dtype=wp.int32),
    weight: wp.array(dtype=wp.int64),
):
    """Draw a pixel: every picture, the state for the backward pass, and the splats' weights.

    Depths are summed from the first splat's, which keeps the digits of thin layers far away.
    """
    here = pixel_of(view, wp.tid())
    T = wp.where(here.inside, f32(1.0), f32(0.0))
    A, depth_sum, gaps = f32(0.0), f32(0.0), f32(0.0)
    first_depth, middle = f32(0.0), f32(0.0)
    n, c = wp.vec3f(), wp.vec3f()
    last, median_step, hits = wp.int32(0), wp.int32(0), wp.int32(0)
    begin, end = bounds[here.tile, 0], bounds[here.tile, 1]
    if here.inside and view.channels > 3:
        for k in range(3, view.channels):
            color[here.row, here.column, k] = f32(0.0)
    for e in range(begin, end):
        alive = T > STOP
        if not any_lane(alive):
            break
        i = splats[e]
        r = evaluate(view, singles, terms, i, e, here.x, here.y)
        drawn = alive and r.drawn
        if any_lane(drawn):
            w = f32(0.0)
            if drawn:
                w = r.alpha * T
                if hits == 0:
                    first_depth = depth_from(view, singles, i, r, f32(0.0))
                z = depth_from(view, singles, i, r, first_depth)
                last = e - begin + 1
                hits += 1
                if T > MEDIAN:
                    middle, median_step = z, last
                w_depth = w * z
                gaps += wp.abs(w_depth * A - w * depth_sum)
                A += w
                depth_sum += w_depth
                for k in range(3):
                    n[k] += w * singles[i, Of.normal + k]
                    c[k] += w * singles[i, Of.values + k]
                for k in range(3, view.channels):
                    color[here.row, here.column, k] = (
                        color[here.row, here.column, k] + w * features[i, k]
                    )
                T -= w
            add_whole(w, UNIT, weight, i)
    if not here.inside:
        return
    covered = hits > 0
    inverse = wp.where(covered, f32(1.0) / A, f32(0.0))
    for k in range(view.channels):
        value = f32(0.0)
        if k < 3:
            value = c[k]
        else:
            value = color[here.row, here.column, k]
        color[here.row, here.column, k] = value + (f32(1.0) - A) * background[k]
    for k in range(3):
        normal[here.row, here.column, k] = n[k]
    alpha[here.row, here.column] = A
    depth[here.row, here.column] = wp.where(covered, first_depth + depth_sum * inverse, NAN)
    median[here.row, here.column] = wp.where(covered, first_depth + middle, NAN)
    # Pairs were counted once.
    ordered[here.row, here.column] = f32(2.0) * gaps
    state[here.row, here.column] = T
    steps[Plane.last, here.row, here.column] = last
    steps[Plane.median, here.row, here.column] = median_step
