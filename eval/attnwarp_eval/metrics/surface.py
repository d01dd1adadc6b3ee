"""Accuracy of a reconstructed surface: distances and normals between its points and true ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from attnwarp_eval.metrics.arrays import Array, floats, mean, share


def surface_error(
    points: Any,
    true_points: Any,
    *,
    threshold: float,
    cut: float = np.inf,
    normal: Any = None,
    true_normal: Any = None,
) -> dict[str, float]:
    """Distances between the points of two surfaces, each to the nearest of the other.

    Both are sampled evenly on their surfaces, more densely than the distances of interest.
    Accuracy, completeness and their mean, the chamfer distance, are those of DTU (Aanaes et al.
    2016, Large-scale data for multiple-view stereopsis); precision, recall and F-score those of
    Tanks and Temples (Knapitsch et al. 2017); normal consistency is that of Mescheder et al. 2019
    (Occupancy networks).

    Args:
        points: (P, 3) points of the reconstruction; P may be 0.
        true_points: (T, 3) points of the true surface.
        threshold: distance below which a point counts as right, in the points' unit.
        cut: limit above which distances are left out of the means, as DTU does above 20 mm.
        normal, true_normal: (P, 3) and (T, 3) unit normals, of either sign.

    Returns:
        ``surface.accuracy``, ``completeness``, ``chamfer``, and ``chamfer_uncut`` over all points,
        in the points' unit; ``surface.precision``, ``recall`` and ``f_score``;
        ``surface.normal_consistency``, the mean of the absolute cosine between the normals of
        nearest points, both ways, if normals are given; and the counts ``surface.points`` and
        ``surface.true_points``. NaN if one side has no point, or none within ``cut``.

    Raises:
        ValueError: another shape, one of the two normals without the other, or a point that is not
            finite.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> plane = np.stack(np.mgrid[0:5, 0:5, 0:1], axis=-1).reshape(-1, 3) / 10
        >>> error = metrics.surface_error(plane + [0, 0, 0.02], plane, threshold=0.05)
        >>> round(error["surface.chamfer"], 9), error["surface.f_score"]
        (0.02, 1.0)
    """
    from scipy.spatial import KDTree

    ours, truth = floats(points, ("P", 3), "points"), floats(true_points, ("T", 3), "true_points")
    if (normal is None) != (true_normal is None):
        raise ValueError("normal, true_normal: got one of them, expected both or neither")
    for name, array in (("points", ours), ("true_points", truth)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: not finite; leave such points out")
    counts = {"surface.points": len(ours), "surface.true_points": len(truth)}
    empty = not len(ours) or not len(truth)

    def nearest(of: Array, among: Array) -> tuple[Array, Any]:
        if empty:
            return np.zeros(0), np.zeros(0, dtype=np.int64)
        return KDTree(among).query(of)

    to_truth, true_index = nearest(ours, truth)
    to_ours, index = nearest(truth, ours)
    accuracy, completeness = mean(to_truth[to_truth < cut]), mean(to_ours[to_ours < cut])
    precision = share(int((to_truth < threshold).sum()), len(to_truth))
    recall = share(int((to_ours < threshold).sum()), len(to_ours))
    both = precision + recall
    figures = {
        "surface.accuracy": accuracy,
        "surface.completeness": completeness,
        "surface.chamfer": (accuracy + completeness) / 2,
        "surface.chamfer_uncut": (mean(to_truth) + mean(to_ours)) / 2,
        "surface.precision": precision,
        "surface.recall": recall,
        "surface.f_score": 2 * precision * recall / both if both else both,
        **counts,
    }
    if normal is not None:
        n = floats(normal, ours.shape, "normal")
        m = floats(true_normal, truth.shape, "true_normal")
        there = np.abs((n[: len(true_index)] * m[true_index]).sum(-1))
        back = np.abs((m[: len(index)] * n[index]).sum(-1))
        figures["surface.normal_consistency"] = (mean(there) + mean(back)) / 2
    return figures
