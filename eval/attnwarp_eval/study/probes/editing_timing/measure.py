"""Seconds of whole edits taken in turn in one process, for accuracy against time.

Seconds of the cells of :mod:`attnwarp_eval.study.probes.editing` come from other times of a machine
whose speed drifts. Here every variant edits the same scene in each round.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

from pydantic import Field

from attnwarp_eval.cost import AGAIN, Meter, in_turn
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.edit_truth import planned_truth
from attnwarp_eval.study.probe import InTurn, Work, register
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.results import Outcome
from attnwarp_eval.study.schema import Part, Study
from attnwarp_eval.study.shared.edits import (
    MethodProbe,
    VariantPart,
    editor_of,
    edits_of,
    scene_seed,
)
from attnwarp_eval.study.shared.method_run import EDITING_PARTS, PARTS, WHOLE, run_method
from attnwarp_eval.study.shared.splats import splats_of

EDITING = "editing"
"""Source, warps and edited views together, tuning apart."""

STAGES = (WHOLE, EDITING, *PARTS)

COUNTERS = ("network_rows", "iterations")
"""Work of a contestant, which no machine changes."""


class EditingTiming(Part):
    """Number of the study's scenes, from the first on, whose first edit is timed."""

    scenes: int = Field(default=1, ge=1)


class StudyPart(Part):
    """Keys of a study that only this probe reads; ``timing_rounds`` are those of every timing."""

    editing_timing: EditingTiming = EditingTiming()


@dataclass(frozen=True)
class Rounds:
    """Times and work of the contestants.

    Attributes:
        seconds: stage -> contestant -> round; the first contestant's second run comes last.
        work: of each contestant, counters of one edit.
    """

    seconds: Mapping[str, list[list[float]]]
    work: Sequence[Mapping[str, int]]

    def to_json(self) -> Json:
        """Entries of the record's cost."""
        return {"cost": {"rounds": dict(self.seconds), "work": [dict(row) for row in self.work]}}


@register
class EditingTimingProbe(MethodProbe[Rounds]):
    """One cell of a scene for all contestants: seconds of separate cells cannot be compared."""

    name = "editing-timing"
    protocol = 2
    study_part = StudyPart
    times_in_turn = STAGES

    def check(self, study: Study) -> None:
        """Every contestant runs to its end, by what it sees itself."""
        for name in study.probes.get(self.name, []):
            variant = study.variants[name]
            own = variant.part(VariantPart)
            if own.method == "true pictures":
                raise ValueError(
                    f"probes.editing-timing: {name!r} edits nothing, so there is no time to take;"
                    " leave it out"
                )
            if "truth" in (variant.geometry, own.mask):
                raise ValueError(
                    f"probes.editing-timing: {name!r} warps by the scene's truth, which takes no"
                    " time of the method; leave it out"
                )
            if own.budget is not None:
                raise ValueError(
                    f"probes.editing-timing: {name!r} has a budget, which may cut it short; leave"
                    " it out"
                )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene, of its first edit and the first seed."""
        seed = study.seeds[0]
        variants = [study.variants[label] for label in names]
        count = study.part(StudyPart).editing_timing.scenes
        for name, scene in islice(scenes.items(), count):
            spec = {
                **self.common_spec(study, scene, seed),
                "spp": study.spp,
                "edit": next(iter(edits_of(study, scene))),
                "rounds": study.timing_rounds,
                "contestants": [
                    self.variant_spec(study, v, scene_seed(study, name, seed)) for v in variants
                ],
            }
            editors = {f"editor {k}": editor_of(study, v).name for k, v in enumerate(variants)}
            yield Cell(spec, name, "all", self.name, seed, tuple(names), sources=editors)

    def compute(self, work: Work) -> Rounds:
        """Run every contestant in every round; see :func:`attnwarp_eval.cost.in_turn`.

        The seconds are those of the method's own parts: files and renders for people are left out.
        """
        spec, world = work.spec, work.world
        names = [world.source.name, *spec["views"]]
        with work.meter.stage("truth"):
            truth = planned_truth(work.cell, names)
        contestants = [self._contestant(work, k) for k in range(len(spec["contestants"]))]
        with work.meter.stage("splats"):
            scenes = [splats_of(contestant) for contestant in contestants]
        rows: list[list[Mapping[str, float]]] = [[] for _ in range(len(contestants) + 1)]
        counters: list[dict[str, int]] = [{} for _ in contestants]

        def run(index: int, turn: int) -> None:
            result = run_method(contestants[index], truth, names, scenes[index])
            rows[-1 if turn >= AGAIN else index].append(result.seconds)
            counters[index] = {key: int(result.counters.get(key, 0)) for key in COUNTERS}

        runs = [partial(run, k) for k in range(len(contestants))]
        in_turn(runs, spec["rounds"], seed=spec["seed"])
        parts = {WHOLE: PARTS, EDITING: EDITING_PARTS, **{part: (part,) for part in PARTS}}
        seconds = {
            stage: [
                # The first round compiles.
                [sum(row.get(part, 0.0) for part in own) for row in taken[1:]]
                for taken in rows
            ]
            for stage, own in parts.items()
        }
        work.meter.count(rounds=spec["rounds"], contestants=len(contestants) + 1)
        return Rounds(seconds, counters)

    def _contestant(self, work: Work, number: int) -> Work:
        """A contestant as the work of a cell of the probe ``editing``."""
        spec = {k: v for k, v in work.spec.items() if k not in ("contestants", "rounds")}
        cell = replace(
            work.cell,
            spec={**spec, **work.spec["contestants"][number]},
            sources={**work.cell.sources, "editor": work.cell.sources[f"editor {number}"]},
        )
        return Work(cell, work.root, work.scene_world, Meter())

    def read_extra(self, data: Json) -> Rounds:
        """Read from the record's cost."""
        rounds = data["cost"]["rounds"]
        seconds = {s: [[float(v) for v in row] for row in rounds[s]] for s in STAGES}
        return Rounds(seconds, [dict(row) for row in data["cost"]["work"]])

    def in_turn(self, cell: Outcome, record: Record[Rounds]) -> InTurn:
        """The seconds of a cell."""
        return InTurn(
            cell.variants,
            record.extra.seconds,
            record.spec["rounds"],
            record.cost.threads,
            f"the edit {record.spec['edit']['name']} of {cell.scene}",
        )
