"""Report of an edit in a few views: pictures side by side, and how well the views agree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
from attnwarp_eval.study.probes.carry.measure import LEAST_CHANGE
from attnwarp_eval.study.results import Results

MOST_ROWS = 24
"""Rows of the table of single scenes that stand on the page."""


@register_report
class CarryReport(ProbeReport):
    """Colour difference of views at the same points, by variant and view."""

    name = "carry"
    measures = "an edit carried to a few views"
    tabulates_all = True
    columns: ClassVar[Mapping[str, str]] = {
        "parts with the source's colour": "multiview.same_part.seen",
        "... where the source does not see them": "multiview.same_part.unseen",
        "colour difference, dE00": "multiview.delta_e",
    }
    contrasts = tuple(columns.values())
    cost = "whole"
    cost_of = "an edit"
    cost_text = "Seconds are those of the source's edit, the warps and the views' edits."

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Table of each view's difference from the source."""
        rows, views = [], dict[str, None]()
        for cell, record in results.finished(self.name):
            values = {view.name: view.metrics["multiview.delta_e"] for view in record.views}
            views |= dict.fromkeys(values)
            rows.append(
                ([cell.scene, cell.variants[0], record.spec["edit"]["instruction"]], values)
            )
        if rows:
            seen = views_of(record for _, record in results.finished(self.name))
            columns = ["scene", "variant", "words", *in_degrees(views, seen)]
            table = [[*row, *(number(values.get(view)) for view in views)] for row, values in rows]
            text = (
                "Mean CIEDE2000 between an edited view and the edited source, at the same points of"
                " the thing by exact depth. A dash: the two share no 16 pixels of it, or the source"
                f" changed by less than {LEAST_CHANGE:g} dE00, so that there is no edit to carry."
            )
            folded = len(rows) > MOST_ROWS
            yield Section("An edit carried", [text], [Table(columns, table, folded=folded)])

    def gallery(self, results: Results) -> Section | None:
        """Pictures of each scene."""
        grids = scenes_side_by_side(results, self.name, "after", {"before": "before"})
        return Section("Edited views side by side", grids=grids, folded=True) if grids else None
