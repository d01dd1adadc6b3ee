"""A scene edited by a method, against the true pictures of the edit.

Views of a record are named ``edit/view``. Figures end in ``.edit`` for the edited views and in
``.render`` for renders of the edited splats. If the editor failed at the edit in the source view,
figures of agreement between views are undefined: there is no edit to carry.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Literal

import torch

from attnwarp import Camera, Gaussians, check
from attnwarp.fit import compile_kernels
from attnwarp.warp import warp_view
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, probe, register
from attnwarp_eval.study.probes.editing.result import EditResult, Measurement
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared.controls import OTHER_SCENE
from attnwarp_eval.study.shared.edit_truth import planned_truth
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS
from attnwarp_eval.study.shared.edits import (
    EditingPart,
    MethodProbe,
    VariantPart,
    editor_of,
    edits_of,
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
    pass


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
        """Refuse the ideal editor."""
        for name in sorted(self.measured(study) & study.variants.keys()):
            if editor_of(study, study.variants[name]).ideal is not None:
                raise ValueError(
                    f"probes.{self.name}: {name!r} has the ideal editor, whose answers are those of"
                    " parts; measure it by probes.ideal"
                )

    def check_scenes(self, study: Study, scenes: Sequence[Scene]) -> None:
        """Refuse unknown scene names: a scene without an entry has all edits measured."""
        study.check_scenes(study.part(EditingPart).editing.edits, "editing.edits", scenes)

    def check_variant(self, study: Study, variant: Variant) -> None:
        """Refuse invalid settings even if nothing is edited."""
        own = variant.part(VariantPart)
        check.one_of(own.method, list(EDITING_METHODS), "method")
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
        result = run_method(work, truth, names, before)
        meter.add("whole", own_seconds(result))
        with meter.stage("checks"):
            return Measurement(work, truth, names, before, result, encoders).record()

    def read_extra(self, data: Json) -> EditResult:
        """Read from the record's entry ``edit``."""
        return EditResult.from_json(data["edit"])


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
