"""Splats fitted to true pictures, measured on views held out: pictures, depth and normals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

import attnwarp.fit
from attnwarp.fit import FitSettings
from attnwarp.io.lock import locked
from attnwarp.warp import WarpSettings, render_surface
from attnwarp_eval import metrics
from attnwarp_eval.canonical_json import canonical_json, digest
from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.splats import export, fitted
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study import pictures
from attnwarp_eval.study.probes import register
from attnwarp_eval.study.probes.base import Layout, Place, Probe, Work, metrics_of
from attnwarp_eval.study.reads import DEPTH_READS
from attnwarp_eval.study.record import Json, Record, finite, with_nan
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Part, Study, Variant

GOOD_PSNR = 28.0
"""dB: a fit counts as good from here on."""


class Fits(Part):
    """Views and first points of every fit, and fields of :class:`attnwarp.fit.FitSettings`."""

    views: Annotated[int, Field(ge=9, le=10_000)] = 64
    points: Annotated[int, Field(ge=10, le=5_000_000)] = 5000
    noise: Annotated[float, Field(ge=0)] = 0.5
    settings: dict[str, Any] = Field(
        default_factory=dict, description="fields of attnwarp.fit.FitSettings"
    )


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    fit: Fits = Fits()


class VariantPart(Part):
    """Keys of a variant: its own fields of the fit's settings; ``fitted`` has the other probes take
    fitted splats in place of sampled ones.
    """

    fitted: bool = False
    fit: dict[str, Any] = Field(default_factory=dict)


FIT_READS = frozenset(f"fit.{f.name}" for f in fields(FitSettings))
"""Keys of a variant that decide its fit."""


@dataclass(frozen=True)
class Point:
    """One evaluation of a fit; NaN where undefined.

    Attributes:
        iteration: iterations done.
        seconds, cpu_seconds: spent on them, without evaluations and files.
        splats: their number.
        loss: of the last iterations, smoothed.
        psnr, psnr_pooled: mean over the views held out, and of their mean squared error; dB.
        measures: further figures over the views held out.
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
        """Rebuild from :meth:`to_json`, or from an evaluation's attributes, None where
        undefined.
        """
        numbers = with_nan({name: data[name] for name in ("loss", "psnr", "psnr_pooled")})
        return cls(**{**data, **numbers, "measures": with_nan(data["measures"])})


@dataclass(frozen=True)
class Curve:
    """Accuracy against time as a fit proceeds."""

    points: tuple[Point, ...]

    def to_json(self) -> Json:
        """The record's entry ``curve``."""
        return {"curve": [point.to_json() for point in self.points]}


Pick = Callable[[Point], float]

CURVES: dict[str, tuple[str, Pick]] = {
    "PSNR of held-out views": ("dB", lambda point: point.psnr),
    "AbsRel of depth": ("ratio", lambda point: _measure(point, "depth.abs_rel")),
    "normals": ("deg", lambda point: _measure(point, "depth.normal_median")),
}

TIMED = ("CPU seconds", "seconds", "CPU seconds to 28 dB")


@register
class Fit(Probe[Curve]):
    """A fit and its errors on views held out."""

    name = "fit"
    study_part = StudyPart
    variant_part = VariantPart
    metrics = metrics_of("fit.", "depth.")
    columns: ClassVar[Mapping[str, str]] = {
        "PSNR, dB": "fit.psnr",
        "PSNR, pooled": "fit.mse",
        "SSIM": "fit.ssim",
        "AbsRel": "depth.abs_rel",
        "AbsRel inside": "depth.abs_rel.interior",
        "AbsRel at edges": "depth.abs_rel.edge",
        "median bias inside": "depth.bias_median.interior",
        "delta < 1.01": "depth.delta_1_01",
        "normal, deg": "depth.normal_median",
        "normal inside, deg": "depth.normal_median.interior",
    }
    contrasts = (
        "fit.psnr",
        "fit.ssim",
        "depth.abs_rel",
        "depth.abs_rel.interior",
        "depth.normal_median",
    )

    study_keys = frozenset({"size", "seeds", "spp", "fit"})
    shared: ClassVar[Mapping[tuple[str, ...], str]] = {("fit", "settings"): "fit"}

    def reads(self, study: Study, variant: Variant) -> Set[str]:
        """The fit, and how depth is read off it."""
        return FIT_READS | DEPTH_READS | {"fitted"}

    def check_variant(self, study: Study, variant: Variant) -> None:
        """Fit settings are refused even where nothing is fitted."""
        own = variant.part(VariantPart).fit
        if self.name in study.probes or own or study.part(StudyPart).fit.settings:
            settings_of(study, variant, 0)

    def common_spec(self, study: Study, scene: Scene, seed: int) -> Json:
        """The views are those held out, not the scene's targets."""
        study.views_of(scene)
        views = export.held_out_names(study.part(StudyPart).fit.views)
        return {**super().common_spec(study, scene, seed), "views": views}

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """The fit, and how depth is read off it."""
        settings = variant.settings()
        return {
            "spp": study.spp,
            "fit": fit_spec(study, variant, seed),
            "depth": settings.depth,
            "depth_statistic": settings.depth_statistic,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Splats are fitted here, so those of the study's surfaces play no part."""
        return variant.settings(), variant.geometry, variant.part(VariantPart).fit

    def compute(self, work: Work) -> Curve:
        """Fit, then measure on every view held out.

        The fit lies below the run's folder, named by what decides it: cells that measure the same
        fit in other ways share it, and one that was cut short is resumed.
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
        # The fit's seconds go into the curve, which holds them for earlier sittings as well.
        result = fit_of(work)
        meter.count(iterations=result.iteration, splats=len(result.gaussians))
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

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Sections on the result of each fit, and its curves."""
        by_content: dict[str, str] = {}
        for cell, record in results.finished(self.name):
            # Variants that read one fit in different ways share its curve; the first names it.
            content = canonical_json({**record.spec["fit"], "seed": cell.seed})
            by_content.setdefault(content, cell.variants[0])
        names = list(dict.fromkeys(by_content.values()))
        if names:
            yield Place.RESULT, self._fits(results, layout, names)

    def _fits(self, results: Results, layout: Layout, names: list[str]) -> Section:
        rows = [
            self._row(name, scene, seed, record)
            for name in names
            for scene, seed, record in results.records(self.name, name)
        ]
        columns = [
            "fit",
            "scene",
            "PSNR",
            "pooled PSNR",
            "SSIM",
            "AbsRel",
            "normal, deg",
            "splats",
            "iterations",
            *TIMED,
        ]
        fits, size = results.study.part(StudyPart).fit, results.study.size
        pictures_seen = fits.views - len(export.held_out_names(fits.views))
        text = [
            (
                f"Every fit begins with the same {fits.points} points per scene, scattered about"
                f" the surfaces by {number(fits.noise)} of their spacing, and sees {pictures_seen}"
                f" of {fits.views} true pictures at {size} x {size} px; every 8th is held out, and"
                " measured. PSNR is a mean over views, pooled PSNR that of their mean squared"
                " error. Depth in this table and in the curves is median depth, by intersection"
                " for 2D splats and at the ray's peak for 3D ones; other ways to read depth off the"
                " same splats stand in the tables above."
            ),
        ]
        section = Section("Fits", text, [Table(columns, rows, timed=TIMED)])
        if layout.timings:
            section.text.append(
                "Curves: means over scenes at each evaluation, 95 % intervals over scenes, against"
                " the CPU seconds of the iterations, those of all threads together (evaluations"
                " and files are not in them)."
            )
            section.figures.append(self._curves(results, layout, names))
        return section

    def _row(self, name: str, scene: str, seed: int, record: Record[Curve]) -> list[str]:
        points = record.extra.points
        last = points[-1]
        reached = next((p.cpu_seconds for p in points if p.psnr >= GOOD_PSNR), None)
        return [
            name,
            scene if seed == 0 else f"{scene}, seed {seed}",
            number(_mean([view.metrics["fit.psnr"] for view in record.views])),
            number(last.psnr_pooled),
            number(_mean([view.metrics["fit.ssim"] for view in record.views])),
            number(_measure(last, "depth.abs_rel")),
            number(_measure(last, "depth.normal_median")),
            str(last.splats),
            str(last.iteration),
            number(last.cpu_seconds),
            number(last.seconds),
            number(reached),
        ]

    def _curves(self, results: Results, layout: Layout, names: list[str]) -> Picture:
        with charts.drawing(layout.figure("fits.svg"), columns=len(CURVES)) as panels:
            for axes, (title, (unit, pick)) in zip(panels, CURVES.items(), strict=True):
                series = [charts.Line(name, *self._curve(results, name, pick)) for name in names]
                charts.lines(
                    axes, series, x="CPU seconds", y=unit, title=title, log=unit == "ratio"
                )
        return Picture("figures/fits.svg", "Accuracy against time as the fits proceed.")

    def _curve(self, results: Results, name: str, pick: Pick) -> tuple[list[float], list[Interval]]:
        """CPU seconds and values at the evaluations that every scene and seed has, without the one
        before the first iteration.
        """
        curves: list[tuple[str, dict[int, Point]]] = [
            (scene, {point.iteration: point for point in record.extra.points})
            for scene, _, record in results.records(self.name, name)
        ]
        common = sorted(set.intersection(*({*curve} for _, curve in curves)) - {0})
        seconds = [sum(curve[k].cpu_seconds for _, curve in curves) / len(curves) for k in common]
        values = []
        for k in common:
            by_scene: dict[str, list[float]] = {}
            for scene, curve in curves:
                by_scene.setdefault(scene, []).append(pick(curve[k]))
            values.append(interval(by_scene))
        return seconds, values


def settings_of(study: Study, variant: Variant, seed: int) -> FitSettings:
    """The study's fit settings with the variant's own fields."""
    shared, own = study.part(StudyPart).fit.settings, variant.part(VariantPart).fit
    if "seed" in {**shared, **own}:
        raise ValueError("fit.seed: the seeds are the study's own; set seeds there")
    return FitSettings.from_dict({**shared, **own, "seed": seed})


def fit_spec(study: Study, variant: Variant, seed: int) -> Json:
    """Spec of a fit of one scene."""
    fits = study.part(StudyPart).fit
    return {**fits.model_dump(), "settings": settings_of(study, variant, seed).to_dict()}


def fit_of(work: Work, spec: Mapping[str, Any] | None = None) -> attnwarp.fit.Fit:
    """The fit that a cell's spec, or ``spec`` in its place, names under ``fit``.

    It lies below the run's folder, named by what decides it: cells that want the same fit share
    it, and one that was cut short is resumed.
    """
    spec, world = work.spec if spec is None else spec, work.world
    data, folder = spec["fit"], folder_of(work.root, spec)
    folder.mkdir(parents=True, exist_ok=True)
    # Where two workers want one fit, the second reads what the first has done.
    with locked(folder / ".lock", wait=True):
        return fitted.fit_scene(
            world.scene,
            FitSettings.from_dict(data["settings"]),
            folder,
            views=data["views"],
            spp=spec["spp"],
            points=data["points"],
            noise=data["noise"],
            seed=spec["seed"],
            geometry=world.geometry,
        )


def folder_of(root: Path, spec: Mapping[str, Any]) -> Path:
    """The folder of the fit that a cell's spec names under ``fit``, below a run's folder."""
    keys = ("scene", "size", "spp", "seed")
    return root / "fits" / digest({**spec["fit"], **{key: spec[key] for key in keys}})[:16]


def _measure(point: Point, name: str) -> float:
    return point.measures.get(name, math.nan)


def _mean(values: list[float]) -> float | None:
    defined = [value for value in values if math.isfinite(value)]
    return sum(defined) / len(defined) if defined else None
