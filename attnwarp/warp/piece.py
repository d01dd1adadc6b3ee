"""Connected surface around a point of a picture, bounded by steps in depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp.gaussians import Gaussians
from attnwarp.warp.view import render_surface

STEP = 0.02
"""Distance of a neighbour from a pixel's tangent plane, over its depth, that separates the two."""

FLAT, LEVEL = 0.01, 0.7
"""Limits of the largest plane: distance over the median depth, and smallest cosine of normals."""

SLAB, ALONG = 0.1, 0.8
"""Smallest share of the piece, and smallest cosine with the largest plane's normal, of a slab's
face."""

DRAWN, TRIED = 10_000, 300
"""Number of pixels that vote for the largest plane, and number of tried planes."""


def piece_around(
    gaussians: Gaussians,
    camera: Camera,
    at: Sequence[float],
    *,
    near: float | None = None,
) -> npt.NDArray[np.bool_]:
    """Select the pixels connected to a pixel by rendered surface, (H, W) bool.

    A connecting path has no step in depth, and avoids what objects stand on, unless it begins
    there: the largest plane, and faces of slabs parallel to it that lie between it and the point.
    If nothing is drawn at the pixel, all pixels are selected.

    Args:
        gaussians: splats of either kind.
        camera: camera of the picture.
        at: x, y of the point, in px of the picture.
        near: near-plane depth, in scene units; by default a hundredth of the splats' median
            distance.

    Raises:
        InputError: the point lies outside of the picture.

    Example:
        >>> from attnwarp.trial import disc, view
        >>> bool(piece_around(disc(0.3), view(), (0, 0)).all())  # nothing there
        True
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    x, y = at
    if not (0 <= x <= camera.width and 0 <= y <= camera.height):
        raise InputError(
            f"at: got {x:g},{y:g}, expected px inside the picture of"
            f" {camera.width} x {camera.height}"
        )
    seen = render_surface(gaussians, camera, near=near)
    depth, normal, alpha = (
        np.asarray(v, np.float64) for v in (seen.depth, seen.normal, seen.alpha)
    )
    height, width = depth.shape
    own = min(int(y), height - 1), min(int(x), width - 1)
    solid = (alpha > 0.5) & np.isfinite(depth)
    if not solid[own]:
        return np.ones_like(solid)
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    place = camera.unproject(pixels, np.where(solid, depth, 1.0))
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    reach = FLAT * float(np.median(depth[solid]))
    middle, axis, flat = _largest_plane(place, normal, solid, reach)
    free = solid if flat[own] else solid & ~flat
    number = np.arange(height * width).reshape(height, width)

    def connected() -> npt.NDArray[np.bool_]:
        joined = []
        for one, two in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            step = place[one] - place[two]
            off = [np.abs((step * normal[side]).sum(-1)) for side in (one, two)]
            limit = STEP * np.minimum(depth[one], depth[two])
            keep = free[one] & free[two] & (np.minimum(*off) < limit)
            joined.append(np.stack([number[one][keep], number[two][keep]]))
        i, j = np.concatenate(joined, axis=1)
        graph = coo_array((np.ones(len(i)), (i, j)), shape=(number.size, number.size))
        part = connected_components(graph, directed=False)[1].reshape(height, width)
        return np.asarray(part == part[own])

    piece = connected()
    above = (place - middle) @ axis * np.sign((camera.position - middle) @ axis)
    low = (np.abs(normal @ axis) > ALONG) & (above < above[own] - 2 * reach)
    while not flat[own]:
        levels = np.sort(above[piece & low])
        counts = np.searchsorted(levels, levels + 2 * reach) - np.arange(len(levels))
        if counts.max(initial=0) < SLAB * piece.sum():
            break
        slab = levels[counts.argmax()] + reach
        free = free & ~(low & (np.abs(above - slab) < 1.5 * reach))
        piece = connected()
    return piece


def _largest_plane(
    place: Any, normal: Any, solid: Any, reach: float
) -> tuple[Any, Any, npt.NDArray[np.bool_]]:
    """Find the largest plane: a point, its normal, and its pixels, (H, W) bool (RANSAC, Fischler &
    Bolles 1981).
    """

    def members(place: Any, normal: Any, point: Any, direction: Any) -> npt.NDArray[np.bool_]:
        near = np.abs((place - point) @ direction) < reach
        return np.asarray(near & (np.abs(normal @ direction) > LEVEL))

    drawn = np.random.default_rng(0).permutation(np.flatnonzero(solid))[:DRAWN]
    some, facing = (v.reshape(-1, 3)[drawn] for v in (place, normal))
    planes = zip(some[:TRIED], facing[:TRIED], strict=True)
    best = max((members(some, facing, *plane) for plane in planes), key=np.count_nonzero)
    middle = some[best].mean(0)
    axis = np.linalg.svd(some[best] - middle, full_matrices=False)[2][-1]
    return middle, axis, solid & members(place, normal, middle, axis)
