"""Splats fitted to true pictures, measured on views held out: pictures, depth and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from attnwarp.warp import WarpSettings, render_surface
from attnwarp_eval import metrics
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.splats import export, fitted
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.record import Json, finite, with_nan
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared import fits, pictures


@dataclass(frozen=True)
class Point:
    """One evaluation of a fit; NaN where undefined.

    Attributes:
        seconds, cpu_seconds: time of the iterations, without evaluations and files.
        loss: loss of the last iterations, smoothed.
        psnr, psnr_pooled: mean PSNR over the held-out views, and PSNR of their mean MSE; dB.
        measures: further figures over the held-out views.
    """

    iteration: int
    seconds: float
    cpu_seconds: float
    splats: int
    loss: float
    psnr: float
    psnr_pooled: float
    measures: Mapping[str, float]

    def to_json(self) -> Json:
        """Entry of the record's ``curve``: null where undefined."""
        numbers = finite({"loss": self.loss, "psnr": self.psnr, "psnr_pooled": self.psnr_pooled})
        return {**asdict(self), **numbers, "measures": finite(self.measures)}

    @classmethod
    def from_json(cls, data: Json) -> Point:
        """Rebuild from :meth:`to_json` or an evaluation's attributes, None where undefined."""
        numbers = with_nan({name: data[name] for name in ("loss", "psnr", "psnr_pooled")})
        return cls(**{**data, **numbers, "measures": with_nan(data["measures"])})


@dataclass(frozen=True)
class Curve:
    """Accuracy against time as a fit proceeds."""

    points: tuple[Point, ...]

    def to_json(self) -> Json:
        """The record's entry ``curve``."""
        return {"curve": [point.to_json() for point in self.points]}


@register
class Fit(Probe[Curve]):
    """A fit and its errors on views held out."""

    name = "fit"
    study_part = fits.StudyPart
    variant_part = fits.VariantPart
    metrics = metrics_of("fit.", "depth.")

    def check_variant(self, study: Study, variant: Variant) -> None:
        """Refuse invalid fit settings even if nothing is fitted."""
        own = variant.part(fits.VariantPart).fit
        if self.name in study.probes or own or study.part(fits.StudyPart).fit.settings:
            fits.settings_of(study, variant, 0)

    def common_spec(self, study: Study, scene: Scene, seed: int) -> Json:
        """Entries with the held-out views in place of the scene's targets."""
        study.views_of(scene)
        views = export.held_out_names(study.part(fits.StudyPart).fit.views)
        return {**super().common_spec(study, scene, seed), "views": views}

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """The fit, and the rule that reads depth off it."""
        settings = variant.settings()
        return {
            "spp": study.spp,
            "fit": fits.fit_spec(study, variant, seed),
            "depth": settings.depth,
            "depth_statistic": settings.depth_statistic,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Key without the study's sampled splats, since splats are fitted here."""
        return variant.settings(), variant.geometry, variant.part(fits.VariantPart).fit

    def compute(self, work: Work) -> Curve:
        """Fit, then measure on every held-out view.

        The fit is saved below the run's folder under a name from its spec: cells that measure the
        same fit in other ways share it, and an interrupted fit is resumed.
        """
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("truth"):
            cameras = {
                camera.name: camera
                for camera in export.orbit(world.scene, spec["fit"]["views"])
                if camera.name in spec["views"]
            }
        for camera in cameras.values():
            world.add(camera)
        # The fit's seconds go into the curve, which also holds those of earlier runs.
        result = fits.fit_of(work)
        meter.count(
            iterations=result.iteration,
            rendered_pairs=result.pairs,
            splats=len(result.gaussians),
        )
        settings = WarpSettings(depth=spec["depth"], depth_statistic=spec["depth_statistic"])
        for name, camera in cameras.items():
            with meter.view():
                surface = render_surface(result.gaussians, camera, settings)
            with meter.stage("truth"):
                hits = world.geometry.trace(camera)
                image = export.picture(world.scene, camera, spec["spp"])
                edge = world.edge(name, spec["size"])
            meter.count(pixels=camera.width * camera.height, **surface.counters)
            with meter.stage("checks"):
                measured = fitted.picture_error(np.asarray(surface.image), image)
                measured |= metrics.depth_error(
                    surface.depth,
                    hits.depth,
                    normal=surface.normal,
                    true_normal=hits.normal,
                    edge=edge,
                )
            work.add(name, measured, partial(pictures.of_fit, surface, hits, image))
        own = fields(Point)
        return Curve(
            tuple(
                Point.from_json({field.name: getattr(evaluation, field.name) for field in own})
                for evaluation in result.history
            )
        )

    def read_extra(self, data: Json) -> Curve:
        """Read from the record's entry ``curve``."""
        return Curve(tuple(map(Point.from_json, data["curve"])))
