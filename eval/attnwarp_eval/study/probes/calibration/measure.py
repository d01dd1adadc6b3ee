"""Calibration of the instrument, before any measurement.

The truth's depth goes through the same warp, the exact mask is scored against itself, and Mitsuba
must find the points that the ray caster finds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from attnwarp.warp import EXACT_DEPTH_TOLERANCE, PRESETS, TAP_SPREAD
from attnwarp_eval import metrics
from attnwarp_eval.scene.materials import NOT_SIMULATED
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.transport import called_for
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.shared.pictures import of_warp
from attnwarp_eval.study.shared.warps import warp_figures, warp_truth
from attnwarp_eval.truth.llvm import variant
from attnwarp_eval.truth.mitsuba import position_and_shape
from attnwarp_eval.truth.plan import everything_on, plan
from attnwarp_eval.two_view import TwoView
from attnwarp_eval.world import World

MITSUBA_TOLERANCE = 1e-4
"""Tolerance, as a share of the distance: Mitsuba's positions are float32, so a point 10 m away is
exact to about 1e-6 of that.
"""

EXACT = dataclasses.replace(
    PRESETS["corrected"], depth_relative=EXACT_DEPTH_TOLERANCE, depth_spread=TAP_SPREAD
)
"""Corrected rules with the tolerances for exact depth."""


@dataclass(frozen=True)
class Transport:
    """Light transport that a scene needs, and the plan of its pictures.

    Attributes:
        needed: simulated effects -> the words of the scene's file that need them.
        not_simulated: effects that are not simulated -> the same.
        plan: plan of the rendering, as JSON.
        everything_on: the integrator that would simulate everything.
        variant: variant of Mitsuba, which decides the pictures' noise.
    """

    needed: Mapping[str, str]
    not_simulated: Mapping[str, str]
    plan: Mapping[str, Any]
    everything_on: str
    variant: str


@dataclass(frozen=True)
class Extra:
    """Transport of the cell's scene."""

    transport: Transport

    def to_json(self) -> Json:
        """The record's entry ``effects``."""
        return {"effects": dataclasses.asdict(self.transport)}


@register
class Calibration(Probe[Extra]):
    """Error of the instrument, in every run."""

    name = "calibration"
    metrics = metrics_of("calibration.", "warp.", "occlusion.")
    judges_variants = False
    always = True

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
        """Warp the truth's depth by the exact rules, view by view."""
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
        return Extra(transport_of(work.world.scene))

    def read_extra(self, data: Json) -> Extra:
        """Read from the record's entry ``effects``."""
        return Extra(Transport(**data["effects"]))


def transport_of(scene: Scene) -> Transport:
    """Effects that a scene's file needs, each with the reason, and the plan."""
    reasons = called_for(scene.spec)
    return Transport(
        {name: text for name, text in reasons.items() if name not in NOT_SIMULATED},
        {name: text for name, text in reasons.items() if name in NOT_SIMULATED},
        plan(scene).to_dict(),
        everything_on(scene, capped=False).integrator,
        variant(),
    )


def _mitsuba_agrees(world: World, truth: TwoView) -> float:
    """Share of pixels where Mitsuba's ray tracer and the ray caster find the same point."""
    position, _ = position_and_shape(world.scene, truth.target)
    error = np.linalg.norm(position - truth.hits.point, axis=-1)
    distance = np.linalg.norm(truth.hits.point - truth.target.position, axis=-1)
    empty = ~np.isfinite(position).all(axis=-1) & ~truth.hits.valid
    with np.errstate(invalid="ignore"):
        return float((empty | (error < MITSUBA_TOLERANCE * distance)).mean())
