"""Report of surfaces: which figure of a fit ranks settings as the error of its warp does."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean, median
from typing import ClassVar

import numpy as np

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number, spread
from attnwarp_eval.metrics.registry import metric
from attnwarp_eval.statistics.intervals import Interval, benjamini_hochberg, interval
from attnwarp_eval.statistics.rankings import rank_agreement
from attnwarp_eval.statistics.signflips import SignFlips
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.surfaces.measure import CUT, PARTS, THRESHOLD
from attnwarp_eval.study.results import Results

MESH, HELD_OUT, WARP = "the fused mesh", "held-out views", "the warped views"

FIGURES: dict[str, tuple[str, str]] = {
    "chamfer": ("surface.chamfer", MESH),
    "chamfer, uncut": ("surface.chamfer_uncut", MESH),
    "F-score": ("surface.f_score", MESH),
    "normal consistency": ("surface.normal_consistency", MESH),
    "AbsRel": ("depth.abs_rel", HELD_OUT),
    "delta < 1.25": ("depth.delta_1_25", HELD_OUT),
    "normals, deg": ("depth.normal_median", HELD_OUT),
    "PSNR, dB": ("fit.psnr", HELD_OUT),
    "EPE, px": ("warp.epe_median", WARP),
}
"""Figures that are asked, by title: metric, and what it is read off."""

STAGES = {MESH: ("fuse", "nearest"), HELD_OUT: ("held out",), WARP: ("source", "method")}
"""Stages of a cell whose seconds the figures of a kind cost."""

ERRORS = {
    "feature error, accepted": "warp.feature_all_accepted.{layer}",
    "feature error, visible": "warp.feature_visible.{layer}",
    "right labels": "labels.right",
}
"""Errors that they are to predict, by title: of what the mask lets through, of all that the source
shows, whatever the mask says, and of labels.
"""

CPU = "CPU seconds of the fit"


@dataclass(frozen=True)
class Rankings:
    """Values of settings by scene, and the agreement of two metrics in ranking them.

    Attributes:
        results: of the run.
        names: of the settings.
    """

    results: Results
    names: Sequence[str]

    def values(self, metric: str) -> dict[str, list[float]]:
        """Scene -> value of each setting: the mean over the views in which all settings that have
        any value have one; NaN for a setting without any.
        """
        by_name = {n: self.results.views("surfaces", n, metric) for n in self.names}
        values = {}
        for scene in dict.fromkeys(scene for table in by_name.values() for scene in table):
            rows = [
                {view: v for view, v in by_name[n].get(scene, {}).items() if math.isfinite(v)}
                for n in self.names
            ]
            shared = set.intersection(*(set(row) for row in rows if row)) if any(rows) else set()
            values[scene] = [
                fmean(row[view] for view in sorted(shared)) if row and shared else math.nan
                for row in rows
            ]
        return values

    def mean(self, name: str, metric: str) -> str:
        """Mean over scenes of what is ranked."""
        place = list(self.names).index(name)
        return number(interval({s: [v[place]] for s, v in self.values(metric).items()}).mean)

    def taus(self, figure: str, error: str) -> dict[str, float]:
        """Scene -> Kendall's tau; above 0 where the better figure goes with the smaller error."""
        sign = _sign(figure) * _sign(error)
        judged = self.values(error)
        return {
            scene: sign * rank_agreement(own, judged[scene])
            for scene, own in self.values(figure).items()
            if scene in judged
        }


def _sign(name: str) -> int:
    return -1 if metric(name).direction == "lower" else 1


@dataclass(frozen=True)
class Prediction:
    """Agreement of one figure with one error of warps.

    Attributes:
        title: of the figure.
        taus: by scene.
    """

    title: str
    taus: Mapping[str, float]

    @cached_property
    def mean(self) -> Interval:
        """Mean over scenes."""
        return interval({scene: [tau] for scene, tau in self.taus.items()})

    def __str__(self) -> str:
        name = self.title.removesuffix(", px").removesuffix(", dB").removesuffix(", deg")
        many = self.mean.scenes >= FEWEST_SCENES and self.mean.bounded
        within = f" ± {number(self.mean.high - self.mean.mean, 2)}" if many else ""
        return f"{name} {number(self.mean.mean, 2)}{within}"

    def behind(self, best: Prediction) -> float:
        """Probability by flipped signs of the gap to the best one, were both alike."""
        gaps = [best.taus[scene] - tau for scene, tau in self.taus.items()]
        return SignFlips(np.array([gap for gap in gaps if math.isfinite(gap)]), rounding=1e-12).p


@register_report
class SurfaceReport(ProbeReport):
    """Rankings of settings by each figure, against those by the errors of their warps."""

    name = "surfaces"
    measures = "surfaces of splats, and their warps"
    columns: ClassVar[Mapping[str, str]] = {
        **{title: name for title, (name, _) in FIGURES.items()},
        "feature error": ERRORS["feature error, accepted"],
        "right labels": ERRORS["right labels"],
    }
    tabulates_all = True
    contrasts = tuple(columns.values())
    cost = "fit"
    cost_of = "a fit"
    cost_text = "CPU seconds are those of a fit's iterations."

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The answer and two tables, where a scene has two settings."""
        measured = [
            name
            for name in results.study.probes.get(self.name, [])
            if results.records(self.name, name)
        ]
        names = [name for name in measured if results.study.variants[name].geometry == "splats"]
        ranked = Rankings(results, names)
        found = {
            error: [
                Prediction(title, ranked.taus(name, metric.format(layer=results.layer)))
                for title, (name, _) in FIGURES.items()
            ]
            for error, metric in ERRORS.items()
        }
        if any(math.isfinite(one.mean.mean) for own in found.values() for one in own):
            yield Place.ANSWER, self._answer(results, layout, ranked, found, measured)

    def _answer(
        self,
        results: Results,
        layout: Layout,
        ranked: Rankings,
        found: Mapping[str, Sequence[Prediction]],
        measured: Sequence[str],
    ) -> Section:
        seconds = {read: self._seconds(results, ranked.names, read) for read in STAGES}
        scenes = len(results.study.scenes)
        rows = [
            [
                title,
                read,
                *(spread(own[place].mean, scenes) for own in found.values()),
                number(seconds[read]),
            ]
            for place, (title, (_, read)) in enumerate(FIGURES.items())
        ]
        columns = ["figure", "read off", *(f"tau with {title}" for title in ERRORS), "seconds"]
        everyone = Rankings(results, measured)
        shown = {title: name for title, (name, _) in FIGURES.items()} | ERRORS
        keys = [name.format(layer=results.layer) for name in shown.values()]
        settings = [
            [
                name,
                *(everyone.mean(name, key) for key in keys),
                number(results.usual_seconds(self.name, name, self.cost)),
            ]
            for name in measured
        ]
        words = list(_words(found))
        if layout.timings:
            told = ", ".join(f"{number(taken, 2)} s for {read}" for read, taken in seconds.items())
            words.append(f"- **Cost** of the figures of one fit: {told}.")
        return Section(
            "Which figure predicts the warp",
            ["\n".join(words), *_how(results, ranked, layout)],
            [
                Table(columns, rows, "Kendall's tau of each figure", timed=("seconds",)),
                Table(
                    ["setting", *shown, CPU],
                    settings,
                    "The settings, means over scenes",
                    timed=(CPU,),
                ),
            ],
        )

    def _seconds(self, results: Results, names: Sequence[str], read: str) -> float:
        """Median over settings of the seconds of all figures that are read off one thing."""
        taken = [
            sum(results.usual_seconds(self.name, name, stage) for stage in STAGES[read])
            for name in names
        ]
        return median(taken)


def _words(found: Mapping[str, Sequence[Prediction]]) -> Iterator[str]:
    """Sentences on what was found, one for each error."""
    for error, predictions in found.items():
        known = [one for one in predictions if math.isfinite(one.mean.mean)]
        if not known:
            continue
        best, *others = sorted(known, key=lambda one: -one.mean.mean)
        adjusted = benjamini_hochberg([one.behind(best) for one in others])
        worse = [str(one) for one, p in zip(others, adjusted, strict=True) if p <= 0.05]
        alike = [str(one) for one, p in zip(others, adjusted, strict=True) if not p <= 0.05]
        told = f"- **{error[0].upper()}{error[1:]}**: best is **{best}**, which orders"
        told += f" {50 * (1 + best.mean.mean):.0f} % of the pairs of settings alike."
        told += f" Not told apart from it: {', '.join(alike)}." if alike else ""
        yield told + (f" Worse: {', '.join(worse)}." if worse else "")


def _how(results: Results, ranked: Rankings, layout: Layout) -> Iterator[str]:
    """Sentences on what was done."""
    study = results.study
    yield (
        f"{len(ranked.names)} settings of fits, {study.scenes_in_words}. In each scene every figure"
        " ranks the settings, and so does each error of their warps. Kendall's tau is 1 where both"
        " order every pair of settings alike, and 0 by chance; means and intervals are over scenes."
        " Masks of two settings accept different features: one that accepts little can err little."
    )
    yield (
        "The mesh is fused of the depth in the views that were fitted (TSDF, voxels of a pixel,"
        f" cut at 5 voxels). Chamfer is DTU's, without distances above {CUT:g} of the cameras'"
        f" distance; the F-score's threshold is {THRESHOLD:g} of it. AbsRel, delta, normals and"
        " PSNR are of views that no fit has seen. EPE is the median distance of carried points from"
        f" where they belong. Labels are of {PARTS} parts. All but PSNR need the true surface."
        " Depth that is exact shows what fusing and sampling cost; its warps have stricter rules."
    )
    if layout.timings:
        yield (
            "Seconds: of all figures that are read off one thing, without the truth's own (median"
            " over scenes, then over settings; one pass, other work ran beside it)."
        )
