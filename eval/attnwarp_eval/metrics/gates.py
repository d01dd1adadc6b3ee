"""Figures that gate a comparison of two runs, with their tolerated worsening.

The registry has each figure's direction, and its tolerance for no change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from attnwarp_eval.metrics.registry import METRICS


@dataclass(frozen=True)
class Margin:
    """Largest worsening of one view that is not a regression.

    A margin is wider than the registry's tolerance: another processor rounds a few pixels of a
    small picture to the other side of a threshold.

    Attributes:
        absolute: margin in the metric's unit.
        relative: margin as a share of the baseline's value, added to ``absolute``.
    """

    absolute: float
    relative: float = 0.0

    def around(self, value: float) -> float:
        """The margin around a value of the baseline."""
        return self.absolute + self.relative * abs(value)


GATES: Mapping[str, Margin] = {
    "calibration.mitsuba_agrees": Margin(5e-3),
    "warp.epe_median": Margin(0.02, 0.02),
    "warp.epe_p95": Margin(0.1, 0.05),
    "warp.epe_median_layer": Margin(0.005, 0.02),
    "warp.below_1px": Margin(5e-3),
    "warp.coverage": Margin(5e-3),
    "warp.feature_all_accepted": Margin(1e-3, 0.02),
    "occlusion.precision": Margin(5e-3),
    "occlusion.recall": Margin(5e-3),
    "labels.net": Margin(0.02),
    "labels.right": Margin(0.02),
    "labels.wrong": Margin(0.02),
    "labels.none": Margin(0.02),
    "labels.painted_hidden": Margin(0.02),
    "labels.painted_outside": Margin(0.01),
    "masks.iou": Margin(0.02),
    "masks.precision": Margin(0.02),
    "masks.recall": Margin(0.02),
    "masks.given": Margin(0.02),
    "masks.back": Margin(0.02),
    # One part of a view that changes its answer changes these by a tenth.
    "parts.seen": Margin(0.1),
    "parts.fill": Margin(0.1),
    "parts.through": Margin(0.1),
    "parts.bleed": Margin(0.05, 0.05),
    "parts.delta_e": Margin(0.5, 0.1),
    "shape.same": Margin(0.1),
    "shape.new": Margin(0.1),
    "shape.uncovered": Margin(0.1),
    "shape.overlap": Margin(0.1),
    "shape.stands": Margin(0.1),
    "shape.lost": Margin(0.5, 0.1),
    "fit.mse": Margin(1e-5, 0.05),
    "fit.ssim": Margin(2e-3),
    "depth.abs_rel": Margin(1e-4, 0.05),
    "depth.bias_relative": Margin(1e-4, 0.05),
    "depth.delta_1_01": Margin(5e-3),
    "depth.normal_median": Margin(0.05, 0.02),
    "depth.coverage": Margin(5e-3),
    "multiview.delta_e": Margin(0.05, 0.02),
    "multiview.delta_e_above": Margin(0.05, 0.02),
    "multiview.same_answer": Margin(5e-3),
    "multiview.same_part": Margin(0.1),
    "embedding.clip_similarity": Margin(5e-3),
    "embedding.clip_directional": Margin(5e-3),
    "embedding.clip_image": Margin(5e-3),
    "embedding.dino_image": Margin(5e-3),
    "fidelity.mse": Margin(1e-5, 0.05),
    "fidelity.ssim": Margin(2e-3),
    "fidelity.preserved_mse": Margin(1e-5, 0.05),
    "fidelity.preserved_psnr": Margin(0.2),
    "image.mse": Margin(1e-5, 0.05),
    "image.psnr": Margin(0.2),
    "stability.margin": Margin(0.5),
}
"""Margins by metric. PSNR is infinite for equal pictures, so a comparison leaves it to its mean
squared error where both sides have that; 0.2 dB are 5 % of it.
"""


EDITED = frozenset(
    (*(kind + of for kind in ("edit", "render") for of in ("", "_inside", "_next", "_seen")),
     "edit_render", "after", "seen", "unseen", "several", "one", "new", "gone", "untouched")
)  # fmt: skip
"""Endings of a metric's name for edits: edited views, renders of edited splats, their edited
object, their neighbours, pixels visible in the source; for a lifted mask also the invisible ones;
for changed shapes their number of right answers, and surface that is new, gone or neither.
"""


COUNTERS: Mapping[str, Margin] = dict.fromkeys(
    (
        "visible",
        "tile_pairs",
        "pairs",
        "source_pairs",
        "rendered_pairs",
        "composited",
        "contributing",
    ),
    Margin(0.0, 1e-3),
)
"""Margins of the counters that depend on comparisons of rounded numbers, such as whether a
splat reaches a tile: another processor counts a few more or less. All others must be the same.
"""


def same_count(counter: str, before: int, now: int) -> bool:
    """Return True if two counts of a cell are equal within the counter's margin.

    Example:
        >>> same_count("pairs", 966_432, 966_416), same_count("taps", 300_672, 300_671)
        (True, False)
    """
    return abs(now - before) <= COUNTERS.get(counter, Margin(0.0)).around(before)


def gated(key: str) -> bool:
    """Return True if a result's key is gated: a metric of :data:`GATES`, over the whole picture, on
    a feature grid or of an edit (:data:`EDITED`). Regions of a picture follow from the whole, and
    keys of known flaws rate a metric, not the code.

    Example:
        >>> [gated(key) for key in ("depth.abs_rel", "warp.epe_median_layer.64", "depth.rmse")]
        [True, True, False]
        >>> gated("depth.abs_rel.edge"), gated("depth.abs_rel.after")
        (False, True)
    """
    base = key
    while base not in METRICS:
        base, _, tail = base.rpartition(".")
        if not (tail.isdecimal() or tail in EDITED):
            return False
    return base in GATES


def margin(key: str) -> Margin:
    """Margin of a gated key. KeyError: the key is not gated.

    Example:
        >>> margin("warp.epe_median_layer.64").absolute
        0.005
    """
    return GATES[METRICS[key].name]
