# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Depths of splats, and their order from front to back."""

from __future__ import annotations

import numpy as np

from attnwarp.render._kernels.compilation import f64, jit
from attnwarp.render._kernels.layout import TILE
from attnwarp.render.constants import ALPHA_MIN


@jit
def depths(first, last, view, splats, depth, listed):
    """Depths of the splats first..last, to ``depth`` (N,); NaN where nothing can show.

    ``listed`` (1,) gets an estimate of how many tiles will list them: rectangles of 5 sigmas, their
    centres in the picture.
    """
    R, T, near = view.rotation, view.translation, view.near
    means, scales, opacities = splats.means, splats.scales, splats.opacities
    fx, fy = view.fx / TILE, view.fy / TILE
    wide, tall = view.width / TILE, view.height / TILE
    cx, cy = view.cx / TILE, view.cy / TILE
    estimate = 0.0
    r0, r1, r2, t = R[2, 0], R[2, 1], R[2, 2], T[2]
    for i in range(first, last):
        c2 = r0 * f64(means[i, 0]) + r1 * f64(means[i, 1]) + r2 * f64(means[i, 2]) + t
        shows = c2 > near and opacities[i] >= ALPHA_MIN
        depth[i] = c2 if shows else np.nan
        if shows:
            m0, m1, m2 = f64(means[i, 0]), f64(means[i, 1]), f64(means[i, 2])
            c0 = R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2 + T[0]
            c1 = R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2 + T[1]
            x, y = fx * c0 / c2 + cx, fy * c1 / c2 + cy
            if 0 < x < wide and 0 < y < tall:
                first_side = min(1 + 5 * fx * f64(scales[i, 0]) / c2, wide)
                second_side = min(1 + 5 * fy * f64(scales[i, 1]) / c2, tall)
                estimate += first_side * second_side
    listed[0] = estimate


@jit
def radix_order(
    key,  # (N,) float32
    index,  # (N,) int32, for work, as the others are
    other,  # (N,) int32
    bits,  # (N,) uint32
    spare,  # (N,) uint32
):
    """Indices of the keys that are not NaN, ascending, equal ones in their order of input; and the
    places in them of keys that are equal to one beside them.

    A radix sort of the keys' bits, least significant digits first. The results lie in ``index`` and
    ``other``.
    """
    raw = key.view(np.uint32)
    n = 0
    for i in range(key.shape[0]):
        if key[i] == key[i]:
            b = raw[i] if key[i] != 0 else np.uint32(0)
            # Flipping makes the order of the bits that of the numbers: all bits of a negative, the
            # sign of a positive.
            bits[n] = ~b if b >> np.uint32(31) else b | np.uint32(0x80000000)
            index[n] = i
            n += 1
    counts = np.empty(2048, np.int64)
    for shift in (0, 11, 22):
        counts[:] = 0
        for i in range(n):
            counts[(bits[i] >> np.uint32(shift)) & np.uint32(2047)] += 1
        if n == 0 or counts[(bits[0] >> np.uint32(shift)) & np.uint32(2047)] == n:
            continue
        total = 0
        for i in range(2048):
            here = counts[i]
            counts[i] = total
            total += here
        for i in range(n):
            digit = (bits[i] >> np.uint32(shift)) & np.uint32(2047)
            spare[counts[digit]] = bits[i]
            other[counts[digit]] = index[i]
            counts[digit] += 1
        bits, spare = spare, bits
        index, other = other, index
    ties = 0
    for i in range(n):
        other[ties] = i
        ties += (i > 0 and bits[i] == bits[i - 1]) or (i + 1 < n and bits[i] == bits[i + 1])
    return index[:n], other[:ties]
