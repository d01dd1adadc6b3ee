"""Report of labels: right, wrong, none, painted by grid, parts, and distance to depth edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from attnwarp_eval.document.model import Table
from attnwarp_eval.study.probe_report import ProbeReport, mean_values, register_report
from attnwarp_eval.study.results import Results
from attnwarp_lab.probes.labels.measure import FAR


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
        """Labels by distance to depth edges, and right labels by grid and number of parts."""
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
        return [
            self._by_distance(results, names),
            Table(["variant", "parts", *map(str, grids)], rows, caption, folded=True),
        ]

    def _by_distance(self, results: Results, names: Sequence[str]) -> Table:
        figures = {
            "right": "labels.right",
            "wrong": "labels.wrong",
            "painted, hidden": "labels.painted_hidden",
        }
        rows = [
            [name, text, *mean_values(results, self.name, name, keys)]
            for name in names
            for text, figure in figures.items()
            if (keys := [f"{figure}.edge{tokens}" for tokens in range(FAR + 1)])
        ]
        heads = [*map(str, range(FAR)), f"{FAR} and more"]
        return Table(
            ["variant", "labels", *heads], rows,
            "Labels by the token's distance to the nearest true depth edge, in whole tokens",
        )  # fmt: skip
