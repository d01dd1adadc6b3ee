"""Warp and mask of a variant against exact correspondences and visibility."""

from __future__ import annotations

from collections.abc import Set
from functools import partial
from typing import Any

from pydantic import Field

from attnwarp.warp import WarpSettings, parts_read, render_surface, warp_view
from attnwarp_eval.study import pictures
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.reads import warp_reads
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.study.shared.splats import (
    splats_of,
    surface_meaning,
    surface_reads,
    surface_spec,
)
from attnwarp_eval.study.warping import warp_figures, warp_truth


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
