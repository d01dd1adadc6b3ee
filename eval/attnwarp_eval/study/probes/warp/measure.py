"""Warp and mask of a variant against exact correspondences and visibility."""

from __future__ import annotations

from functools import partial

from pydantic import Field

from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json, NoExtra
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.study.shared.warps import WarpProbe, warp_figures, warped_views


class Yaw(Part):
    """The variants whose masks the report shows by yaw."""

    variants: list[str] = Field(default_factory=list)


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    yaw: Yaw = Yaw()


@register
class Warp(WarpProbe):
    """One warp for each view: endpoint error, feature error and mask scores."""

    name = "warp"
    study_part = StudyPart
    metrics = metrics_of("warp.", "occlusion.")

    def check(self, study: Study) -> None:
        """Require that the variants of masks by yaw are measured."""
        names = study.part(StudyPart).yaw.variants
        study.check_variants(names, "yaw.variants", self.name)

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Depth, rules and feature grids."""
        return {
            **super().variant_spec(study, variant, seed),
            "feature_sizes": study.feature_sizes,
            "feature_channels": study.feature_channels,
        }

    def compute(self, work: Work) -> NoExtra:
        """Warp and measure, view by view."""
        spec, world = work.spec, work.world
        for name, truth, view in warped_views(work, spec["feature_sizes"]):
            measured = warp_figures(work, name, view)
            draw = partial(pictures.of_warp, world, name, spec["spp"], truth, view)
            work.add(name, measured, draw)
        return NoExtra()
