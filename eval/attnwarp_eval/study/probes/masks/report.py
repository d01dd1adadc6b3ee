"""Report of lifted masks: overlap by yaw and by visibility, and pictures side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from statistics import median
from typing import ClassVar

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.study.probe_report import (
    Layout,
    ProbeReport,
    in_degrees,
    register_report,
    scenes_side_by_side,
    views_of,
)
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.pictures import MARKS

PARTS = {
    "Overlap over the whole view": "masks.iou",
    "Overlap where the source shows the surface": "masks.iou.seen",
    "Overlap where it does not": "masks.iou.unseen",
}
"""Title of a table -> its metric."""


@register_report
class MasksReport(ProbeReport):
    """Overlap of lifted masks with the exact ones, by variant."""

    name = "masks"
    measures = "masks lifted through splats"
    columns: ClassVar[Mapping[str, str]] = {
        "IoU": "masks.iou",
        "IoU, seen": "masks.iou.seen",
        "IoU, unseen": "masks.iou.unseen",
        "precision": "masks.precision",
        "recall": "masks.recall",
        "the source's mask": "masks.given",
        "back in the source": "masks.back",
    }
    contrasts = ("masks.iou", "masks.iou.seen", "masks.iou.unseen", "masks.given")
    cost = "lift"
    cost_of = "a lift"
    cost_text = "Seconds are those of one call of `lift_masks`, for all of its masks."

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Tables of medians over scenes by yaw."""
        names = results.study.probes.get(self.name, [])
        tables = [self._by_yaw(results, names, title, metric) for title, metric in PARTS.items()]
        for table in tables[1:]:
            table.folded = True
        if any(table.rows for table in tables):
            text = (
                "Intersection over union of a lifted mask and the exact one: medians over scenes,"
                " in brackets the lowest scene. A view that shows fewer than 16 pixels of the thing"
                " has none there; `of` says how many scenes are left. With several masks, some"
                " targets lie close to a view that has one."
            )
            yield Section("Lifted masks by yaw", [text], tables)

    def _by_yaw(self, results: Results, names: list[str], title: str, metric: str) -> Table:
        rows, views = [], dict[str, None]()
        for name in names:
            by_view: dict[str, list[float]] = {}
            for _, _, record in results.records(self.name, name):
                for view in record.views:
                    by_view.setdefault(view.name, []).append(view.metrics.get(metric, math.nan))
            views |= dict.fromkeys(by_view)
            if by_view:
                rows.append((name, by_view))
        cells = [[name, *(_median(own.get(view, [])) for view in views)] for name, own in rows]
        seen = views_of(one for name in names for *_, one in results.records(self.name, name))
        return Table(["variant", *in_degrees(views, seen)], cells, title)

    def gallery(self, results: Results) -> Section | None:
        """Masks of each scene, in the colours of right, lost and wrong."""
        grids = scenes_side_by_side(results, self.name, "lifted", {"true view": "target"})
        legend = "; ".join(f"`{color}` {name}" for name, color in MARKS.items())
        return Section("Lifted masks", [f"{legend}."], grids=grids, folded=True) if grids else None


def _median(values: list[float]) -> str:
    """Median with the lowest value, and the number of defined values if some are undefined."""
    defined = [value for value in values if math.isfinite(value)]
    if not defined:
        return "–"
    of = "" if len(defined) == len(values) else f", {len(defined)} of {len(values)}"
    return f"{number(median(defined))} ({number(min(defined))}{of})"
