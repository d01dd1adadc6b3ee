# mypy: ignore-errors
"""Binning: the order of the splats, and the splats of each tile.

Splats are sorted by depth, an entry is written for each tile that a splat may cover, in depth
order, and a stable sort by tile keeps this order within each tile.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from attnwarp.render._gpu.layout import MIDDLE, TILE, At, View
from attnwarp.render._gpu.projection import columns_of, of_type, outline_of, overlaps

f32, f64 = wp.float32, wp.float64
CENTER = f64(MIDDLE + 0.5)


@wp.func
def compare(a: wp.array2d(dtype=Any), i: wp.int32, j: wp.int32) -> wp.int32:
    """Order of rows i and j: -1, 0 or 1."""
    result = wp.int32(0)
    for k in range(a.shape[1]):
        if result == 0:
            if a[i, k] < a[j, k]:
                result = -1
            elif a[i, k] > a[j, k]:
                result = 1
    return result


@wp.kernel(enable_backward=False)
def break_ties(
    depths: wp.array(dtype=wp.float32),  # sorted
    order: wp.array(dtype=wp.int32),  # sorted by depth, then by mean
    means: wp.array2d(dtype=Any),
    scales: wp.array2d(dtype=Any),
    quats: wp.array2d(dtype=Any),
    opacities: wp.array2d(dtype=Any),
    values: wp.array2d(dtype=wp.float32),
    result: wp.array(dtype=wp.int32),
):
    """Order splats of equal depth and mean by their other parameters; splats equal in all are
    interchangeable and keep their order."""
    k = wp.tid()
    i = order[k]
    place = k
    for side in range(2):
        step = 2 * side - 1
        other = k + step
        while other >= 0 and other < order.shape[0]:
            j = order[other]
            if depths[other] != depths[k] or compare(means, i, j) != 0:
                break
            by = compare(scales, i, j)
            if by == 0:
                by = compare(quats, i, j)
            if by == 0:
                by = compare(opacities, i, j)
            if by == 0:
                by = compare(values, i, j)
            if side == 0 and by < 0:
                place -= 1
            elif side == 1 and by > 0:
                place += 1
            other += step
    result[place] = i


BREAK_TIES = {
    real: of_type(break_ties, real, ("means", "scales", "quats", "opacities"))
    for real in (wp.float32, wp.float64)
}
"""``break_ties`` by the type of the splats."""


@wp.kernel(enable_backward=False)
def write_entries(
    view: View,
    doubles: wp.array2d(dtype=wp.float64),
    singles: wp.array2d(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int64),  # of the entries of each splat, in the order of depth
    tiles: wp.array(dtype=wp.int32),
    splats: wp.array(dtype=wp.int32),
):
    """Write an entry for each tile that a splat may cover."""
    k = wp.tid()
    i = order[k]
    count = counts[i]
    if count == 0:
        return
    at = wp.int32(ends[k]) - count
    o = outline_of(doubles, singles, i, view)
    for row in range(o.first, o.last + 1):
        if o.is_ellipse:
            span = columns_of(o, view, row)
            for column in range(span[0], span[1] + 1):
                tiles[at] = row * view.across + column
                splats[at] = i
                at += 1
        else:
            for column in range(view.across):
                if overlaps(doubles, singles, i, o, view, row, column):
                    tiles[at] = row * view.across + column
                    splats[at] = i
                    at += 1


@wp.kernel(enable_backward=False)
def lay_out(
    view: View,
    doubles: wp.array2d(dtype=wp.float64),
    tiles: wp.array(dtype=wp.int32),  # sorted
    splats: wp.array(dtype=wp.int32),
    count: wp.int32,
    bounds: wp.array2d(dtype=wp.int32),  # (tiles, 2) first entry and the one after the last
    terms: wp.array2d(dtype=wp.float32),  # (entries, 5)
):
    """Evaluate terms linear in a pixel's position at the middle of each entry's tile, in float64,
    and find the entries of each tile.

    Of 2D splats U, V, W and the offset from the reference point; of 3D splats u, v, l, p and q.
    """
    e = wp.tid()
    t, i = tiles[e], splats[e]
    if e == 0 or tiles[e - 1] != t:
        bounds[t, 0] = e
    if e == count - 1 or tiles[e + 1] != t:
        bounds[t, 1] = e + 1
    dx = f64((t % view.across) * TILE) + CENTER - doubles[i, At.center_x]
    dy = f64((t / view.across) * TILE) + CENTER - doubles[i, At.center_y]
    if view.discs:
        for k in range(3):
            column = At.u_x + 2 * k
            terms[e, k] = f32(
                wp.where(k == 2, f64(1.0), f64(0.0))
                + doubles[i, column] * dx
                + doubles[i, column + 1] * dy
            )
        terms[e, 3] = f32(dx)
        terms[e, 4] = f32(dy)
    else:
        xx, xy, yy = doubles[i, At.factor_xx], doubles[i, At.factor_xy], doubles[i, At.factor_yy]
        terms[e, 0] = f32(xx * dx + xy * dy)
        terms[e, 1] = f32(yy * dy)
        if not view.by_center:
            terms[e, 2] = f32(f64(1.0) + doubles[i, At.peak_x] * dx + doubles[i, At.peak_y] * dy)
            terms[e, 3] = f32(doubles[i, At.peak_xx] * dx + doubles[i, At.peak_xy] * dy)
            terms[e, 4] = f32(doubles[i, At.peak_yy] * dy)
