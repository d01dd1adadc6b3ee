"""Warp and mask of a variant against exact correspondences and visibility."""

from __future__ import annotations

from collections.abc import Set
from functools import partial
from typing import Any

from pydantic import Field

from attnwarp_eval.study import pictures
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.reads import warp_reads
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.study.shared.splats import surface_meaning, surface_reads, surface_spec
from attnwarp_eval.study.shared.warps import warped_views
from attnwarp_eval.study.warping import warp_figures


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
        spec, world = work.spec, work.world
        for name, truth, view in warped_views(work, spec["feature_sizes"]):
            measured = warp_figures(work, name, view)
            draw = partial(pictures.of_warp, world, name, spec["spp"], truth, view)
            work.add(name, measured, draw)
        return NoExtra()
