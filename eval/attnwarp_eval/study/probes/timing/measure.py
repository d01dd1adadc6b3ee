"""Seconds of variants taken in turn in one process, for accuracy against time: of whole edits if
the study's probe ``editing`` measures the variants too, else of warps.

Seconds of separate cells are taken at different times, and a machine's speed drifts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Annotated

from pydantic import Field

from attnwarp.warp import WarpSettings, render_surface, warp_view
from attnwarp_eval.cost import AGAIN, Meter, in_turn
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import InTurn, Probe, Work, probe, register
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.results import Outcome
from attnwarp_eval.study.schema import Part, Study, Whole
from attnwarp_eval.study.shared.controls import OTHER_SCENE
from attnwarp_eval.study.shared.edit_truth import planned_truth
from attnwarp_eval.study.shared.edits import VariantPart, editor_of, edits_of, scene_seed
from attnwarp_eval.study.shared.method_run import PARTS, WHOLE, run_method
from attnwarp_eval.study.shared.splats import check_splats, splats_of, surface_spec

OF_A_WARP = ("render", "pair")
"""Stages: the target's surface; render, correspondence, mask and feature grids together."""

OF_AN_EDIT = (WHOLE, *PARTS)

COUNTERS = ("network_rows", "iterations")
"""Counters of an edit's work, which are the same on every machine."""


class StudyPart(Part):
    """Keys of a study that only this probe reads; ``timing_rounds`` applies to every timing."""

    timed_scenes: Annotated[Whole, Field(ge=1)] | None = Field(
        default=None, description="how many scenes are timed, from the first on; all if left out"
    )


@dataclass(frozen=True)
class Rounds:
    """Seconds and work of the contestants.

    Attributes:
        seconds: stage -> contestant -> round; the first contestant's second run comes last.
        work: work of each contestant, counters of one edit; empty for warps.
    """

    seconds: Mapping[str, list[list[float]]]
    work: Sequence[Mapping[str, int]] = ()

    def to_json(self) -> Json:
        """Entries of the record's cost."""
        work = {"work": [dict(row) for row in self.work]} if self.work else {}
        return {"cost": {"rounds": dict(self.seconds), **work}}


def _edited(study: Study) -> Sequence[str]:
    """Variants timed as whole edits."""
    return study.probes.get("editing", ())


@register
class Timing(Probe[Rounds]):
    """Timing of all contestants in one cell: seconds of separate cells cannot be compared."""

    name = "timing"
    study_part = StudyPart
    times_in_turn = (*OF_A_WARP, *OF_AN_EDIT)

    def check(self, study: Study) -> None:
        """Require contestants that render and edit, without the exact truth."""
        check_splats(study, self.name, "time to take")
        for name in study.probes.get(self.name, []):
            own = study.variants[name].part(VariantPart)
            if name not in _edited(study):
                continue
            why = "takes its mask from the scene's truth" if own.mask == "truth" else ""
            if own.control == OTHER_SCENE:
                why = "takes features of another scene, whose edit is no part of its own"
            why = "edits nothing" if own.method == "true pictures" else why
            if why:
                raise ValueError(
                    f"probes.timing: {name!r} {why}, so there is no time to take; leave it out"
                )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene and seed, of the middle view; of edits one for each scene, of
        its first edit and the first seed.
        """
        edited = [name for name in names if name in _edited(study)]
        warped = [name for name in names if name not in edited]
        for name, scene in islice(scenes.items(), study.part(StudyPart).timed_scenes):
            if edited:
                yield self._of_edits(study, edited, name, scene)
            for seed in study.seeds if warped else ():
                views = study.views_of(scene)
                spec = {
                    **self.common_spec(study, scene, seed),
                    "views": [views[len(views) // 2]],
                    "feature_sizes": study.feature_sizes,
                    "rounds": study.timing_rounds,
                    "contestants": [
                        {
                            "settings": study.variants[label].settings().to_dict(),
                            **surface_spec(study, study.variants[label], seed),
                        }
                        for label in warped
                    ],
                }
                yield Cell(spec, name, "all", self.name, seed, tuple(warped))

    def _of_edits(self, study: Study, names: Sequence[str], scene: str, of: Scene) -> Cell:
        seed, editing = study.seeds[0], probe("editing")
        variants = [study.variants[label] for label in names]
        spec = {
            **self.common_spec(study, of, seed),
            "spp": study.spp,
            "edit": next(iter(edits_of(study, of))),
            "rounds": study.timing_rounds,
            "contestants": [
                editing.variant_spec(study, v, scene_seed(study, scene, seed)) for v in variants
            ],
        }
        editors = {f"editor {k}": editor_of(study, v).name for k, v in enumerate(variants)}
        return Cell(spec, scene, "all", self.name, seed, tuple(names), sources=editors)

    def compute(self, work: Work) -> Rounds:
        """Time every contestant in every round; see :func:`attnwarp_eval.cost.in_turn`."""
        spec = work.spec
        work.meter.count(rounds=spec["rounds"], contestants=len(spec["contestants"]) + 1)
        return _edits(work) if "edit" in spec else _warps(work)

    def read_extra(self, data: Json) -> Rounds:
        """Read from the record's cost."""
        cost = data["cost"]
        seconds = {
            stage: [[float(v) for v in row] for row in rounds]
            for stage, rounds in cost["rounds"].items()
        }
        return Rounds(seconds, [dict(row) for row in cost.get("work", ())])

    def in_turn(self, cell: Outcome, record: Record[Rounds]) -> InTurn:
        """Seconds of a cell, by stage and contestant."""
        spec = record.spec
        of = (
            f"the edit {spec['edit']['name']} of {cell.scene}"
            if "edit" in spec
            else f"view {spec['views'][0]} of {cell.scene}"
        )
        return InTurn(cell.variants, record.extra.seconds, spec["rounds"], record.cost.threads, of)


def _warps(work: Work) -> Rounds:
    """Seconds of renders and of warps of a target."""
    spec, world = work.spec, work.world
    target = world.targets[spec["views"][0]]
    contestants = [
        (splats_of(work, {**spec, **contestant}), WarpSettings.from_dict(contestant["settings"]))
        for contestant in spec["contestants"]
    ]
    sources = [render_surface(model, world.source, settings) for model, settings in contestants]

    def render(index: int) -> None:
        model, settings = contestants[index]
        render_surface(model, target, settings)

    def pair(index: int) -> None:
        model, settings = contestants[index]
        surface = sources[index]
        view = warp_view(
            model, world.source, target, settings, source_surface=surface, warn_empty=False
        )
        for layer in spec["feature_sizes"]:
            view.at((layer, layer))

    def timed(stage: Callable[[int], None]) -> list[list[float]]:
        works = [lambda _, index=index: stage(index) for index in range(len(contestants))]
        turns = in_turn(works, spec["rounds"], seed=spec["seed"])
        return [*turns.seconds, turns.again]

    return Rounds({"render": timed(render), "pair": timed(pair)})


def _edits(work: Work) -> Rounds:
    """Seconds of whole edits: of the method's parts, without files and renders for display."""
    spec, world = work.spec, work.world
    names = [world.source.name, *spec["views"]]
    with work.meter.stage("truth"):
        truth = planned_truth(work.cell, names)
    contestants = [_contestant(work, k) for k in range(len(spec["contestants"]))]
    with work.meter.stage("splats"):
        scenes = [splats_of(contestant) for contestant in contestants]
    rows: list[list[Mapping[str, float]]] = [[] for _ in range(len(contestants) + 1)]
    counters: list[dict[str, int]] = [{} for _ in contestants]

    def run(index: int, turn: int) -> None:
        result = run_method(contestants[index], truth, names, scenes[index])
        rows[-1 if turn >= AGAIN else index].append(result.seconds)
        counters[index] = {key: int(result.counters.get(key, 0)) for key in COUNTERS}

    works = [lambda turn, index=index: run(index, turn) for index in range(len(contestants))]
    in_turn(works, spec["rounds"], seed=spec["seed"])
    parts = {WHOLE: PARTS, **{part: (part,) for part in PARTS}}
    seconds = {
        stage: [
            # The first round includes compilation.
            [sum(row.get(part, 0.0) for part in own) for row in taken[1:]]
            for taken in rows
        ]
        for stage, own in parts.items()
    }
    return Rounds(seconds, counters)


def _contestant(work: Work, number: int) -> Work:
    """A contestant as the work of a cell of the probe ``editing``."""
    spec = {k: v for k, v in work.spec.items() if k not in ("contestants", "rounds")}
    cell = replace(
        work.cell,
        spec={**spec, **work.spec["contestants"][number]},
        sources={**work.cell.sources, "editor": work.cell.sources[f"editor {number}"]},
    )
    return Work(cell, work.root, work.scene_world, Meter())
