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
    "feature error": "warp.feature_all_accepted.{layer}",
    "right labels": "labels.right",
}
"""Errors that they are to predict, by title; the first one decides."""

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
    """Agreement of one figure with the errors of warps.

    Attributes:
        title: of the figure.
        read: what it is read off.
        taus: of each error of :data:`ERRORS`, by scene.
    """

    title: str
    read: str
    taus: Sequence[Mapping[str, float]]

    @cached_property
    def intervals(self) -> list[Interval]:
        """Mean over scenes for each error."""
        return [interval({scene: [tau] for scene, tau in own.items()}) for own in self.taus]

    @property
    def tau(self) -> float:
        """Mean for the error that decides; -inf where it is undefined."""
        mean = self.intervals[0].mean
        return mean if math.isfinite(mean) else -math.inf

    def behind(self, best: Prediction) -> SignFlips:
        """Test of the best one's tau less this one's, over the scenes that have both."""
        ours, theirs = self.taus[0], best.taus[0]
        gaps = [theirs[scene] - tau for scene, tau in ours.items() if scene in theirs]
        return SignFlips(np.array([gap for gap in gaps if math.isfinite(gap)]), rounding=1e-12)


@register_report
class SurfaceReport(ProbeReport):
    """Rankings of settings by each figure, against those by the errors of their warps."""

    name = "surfaces"
    measures = "surfaces of splats, and their warps"
    columns: ClassVar[Mapping[str, str]] = {
        **{title: name for title, (name, _) in FIGURES.items()},
        **ERRORS,
    }
    tabulates_all = True
    contrasts = ("surface.chamfer", "surface.f_score", *ERRORS.values())
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
        errors = [name.format(layer=results.layer) for name in ERRORS.values()]
        found = [
            Prediction(title, read, [ranked.taus(name, error) for error in errors])
            for title, (name, read) in FIGURES.items()
        ]
        if any(math.isfinite(one.tau) for one in found):
            found.sort(key=lambda one: -one.tau)
            yield Place.ANSWER, self._answer(results, layout, ranked, found, errors, measured)

    def _answer(
        self,
        results: Results,
        layout: Layout,
        ranked: Rankings,
        found: Sequence[Prediction],
        errors: Sequence[str],
        measured: Sequence[str],
    ) -> Section:
        best, *others = found
        tests = {one.title: one.behind(best) for one in others}
        adjusted = benjamini_hochberg([test.p for test in tests.values()])
        apart = {title: p <= 0.05 for title, p in zip(tests, adjusted, strict=True)}
        seconds = {read: self._seconds(results, ranked.names, read) for read in STAGES}
        own = {scene: [tau] for scene, tau in ranked.taus(errors[1], errors[0]).items()}
        scenes = len(results.study.scenes)
        rows = [
            [
                one.title,
                one.read,
                *(spread(value, scenes) for value in one.intervals),
                "–" if one is best else _gap(tests[one.title]),
                "–" if one is best else "yes" if apart[one.title] else "no",
                number(seconds[one.read]),
            ]
            for one in found
        ]
        columns = [
            "figure",
            "read off",
            *(f"tau with {title}" for title in ERRORS),
            "behind the first",
            "told apart",
            "seconds",
        ]
        everyone = Rankings(results, measured)
        keys = list(self.columns_at(results.layer).values())
        settings = [
            [
                name,
                *(everyone.mean(name, key) for key in keys),
                number(results.usual_seconds(self.name, name, self.cost)),
            ]
            for name in measured
        ]
        return Section(
            "Which figure predicts the warp",
            [*_words(results, found, apart), *_how(results, ranked, interval(own), layout)],
            [
                Table(columns, rows, "Kendall's tau of each figure", timed=("seconds",)),
                Table(
                    ["setting", *self.columns, CPU],
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


def _gap(test: SignFlips) -> str:
    low, high = test.interval()
    bounds = f" ({number(low)} to {number(high)})" if math.isfinite(low) else ""
    return f"{number(test.mean)}{bounds}"


def _tau(one: Prediction) -> str:
    tau = one.intervals[0]
    within = f" ± {number(tau.high - tau.mean, 2)}" if tau.scenes >= FEWEST_SCENES else ""
    return f"{number(tau.mean, 2)}{within}"


def _words(
    results: Results, found: Sequence[Prediction], apart: Mapping[str, bool]
) -> Iterator[str]:
    """Sentences on what was found."""
    known = [one for one in found if math.isfinite(one.tau)]
    best, *others = known
    yield (
        f"Best is **{_name(best)}**, read off {best.read}: it orders {50 * (1 + best.tau):.0f} % of"
        " all pairs of settings as the feature error of their warps does (Kendall's tau"
        f" {_tau(best)})."
    )
    kinds: dict[str, Prediction] = {}
    for one in known:
        kinds.setdefault(one.read, one)
    lines = [
        f"- Of {read}, the best is **{_name(one)}**: {_tau(one)}."
        for read, one in kinds.items()
        if one is not best
    ]
    for told, title in ((False, "Not told apart from the first"), (True, "Worse than it")):
        names = ", ".join(f"{_name(one)} {_tau(one)}" for one in others if apart[one.title] is told)
        if names:
            lines.append(f"- {title}: {names}.")
    yield "\n".join(lines)


def _name(one: Prediction) -> str:
    """The title without its unit."""
    return one.title.removesuffix(", px").removesuffix(", dB").removesuffix(", deg")


def _how(results: Results, ranked: Rankings, own: Interval, layout: Layout) -> Iterator[str]:
    """Sentences on what was done."""
    study = results.study
    yield (
        f"{len(ranked.names)} settings of fits, {study.scenes_in_words}. In each scene every figure"
        " ranks the settings; tau is 1 where it orders each pair as the error does, 0 for chance."
        f" Intervals are over scenes. Right labels, the other error of a warp, have a tau of"
        f" {spread(own, len(study.scenes))} with the feature error."
    )
    yield (
        "The mesh is fused of the depth in the views that were fitted (TSDF, voxels of a pixel,"
        f" cut at 5 voxels). Chamfer is DTU's, without distances above {CUT:g} of the cameras'"
        f" distance; the F-score's threshold is {THRESHOLD:g} of it. AbsRel, delta, normals and"
        " PSNR are of views that no fit has seen. EPE is the median distance of carried points from"
        f" where they belong. Labels are of {PARTS} parts. All but PSNR need the true surface."
    )
    if layout.timings:
        yield (
            "Seconds: of all figures that are read off one thing, without the truth's own (median"
            " over scenes, then over settings; one pass, other work ran beside it)."
        )
