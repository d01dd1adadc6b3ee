"""Polygons cut into triangles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


NONE = -1
"""Corner of a triangle that is left out."""


def triangulate(vertices: Array, corners: Indices, sizes: Indices) -> tuple[Indices, Indices]:
    """Triangulate polygons, in the polygons' order and with their winding.

    A convex polygon becomes a fan about its first corner; another one is cut by mapbox-earcut in
    the plane of its mean normal (Newell's method).

    Args:
        vertices: (V, 3).
        corners: (C,) indices into ``vertices``, polygon after polygon.
        sizes: (P,) corners of each polygon, at least 3.

    Returns:
        faces: (F, 3); a polygon of n corners gives n - 2, or fewer if some lie on a straight line.
        crossed: (Q,) indices of the polygons that cross themselves; they give no triangles.

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
            ears = _ears(_flat(points[k], normal[k])) if whole[k] else np.empty((0, 3), np.int64)
            own = faces[row[group[k]] : row[group[k] + 1]]
            own[:] = NONE
            own[: len(ears)] = index[k][ears]
            if not len(ears):
                crossed.append(int(group[k]))
    return faces[(faces != NONE).all(axis=1)], np.array(sorted(crossed), np.int64)


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


def _ears(points: Array) -> Indices:
    """(T, 3) triangles of a counterclockwise polygon; (0, 3) if their area is another than the
    polygon's, which crosses itself then.
    """
    from mapbox_earcut import triangulate_float64

    ends = np.array([len(points)], np.uint32)
    ears = triangulate_float64(points, ends).astype(np.int64).reshape(-1, 3)
    parts = np.abs(_twice_areas(points[ears])).sum()
    whole = _twice_areas(points[None])[0]
    return ears if abs(parts - whole) <= 1e-9 * whole else ears[:0]


def _twice_areas(outlines: Array) -> Array:
    """(G,) twice the signed areas of (G, n, 2) outlines, by the shoelace formula."""
    x, y = np.moveaxis(outlines, -1, 0)
    areas: Array = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    return areas
