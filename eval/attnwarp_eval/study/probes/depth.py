"""Depth and normals of sampled splats against exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from functools import partial
from typing import Any, ClassVar

from attnwarp.warp import WarpSettings, render_surface
from attnwarp_eval import metrics
from attnwarp_eval.document.model import Finding, Section, Table
from attnwarp_eval.study import pictures
from attnwarp_eval.study.probes import register
from attnwarp_eval.study.probes.base import Layout, Place, Probe, Work, mean_values, metrics_of
from attnwarp_eval.study.probes.variant_splats import (
    check_splats,
    splats_of,
    surface_meaning,
    surface_reads,
    surface_spec,
)
from attnwarp_eval.study.reads import DEPTH_READS
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Study, Variant

PLACES = (
    "depth.abs_rel",
    "depth.rmse",
    "depth.bias_relative",
    "depth.delta_1_01",
    "depth.delta_1_25",
    "depth.normal_median",
)
"""Metrics with a table of their own for the inside of surfaces and for edges."""


@register
class Depth(Probe[NoExtra]):
    """One render of splats for each view, and its error."""

    name = "depth"
    metrics = metrics_of("depth.")
    columns: ClassVar[Mapping[str, str]] = {
        "AbsRel": "depth.abs_rel",
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
    study_keys = frozenset({"size", "views", "seeds", "spp"})

    def check(self, study: Study) -> None:
        """A variant without splats renders nothing."""
        check_splats(study, self.name, "depth to measure")

    def reads(self, study: Study, variant: Variant) -> Set[str]:
        """Splats, and how depth is read off them."""
        return surface_reads(variant) | DEPTH_READS

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Splats, and how depth is read off them."""
        settings = variant.settings()
        return {
            **surface_spec(study, variant, seed),
            "depth": settings.depth,
            "depth_statistic": settings.depth_statistic,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Splats may be fitted."""
        return surface_meaning(study, variant)

    def compute(self, work: Work) -> NoExtra:
        """Render and measure, view by view."""
        spec, world, meter = work.spec, work.world, work.meter
        size = spec["size"]
        with meter.stage("splats"):
            model = splats_of(work)
        settings = WarpSettings(depth=spec["depth"], depth_statistic=spec["depth_statistic"])
        for name in spec["views"]:
            with meter.stage("truth"):
                hits = world.pair(name, size).hits
            with meter.view():
                surface = render_surface(model, world.targets[name], settings)
            meter.count(pixels=size * size, **surface.counters)
            with meter.stage("checks"):
                figures = metrics.depth_error(
                    surface.depth,
                    hits.depth,
                    normal=surface.normal,
                    true_normal=hits.normal,
                    edge=world.edge(name, size),
                )
            work.add(name, figures, partial(pictures.of_depth, surface, hits))
        return NoExtra()

    def findings(self, results: Results) -> Iterator[Finding]:
        """Views without any depth: in tables their figures are dashes, which do not say why."""
        sentence, count = self._without_depth(results)
        if sentence:
            yield Finding(sentence, count, "their `depth.coverage` is 0", "fails")

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Section on views without depth; none where every view has a depth."""
        sentence, count = self._without_depth(results)
        if sentence:
            yield Place.RESULT, Section("Views without depth", [f"{sentence} That is {count}."])

    def _without_depth(self, results: Results) -> tuple[str, str]:
        """A sentence that names them, and how many there are; both empty where there are none."""
        empty, views, places = 0, 0, []
        for cell, record in results.finished(self.name):
            names = [v.name for v in record.views if v.metrics.get("depth.coverage") == 0]
            empty, views = empty + len(names), views + len(record.views)
            if names:
                which = "every view" if len(names) == len(record.views) else ", ".join(names)
                places.append(f"{cell.scene} / {cell.variants[0]} ({which})")
        if not empty:
            return "", ""
        listed = "; ".join(dict.fromkeys(places))
        return (
            f"No splat is drawn on any surface, so depth is undefined, in {listed}.",
            f"{empty} of {views} views",
        )

    def details(self, results: Results, names: Sequence[str]) -> list[Table]:
        """Inside surfaces and at edges apart."""
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
        return [Table(columns, rows, "Inside surfaces and at edges apart", folded=True)]
