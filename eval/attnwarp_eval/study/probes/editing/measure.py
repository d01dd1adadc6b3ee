"""A scene edited by a method, against the true pictures of the edit.

Views of a record are named ``edit/view``. Figures end in ``.edit`` for the edited views and in
``.render`` for renders of the edited splats. If the editor failed at the edit in the source view,
figures of agreement between views are undefined: there is no edit to carry.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Literal

import torch

from attnwarp import Camera, Gaussians, check
from attnwarp.fit import compile_kernels
from attnwarp.warp import warp_view
from attnwarp_eval.cost import Meter
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, probe, register
from attnwarp_eval.study.probes.editing.result import EditResult, Measurement
from attnwarp_eval.study.record import Json, Record
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared.budgets import Spent, Stopwatch, timed
from attnwarp_eval.study.shared.controls import OTHER_SCENE
from attnwarp_eval.study.shared.edit_truth import EditTruth, planned_truth
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS
from attnwarp_eval.study.shared.edits import (
    EditingPart,
    MethodProbe,
    VariantPart,
    editor_of,
    edits_of,
    reference_of,
    scene_seed,
    settings_of,
)
from attnwarp_eval.study.shared.encoders import (
    EncodersPart,
    encoder_identities,
    encoder_sources,
    loaded,
)
from attnwarp_eval.study.shared.method_run import own_seconds, run_method
from attnwarp_eval.study.shared.splats import splats_of

if TYPE_CHECKING:
    from attnwarp.methods import Budget

STOPWATCH = Stopwatch()
"""Seconds of the methods run by this process."""


class StudyPart(EditingPart, EncodersPart):
    """Keys of a study for this probe."""


@register
class EditingProbe(MethodProbe[EditResult]):
    """One edit of one scene by one method."""

    name = "editing"
    protocol = 3
    study_part = StudyPart
    variant_part = VariantPart
    metrics = metrics_of(
        "multiview.", "fidelity.", "embedding.", "depth.", "image.", "cost.", "edit.drift"
    )

    # From a study to cells

    def check(self, study: Study) -> None:
        """Refuse the ideal editor, and budgets by variants that cannot give one."""
        for name in sorted(self.measured(study) & study.variants.keys()):
            if editor_of(study, study.variants[name]).ideal is not None:
                raise ValueError(
                    f"probes.{self.name}: {name!r} has the ideal editor, whose answers are those of"
                    " parts; measure it by probes.ideal"
                )
        for name, variant in study.variants.items():
            budget = variant.part(VariantPart).budget
            if budget is None or budget.seconds_of is None:
                continue
            key = f"variants.{name}.budget.seconds_of"
            study.check_variants([budget.seconds_of], key)
            other = study.variants[budget.seconds_of].part(VariantPart).budget
            if other is not None and other.seconds_of is not None:
                raise ValueError(
                    f"{key}: {budget.seconds_of!r} has seconds_of itself; name a variant that has"
                    " none"
                )

    def check_scenes(self, study: Study, scenes: Sequence[Scene]) -> None:
        """Refuse unknown scene names: a scene without an entry has all edits measured."""
        study.check_scenes(study.part(EditingPart).editing.edits, "editing.edits", scenes)

    def check_variant(self, study: Study, variant: Variant) -> None:
        """Refuse invalid settings even if nothing is edited."""
        own = variant.part(VariantPart)
        check.one_of(own.method, list(EDITING_METHODS), "method")
        if own.budget is not None and not EDITING_METHODS[own.method].takes_budget:
            able = ", ".join(
                repr(name) for name, method in EDITING_METHODS.items() if method.takes_budget
            )
            raise ValueError(
                f"budget: method {own.method!r} runs to its end; methods with a budget are {able}"
            )
        if own.control == OTHER_SCENE:
            self._check_other_scene(study, variant)
        if own.options or any(probe(name).edits for name in study.probes):
            settings_of(study, variant, 0)

    def _check_other_scene(self, study: Study, variant: Variant) -> None:
        from attnwarp.editing.small import guide_of

        editor = editor_of(study, variant)
        if editor.ideal is None and guide_of(editor.name) == "depth":
            raise ValueError(
                f"control: {OTHER_SCENE!r} needs an editor that takes pictures, and"
                f" {editor.name!r} takes depth; choose another editor or control"
            )

    def measured(self, study: Study) -> Set[str]:
        """Measured variants, with those whose seconds limit others."""
        names = study.variants.keys() & super().measured(study)
        references = {reference_of(study.variants[name]) for name in names}
        return names | {name for name in references if name is not None}

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene, edit, variant and seed."""
        wanted = study.part(EncodersPart)
        encoders = encoder_identities(wanted)
        sources = encoder_sources(wanted)
        for name, scene in scenes.items():
            edits = list(edits_of(study, scene))
            for label in names:
                variant = study.variants[label]
                names_of = {"editor": editor_of(study, variant).name}
                reference = reference_of(variant)
                if reference is not None:
                    names_of["reference"] = reference
                    other = study.variants[reference]
                    names_of["reference editor"] = editor_of(study, other).name
                for seed in study.seeds:
                    decided = {
                        **self.common_spec(study, scene, seed),
                        **self.variant_spec(study, variant, scene_seed(study, name, seed)),
                    }
                    donor, files = self.other_scene(study, variant, name, scenes)
                    decided |= donor
                    views = study.pictures_of(decided["views"], label)
                    for edit in edits:
                        yield Cell(
                            {**decided, "edit": edit, "encoders": encoders},
                            name, label, self.name, seed, (label,),
                            tuple(f"{edit['name']}/{view}" for view in views),
                            {**sources, **names_of, **files},
                        )  # fmt: skip

    # From a cell to its record

    def compute(self, work: Work) -> EditResult:
        """Edit the scene, then measure every target."""
        spec, world, meter = work.spec, work.world, work.meter
        names = [world.source.name, *spec["views"]]
        with meter.stage("truth"):
            truth = planned_truth(work.cell, names)
        with meter.stage("splats"):
            before = splats_of(work)
        with meter.stage("setup"):
            encoders = loaded(work.cell.sources, spec["encoders"])
            _compile(before.kind)
        budget = self._budget(work, truth, names)
        result = run_method(work, truth, names, before, budget)
        STOPWATCH.note(_decisive(spec), own_seconds(result))
        meter.add("whole", own_seconds(result))
        with meter.stage("checks"):
            extra = Measurement(work, truth, names, before, result, encoders).record()
        if budget is None:
            return extra
        given = work.cell.sources.get("reference")
        return replace(extra, budget=Spent(budget.seconds, given, budget.network_rows, result.cut))

    def _budget(self, work: Work, truth: EditTruth, names: Sequence[str]) -> Budget | None:
        """Limits of the work's method; runs the variant whose seconds are the limit if needed."""
        from attnwarp.methods import Budget

        given = work.spec.get("budget")
        if given is None:
            return None
        seconds = given.get("seconds")
        if "seconds_of" in given:
            shared = {k: work.spec[k] for k in _SHARED if k in work.spec}
            sources = {**work.cell.sources, "editor": work.cell.sources["reference editor"]}
            cell = replace(work.cell, spec={**shared, **given["seconds_of"]}, sources=sources)
            other = Work(cell, work.root, work.scene_world, Meter())

            def run() -> float:
                limits = self._budget(other, truth, names)
                return own_seconds(run_method(other, truth, names, splats_of(other), limits))

            with work.meter.stage("budget"):
                seconds = STOPWATCH.seconds(_decisive(cell.spec), run)
        return Budget(seconds, given.get("network_rows"))

    def read_extra(self, data: Json) -> EditResult:
        """Read from the record's entry ``edit``."""
        return EditResult.from_json(data["edit"])

    def repeatable(self, record: Record[EditResult]) -> bool:
        """False when a time budget limited the method."""
        return not timed(record.spec)


@cache
def _compile(kind: Literal["2d", "3d"]) -> None:
    """Compile rendering, tuning and warping, so that a first edit's seconds exclude compilation."""
    compile_kernels(kind)
    axes = 3 if kind == "3d" else 2
    one = torch.ones(1, 1, 3, dtype=torch.float32)
    splats = Gaussians(
        kind, one[0], torch.eye(1, 4, dtype=torch.float32), one[0, :, :axes], one[0, :, 0], one
    )
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), width=16, height=16, fov_y=40, up=(0, 1, 0))
    warp_view(splats, camera, camera).at((4, 4)).warp_tokens(
        torch.zeros(1, 16, 4, dtype=torch.float32)
    )


_SHARED = ("probe", "protocol", "scene", "size", "views", "seed", "edit", "encoders")
"""Entries of a cell's spec that all variants share."""


def _decisive(spec: Json) -> Json:
    """Entries of a cell's spec that decide its method's run; encoders only measure the result."""
    return {key: value for key, value in spec.items() if key != "encoders"}
