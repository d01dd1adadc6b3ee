"""Report of labels: right, wrong, none and painted by grid and number of parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from attnwarp_eval.document.model import Table
from attnwarp_eval.study.probe_report import ProbeReport, mean_values, register_report
from attnwarp_eval.study.results import Results


@register_report
class LabelReport(ProbeReport):
    """Carried labels of a thing's parts, by variant."""

    name = "labels"
    measures = "where labels of parts arrive"
    columns: ClassVar[Mapping[str, str]] = {
        "right": "labels.right",
        "wrong": "labels.wrong",
        "none": "labels.none",
        "painted, hidden": "labels.painted_hidden",
        "painted, outside": "labels.painted_outside",
    }
    contrasts = ("labels.right", "labels.painted_hidden")
    stage = "pair"

    def details(self, results: Results, names: Sequence[str]) -> list[Table]:
        """Share of right labels by the grid's side and the number of parts."""
        specs = [record.spec for _, record in results.finished(self.name)]
        if not specs:
            return []
        grids = specs[0]["grids"]
        rows = [
            [
                name,
                str(count),
                *mean_values(
                    results, self.name, name, [f"labels.right.{grid}.{count}" for grid in grids]
                ),
            ]
            for name in names
            for count in specs[0]["parts"]
        ]
        caption = "Right labels by tokens along a side"
        return [Table(["variant", "parts", *map(str, grids)], rows, caption, folded=True)]
