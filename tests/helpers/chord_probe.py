"""A probe of the tests' own, in one file: how far a target camera is from the source."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.metrics.registry import Metric, Registry
from attnwarp_eval.study.probe import Probe, Work
from attnwarp_eval.study.probe_report import Layout, ProbeReport, register_report
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.study.shared.pictures import jpeg

CHORD = Metric("chord.length", "scene", "lower", 1e-9, 0, "distance of target and source camera")


class StudyPart(Part):
    """Its keys of a study."""

    camera_unit: float = 1.0


class VariantPart(Part):
    """Its keys of a variant."""

    stretch: float = Field(default=1.0, gt=0)


@dataclass(frozen=True)
class Longest:
    """The longest chord of a cell, and its target."""

    target: str
    chord: float

    def to_json(self) -> Json:
        return {"longest": {"target": self.target, "chord": self.chord}}


class Chord(Probe[Longest]):
    """One figure a view, from the cameras alone."""

    name = "chord"
    study_part = StudyPart
    variant_part = VariantPart
    metrics = Registry({CHORD.name: CHORD})

    def check(self, study: Study) -> None:
        if study.part(StudyPart).camera_unit <= 0:
            raise ValueError("camera_unit: expected a positive number")

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        return {
            "unit": study.part(StudyPart).camera_unit,
            "stretch": variant.part(VariantPart).stretch,
        }

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        return (variant.part(VariantPart).stretch,)

    def compute(self, work: Work) -> Longest:
        chords = {}
        for name in work.spec["views"]:
            with work.meter.view():
                offset = work.world.targets[name].position - work.world.source.position
                chord = float(np.linalg.norm(offset)) * work.spec["stretch"] / work.spec["unit"]
            chords[name] = chord
            work.add(name, {CHORD.name: chord}, lambda: {"grey": jpeg(np.full((8, 8, 3), 0.5))})
        return Longest(*max(chords.items(), key=lambda item: item[1]))

    def read_extra(self, data: Json) -> Longest:
        return Longest(**data["longest"])


@register_report
class ChordReport(ProbeReport):
    """A table of variants, and the longest chord of each cell."""

    name = "chord"
    columns: ClassVar[Mapping[str, str]] = {"chord": CHORD.name}
    contrasts = (CHORD.name,)

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        rows = [
            [cell.variants[0], record.extra.target, number(record.extra.chord)]
            for cell, record in results.finished(self.name)
        ]
        if rows:
            table = Table(["variant", "target", "chord"], rows)
            yield Section("Longest chords", [], [table])
