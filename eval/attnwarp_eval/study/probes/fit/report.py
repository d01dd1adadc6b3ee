"""Report of fits: their results, and their curves of accuracy against time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import ClassVar

from attnwarp_eval.canonical_json import canonical_json
from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Picture, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.splats import export
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_eval.study.probe_report import Layout, ProbeReport, register_report
from attnwarp_eval.study.probes.fit.measure import Curve, Point
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.fits import StudyPart

GOOD_PSNR = 28.0
"""dB from which a fit counts as good."""


Pick = Callable[[Point], float]

CURVES: dict[str, tuple[str, Pick]] = {
    "PSNR of held-out views": ("dB", lambda point: point.psnr),
    "AbsRel of depth": ("ratio", lambda point: _measure(point, "depth.abs_rel")),
    "normals": ("deg", lambda point: _measure(point, "depth.normal_median")),
}

TIMED = ("CPU seconds", "seconds", "CPU seconds to 28 dB")


@register_report
class FitReport(ProbeReport):
    """Pictures, depth and normals of fits by variant."""

    name = "fit"
    measures = "splats fitted to true pictures"
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

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Sections on the result of each fit, and its curves."""
        by_content: dict[str, str] = {}
        for cell, record in results.finished(self.name):
            # Variants that read one fit's depth differently share its curve, named by the first.
            content = canonical_json({**record.spec["fit"], "seed": cell.seed})
            by_content.setdefault(content, cell.variants[0])
        names = list(dict.fromkeys(by_content.values()))
        if names:
            yield self._fits(results, layout, names)

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
        section = Section("Fits", text, [Table(columns, rows, timed=TIMED, folded=True)])
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
            f"{points[0].splats} to {last.splats}",
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
        """CPU seconds and values at the evaluations that every scene and seed has, except the one
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


def _measure(point: Point, name: str) -> float:
    return point.measures.get(name, math.nan)


def _mean(values: list[float]) -> float | None:
    defined = [value for value in values if math.isfinite(value)]
    return sum(defined) / len(defined) if defined else None
