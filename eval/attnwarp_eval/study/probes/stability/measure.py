"""Hard cases swept over their hardness: where the numerics hold, break, or refuse."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from pydantic import Field

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.stability import Case, Outcome, Way, hard_case, hard_cases, level_name
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe, Work, metrics_of, register
from attnwarp_eval.study.record import Json, Record, View
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Part, Study


class Sweep(Part):
    """Hard cases of a study."""

    cases: list[str] = Field(default_factory=list, description="by name; all of them if empty")
    levels: Literal["all", "quick"] = "all"
    gpu: Annotated[bool, Field(description="also backend gpu; without a GPU on one thread")] = False


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    stability: Sweep | None = Field(default=None, exclude_if=lambda value: value is None)


@dataclass(frozen=True)
class Extra:
    """Error messages of the refused levels."""

    refusals: Mapping[str, str]

    def to_json(self) -> Json:
        """The record's entry ``refusals``."""
        return {"refusals": dict(self.refusals)}


@dataclass(frozen=True)
class Swept:
    """Measured outcomes of one way of one case by level, the easiest first."""

    case: Case
    way: Way
    outcomes: tuple[Outcome, ...]

    @property
    def end(self) -> Outcome | None:
        """The first level that breaks or is refused; None if all hold."""
        return next((o for o in self.outcomes if o.verdict != "holds"), None)


@register
class Stability(Probe[Extra]):
    """Numerically hard inputs against independent oracles."""

    name = "stability"
    study_part = StudyPart
    metrics = metrics_of("stability.")
    needs_scenes = False
    judges_variants = False

    def check(self, study: Study) -> None:
        """Require known names of cases, and no variants, since no case depends on one."""
        sweep = study.part(StudyPart).stability
        if study.probes.get(self.name):
            raise ValueError(
                "probes.stability: got variants, expected []; a hard case has ways of its own"
            )
        for name in sweep.cases if sweep else ():
            try:
                hard_case(name)
            except ValueError as error:
                raise ValueError(f"stability.cases: {error}") from None

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each way of each case."""
        sweep = study.part(StudyPart).stability or Sweep()
        for hard in [hard_case(name) for name in sweep.cases] or hard_cases().values():
            levels = hard.levels if sweep.levels == "all" else hard.quick
            for way in hard.ways:
                if way.backend == "gpu" and not sweep.gpu:
                    continue
                spec = {
                    "probe": self.name,
                    "protocol": self.protocol,
                    "case": hard.name,
                    "version": hard.version,
                    **asdict(way),
                    "levels": [level_name(level) for level in levels],
                }
                yield Cell(spec, hard.name, way.name, self.name, 0, (way.name,))

    def compute(self, work: Work) -> Extra:
        """Evaluate one way of one case at each of its levels."""
        hard, way, levels = _definition(work.spec)
        refusals = {}
        for level in levels:
            with work.meter.view():
                outcome = hard.outcome(level, way)
            figures = {
                "stability.margin": outcome.margin,
                "stability.error": outcome.error,
                "stability.refused": float(bool(outcome.refusal)),
            }
            work.views.append(View(level_name(level), 0.0, figures))
            if outcome.refusal:
                refusals[level_name(level)] = outcome.refusal
        return Extra(refusals)

    def read_extra(self, data: Json) -> Extra:
        """Read from the record's entry ``refusals``."""
        return Extra(data["refusals"])

    def read(self, data: Json) -> Record[Extra]:
        """Read a record from its JSON. ValueError: the present cases have no such case or level."""
        _definition(data["spec"])
        return super().read(data)


def _definition(spec: Json) -> tuple[Case, Way, list[float]]:
    hard = hard_case(spec["case"])
    by_name = {level_name(level): level for level in hard.levels}
    former = [name for name in spec["levels"] if name not in by_name]
    if former:
        raise ValueError(f"hard case {hard.name!r} has no level {former[0]} today")
    way = Way(spec["backend"], spec["precision"], spec["direction"])
    return hard, way, [by_name[name] for name in spec["levels"]]


def read_sweeps(results: Results) -> list[Swept]:
    """Sweeps from a run's records, in the order of the cases."""
    swept = []
    for _, record in results.finished(Stability.name):
        hard, way, levels = _definition(record.spec)
        refusals = record.extra.refusals
        # JSON has no infinity: an infinite error is NaN in a record.
        outcomes = [
            hard.judge(level, way, view.metrics["stability.error"], refusals.get(view.name, ""))
            for level, view in zip(levels, record.views, strict=True)
        ]
        swept.append(Swept(hard, way, tuple(outcomes)))
    return swept
