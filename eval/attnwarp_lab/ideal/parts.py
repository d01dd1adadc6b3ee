"""Parts of a thing: cells of its surface, the same in every view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.cluster.vq import kmeans2, vq

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int16]

MOST_POINTS = 20_000
"""Number of surface points for k-means, taken evenly from all views."""

GRAIN = 1e-9
"""Quantization step of the points, as a share of the thing's extent: far above rounding."""


def part_labels(points: Mapping[str, Array], parts: int) -> dict[str, Labels]:
    """Parts of a thing in every view: k-means cells of its surface points, pooled over the views.

    Cells depend only on position, so both sides of a thin body are one part. This is intended: an
    answer does not depend on the viewing side.

    Args:
        points: by view, (H, W, 3) world coordinates of the thing; NaN elsewhere.
        parts: number of cells; fewer where there are fewer points.

    Returns:
        (H, W) by view: the part, -1 outside the thing.

    Raises:
        ValueError: no view shows the thing.

    Example:
        >>> import numpy as np
        >>> line = np.stack(np.broadcast_arrays(np.arange(4.0), 0.0, 0.0), axis=-1)[None]
        >>> labels = part_labels({"a": line, "b": line[:, ::-1]}, 2)
        >>> bool((labels["a"] == labels["b"][:, ::-1]).all()), np.unique(labels["a"]).tolist()
        (True, [0, 1])
    """
    pooled = np.concatenate([p[np.isfinite(p).all(axis=-1)] for p in points.values()])
    if not len(pooled):
        raise ValueError("points: no view shows the thing; choose other objects or views")
    every = max(1, len(pooled) // MOST_POINTS)
    # Rounding must not decide the order of points that share a coordinate, as on a box's face:
    # k-means is initialized with points by index, and another order gives other cells.
    grain = GRAIN * max(float(np.ptp(pooled, axis=0).max()), np.finfo(float).tiny)
    sample = grain * np.unique(np.round(pooled[::every] / grain) + 0.0, axis=0)
    count = min(parts, len(sample))
    centers, _ = kmeans2(sample, count, minit="++", rng=np.random.default_rng(0), iter=50)
    # Numbered by position, independent of the order of k-means.
    centers = centers[np.lexsort(centers.T)]
    result = {}
    for view, own in points.items():
        there = np.isfinite(own).all(axis=-1)
        labels = np.full(own.shape[:2], -1, dtype=np.int16)
        if there.any():
            labels[there] = vq(own[there], centers)[0]
        result[view] = labels
    return result


def token_parts(labels: Labels, size: tuple[int, int]) -> Labels:
    """(h, w) part of each token: the part of most of its pixels; -1 counts as a part.

    Args:
        labels: (H, W) parts, -1 for none; sides are multiples of the grid's.
        size: (h, w) of the grid.

    Raises:
        ValueError: sides that do not divide; the message names them.

    Example:
        >>> import numpy as np
        >>> token_parts(np.array([[0, 0, 1, -1], [0, 2, -1, -1]], np.int16), (1, 2)).tolist()
        [[0, -1]]
    """
    (H, W), (h, w) = labels.shape, size
    if H % h or W % w:
        raise ValueError(f"size: got {h} x {w} tokens for {H} x {W} px, expected divisors of them")
    cells = labels.reshape(h, H // h, w, W // w).transpose(0, 2, 1, 3).reshape(h * w, -1)
    counts = np.zeros((h * w, int(labels.max()) + 2), dtype=np.int64)
    np.add.at(counts, (np.arange(h * w)[:, None], cells + 1), 1)
    return (counts.argmax(axis=1) - 1).astype(np.int16).reshape(h, w)
