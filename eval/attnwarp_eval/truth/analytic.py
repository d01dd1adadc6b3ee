"""Closed-form ray tracing of spheres, rectangles and known triangles in float64."""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

from attnwarp.numba_cache import CACHE

Array = npt.NDArray[np.float64]


@numba.njit(cache=CACHE, nogil=True, error_model="numpy")
def nearest_hit(
    origins: Array, directions: Array, spheres: Array, rectangles: Array
) -> tuple[Array, npt.NDArray[np.int64]]:
    """First hit of each ray with any sphere or rectangle.

    Spheres use the discriminant r^2 - |oc - (oc.d)d|^2, which keeps its precision for tangent and
    far-away rays where b^2 - 4ac loses them (Haines et al., Ray Tracing Gems, ch. 7), and the near
    root as a product, c / (b + s), which keeps precision when the origin is close to the surface.

    Args:
        origins: (N, 3).
        directions: (N, 3), of any length, which is the unit of t.
        spheres: (S, 4): centre and radius.
        rectangles: (R, 12): centre, half edges u and v, unit normal.

    Returns:
        t: (N,) distance in units of the direction's length, infinite on a miss.
        index: (N,) 0..S-1 for spheres, S..S+R-1 for rectangles, -1 on a miss.
    """
    n = origins.shape[0]
    t_out = np.full(n, np.inf)
    index = np.full(n, -1, np.int64)
    for i in range(n):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        dd = dx * dx + dy * dy + dz * dz
        best = np.inf
        which = -1
        for s in range(spheres.shape[0]):
            cx, cy, cz = spheres[s, 0] - ox, spheres[s, 1] - oy, spheres[s, 2] - oz
            r = spheres[s, 3]
            b = (cx * dx + cy * dy + cz * dz) / dd
            qx, qy, qz = cx - b * dx, cy - b * dy, cz - b * dz
            disc = r * r - (qx * qx + qy * qy + qz * qz)
            if disc < 0:
                continue
            half = math.sqrt(disc / dd)
            distance = math.sqrt(cx * cx + cy * cy + cz * cz)
            c = (distance - r) * (distance + r) / dd
            if c > 0:  # outside: both roots on the same side
                if b <= 0:
                    continue
                t = c / (b + half)
            else:
                t = b + half
            if 0 < t < best:
                best = t
                which = s
        for k in range(rectangles.shape[0]):
            q = rectangles[k]
            nd = q[9] * dx + q[10] * dy + q[11] * dz
            if nd == 0:
                continue
            cx, cy, cz = q[0] - ox, q[1] - oy, q[2] - oz
            t = (q[9] * cx + q[10] * cy + q[11] * cz) / nd
            if not 0 < t < best:
                continue
            px, py, pz = t * dx - cx, t * dy - cy, t * dz - cz
            if abs(px * q[3] + py * q[4] + pz * q[5]) > q[3] * q[3] + q[4] * q[4] + q[5] * q[5]:
                continue
            if abs(px * q[6] + py * q[7] + pz * q[8]) > q[6] * q[6] + q[7] * q[7] + q[8] * q[8]:
                continue
            best = t
            which = spheres.shape[0] + k
        t_out[i] = best
        index[i] = which
    return t_out, index


NO_TRIANGLE = 0xFFFFFFFF
"""Open3D's INVALID_ID."""


@numba.njit(cache=CACHE, nogil=True, error_model="numpy")
def meet_triangles(
    t: Array,
    index: npt.NDArray[np.int64],
    face: npt.NDArray[np.uint32],
    rough: npt.NDArray[np.float32],
    origins: Array,
    directions: Array,
    normals: Array,
    corners: Array,
    limit: float,
) -> None:
    """Merge triangles found by another tracer into the first hits, in place.

    The intersection of each ray with its triangle's plane is computed in float64.

    Args:
        t, index: (N,) from :func:`nearest_hit`. A nearer triangle replaces the hit; the other
            indices grow by the number of triangles.
        face: (N,) first triangle of each ray, or :data:`NO_TRIANGLE`.
        rough: (N,) the other tracer's distance, in units of the direction's length.
        origins, directions: (N, 3) of the rays.
        normals, corners: (T, 3) the plane of each triangle.
        limit: largest difference from ``rough``, as a share of it, at which the plane's distance
            is used; beyond, ``rough`` is.
    """
    for i in range(len(t)):
        if index[i] >= 0:
            index[i] += len(normals)
        f = face[i]
        if f == NO_TRIANGLE:
            continue
        distance = np.float64(rough[i])
        # Same order as numpy.einsum's sum of three products.
        above = (
            normals[f, 0] * (corners[f, 0] - origins[i, 0])
            + normals[f, 2] * (corners[f, 2] - origins[i, 2])
        ) + normals[f, 1] * (corners[f, 1] - origins[i, 1])
        along = (normals[f, 0] * directions[i, 0] + normals[f, 2] * directions[i, 2]) + normals[
            f, 1
        ] * directions[i, 1]
        exact = above / along
        if abs(exact - distance) <= limit * distance:
            distance = exact
        if distance < t[i]:
            t[i] = distance
            index[i] = f
