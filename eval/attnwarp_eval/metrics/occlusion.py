"""Masks against true visibility from the source: precision, recall and other scores.

A pixel that shows a surface is visible, hidden (occluded, turned away) or ambiguous, or its point
falls outside the source image or behind its camera. Ambiguous pixels are counted but not scored.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp_eval.metrics.arrays import Mask, mask, share
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, NONE, VISIBLE

COUNTS = (
    "visible_accepted",
    "visible_rejected",
    "hidden_accepted",
    "hidden_rejected",
    "outside_accepted",
    "outside_rejected",
    "behind_accepted",
    "behind_rejected",
    "empty_accepted",
    "ambiguous_accepted",
    "ambiguous_rejected",
)
"""Names of :func:`confusion`'s counts. "outside" is surface with a point outside the source image,
including points behind the camera; "behind" only those. "empty" is background."""

Counts = dict[str, int]
Ints = npt.NDArray[np.int64]


def confusion(
    accepted: Any, label: Any, surface: Any, behind: Any = None, among: Any = None
) -> Counts:
    """Count accepted and rejected pixels by their true class, for each of :data:`COUNTS`.

    Args:
        accepted: (H, W) bool, the mask to judge.
        label: (H, W) 0 none, 1 visible, 2 hidden, 3 ambiguous.
        surface: (H, W) bool, the target pixel shows a surface.
        behind: (H, W) bool, the surface's point lies behind the source camera.
        among: (H, W) bool, the pixels to count; by default all.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> accepted, label = np.array([[True, True, False]]), np.array([[1, 2, 1]])
        >>> counts = metrics.confusion(accepted, label, np.ones((1, 3), bool))
        >>> {name: count for name, count in counts.items() if count}
        {'visible_accepted': 1, 'visible_rejected': 1, 'hidden_accepted': 1}
    """
    counted = None if among is None else mask(among, np.asarray(label).shape, "among")
    return _counts(_table(accepted, label, surface, behind, counted)[1])


def _table(accepted: Any, label: Any, surface: Any, behind: Any, region: Mask | None) -> Ints:
    """Pixels by (in the region, accepted, behind, surface, label), counted in one pass."""
    truth = np.asarray(label)
    check.shape(truth, ("H", "W"), "label")
    if not np.isin(truth, (NONE, VISIBLE, HIDDEN, AMBIGUOUS)).all():
        raise ValueError(
            f"label: got values {np.unique(truth).tolist()}, expected 0 to {AMBIGUOUS}"
        )
    code = truth.astype(np.uint8)
    code |= mask(surface, truth.shape, "surface").view(np.uint8) << 2
    if behind is not None:
        code |= mask(behind, truth.shape, "behind").view(np.uint8) << 3
    code |= mask(accepted, truth.shape, "accepted").view(np.uint8) << 4
    # Without a region every pixel counts.
    code |= np.uint8(1 << 5) if region is None else region.view(np.uint8) << 5
    return np.bincount(code.ravel(), minlength=64).reshape(2, 2, 2, 2, 4)


def _counts(table: Ints) -> Counts:
    """The counts of (accepted, behind, surface, label)."""
    outside = table[:, :, 1, NONE]
    classes = {
        "visible": table[..., VISIBLE].sum(axis=(1, 2)),
        "hidden": table[..., HIDDEN].sum(axis=(1, 2)),
        "outside": outside.sum(axis=1),
        "behind": outside[:, 1],
        "ambiguous": table[..., AMBIGUOUS].sum(axis=(1, 2)),
    }
    counts = {"empty_accepted": int(table[1, :, 0, NONE].sum())}
    for name, (rejected, passed) in classes.items():
        counts |= {f"{name}_accepted": int(passed), f"{name}_rejected": int(rejected)}
    return {name: counts[name] for name in COUNTS}


def scores(counts: Mapping[str, int]) -> dict[str, float]:
    """Precision, recall, F1 and both error rates from :func:`confusion`'s counts, of one view or
    summed over several.

    A mask that accepts nothing has no precision, and a view without visible pixels has no
    recall, no false negative rate and no F1: NaN. Accepted background counts against precision and
    F1, but not in the false positive rate, whose base is surface hidden from the source: a large
    sky would dilute it.

    Example:
        >>> from attnwarp_eval import metrics
        >>> counts = dict.fromkeys(metrics.COUNTS, 0)
        >>> counts |= {"visible_accepted": 3, "hidden_accepted": 1}
        >>> result = metrics.scores(counts)
        >>> result["occlusion.precision"], result["occlusion.recall"]
        (0.75, 1.0)
    """
    tp, fn = counts["visible_accepted"], counts["visible_rejected"]
    unseen = counts["hidden_accepted"] + counts["outside_accepted"]
    fp = unseen + counts["empty_accepted"]
    tn = counts["hidden_rejected"] + counts["outside_rejected"]
    return {
        "occlusion.precision": share(tp, tp + fp),
        "occlusion.recall": share(tp, tp + fn),
        "occlusion.f1": share(2 * tp, 2 * tp + fp + fn) if tp + fn else float("nan"),
        "occlusion.false_positive_rate": share(unseen, unseen + tn),
        "occlusion.false_negative_rate": share(fn, tp + fn),
        "occlusion.behind_share": share(counts["behind_accepted"], tp + fp),
        "occlusion.hidden_share": share(counts["hidden_accepted"], tp + fp),
    }


def mask_error(
    accepted: Any, label: Any, surface: Any, behind: Any = None, edge: Any = None
) -> dict[str, float]:
    """Scores and counts of a mask; with ``edge`` also for the interior and for the band
    around edges.

    Args:
        accepted, label, surface, behind: as in :func:`confusion`.
        edge: (H, W) bool, the band around edges.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> accepted, label = np.array([[True, True, False]]), np.array([[1, 2, 1]])
        >>> error = metrics.mask_error(accepted, label, np.ones((1, 3), bool))
        >>> error["occlusion.precision"], error["occlusion.hidden_accepted"]
        (0.5, 1)
    """
    shape = np.asarray(label).shape
    band = None if edge is None else mask(edge, shape, "edge")
    table = _table(accepted, label, surface, behind, band)
    parts = {"": table.sum(axis=0)}
    if band is not None:
        parts |= {".interior": table[0], ".edge": table[1]}
    figures: dict[str, float] = {}
    for suffix, part in parts.items():
        counts = _counts(part)
        figures |= {f"{name}{suffix}": value for name, value in scores(counts).items()}
        figures |= {f"occlusion.{name}{suffix}": value for name, value in counts.items()}
    return figures


@dataclass(frozen=True)
class YawBin:
    """Views whose yaw lies in [low, high), the last bin including its upper end.

    Attributes:
        low, high: degrees.
        counts: sums of the views' counts.
        scores: scores of the sums, NaN where undefined.
    """

    low: float
    high: float
    views: int
    counts: Counts
    scores: dict[str, float]


def by_yaw(
    rows: Iterable[tuple[float, Mapping[str, int]]],
    edges: Sequence[float] = (0, 15, 30, 60, 90, 120, 150, 180),
) -> list[YawBin]:
    """Sum the counts of views in bins of yaw.

    Args:
        rows: yaw in degrees, of either sign and folded to [0, 180], and the counts of
            :func:`confusion`.
        edges: ends of the bins, rising from 0 to 180.

    Returns:
        One entry for each bin, empty ones included: their scores are NaN.

    Raises:
        ValueError: edges that do not rise from 0 to 180.

    Example:
        >>> from attnwarp_eval import metrics
        >>> counts = dict.fromkeys(metrics.COUNTS, 0) | {"visible_accepted": 3}
        >>> [entry.views for entry in metrics.by_yaw([(10, counts), (-20, counts), (180, counts)])]
        [1, 1, 0, 0, 0, 0, 1]
    """
    ends = [float(edge) for edge in edges]
    if (
        len(ends) < 2
        or ends[0] != 0
        or ends[-1] != 180
        or any(a >= b for a, b in itertools.pairwise(ends))
    ):
        raise ValueError(f"edges: got {list(edges)}, expected rising degrees from 0 to 180")
    sums = [dict.fromkeys(COUNTS, 0) for _ in ends[1:]]
    views = [0] * len(sums)
    for yaw, counts in rows:
        folded = abs((float(yaw) + 180) % 360 - 180)
        index = min(int(np.searchsorted(ends, folded, side="right")) - 1, len(sums) - 1)
        views[index] += 1
        for name in COUNTS:
            sums[index][name] += int(counts[name])
    return [
        YawBin(low, high, n, total, scores(total))
        for low, high, n, total in zip(ends, ends[1:], views, sums, strict=False)
    ]
