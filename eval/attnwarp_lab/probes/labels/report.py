"""Report of labels: right, wrong, none, painted, and by distance to depth edges."""

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
from attnwarp_lab.ideal.edge_report import edge_section
from attnwarp_lab.ideal.edges import edges_of

RIGHT, HIDDEN = "labels.right.{}", "labels.painted_hidden.{}"
"""Figures of a row on depth edges."""

TOKENS = (
    "Only the net share, which the table above judges, ranks the truth first: the others describe"
    " what it is made of."
)


@register_report
class LabelReport(ProbeReport):
    """Carried labels of a thing's parts, by variant."""

    name = "labels"
    measures = "where labels of parts arrive"
    columns: ClassVar[Mapping[str, str]] = {
        "net": "labels.net",
        "right": "labels.right",
        "wrong": "labels.wrong",
        "none": "labels.none",
        "painted, hidden": "labels.painted_hidden",
        "painted, outside": "labels.painted_outside",
    }
    contrasts = ("labels.net",)
    stage = "pair"

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Fate of tokens, by variant; errors at depth edges."""
        names = dict.fromkeys(v for c, _ in results.finished(self.name) for v in c.variants)
        rows = [
            [n, *mean_values(results, self.name, n, self.columns.values())]
            for n in results.study.variants
            if n in names
        ]
        records = [record for _, record in results.finished(self.name)]
        # Older results lack it, whose page has the shares elsewhere.
        if any("labels.net" in view.metrics for record in records for view in record.views):
            yield Section("Tokens", [TOKENS], [Table(["variant", *self.columns], rows)])
        edges = edges_of(results.study, self.name)
        if edges is not None and names:
            metrics = {name: (name, RIGHT, HIDDEN) for name in edges.named}
            yield edge_section(results, layout, self.name, metrics)
