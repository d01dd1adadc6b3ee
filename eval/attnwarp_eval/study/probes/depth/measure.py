"""Depth and normals of sampled splats against exact truth."""

from __future__ import annotations

from functools import partial
from typing import Any

from attnwarp.warp import WarpSettings, render_surface
from attnwarp_eval import metrics
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.study.shared.splats import (
    check_splats,
    splats_of,
    surface_meaning,
    surface_spec,
)


@register
class Depth(Probe[NoExtra]):
    """One render of splats for each view, and its error."""

    name = "depth"
    metrics = metrics_of("depth.")

    def check(self, study: Study) -> None:
        """Refuse variants without splats: they render nothing."""
        check_splats(study, self.name, "depth to measure")

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Splats, and the rule that reads depth off them."""
        settings = variant.settings()
        return {
            **surface_spec(study, variant, seed),
            "depth": settings.depth,
            "depth_statistic": settings.depth_statistic,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Key of the splats, sampled or fitted, and of the depth."""
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
