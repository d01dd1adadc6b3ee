"""Compositing order of splats: front to back by centre depth, independent of their order in the
input.
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
    """Put splats of equal depth into an order that depends on their parameters, in place.

    Depths count as equal if they round to the same float32. In a plane of splats before a rotated
    camera, depths differ only in the last bits of float64, which are noise. Splats equal in all
    parameters are interchangeable.

    Args:
        order: (M,) indices of splats, sorted by ``depth``; changed in place.
        depth: (N,) float32 depth of each splat.
        places: ascending positions in ``order`` whose depth equals a neighbour's, if known.
    """
    if places is None:
        same = np.flatnonzero(np.diff(depth[order]) == 0)
        places = np.union1d(same, same + 1)
    if not len(places):
        return
    splats = order[places]
    # The first parameters break most ties: the others are only compared if necessary.
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
    """Sort splats from the nearest to the farthest, (N,) indices; see :func:`break_ties`."""
    order = np.argsort(depth, kind="stable").astype(np.int64)
    break_ties(order, depth, content)
    return order
