"""The warps of a variant's cell, view by view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from attnwarp.warp import WarpedView, WarpSettings, parts_read, render_surface, warp_view
from attnwarp_eval.study.probe import Probe, Work
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared.splats import (
    splats_of,
    surface_meaning,
    surface_spec,
)
from attnwarp_eval.study.warping import warp_truth
from attnwarp_eval.two_view import TwoView


class WarpProbe(Probe[NoExtra]):
    """Base of probes that judge a variant's warp."""

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Depth and rules."""
        return {
            **surface_spec(study, variant, seed),
            "spp": study.spp,
            "settings": variant.settings().to_dict(),
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Splats may be fitted."""
        return surface_meaning(study, variant)


def warped_views(work: Work, grids: Sequence[int]) -> Iterator[tuple[str, TwoView, WarpedView]]:
    """Each target of a cell with its truth and its warp, which counts as the cell's work.

    Args:
        work: work of the cell, whose spec has ``settings`` and the source of depth.
        grids: sides of the feature grids that are warped too.
    """
    spec, world, meter = work.spec, work.world, work.meter
    size, spp = spec["size"], spec["spp"]
    settings = WarpSettings.from_dict(spec["settings"])
    source_surface = model = None
    if spec.get("geometry") != "truth":
        with meter.stage("splats"):
            model = splats_of(work)
        # One source serves every target, so its render is no part of what a target costs.
        with meter.stage("source"):
            source_surface = render_surface(model, world.source, settings)
        meter.count(source_pairs=source_surface.counters["pairs"])
    for name in spec["views"]:
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
                    world.targets[name],
                    settings,
                    source_surface=source_surface,
                    **images,
                    warn_empty=False,
                )
            for grid in grids:
                view.at((grid, grid))
        meter.count(**view.target.counters)
        yield name, truth, view
