"""The instrument judged by itself, before it judges anything.

The truth's own depth goes through the same warp, the exact mask is scored against itself, and
Mitsuba must find the points that the ray caster finds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from attnwarp.warp import EXACT_DEPTH_TOLERANCE, PRESETS, TAP_SPREAD
from attnwarp_eval import metrics
from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.effects.table import USUAL, plan_words, transport_of
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.pictures import of_warp
from attnwarp_eval.study.probes import register
from attnwarp_eval.study.probes.base import Layout, Place, Probe, Work, metrics_of
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.warping import warp_figures, warp_truth
from attnwarp_eval.truth.llvm import variant
from attnwarp_eval.truth.mitsuba import position_and_shape
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import World

MITSUBA_TOLERANCE = 1e-4
"""Tolerance, as a share of the distance: Mitsuba's positions are float32, so a point 10 m away is
exact to about 1e-6 of that.
"""

SMALL = 256
"""Pixels: in smaller pictures, depth changes from pixel to pixel by more than the rules for exact
depth let its taps spread. They then reject much that is visible, and their F1 says little.
"""

LARGEST_EPE = 1e-3
"""Pixels: the largest median endpoint error of the truth's own depth through the warp."""

SMALLEST_SHARE = 0.99
"""Least share of pixels whose surface point Mitsuba must find where the ray caster does. Rays on
outlines may fall either way.
"""

EXACT = dataclasses.replace(
    PRESETS["corrected"], depth_relative=EXACT_DEPTH_TOLERANCE, depth_spread=TAP_SPREAD
)
"""The corrected rules with the tolerances for exact depth."""


@dataclass(frozen=True)
class Transport:
    """The light transport that a scene calls for, and the plan of its pictures.

    Attributes:
        needed: effects that are simulated -> the words of the scene's file that call for them.
        not_simulated: effects that are not -> the same.
        plan: of the rendering, as JSON.
        everything_on: the integrator that would simulate everything.
        variant: of Mitsuba, which draws the pictures' noise.
    """

    needed: Mapping[str, str]
    not_simulated: Mapping[str, str]
    plan: Mapping[str, Any]
    everything_on: str
    variant: str


@dataclass(frozen=True)
class Extra:
    """The transport of the cell's scene."""

    transport: Transport

    def to_json(self) -> Json:
        """The record's entry ``effects``."""
        return {"effects": dataclasses.asdict(self.transport)}


@register
class Calibration(Probe[Extra]):
    """The error of the instrument itself, in every run."""

    name = "calibration"
    metrics = metrics_of("calibration.", "warp.", "occlusion.")
    judges_variants = False
    always = True
    study_keys = frozenset({"size", "views", "seeds", "spp", "feature_sizes", "feature_channels"})
    picture_label = "truth's own depth"

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene."""
        seed = study.seeds[0]
        for name, scene in scenes.items():
            spec = {
                **self.common_spec(study, scene, seed),
                "feature_sizes": study.feature_sizes,
                "feature_channels": study.feature_channels,
                "spp": study.spp,
            }
            pictures = study.pictures_of(spec["views"])
            yield Cell(spec, name, self.name, self.name, seed, (self.name,), pictures)

    def compute(self, work: Work) -> Extra:
        """Warp the truth's own depth by the exact rules, view by view."""
        spec, size = work.spec, work.spec["size"]
        for name in spec["views"]:
            with work.meter.stage("truth"):
                truth = work.world.pair(name, size)
            with work.meter.view():
                view = warp_truth(work.world, truth, EXACT)
            figures = warp_figures(work, name, view)
            if name == spec["views"][0]:
                figures["calibration.mitsuba_agrees"] = _mitsuba_agrees(work.world, truth)
            own = metrics.mask_error(
                truth.visible, truth.label, truth.hits.valid, truth.behind, truth.edge
            )
            figures |= {f"{key}.exact": value for key, value in own.items()}
            work.meter.count(pixels=size * size)
            draw = partial(of_warp, work.world, name, spec["spp"], truth, view)
            work.add(name, figures, draw)
        return Extra(Transport(**transport_of(work.world.scene), variant=variant()))

    def read_extra(self, data: Json) -> Extra:
        """Read from the record's entry ``effects``."""
        return Extra(Transport(**data["effects"]))

    def problems(self, results: Results) -> list[str]:
        """One line a scene and figure; empty when the instrument is calibrated."""
        lines = []
        for cell in results.cells:
            if cell.probe != self.name:
                continue
            if cell.record is None:
                lines.append(f"{cell.scene}: the calibration was not measured")
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
                lines += [
                    f"{cell.scene}: {metric} is {number(v)}, expected {expected}"
                    for v in values
                    if not passes(v)
                ]
                if not values:
                    lines.append(f"{cell.scene}: {metric} is undefined in every view")
        return lines

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """The calibration, and the light transport of the scenes."""
        if not results.study.scenes:
            return
        yield Place.INSTRUMENT, self._calibration(results)
        yield from ((Place.APPENDIX, section) for section in self._transport(results))

    def _calibration(self, results: Results) -> Section:
        sizes = results.study.feature_sizes
        bad = self.problems(results)
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
            passed = not any(line.startswith(f"{cell.scene}: ") for line in bad)
            rows.append([cell.scene, "passed" if passed else "FAILED", *figures])
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
        if bad:
            text.insert(
                0,
                "**The instrument is not calibrated; nothing below can be trusted:** "
                + "; ".join(bad)
                + ".",
            )
        return Section("Calibration", text, [Table(columns, rows)])

    def _transport(self, results: Results) -> list[Section]:
        rows = []
        for cell, record in results.finished(self.name):
            transport = record.extra.transport
            beyond = [
                f"{name} ({words})" for name, words in transport.needed.items() if name not in USUAL
            ]
            rows.append(
                [
                    cell.scene,
                    ", ".join(name for name in transport.needed if name in USUAL) or "–",
                    "; ".join(beyond) or "–",
                    ", ".join(transport.not_simulated) or "–",
                    plan_words(transport.plan),
                    transport.everything_on,
                    "; ".join(transport.plan["reasons"]),
                ]
            )
        if not rows:
            return []
        text = [
            (
                "Depth, visibility and correspondences are cast with rays, without any light. The"
                " true pictures are rendered as each scene's plan says: only what it calls for is"
                " simulated. A run does not prove its plans; `attnwarp-eval scenes effects NAME"
                " --prove` holds one against a rendering with everything on, and reports/effects"
                " in the repository has that for every scene that ships."
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
        columns = [
            "scene",
            "effects",
            "and",
            "not simulated",
            "plan",
            "everything on would be",
            "because",
        ]
        title = "What light does in these scenes, and what of it is simulated"
        return [Section(title, text, [Table(columns, rows)])]


def _mitsuba_agrees(world: World, truth: TwoView) -> float:
    """Share of a view's pixels where Mitsuba's own ray tracer finds the same surface point, or none
    where there is none.
    """
    position, _ = position_and_shape(world.scene, truth.target)
    error = np.linalg.norm(position - truth.hits.point, axis=-1)
    distance = np.linalg.norm(truth.hits.point - truth.target.position, axis=-1)
    empty = ~np.isfinite(position).all(axis=-1) & ~truth.hits.valid
    with np.errstate(invalid="ignore"):
        return float((empty | (error < MITSUBA_TOLERANCE * distance)).mean())


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
