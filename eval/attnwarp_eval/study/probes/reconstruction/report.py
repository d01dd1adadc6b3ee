"""Report of COLMAP's reconstructions: its figures of right and flawed sets, and what they see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.registry import metric
from attnwarp_eval.statistics.auroc import Auroc, auroc
from attnwarp_eval.study.probe_report import Layout, Place, ProbeReport, register_report
from attnwarp_eval.study.probes.reconstruction.measure import CONDITIONS, FLAWED, SECONDS
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.encoders import Seconds
from attnwarp_eval.study.shared.right_views import METAL, RIGHT, VARNISHED

FIGURES = {
    "consistency.colmap_registered": "registered views",
    "consistency.colmap_points": "points",
    "consistency.colmap_track_length": "track length",
    "consistency.colmap_error": "reprojection error",
}
"""Figures that are told from one another, with their titles."""

FAILED = "consistency.colmap_failed"

SEES = 0.9
"""AUROC from which a figure sees a flaw."""

TITLES = {
    RIGHT[0]: "right",
    RIGHT[1]: "right, another answer",
    VARNISHED: "right, varnished",
    METAL: "right, metal",
    **{name: flaw.at(flaw.reference) for name, flaw in FLAWED.items()},
}

Records = Sequence[tuple[str, Record[Seconds]]]


def values_of(records: Records, key: str, conditions: Sequence[str]) -> dict[str, list[float]]:
    """Scene -> values of a figure in conditions."""
    values: dict[str, list[float]] = {}
    for scene, record in records:
        found = record.views[0].metrics
        values.setdefault(scene, []).extend(found[f"{key}.{one}"] for one in conditions)
    return values


def area(records: Records, key: str, condition: str) -> Auroc:
    """AUROC of a figure between the sets with a flaw and the right ones."""
    sign = -1.0 if metric(key).direction == "higher" else 1.0

    def rising(conditions: Sequence[str]) -> Mapping[str, list[float]]:
        found = values_of(records, key, conditions)
        return {scene: [sign * value for value in own] for scene, own in found.items()}

    return auroc([(rising([condition]), rising(RIGHT))])


@register_report
class ReconstructionReport(ProbeReport):
    """Presentation of COLMAP's figures."""

    name = "reconstruction"
    measures = "what COLMAP's figures see of flaws"

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """One section: the answer and two tables."""
        records = [(cell.scene, record) for cell, record in results.finished(self.name)]
        if records:
            yield Place.ANSWER, _answer(results, records, layout)


def _mean(values: Mapping[str, list[float]]) -> float:
    known = [v for own in values.values() for v in own if math.isfinite(v)]
    return float(np.mean(known)) if known else math.nan


def _answer(results: Results, records: Records, layout: Layout) -> Section:
    spec = records[0][1].spec
    flaws = list(FLAWED)
    table = []
    for name in CONDITIONS:
        failed = [v for own in values_of(records, FAILED, [name]).values() for v in own]
        known = [v for v in failed if math.isfinite(v)]
        means = [_mean(values_of(records, key, [name])) for key in FIGURES]
        table.append(
            [
                TITLES[name],
                f"{100 * means[0]:.0f} %" if math.isfinite(means[0]) else "–",
                *(number(value) if math.isfinite(value) else "–" for value in means[1:]),
                f"{sum(known):.0f} of {len(known)}",
            ]
        )
    areas = {key: [area(records, key, name).value for name in flaws] for key in FIGURES}
    seen = [
        [title, *(f"{v:.2f}" if math.isfinite(v) else "–" for v in areas[key])]
        for key, title in FIGURES.items()
    ]
    lines = []
    for key, title in FIGURES.items():
        found = [TITLES[n] for n, v in zip(flaws, areas[key], strict=True) if v >= SEES]
        lines.append(
            f"- **{title}** sees {len(found)} of {len(flaws)} flaws"
            + (f": {', '.join(found)}." if found else ".")
        )
    seconds = [s for _, record in records for s in record.extra.seconds.get(SECONDS, ())]
    views = len(spec["yaws"]) + 1
    text = [
        (
            f"COLMAP reconstructs {views} views of {spec['size']} px, up to"
            f" {max(map(abs, spec['yaws'])):g} degrees from the source, of"
            f" {results.study.scenes_in_words}, with known intrinsics and unknown poses. In a"
            f" flawed set {len(spec['yaws'][::2])} of the {views} views have the flaw."
        ),
        "\n".join(lines),
        (
            "AUROC: the probability that a flawed set ranks below a right one of any scene; 1 sees"
            " every flaw, 0.5 is blind, below 0.5 the flaw is preferred. A set of which COLMAP"
            " makes no model has 0 registered views and points, and neither track length nor error:"
            " these leave it out."
        ),
    ]
    if layout.timings and seconds:
        text.append(f"A set takes {number(float(np.median(seconds)))} s (median).")
    return Section(
        "What COLMAP's figures see",
        text,
        [
            Table(
                ["views", "registered", "points", "track length", "error, px", "failed"],
                table,
                "Figures, means over scenes",
            ),
            Table(
                ["figure", *(TITLES[name] for name in flaws)],
                seen,
                "AUROC of flawed against right sets",
            ),
        ],
    )
