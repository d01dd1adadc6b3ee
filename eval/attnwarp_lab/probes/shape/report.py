"""Report of edits that change shapes by the ideal editor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.study.probe_report import (
    Layout,
    ProbeReport,
    mean_values,
    register_report,
)
from attnwarp_eval.study.results import Results
from attnwarp_lab.probes.shape.measure import KINDS

BY_KIND = {
    "same": "shape.same.{}",
    "new, seen": "shape.new.{}",
    "uncovered": "shape.uncovered.{}",
    "overlap": "shape.overlap.{}",
    "new stands": "shape.stands.new.{}",
    "gone stands": "shape.stands.gone.{}",
}
"""Columns of a kind."""

TOLD = (
    "Places with several right answers: those that are added, replaced and moved. With one, removed"
    " and grown, each view alone is the truth, so they show harm alone. Same, new, uncovered and"
    " overlap are of the edited pictures; what stands is the depth of the tuned splats, within 2 %"
    " of the true scene after."
)


@register_report
class ShapeReport(ProbeReport):
    """New, uncovered and untouched surface by variant; by kind and number of answers."""

    name = "shape"
    measures = "edits that change shapes by the ideal editor"
    columns: ClassVar[Mapping[str, str]] = {
        "same": "shape.same.several",
        "new, seen": "shape.new.several",
        "uncovered": "shape.uncovered.several",
        "overlap": "shape.overlap.several",
        "one answer: new, seen": "shape.new.one",
        "one answer: uncovered": "shape.uncovered.one",
        "lost, dE00": "shape.lost",
        "new stands": "shape.stands.new.several",
        "gone stands": "shape.stands.gone.several",
        "untouched stands": "shape.stands.untouched",
    }
    contrasts = (
        "shape.same.several",
        "shape.new.several",
        "shape.overlap.several",
        "shape.new.one",
        "shape.lost",
        "shape.stands.new.several",
        "shape.stands.untouched",
    )
    cost = "whole"
    cost_of = "an edit"
    cost_text = "Seconds are those of one whole edit of a scene by the ideal editor, with tuning."

    def problems(self, results: Results) -> list[str]:
        """Editors that are not ideal."""
        faults: dict[tuple[str, str], list[str]] = {}
        for cell, record in results.finished(self.name):
            if record.extra.fault is not None:
                faults.setdefault((cell.scene, record.extra.fault), []).extend(cell.variants)
        return [
            f"{scene}: not ideal in {', '.join(names)}: {fault}"
            for (scene, fault), names in sorted(faults.items())
        ]

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Figures of each kind, by variant."""
        measured = dict.fromkeys(v for c, _ in results.finished(self.name) for v in c.variants)
        names = [name for name in results.study.variants if name in measured]
        if not names:
            return
        tables = []
        for kind in KINDS:
            columns = {title: metric.format(kind) for title, metric in BY_KIND.items()}
            rows = [[n, *mean_values(results, self.name, n, columns.values())] for n in names]
            tables.append(Table([kind, *columns], rows, folded=True))
        yield Section("Kinds of edits", [TOLD], tables)
