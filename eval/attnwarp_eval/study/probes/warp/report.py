"""Report of warps: feature error by grid size, and masks by yaw."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.occlusion import COUNTS, by_yaw
from attnwarp_eval.statistics.intervals import Interval, over_scenes
from attnwarp_eval.study.probe_report import (
    Layout,
    Place,
    ProbeReport,
    mean_values,
    register_report,
)
from attnwarp_eval.study.probes.warp.measure import StudyPart
from attnwarp_eval.study.results import Results

YAW_EDGES = (0, 15, 45, 75, 105, 135, 165, 180)
"""Bins around the yaws 30, 60, ... 150 that studies often use, with separate bins at the ends."""

RATES = {
    "occlusion.false_positive_rate": (
        "Of surface that the source does not show, accepted (false positive rate)"
    ),
    "occlusion.false_negative_rate": (
        "Of surface that the source shows, rejected (false negative rate)"
    ),
    "occlusion.behind_share": "Of what is accepted, behind the source camera",
    "occlusion.hidden_share": "Of what is accepted, hidden from the source",
}


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
        return [Table(["variant", "over", *map(str, sizes)], rows, caption, folded=True)]

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Section on masks by yaw, if the study asks for them."""
        wanted = results.study.part(StudyPart).yaw.variants
        names = [name for name in wanted if results.records(self.name, name)]
        if names:
            yield Place.RESULT, self._by_yaw(results, layout, names)

    def _by_yaw(self, results: Results, layout: Layout, names: list[str]) -> Section:
        columns = ["variant", *(f"{low}–{high}°" for low, high in itertools.pairwise(YAW_EDGES))]
        bins = {
            (name, region): by_yaw(self._counts(results, name, region), YAW_EDGES)
            for name in names
            for region in ("", ".interior", ".edge")
        }
        tables = [
            Table(
                columns,
                [[name, *(number(b.scores[metric]) for b in bins[name, ""])] for name in names],
                caption,
            )
            for metric, caption in RATES.items()
        ]
        places = {"": "everywhere", ".interior": "inside surfaces", ".edge": "at edges"}
        for metric in ("precision", "recall"):
            rows = [
                [
                    name,
                    place,
                    *(number(b.scores[f"occlusion.{metric}"]) for b in bins[name, region]),
                ]
                for name in names
                for region, place in places.items()
            ]
            caption = f"{metric.capitalize()}, inside surfaces and at edges apart"
            tables.append(Table([columns[0], "where", *columns[1:]], rows, caption, folded=True))
        rows = [[name, *(number(_ambiguous(b.counts)) for b in bins[name, ""])] for name in names]
        caption = "Of ambiguous pixels, which are not scored, accepted"
        tables.append(Table(columns, rows, caption, folded=True))
        text = [
            (
                "Counts of all scenes' views summed in bins of the yaw between source and target. A"
                " dash: nothing to measure, such as a view in which the source shows nothing at"
                " all."
            ),
        ]
        with charts.drawing(layout.figure("masks-by-yaw.svg"), columns=2) as (left, right):
            for axes, metric, title in (
                (left, "occlusion.false_positive_rate", "unseen surface accepted"),
                (right, "occlusion.false_negative_rate", "visible surface rejected"),
            ):
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
            "Both errors of the masks by yaw; means and 95 % intervals over scenes.",
        )
        return Section("Masks by yaw", text, tables, [drawn])

    def _counts(
        self, results: Results, variant: str, region: str
    ) -> list[tuple[float, dict[str, int]]]:
        """(yaw, confusion counts) of every view: everywhere, or in ".interior" or ".edge"."""
        return [
            (
                view.yaw,
                {name: int(view.metrics[f"occlusion.{name}{region}"]) for name in COUNTS},
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


def _ambiguous(counts: Mapping[str, int]) -> float:
    """Share of the ambiguous pixels that are accepted."""
    total = counts["ambiguous_accepted"] + counts["ambiguous_rejected"]
    return counts["ambiguous_accepted"] / total if total else math.nan
