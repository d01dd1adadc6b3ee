"""An edit of a thing in some views, judged by the views' agreement alone.

True pictures of an edit cost more than the edit, and this probe needs none: it shows a method's
result to a person. Nothing changes outside the thing's exact mask, and splats are not tuned.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field

from attnwarp_eval import metrics
from attnwarp_eval.colors import color_difference
from attnwarp_eval.metrics.registry import METRICS, Registry
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, register
from attnwarp_eval.study.record import NoExtra
from attnwarp_eval.study.schema import Part, Study, Whole
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS
from attnwarp_eval.study.shared.edits import (
    LEAST_PIXELS,
    MethodProbe,
    VariantPart,
    editor_of,
    noise_seed,
)
from attnwarp_eval.study.shared.method_run import own_seconds, run_method
from attnwarp_eval.study.shared.splats import splats_of
from attnwarp_eval.study.shared.things import thing_of

Image = npt.NDArray[np.float32]

LEAST_CHANGE = 5.0
"""dE00 by which the source must change inside the thing: otherwise there is no edit to carry."""


class Carry(Part):
    """Edited scenes, each with the words for its thing, and the views.

    Args:
        edits: scene -> words.
        views: targets by name; the study's if empty.
        size: side of the pictures in px, at most the study's, which is the default.
    """

    edits: dict[str, str] = Field(default_factory=dict)
    views: list[str] = Field(default_factory=list)
    size: Annotated[Whole, Field(ge=16)] | None = None


class StudyPart(Part):
    """Keys of a study that only this probe reads."""

    carry: Carry = Carry()


@register
class CarryProbe(MethodProbe[NoExtra]):
    """One edit of a scene's thing by one method, in a few views."""

    name = "carry"
    protocol = 2
    study_part = StudyPart
    metrics = Registry(
        {name: METRICS[name] for name in ("multiview.delta_e", "multiview.same_part")}
    )

    def check(self, study: Study) -> None:
        """Require an edit, editing variants, and an editor that takes instructions."""
        if self.name not in study.probes:
            return
        if not study.part(StudyPart).carry.edits:
            raise ValueError("carry.edits: got none, expected a scene and the words for its edit")
        for name in study.probes[self.name]:
            variant = study.variants[name]
            method = EDITING_METHODS.get(variant.part(VariantPart).method)
            if method is not None and method.needs_truth:
                raise ValueError(
                    f"probes.carry: {name!r} takes the true pictures of an edit, and here are none;"
                    " leave it out"
                )
            if editor_of(study, variant).ideal is not None:
                raise ValueError(
                    f"probes.carry: {name!r} has the ideal editor, which reads no words"
                )

    def check_scenes(self, study: Study, scenes: Sequence[Scene]) -> None:
        """Refuse words for a scene that the study lacks: they would be unused."""
        study.check_scenes(study.part(StudyPart).carry.edits, "carry.edits", scenes)

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene with words, variant and seed."""
        part = study.part(StudyPart).carry
        size = min(part.size or study.size, study.size)
        for name, scene in scenes.items():
            if scene.name not in part.edits:
                continue
            views = study.model_copy(update={"views": part.views or study.views}).views_of(scene)
            for label in names:
                variant = study.variants[label]
                donor, files = self.other_scene(study, variant, name, scenes)
                for seed in study.seeds:
                    spec = {
                        **self.common_spec(study, scene, seed),
                        **self.variant_spec(study, variant, noise_seed(scene, seed)),
                        **donor,
                        "size": size,
                        "views": views,
                        "thing": thing_of(study, scene),
                        # The words also describe the result, for a method that needs a description.
                        "edit": {
                            "instruction": part.edits[scene.name],
                            "target": part.edits[scene.name],
                            "source": scene.title,
                        },
                    }
                    sources = {"editor": editor_of(study, variant).name, **files}
                    yield Cell(
                        spec,
                        name,
                        label,
                        self.name,
                        seed,
                        (label,),
                        (scene.source.name, *views),
                        sources,
                    )

    def compute(self, work: Work) -> NoExtra:
        """Edit the views, and compare each with the source at exact correspondences."""
        spec, world, meter = work.spec, work.world, work.meter
        source, names = world.source.name, [world.source.name, *spec["views"]]
        objects = [world.scene.object_names.index(name) for name in spec["thing"]]
        with meter.stage("truth"):
            before = {name: np.clip(world.image(name, spec["spp"]), 0, 1) for name in names}
            hits = {name: world.geometry.trace(world.camera(name)) for name in names}
            inside = {name: np.isin(hit.object_id, objects) for name, hit in hits.items()}
        with meter.stage("splats"):
            model = splats_of(work)
        segments = [inside[name] for name in names]
        truth = EditTruth(before, {}, {}, inside)
        result = run_method(work, truth, names, model, segments=segments)
        meter.add("whole", own_seconds(result))
        with meter.stage("checks"):
            after = {
                names[k]: picture.astype(np.float32) / np.float32(255)
                for k, picture in result.edited.items()
            }
            done = color_difference(before[source], after[source], inside[source]) >= LEAST_CHANGE
            shown = {"before": before, "after": after}
            work.draw(source, partial(_jpegs, shown, source))
            for name in spec["views"]:
                pair = world.between(source, name)
                difference = metrics.cross_view(after[source], after[name], pair, mask=inside[name])
                judged = done and difference.counted.sum() >= LEAST_PIXELS
                value = difference.delta_e[difference.counted].mean() if judged else math.nan
                row = {"multiview.delta_e": float(value)}
                both = [(shot[source], shot[name]) for shot in (before, after)]
                for end, region in (("seen", pair.visible), ("unseen", pair.unseen)):
                    parts = [
                        (hits[source].object_id == k, (hits[name].object_id == k) & region)
                        for k in objects
                    ]
                    row[f"multiview.same_part.{end}"] = metrics.same_parts(both[0], both[1], parts)
                work.add(name, row, partial(_jpegs, shown, name))
        return NoExtra()


def _jpegs(shown: Mapping[str, Mapping[str, Image]], name: str) -> dict[str, bytes]:
    return {kind: pictures.jpeg(pictures.enlarged(own[name])) for kind, own in shown.items()}
