"""Seconds of whole edits taken in turn in one process, for accuracy against time.

Seconds of the cells of :mod:`attnwarp_eval.study.probes.editing` come from other times of a machine
whose speed drifts. Here every variant edits the same scene in each round.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

from pydantic import Field

from attnwarp_eval.cost import AGAIN, Meter, in_turn
from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number, ratio_text
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.statistics.intervals import RATIO_INTERVAL, time_ratio
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.edit_truth import planned_truth
from attnwarp_eval.study.probes import editing, register
from attnwarp_eval.study.probes.base import InTurn, Layout, Place, Probe, Work
from attnwarp_eval.study.probes.editing_sections import PARTS, WHOLE, is_alone
from attnwarp_eval.study.probes.turns import Timed, timed_in_turn
from attnwarp_eval.study.probes.variant_splats import splats_of
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.schema import Part, Study, Variant

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
class EditingTimingProbe(Probe[Rounds]):
    """One cell of a scene for all contestants: seconds of separate cells cannot be compared."""

    name = "editing-timing"
    study_part = StudyPart
    times_in_turn = STAGES
    draws = False
    edits = True
    study_keys = frozenset({"size", "views", "spp", "timing_rounds", "editing", "editing_timing"})
    shared = editing.EditingProbe.shared

    def check(self, study: Study) -> None:
        """Every contestant runs to its end, by what it sees itself."""
        for name in study.probes.get(self.name, []):
            variant = study.variants[name]
            own = variant.part(editing.VariantPart)
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

    def reads(self, study: Study, variant: Variant) -> Set[str]:
        """A method of editing."""
        return editing.EditingProbe().reads(study, variant)

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """One for each scene, of its first edit and the first seed."""
        seed = study.seeds[0]
        variants = [study.variants[label] for label in names]
        method = editing.EditingProbe()
        count = study.part(StudyPart).editing_timing.scenes
        for name, scene in islice(scenes.items(), count):
            spec = {
                **self.common_spec(study, scene, seed),
                "spp": study.spp,
                "edit": next(iter(editing.edits_of(study, scene))),
                "rounds": study.timing_rounds,
                "contestants": [method.variant_spec(study, v, seed) for v in variants],
            }
            editors = {
                f"editor {k}": editing.editor_of(study, v).name for k, v in enumerate(variants)
            }
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
            result = editing.run_method(contestants[index], truth, names, scenes[index])
            rows[-1 if turn >= AGAIN else index].append(result.seconds)
            counters[index] = {key: int(result.counters.get(key, 0)) for key in COUNTERS}

        runs = [partial(run, k) for k in range(len(contestants))]
        in_turn(runs, spec["rounds"], seed=spec["seed"])
        parts = {WHOLE: PARTS, EDITING: editing.EDITING_PARTS, **{part: (part,) for part in PARTS}}
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

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Seconds of each contestant, their spread, and ratios to the first."""
        timed = timed_in_turn(results, WHOLE)
        if layout.timings and timed is not None:
            yield Place.RESULT, self._section(results, timed)

    def _section(self, results: Results, timed: Timed) -> Section:
        own = timed.of(EDITING)
        _, record = results.finished(self.name)[0]
        names = timed.turns[0].names
        work = dict(zip(names, record.extra.work, strict=True))
        contestants = zip(names, record.spec["contestants"], strict=True)
        alone = [name for name, spec in contestants if is_alone(spec)]
        control = alone[0] if alone else None
        columns = [
            "variant",
            "s, median",
            "lowest to highest",
            f"ratio to {timed.baseline!r}",
            "verdict",
            *(f"{part}, s" for part in PARTS),
            "editing, ratio to control",
            *(counter.replace("_", " ") for counter in COUNTERS),
        ]
        rows = []
        for name in names:
            ratio = timed.ratio(name)
            base = name == timed.baseline
            to_control = "–"
            if control is not None and name != control:
                to_control = ratio_text(time_ratio(own.rounds(name), own.rounds(control)))
            rows.append(
                [
                    name,
                    *_spread(timed.rounds(name)),
                    "1" if base else ratio_text(ratio),
                    "baseline" if base else timed.judge(ratio),
                    *(_spread(timed.of(part).rounds(name))[0] for part in PARTS),
                    to_control,
                    *(str(work[name][counter]) for counter in COUNTERS),
                ]
            )
        rest = ["–"] * (len(PARTS) + 1 + len(COUNTERS))
        rows.append(["again", *_spread(timed.rounds(None)), ratio_text(timed.noise), "–", *rest])
        editing_text = (
            f" Editing is {', '.join(editing.EDITING_PARTS)}, without tuning; {control!r} is its"
            " control."
        )
        text = [
            (
                f"Seconds of one whole edit, {timed.turns[0].rounds} rounds of each variant in one"
                f" process, in turn: {', '.join(turn.of for turn in timed.turns)}. Ratios are"
                f" medians over rounds of the ratio within a round; {RATIO_INTERVAL} The"
                " row `again` is the first variant against itself: inside that band, or its mirror"
                " image about 1, nothing is called faster or"
                f" slower.{editing_text if control is not None else ''}"
            ),
        ]
        return Section("Seconds of an edit, taken in turn", text, [Table(columns, rows)])


def _spread(rounds: Sequence[Sequence[float]]) -> tuple[str, str]:
    """Median over cells and rounds; the lowest and the highest."""
    taken = [value for row in rounds for value in row]
    return number(statistics.median(taken)), f"{number(min(taken))} to {number(max(taken))}"
