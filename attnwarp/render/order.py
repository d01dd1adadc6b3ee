"""The order in which splats are composited: front to back by centre depth, and never by their place
in the input.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def break_ties(
    order: npt.NDArray[np.int64],
    depth: npt.NDArray[np.float32],
    content: list[np.ndarray],
    places: npt.NDArray[np.int64] | None = None,
) -> None:
    """Put splats of equal depth into an order that depends on what they are, in place.

    Depths count as equal when they round to the same float32. In a plane of splats before a rotated
    camera, depths differ in the last bits of float64 only, which are noise. Splats equal in all
    parameters are interchangeable.

    Args:
        order: (M,) indices of splats, sorted by ``depth``; changed in place.
        depth: (N,) float32 depth of each splat.
        content: arrays of (N,) or (N, k) values that describe a splat, most significant first.
        places: where in ``order`` a depth equals one beside it, ascending, if that is known.
    """
    if places is None:
        same = np.flatnonzero(np.diff(depth[order]) == 0)
        places = np.union1d(same, same + 1)
    if not len(places):
        return
    splats = order[places]
    # Most ties are broken by what comes first: the rest is only looked at if it has to be.
    for arrays in (content[:1], content):
        keys = [
            depth[splats],
            *(row for array in arrays for row in array[splats].reshape(len(splats), -1).T),
        ]
        by = np.lexsort(keys[::-1])
        if not np.all([key[by[1:]] == key[by[:-1]] for key in keys], axis=0).any():
            break
    order[places] = splats[by]


def front_to_back(
    depth: npt.NDArray[np.float32], content: list[np.ndarray]
) -> npt.NDArray[np.int64]:
    """(N,) indices from the nearest to the farthest splat; see :func:`break_ties`."""
    order = np.argsort(depth, kind="stable").astype(np.int64)
    break_ties(order, depth, content)
    return order
