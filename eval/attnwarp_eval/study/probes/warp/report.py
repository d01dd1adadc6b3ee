"""Report of warps: feature error by grid size, and masks by yaw."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.occlusion import COUNTS, YawBin, by_yaw
from attnwarp_eval.statistics.intervals import Interval, over_scenes
from attnwarp_eval.study.probe_report import (
    Layout,
    ProbeReport,
    mean_values,
    register_report,
)
from attnwarp_eval.study.probes.warp.measure import StudyPart
from attnwarp_eval.study.results import Results

YAW_EDGES = (0, 15, 45, 75, 105, 135, 165, 180)
"""Bins around the yaws 30, 60, ... 150 that studies often use, with separate bins at the ends."""

RATES = {
    "occlusion.behind_share": "Of what is accepted, behind the source camera",
    "occlusion.hidden_share": "Of what is accepted, hidden from the source",
}

CURVES = {
    "occlusion.false_positive_rate": "hidden surface accepted",
    "occlusion.recall": "visible surface kept",
}
"""Shares that stand on the page, as a figure and side by side in one table."""


@register_report
class WarpReport(ProbeReport):
    """Endpoint error, feature error and mask scores by variant."""

    name = "warp"
    measures = "warps and masks against exact correspondences"
    columns: ClassVar[Mapping[str, str]] = {
        "EPE, image px": "warp.epe_median",
        "EPE p95": "warp.epe_p95",
        "EPE on {layer}, layer px": "warp.epe_median_layer.{layer}",
        "within 1 px": "warp.below_1px",
        "feature error, {layer}": "warp.feature_all_accepted.{layer}",
        "precision": "occlusion.precision",
        "recall": "occlusion.recall",
        "F1": "occlusion.f1",
    }
    contrasts = (
        "warp.epe_median_layer.{layer}",
        "warp.feature_all_accepted.{layer}",
        "occlusion.precision",
        "occlusion.recall",
    )
    stage = "pair"

    def details(self, results: Results, names: Sequence[str]) -> list[Table]:
        """Feature error by grid size."""
        sizes = results.study.feature_sizes
        kinds = {
            "all that is accepted": "warp.feature_all_accepted",
            "accepted and truly visible": "warp.feature_accepted",
            "and inside surfaces": "warp.feature_accepted.interior",
        }
        rows = [
            [
                name,
                kind,
                *mean_values(results, self.name, name, [f"{metric}.{size}" for size in sizes]),
            ]
            for name in names
            for kind, metric in kinds.items()
        ]
        caption = "Feature error by grid size (the floor stands under Calibration)"
        return [Table(["variant", "over", *map(str, sizes)], rows, caption)]

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Section on masks by yaw, if the study asks for them."""
        wanted = results.study.part(StudyPart).yaw.variants
        names = [name for name in wanted if results.records(self.name, name)]
        if names:
            yield self._by_yaw(results, layout, names)

    def _by_yaw(self, results: Results, layout: Layout, names: list[str]) -> Section:
        columns = ["variant", *(f"{low}–{high}°" for low, high in itertools.pairwise(YAW_EDGES))]
        bins = {name: by_yaw(self._counts(results, name), YAW_EDGES) for name in names}
        tables = [
            Table(
                columns,
                [[name, *(number(b.scores[metric]) for b in bins[name])] for name in names],
                caption,
                folded=True,
            )
            for metric, caption in RATES.items()
        ]
        seen = [i for i, of in enumerate(zip(*bins.values(), strict=True)) if any(map(_seen, of))]
        rows = [[name, *(_both(bins[name][i]) for i in seen)] for name in names]
        heads = ["variant", *(columns[i + 1] for i in seen)]
        tables.insert(0, Table(heads, rows, f"{' / '.join(CURVES.values())}, %".capitalize()))
        text = ["Counts of all scenes' views are summed, by the yaw between source and target."]
        with charts.drawing(layout.figure("masks-by-yaw.svg"), columns=2) as (left, right):
            for axes, (metric, title) in zip((left, right), CURVES.items(), strict=True):
                series = [charts.Line(name, *self._curve(results, name, metric)) for name in names]
                x, y = "yaw from the source, degrees", "share"
                charts.lines(
                    axes,
                    series,
                    x=x,
                    y=y,
                    title=title,
                    share=True,
                    legend=axes is right,
                    apart=charts.APART,
                )
        drawn = Picture(
            "figures/masks-by-yaw.svg",
            "What masks accept, by yaw; means and 95 % intervals over scenes.",
        )
        return Section("Masks by yaw", text, tables, [drawn], leads=True)

    def _counts(self, results: Results, variant: str) -> list[tuple[float, dict[str, int]]]:
        """(yaw, confusion counts) of every view."""
        return [
            (
                view.yaw,
                {name: int(view.metrics[f"occlusion.{name}"]) for name in COUNTS},
            )
            for _, _, record in results.records(self.name, variant)
            for view in record.views
        ]

    def _curve(
        self, results: Results, variant: str, metric: str
    ) -> tuple[list[float], list[Interval]]:
        """The yaws of a variant's views, and its means over scenes at each."""
        yaws = sorted(
            {
                view.yaw
                for _, _, record in results.records(self.name, variant)
                for view in record.views
            }
        )
        tables = [results.views(self.name, variant, metric, (yaw, yaw)) for yaw in yaws]
        return yaws, list(map(over_scenes, tables))


def _seen(one: YawBin) -> bool:
    return any(math.isfinite(one.scores[metric]) for metric in CURVES)


def _both(one: YawBin) -> str:
    """The shares of a bin in percent."""
    shares = [100 * one.scores[metric] for metric in CURVES]
    return " / ".join(f"{x:.0f}" if x >= 10 else number(x, 2) for x in shares)
