"""Report of the instrument: its calibration, and the light transport that its scenes need."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from attnwarp.warp import TAP_SPREAD
from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.study.probe_report import Layout, ProbeReport, register_report
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results

SMALL = 256
"""Pixels. In smaller pictures, depth changes from pixel to pixel by more than the rules for exact
depth let their taps spread. They then reject much of the visible surface, and F1 says little.
"""

LARGEST_EPE = 1e-3
"""Pixels: the largest median endpoint error of the truth's depth through the warp."""

SMALLEST_SHARE = 0.99
"""Least share of pixels where Mitsuba must find the surface point of the ray caster. Rays on
outlines may fall on either side.
"""


@register_report
class CalibrationReport(ProbeReport):
    """Error of the instrument, in every report."""

    name = "calibration"
    measures = "the error of the instrument itself"
    picture_label = "truth's own depth"

    def problems(self, results: Results) -> list[str]:
        """One line a scene and figure; empty when the instrument is calibrated."""
        return [f"{scene}: {fault}" for scene, fault in self._faults(results)]

    def _faults(self, results: Results) -> Iterator[tuple[str, str]]:
        """Each scene that fails, once for each of its faults."""
        for cell in results.cells:
            if cell.probe != self.name:
                continue
            if cell.record is None:
                yield cell.scene, "the calibration was not measured"
                continue
            tests: list[tuple[str, Callable[[float], bool], str]] = [
                ("warp.epe_median", lambda v: v < LARGEST_EPE, f"below {LARGEST_EPE:g} px"),
                ("occlusion.f1.exact", lambda v: v == 1, "1"),
                (
                    "calibration.mitsuba_agrees",
                    lambda v: v >= SMALLEST_SHARE,
                    f"at least {SMALLEST_SHARE:g}",
                ),
            ]
            for metric, passes, expected in tests:
                values = _values(cell.record, metric)
                for value in values:
                    if not passes(value):
                        yield cell.scene, f"{metric} is {number(value)}, expected {expected}"
                if not values:
                    yield cell.scene, f"{metric} is undefined in every view"

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Sections on the calibration, and on the light transport of the scenes."""
        if not results.study.scenes:
            return
        yield self._calibration(results)
        yield from self._transport(results)

    def _calibration(self, results: Results) -> Section:
        sizes = results.study.feature_sizes
        failed = {scene for scene, _ in self._faults(results)}
        worst = {
            "warp.epe_median": max,
            "warp.epe_p95": max,
            "calibration.mitsuba_agrees": min,
            "occlusion.f1.exact": min,
            "occlusion.f1": min,
            **{f"warp.feature_accepted.{size}": max for size in sizes},
            **{f"warp.feature_accepted.interior.{size}": max for size in sizes},
        }
        rows = []
        for cell, record in results.finished(self.name):
            figures = [_worst(record, metric, pick) for metric, pick in worst.items()]
            rows.append([cell.scene, "FAILED" if cell.scene in failed else "passed", *figures])
        columns = [
            "scene",
            "calibration",
            "EPE median, px",
            "EPE p95, px",
            "Mitsuba agrees",
            "F1 of the exact mask",
            "F1 of the rules on exact depth",
            *(f"feature error, {size}" for size in sizes),
            *(f"inside surfaces, {size}" for size in sizes),
        ]
        text = [
            (
                "The truth's own depth goes through the same warp, whose median endpoint error must"
                f" stay below {LARGEST_EPE:g} px; the exact mask is scored against itself, which"
                " must give F1 = 1; and Mitsuba, which shares no code with the ray caster, must"
                " find the same surface point (within 1e-4 of its distance) in at least"
                f" {100 * SMALLEST_SHARE:g} % of a view's pixels. The worst view of each scene is"
                " shown."
            ),
            (
                "What the rules lose on exact depth, and what bilinear sampling of a feature field"
                " costs at each size, are the floor of everything below: at coarse grids most of it"
                " lies at edges, where taps reach across."
            ),
        ]
        if results.study.size < SMALL:
            text.append(
                f"The pictures are small: at {results.study.size} px, depth on a slope changes from"
                f" pixel to pixel by more than the {100 * TAP_SPREAD:g} % that these rules let its"
                " taps spread. So they reject much that is visible, and their F1 is low."
            )
        return Section("Calibration", text, [Table(columns, rows)], folded=True)

    def _transport(self, results: Results) -> list[Section]:
        alike: dict[tuple[str, ...], list[str]] = {}
        for cell, record in results.finished(self.name):
            transport = record.extra.transport
            light = (
                ", ".join(transport.needed) or "–",
                ", ".join(transport.not_simulated) or "–",
                _words(transport.plan),
                transport.everything_on,
            )
            alike.setdefault(light, []).append(cell.scene)
        if not alike:
            return []
        rows = [[", ".join(dict.fromkeys(names)), *light] for light, names in alike.items()]
        text = [
            (
                "Depth, visibility and correspondences are cast with rays, without any light. The"
                " true pictures are rendered as each scene's plan says: only what it calls for is"
                " simulated. A run does not prove its plans; `attnwarp-eval scenes effects NAME"
                " --prove` says why each effect is needed and holds the plan against a rendering"
                " with everything on; reports/effects in the repository has that for every scene"
                " that ships."
            ),
        ]
        variants = sorted(
            {record.extra.transport.variant for _, record in results.finished(self.name)}
        )
        text.append(
            f"The pictures are of Mitsuba's {' and '.join(f'`{name}`' for name in variants)}."
            " Another variant draws other noise, and an editor of pictures that differ by noise"
            " makes edits that differ too."
        )
        columns = ["scenes", "effects", "not simulated", "plan", "everything on would be"]
        title = "What light does in these scenes, and what of it is simulated"
        return [Section(title, text, [Table(columns, rows)], folded=True)]


def _values(record: Record[Any], metric: str) -> list[float]:
    values = [view.metrics.get(metric, math.nan) for view in record.views]
    return [float(v) for v in values if math.isfinite(v)]


def _worst(record: Record[Any], metric: str, pick: Callable[[list[float]], float]) -> str:
    values = _values(record, metric)
    undefined = sum(
        metric in view.metrics and math.isnan(view.metrics[metric]) for view in record.views
    )
    return (number(pick(values)) if values else "–") + (
        f" ({undefined} undefined)" if undefined else ""
    )


def _words(planned: Mapping[str, Any]) -> str:
    """A plan in a few words: integrator, and the camera unless it is a pinhole."""
    return str(planned["integrator"]) + (
        ", thin lens" if planned["sensor"]["type"] == "thinlens" else ""
    )
