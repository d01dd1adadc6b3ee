"""Warp and mask of a variant against exact correspondences and visibility."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence, Set
from functools import partial
from typing import Any, ClassVar

from pydantic import Field

from attnwarp.warp import WarpSettings, parts_read, render_surface, warp_view
from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.occlusion import COUNTS, by_yaw
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study import pictures
from attnwarp_eval.study.probes import register
from attnwarp_eval.study.probes.base import (
    Layout,
    Place,
    Probe,
    Work,
    mean_values,
    metrics_of,
)
from attnwarp_eval.study.probes.variant_splats import (
    splats_of,
    surface_meaning,
    surface_reads,
    surface_spec,
)
from attnwarp_eval.study.reads import warp_reads
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.study.warping import warp_figures, warp_truth

YAW_EDGES = (0, 15, 45, 75, 105, 135, 165, 180)
"""Bins around the yaws 30, 60, ... 150 that studies like to take, with the ends apart."""

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


class Yaw(Part):
    """The variants whose masks the report shows by yaw."""

    variants: list[str] = Field(default_factory=list)


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    yaw: Yaw = Yaw()


@register
class Warp(Probe[NoExtra]):
    """One warp for each view: endpoint error, feature error and mask scores."""

    name = "warp"
    study_part = StudyPart
    metrics = metrics_of("warp.", "occlusion.")
    main = True
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
    study_keys = frozenset(
        {"size", "views", "seeds", "spp", "feature_sizes", "feature_channels", "yaw"}
    )

    def check(self, study: Study) -> None:
        """Masks by yaw need their variants measured."""
        names = study.part(StudyPart).yaw.variants
        study.check_variants(names, "yaw.variants", self.name)

    def reads(self, study: Study, variant: Variant) -> Set[str]:
        """Depth and rules."""
        truth = variant.geometry == "truth"
        return surface_reads(variant) | warp_reads(variant.settings(), truth)

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Depth, rules and feature grids."""
        return {
            **surface_spec(study, variant, seed),
            "spp": study.spp,
            "settings": variant.settings().to_dict(),
            "feature_sizes": study.feature_sizes,
            "feature_channels": study.feature_channels,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Splats may be fitted."""
        return surface_meaning(study, variant)

    def compute(self, work: Work) -> NoExtra:
        """Warp and measure, view by view."""
        spec, world, meter = work.spec, work.world, work.meter
        size, spp = spec["size"], spec["spp"]
        settings = WarpSettings.from_dict(spec["settings"])
        model = source_surface = None
        if spec.get("geometry") != "truth":
            with meter.stage("splats"):
                model = splats_of(work)
            # One source serves every target, so its render is no part of what a target costs.
            with meter.stage("source"):
                source_surface = render_surface(model, world.source, settings)
            meter.count(source_pairs=source_surface.counters["pairs"])
        for name in spec["views"]:
            target = world.targets[name]
            with meter.stage("truth"):
                truth = world.pair(name, size)
                images: dict[str, Any] = {}
                if "source_image" in parts_read(settings):
                    images = {
                        "source_image": world.image(world.source.name, spp),
                        "target_image": world.image(name, spp),
                    }
            with meter.view():
                if model is None:
                    view = warp_truth(world, truth, settings, **images)
                else:
                    view = warp_view(
                        model,
                        world.source,
                        target,
                        settings,
                        source_surface=source_surface,
                        **images,
                        warn_empty=False,
                    )
                for layer in spec["feature_sizes"]:
                    view.at((layer, layer))
            meter.count(**view.target.counters)
            measured = warp_figures(work, name, view)
            work.add(name, measured, partial(pictures.of_warp, world, name, spp, truth, view))
        return NoExtra()

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
        """Masks by yaw, where the study asks for them."""
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
        for metric in ("precision", "recall", "f1", "false_positive_rate", "false_negative_rate"):
            rows = [
                [
                    name,
                    place,
                    *(number(b.scores[f"occlusion.{metric}"]) for b in bins[name, region]),
                ]
                for name in names
                for region, place in places.items()
            ]
            caption = f"{metric.replace('_', ' ').capitalize()}, inside surfaces and at edges apart"
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
        """The yaws of a variant's views, and its means over scenes there."""
        yaws = sorted(
            {
                view.yaw
                for _, _, record in results.records(self.name, variant)
                for view in record.views
            }
        )
        tables = [results.views(self.name, variant, metric, (yaw, yaw)) for yaw in yaws]
        return yaws, [interval({s: list(v.values()) for s, v in table.items()}) for table in tables]


def _ambiguous(counts: Mapping[str, int]) -> float:
    """Share of the ambiguous pixels that are accepted."""
    total = counts["ambiguous_accepted"] + counts["ambiguous_rejected"]
    return counts["ambiguous_accepted"] / total if total else math.nan
