# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Distance of splats' normals from those of the depth that they draw, and its gradient.

The definition is :func:`attnwarp.losses.normal_consistency` in torch. A pixel's surface normal is
the cross product of the differences of its neighbours' points, so all is done in one pass over the
pixels. Backward, a pixel writes its gradients in its neighbours' depths; a second pass gathers
them, so no two threads add to one place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from attnwarp.render._kernels.compilation import bare, f32, inlined

LEFT, RIGHT, UP, DOWN = range(4)
"""Rows of a pixel's gradients in its neighbours' depths."""


class Lens(NamedTuple):
    """Intrinsics of the camera, in pixels."""

    fx: float
    skew: float
    fy: float
    cx: float
    cy: float


class Maps(NamedTuple):
    """Rendered maps: (H, W), (H, W), (H, W, 3) float32; normals in world axes, not unit."""

    depth: np.ndarray
    alpha: np.ndarray
    normal: np.ndarray


@inlined
def _ray_y(lens, i):
    return (i + 0.5 - lens.cy) / lens.fy


@inlined
def _ray_x(lens, y, j):
    return (j + 0.5 - lens.cx - lens.skew * y) / lens.fx


@inlined
def _surface(lens, rotation, z, n, j, ys):
    """A pixel's surface from its neighbours' depths.

    Args:
        rotation: rows of the rotation from world to camera, 9 values.
        z: depth of the pixel, and left, right, above and below of it.
        n: its rendered normal.
        j: its column.
        ys: y of the rays of its row, the one above and the one below.

    Returns:
        Whether it has a normal; that normal, in the camera's axes; 1 over the length of the cross
        product; the rendered normal in the camera's axes; both differences of points; x of the rays
        left, right, above and below.
    """
    middle, left, right, up, down = z
    y, y_up, y_down = ys
    good = (
        (abs(middle) < np.inf)
        & (abs(left) < np.inf)
        & (abs(right) < np.inf)
        & (abs(up) < np.inf)
        & (abs(down) < np.inf)
    )
    one = f32(1)
    left, right = left if good else one, right if good else one
    up, down = up if good else one, down if good else one
    xl, xr = f32(_ray_x(lens, y, j - 1)), f32(_ray_x(lens, y, j + 1))
    xu, xd = f32(_ray_x(lens, y_up, j)), f32(_ray_x(lens, y_down, j))
    ax, ay, az = xr * right - xl * left, f32(y) * (right - left), right - left
    bx, by, bz = xd * down - xu * up, f32(y_down) * down - f32(y_up) * up, down - up
    # y down, z forward: d/dy x d/dx points back at the camera for a surface that faces it.
    cx, cy, cz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
    square = cx * cx + cy * cy + cz * cz
    good = good & (square > 0)
    inverse = one / np.sqrt(square if good else one)
    unit = (cx * inverse, cy * inverse, cz * inverse)
    seen = (
        rotation[0] * n[0] + rotation[1] * n[1] + rotation[2] * n[2],
        rotation[3] * n[0] + rotation[4] * n[1] + rotation[5] * n[2],
        rotation[6] * n[0] + rotation[7] * n[1] + rotation[8] * n[2],
    )
    return good, unit, inverse, seen, (ax, ay, az), (bx, by, bz), (xl, xr, xu, xd)


@bare
def disagreement(begin, end, lens, rotation, maps, sums):
    """Rows ``begin`` to ``end``: the sum over each row of alpha - normal . N.

    Args:
        rotation: (9,) float32 rotation from world to camera, row by row.
        sums: (H,) float64.
    """
    height, width = maps.depth.shape
    for i in range(begin, end):
        total = 0.0
        if 0 < i < height - 1:
            ys = _ray_y(lens, i), _ray_y(lens, i - 1), _ray_y(lens, i + 1)
            row, above, below = maps.depth[i], maps.depth[i - 1], maps.depth[i + 1]
            alpha, normal = maps.alpha[i], maps.normal[i]
            for k in range(width - 2):
                j = k + 1
                z = row[j], row[k], row[k + 2], above[j], below[j]
                n = normal[j, 0], normal[j, 1], normal[j, 2]
                good, unit, _, seen, _, _, _ = _surface(lens, rotation, z, n, j, ys)
                along = seen[0] * unit[0] + seen[1] * unit[1] + seen[2] * unit[2]
                total += alpha[j] - along if good else f32(0)
        sums[i] = total


@bare
def disagreement_backward(begin, end, lens, rotation, share, maps, d_alpha, d_normal, to_neighbors):
    """Rows ``begin`` to ``end``: gradients of ``share`` times the sum over pixels.

    Args:
        share: float32.
        d_alpha, d_normal: gradients of the maps' shapes.
        to_neighbors: (4, H, W) float32, each pixel's gradients in its neighbours' depths.
    """
    height, width = maps.depth.shape
    for i in range(begin, end):
        if 0 < i < height - 1:
            ys = _ray_y(lens, i), _ray_y(lens, i - 1), _ray_y(lens, i + 1)
            y, y_up, y_down = f32(ys[0]), f32(ys[1]), f32(ys[2])
            row, above, below = maps.depth[i], maps.depth[i - 1], maps.depth[i + 1]
            normal = maps.normal[i]
            for k in range(width - 2):
                j = k + 1
                z = row[j], row[k], row[k + 2], above[j], below[j]
                n = normal[j, 0], normal[j, 1], normal[j, 2]
                good, u, inverse, seen, a, b, x = _surface(lens, rotation, z, n, j, ys)
                part = share if good else f32(0)
                d_alpha[i, j] = part
                for axis in range(3):
                    d_normal[i, j, axis] = -part * (
                        rotation[axis] * u[0]
                        + rotation[3 + axis] * u[1]
                        + rotation[6 + axis] * u[2]
                    )
                # Through the unit length, then through the cross product b x a.
                along = seen[0] * u[0] + seen[1] * u[1] + seen[2] * u[2]
                scale = part * inverse
                cx = scale * (u[0] * along - seen[0])
                cy = scale * (u[1] * along - seen[1])
                cz = scale * (u[2] * along - seen[2])
                dax, day, daz = cy * b[2] - cz * b[1], cz * b[0] - cx * b[2], cx * b[1] - cy * b[0]
                dbx, dby, dbz = a[1] * cz - a[2] * cy, a[2] * cx - a[0] * cz, a[0] * cy - a[1] * cx
                to_neighbors[LEFT, i, j] = -(x[0] * dax + y * day + daz)
                to_neighbors[RIGHT, i, j] = x[1] * dax + y * day + daz
                to_neighbors[UP, i, j] = -(x[2] * dbx + y_up * dby + dbz)
                to_neighbors[DOWN, i, j] = x[3] * dbx + y_down * dby + dbz
        for j in range(width):
            if 0 < i < height - 1 and 0 < j < width - 1:
                continue
            d_alpha[i, j] = 0
            for axis in range(3):
                d_normal[i, j, axis] = 0
            for side in range(4):
                to_neighbors[side, i, j] = 0


@bare
def gather(begin, end, to_neighbors, d_depth):
    """Rows ``begin`` to ``end``: the gradient in depth, from those of the four neighbours."""
    height, width = d_depth.shape
    for i in range(begin, end):
        for j in range(width):
            total = f32(0)
            if j > 0:
                total += to_neighbors[RIGHT, i, j - 1]
            if j < width - 1:
                total += to_neighbors[LEFT, i, j + 1]
            if i > 0:
                total += to_neighbors[DOWN, i - 1, j]
            if i < height - 1:
                total += to_neighbors[UP, i + 1, j]
            d_depth[i, j] = total
