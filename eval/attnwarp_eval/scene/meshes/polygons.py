"""Polygons cut into triangles."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from attnwarp.numba_cache import CACHE

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MOST_CORNERS = 5000
"""Concave polygons with more corners are refused: ear clipping takes the square of their number."""


def triangulate(vertices: Array, corners: Indices, sizes: Indices) -> tuple[Indices, Indices]:
    """Triangulate polygons, in the polygons' order and with their winding.

    A convex polygon becomes a fan about its first corner; other polygons are ear-clipped (Meisters
    1975) in the plane of its mean normal (Newell's method).

    Args:
        vertices: (V, 3).
        corners: (C,) indices into ``vertices``, polygon after polygon.
        sizes: (P,) corners of each polygon, at least 3.

    Returns:
        faces: (F, 3); a polygon of n corners gives n - 2.
        crossed: (Q,) indices of the polygons that cross themselves; they give no triangles.

    Raises:
        ValueError: a concave polygon has too many corners.

    Example:
        >>> import numpy as np
        >>> arrow = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [1, 1, 0.0]])  # concave at the last
        >>> faces, _ = triangulate(arrow, np.arange(4), np.array([4]))
        >>> faces.tolist()
        [[3, 0, 1], [3, 1, 2]]
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    row = np.concatenate([[0], np.cumsum(sizes - 2)])
    faces = np.empty((int(row[-1]), 3), np.int64)
    crossed: list[int] = []
    for size in np.unique(sizes).tolist():
        group = np.flatnonzero(sizes == size)
        index = corners[first[group][:, None] + np.arange(size)]  # (G, size)
        fans = np.stack(
            np.broadcast_arrays(index[:, :1], index[:, 1:-1], index[:, 2:]), axis=-1
        )  # (G, size - 2, 3)
        faces[row[group][:, None] + np.arange(size - 2)] = fans
        if size == 3:
            continue
        points = vertices[index]
        normal = _newell(points)
        spoke = points[:, 1:] - points[:, :1]
        area = np.linalg.norm(np.cross(spoke[:, :-1], spoke[:, 1:]), axis=-1).sum(1)
        # A polygon with zero net turning, such as a bow tie, has no normal but triangles with area.
        whole = np.linalg.norm(normal, axis=-1) >= 1e-9 * area
        for k in np.flatnonzero(~(_convex(points, normal) & whole)).tolist():
            if size > MOST_CORNERS:
                raise ValueError(
                    f"polygon {group[k]} is concave and has {size} corners, more than"
                    f" {MOST_CORNERS}; split it"
                )
            ears = _ears(_flat(points[k], normal[k])) if whole[k] else ()
            if len(ears):
                faces[row[group[k]] + np.arange(size - 2)] = index[k][ears]
            else:
                crossed.append(int(group[k]))
    if crossed:
        keep = np.ones(len(faces), dtype=bool)
        for k in crossed:
            keep[row[k] : row[k + 1]] = False
        faces = faces[keep]
    return faces, np.array(sorted(crossed), np.int64)


def _newell(points: Array) -> Array:
    """(G, 3) sum of the cross products of consecutive corners, as long as twice its area."""
    local = points - points.mean(axis=1, keepdims=True)
    return np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)


def _convex(points: Array, normal: Array) -> npt.NDArray[np.bool_]:
    """(G,) whether no corner is reflex and no triangle of the fan is flipped. Polygons
    without an area pass: their triangles have no area either.
    """
    edge = np.roll(points, -1, axis=1) - points
    turn = np.einsum("gki,gi->gk", np.cross(edge, np.roll(edge, -1, axis=1)), normal)
    spoke = points[:, 1:] - points[:, :1]
    fan = np.einsum("gki,gi->gk", np.cross(spoke[:, :-1], spoke[:, 1:]), normal)
    length = np.einsum("gi,gi->g", normal, normal)
    slack = 1e-12 * length[:, None]  # rounding of corners on a straight line is no turn
    return (turn >= -slack).all(1) & (fan >= -slack).all(1)


def _flat(points: Array, normal: Array) -> Array:
    """(n, 2) the polygon in its plane, turning counterclockwise, about 1 in size."""
    drop = int(np.argmax(np.abs(normal)))
    u, v = (drop + 1) % 3, (drop + 2) % 3
    flat = points[:, [u, v]] if normal[drop] > 0 else points[:, [v, u]]
    flat = flat - flat.min(0)
    return np.ascontiguousarray(flat / max(float(flat.max()), 1e-300))


@numba.njit(cache=CACHE, nogil=True)
def _area(points: Array, a: int, b: int, c: int) -> float:
    return (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1]) - (
        points[c, 0] - points[a, 0]
    ) * (points[b, 1] - points[a, 1])


@numba.njit(cache=CACHE, nogil=True)
def _ears(points: Array) -> Indices:
    """(n - 2, 3) triangles of a counterclockwise polygon; (0, 3) where no ear can be cut."""
    n = len(points)
    after, before = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        after[k], before[k] = (k + 1) % n, (k - 1) % n
    out = np.empty((n - 2, 3), np.int64)
    count, here, left = 0, 0, n
    while left > 3:
        cut = -1
        # Ears with an area first, so that a collinear corner becomes a corner of such an ear.
        for flat in (False, True):
            k = here
            for _ in range(left):
                a, c = before[k], after[k]
                area = _area(points, a, k, c)
                if (area > 1e-14 and not flat) or (flat and abs(area) <= 1e-14):
                    free = True
                    j = after[c]
                    while j != a:
                        p = points[j]
                        # A bridge to a hole visits its ends twice; these do not block an ear.
                        same = (
                            (p[0] == points[a, 0] and p[1] == points[a, 1])
                            or (p[0] == points[k, 0] and p[1] == points[k, 1])
                            or (p[0] == points[c, 0] and p[1] == points[c, 1])
                        )
                        if (
                            not flat
                            and not same
                            and _area(points, a, k, j) >= 0
                            and _area(points, k, c, j) >= 0
                            and _area(points, c, a, j) >= 0
                        ):
                            free = False
                            break
                        j = after[j]
                    if free:
                        cut = k
                        break
                k = after[k]
            if cut >= 0:
                break
        if cut < 0:
            return np.empty((0, 3), np.int64)
        a, c = before[cut], after[cut]
        out[count, 0], out[count, 1], out[count, 2] = a, cut, c
        count += 1
        after[a], before[c] = c, a
        here = c
        left -= 1
    a, c = before[here], after[here]
    if _area(points, a, here, c) < -1e-14:
        return np.empty((0, 3), np.int64)
    out[count, 0], out[count, 1], out[count, 2] = a, here, c
    return out
