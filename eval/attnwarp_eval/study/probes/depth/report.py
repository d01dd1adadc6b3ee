"""Report of the depth of splats: tables by region, and views without depth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.study.probe_report import (
    Layout,
    ProbeReport,
    mean_values,
    register_report,
)
from attnwarp_eval.study.results import Results

PLACES = (
    "depth.abs_rel",
    "depth.rmse",
    "depth.bias_relative",
    "depth.delta_1_01",
    "depth.delta_1_25",
    "depth.normal_median",
)
"""Metrics with separate tables for the inside of surfaces and for edges."""


@register_report
class DepthReport(ProbeReport):
    """Depth and normals by variant."""

    name = "depth"
    measures = "depth and normals of sampled splats"
    columns: ClassVar[Mapping[str, str]] = {
        "AbsRel": "depth.abs_rel",
        "AbsRel inside": "depth.abs_rel.interior",
        "RMSE": "depth.rmse",
        "bias": "depth.bias_relative",
        "median bias inside": "depth.bias_median.interior",
        "delta < 1.01": "depth.delta_1_01",
        "delta < 1.25": "depth.delta_1_25",
        "normal, deg": "depth.normal_median",
    }
    contrasts = (
        "depth.abs_rel",
        "depth.abs_rel.interior",
        "depth.bias_median.interior",
        "depth.normal_median",
    )
    stage = "render"

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Section on views without depth, whose figures are unexplained dashes; none if every view
        has a depth.
        """
        empty, views, places = 0, 0, []
        for cell, record in results.finished(self.name):
            names = [v.name for v in record.views if v.metrics.get("depth.coverage") == 0]
            empty, views = empty + len(names), views + len(record.views)
            if names:
                which = "every view" if len(names) == len(record.views) else ", ".join(names)
                places.append(f"{cell.scene} / {cell.variants[0]} ({which})")
        if empty:
            text = (
                "No splat is drawn on any surface, so depth is undefined, in"
                f" {'; '.join(dict.fromkeys(places))}. That is {empty} of {views} views."
            )
            yield Section("Views without depth", [text])

    def details(self, results: Results, names: Sequence[str]) -> list[Table]:
        """Tables for the inside of surfaces and for edges."""
        regions = {"inside surfaces": "interior", "at edges": "edge"}
        columns = ["variant", "where", *(metric.removeprefix("depth.") for metric in PLACES)]
        rows = [
            [
                name,
                title,
                *mean_values(results, self.name, name, [f"{metric}.{region}" for metric in PLACES]),
            ]
            for name in names
            for title, region in regions.items()
        ]
        return [Table(columns, rows, "Inside surfaces and at edges apart")]
