"""COLMAP's reconstructions of sets of views whose edit is right, and of sets in which every second
view has a flaw.

Figures are named ``metric.condition``, as those of the probe ``audit``. Poses are COLMAP's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from time import perf_counter
from typing import Annotated

from pydantic import Field, model_validator

from attnwarp_eval import metrics
from attnwarp_eval.metrics.arrays import Array
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.flaws import FLAWS
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.schema import Part, Study, check_distinct
from attnwarp_eval.study.shared.encoders import MetricsProbe, Seconds
from attnwarp_eval.study.shared.right_views import (
    PAIRS,
    cells_of_edit,
    edited_target,
    true_pictures,
)

FLAWED = {
    flaw.key(flaw.reference): flaw for flaw in FLAWS if flaw.counts or flaw.name == "elsewhere"
}
"""Flaws of the sets: those that matter most, and views of another scene."""

CONDITIONS = (*PAIRS, *FLAWED)

SECONDS = "reconstruct"
"""Name of the seconds of a set."""


class Sweep(Part):
    """Edit and views.

    ``edit``: one with at least two answers. ``yaws``: degrees of the views from the source, which
    is a view too; flaws are in the first, third, ... of them.
    """

    edit: str = "parts"
    yaws: Annotated[list[Annotated[float, Field(ge=-180, le=180)]], Field(min_length=2)] = Field(
        default_factory=lambda: [8.0, -8.0, -16.0, 16.0, 24.0, -24.0, -32.0, 32.0]
    )

    @model_validator(mode="after")
    def _check_yaws(self) -> Sweep:
        check_distinct(self.yaws, "reconstruction.yaws")
        if 0 in self.yaws:
            raise ValueError("reconstruction.yaws: got 0, which the source has; leave it out")
        return self


class StudyPart(Part):
    """Keys of a study that this probe reads."""

    reconstruction: Sweep = Sweep()


@register
class ReconstructionProbe(MetricsProbe):
    """One cell a scene and seed."""

    name = "reconstruction"
    study_part = StudyPart
    metrics = metrics_of("consistency.colmap_")

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene and seed."""
        part = study.part(StudyPart).reconstruction
        yield from cells_of_edit(self, study, scenes, part.edit, {"yaws": part.yaws})

    def compute(self, work: Work) -> Seconds:
        """Reconstruct every set. Its figures stand under the last view's name."""
        spec, world, meter = work.spec, work.world, work.meter
        with meter.stage("truth"):
            cameras, pictures = true_pictures(work)
        views = [world.source, *cameras]
        flawed: dict[str, dict[str, Array | None]] = {name: {} for name in FLAWED}
        with meter.stage("flaws"):
            for camera in cameras[::2]:
                truth = world.pair(camera.name, spec["size"])
                edited = edited_target(world, spec, pictures, camera, truth)
                for name, flaw in FLAWED.items():
                    flawed[name][camera.name] = flaw.make(edited, flaw.reference)
        figures: dict[str, float] = {}
        seconds = []
        for name in CONDITIONS:
            shown = pictures[name] if name in PAIRS else pictures["right"] | flawed[name]
            images = [shown[camera.name] for camera in views]
            if any(image is None for image in images):
                figures |= {f"{key}.{name}": math.nan for key in self.metrics}
                continue
            with meter.stage("checks"):
                start = perf_counter()
                found = metrics.reconstruct(images, views).figures()
                seconds.append(perf_counter() - start)
            meter.count(reconstructions=1)
            figures |= {f"{key}.{name}": value for key, value in found.items()}
        work.add(views[-1].name, figures)
        return Seconds({SECONDS: seconds})
