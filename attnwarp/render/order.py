"""The order in which splats are composited: front to back by centre depth, and never by their place in the input."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def break_ties(order: npt.NDArray[np.int64], depth: npt.NDArray[np.float32], content: list[np.ndarray]) -> None:
    """Put splats of equal depth into an order that depends on what they are, in place.

    Depths count as equal when they round to the same float32: a plane of splats seen by a rotated camera differs in
    the last bits of float64 only, and those are noise. Splats equal in everything are interchangeable.

    Args:
        order: (M,) indices of splats, sorted by ``depth``; changed in place.
        depth: (N,) float32 depth of each splat.
        content: arrays of (N,) or (N, k) values that describe a splat, most significant first.
    """
    if len(order) < 2:
        return
    sorted_depth = depth[order]
    same = sorted_depth[1:] == sorted_depth[:-1]
    if not same.any():
        return
    tied = np.zeros(len(order), dtype=bool)
    tied[1:] |= same
    tied[:-1] |= same
    places = np.flatnonzero(tied)
    splats = order[places]
    keys: list[np.ndarray] = [depth[splats]]
    for array in content:
        rows = array[splats].reshape(len(splats), -1)
        keys += list(rows.T)
    order[places] = splats[np.lexsort(keys[::-1])]


def front_to_back(depth: npt.NDArray[np.float32], content: list[np.ndarray]) -> npt.NDArray[np.int64]:
    """(N,) indices from the nearest to the farthest splat; see :func:`break_ties`."""
    order = np.argsort(depth, kind="stable").astype(np.int64)
    break_ties(order, depth, content)
    return order
