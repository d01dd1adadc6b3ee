"""Edits that change shapes by the ideal editor, against the true scene after the source's answers.

Figures of the edited views, and of the depth of the splats tuned on them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field

from attnwarp.editing.editor import Editor
from attnwarp.gaussians import Gaussians
from attnwarp.methods import AttentionWarpingSettings, attention_warping
from attnwarp.methods.scene import near_of
from attnwarp.warp import WarpSettings, render_surface
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Work, metrics_of, register
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Part, Study, StudyError, Variant, did_you_mean
from attnwarp_eval.study.shared.edit_truth import EditTruth, answers_of
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS
from attnwarp_eval.study.shared.edits import MethodProbe, noise_seed
from attnwarp_eval.study.shared.method_run import own_seconds, run_method
from attnwarp_eval.study.shared.pictures import jpeg
from attnwarp_eval.study.shared.splats import splats_of
from attnwarp_eval.world import World
from attnwarp_lab.ideal.figures import part_answers
from attnwarp_lab.ideal.places import Places
from attnwarp_lab.ideal.recorded import EditorResult, with_ideal_editor
from attnwarp_lab.ideal.shape_figures import ShapeTruth, depth_figures, shape_figures
from attnwarp_lab.ideal.share import alone, solve_share

Image = npt.NDArray[np.float32]

KINDS = ("added", "removed", "replaced", "grown", "moved")
"""Kinds in the order in which things of a drawn scene take them. Of three in a row at most two
have several answers."""

WORDS = "Change its shapes"


class ShapePart(Part):
    """Keys of a study: by scene, the edits that are its places.

    A drawn scene that is left out has three: its things take kinds of edits in turn, and scene N
    begins with the Nth, so that kinds and things mix.
    """

    places: dict[str, list[str]] = Field(default_factory=dict)


class ShapeVariantPart(Part):
    """Key of a variant: ``scene_after: true`` takes true geometry from the scene after the
    source's answers.
    """

    scene_after: bool = False


@dataclass(frozen=True)
class ShapeResult(EditorResult):
    """Entries of a cell's record besides the figures of its views.

    Attributes:
        splats: numbers of splats before and after.
    """

    entry = "shape"
    splats: tuple[int, int]


@register
class ShapeProbe(MethodProbe[ShapeResult]):
    """Edits of several places of a scene by one method and the ideal editor."""

    name = "shape"
    study_part = ShapePart
    variant_part = ShapeVariantPart
    metrics = metrics_of("shape.")

    def check(self, study: Study) -> None:
        """Require the ideal editor of all variants, and true geometry of the scene after."""
        for name, variant in with_ideal_editor(study, self.name):
            if variant.part(ShapeVariantPart).scene_after and variant.geometry != "truth":
                raise ValueError(
                    f"variants.{name}: scene_after without true geometry; add geometry: truth"
                )

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells: one for each scene, variant and seed."""
        for name, scene in scenes.items():
            places = [
                [edit, [scene.edited(edit, one).content_hash for _, one in answers_of(scene, edit)]]
                for edit in places_of(study, scene)
            ]
            for label in names:
                variant = study.variants[label]
                for seed in study.seeds:
                    spec = {
                        **self.common_spec(study, scene, seed),
                        **self.variant_spec(study, variant, noise_seed(scene, seed)),
                        "places": places,
                        **({"after": True} if _after(variant) else {}),
                    }
                    pictures = study.pictures_of(spec["views"], label)
                    yield Cell(spec, name, label, self.name, seed, (label,), pictures)

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Everything that decides a cell except its seed."""
        return (*super().meaning(study, variant), _after(variant))

    def compute(self, work: Work) -> ShapeResult:
        """Solve the share, edit the scene, and measure every target."""
        spec, world, meter = work.spec, work.world, work.meter
        ideal, names = spec["editor"]["ideal"], [world.source.name, *spec["views"]]
        with meter.stage("truth"):
            places = _places(world, tuple(names), [name for name, _ in spec["places"]], spec["spp"])
        with meter.stage("setup"):
            steps = spec["settings"]["steps"]
            share = solve_share(places.grams, ideal["settled"], steps)
            checked = alone(places.grams, share, steps)
            editor = places.editor(share, ideal["cross"])
        with meter.stage("splats"):
            before = splats_of(work)
        source = names[0]
        with meter.stage("truth"):
            first = _edit_source(world, places, before, editor, spec["settings"])
            answers = places.answers(
                source, part_answers(first, places.truth(source), places.parts)
            )
            truth = _truth(world, places, answers)
            after = World(truth.after, spec["size"]) if spec.get("after") else None
        result = run_method(
            work, _pictures(places, truth, names), names, before, editor=editor, warped_by=after,
            words={"instruction": WORDS, "target": WORDS, "source": world.scene.title},
        )  # fmt: skip
        meter.add("whole", own_seconds(result))
        with meter.stage("checks"):
            edited = {
                names[k]: picture.astype(np.float32) / np.float32(255)
                for k, picture in result.edited.items()
            }
            takes_truth = EDITING_METHODS[spec["method"]].needs_truth
            if not takes_truth and not np.array_equal(edited[source], first):
                raise RuntimeError("the source's edit differs from that of its answers")
            depths = _depths(world, names, before, result.gaussians)
            for name in names[1:]:
                view = truth.view(world.camera(name))
                row: dict[str, float] = depth_figures(depths[name], truth, view)
                if name in edited:
                    parts = part_answers(edited[name], places.truth(name), places.parts)
                    shown = places.answers(name, parts)
                    row |= shape_figures(edited[name], truth, view, name, shown)
                    drawn = {"edited": edited[name], "truth": view.after}
                    work.add(name, row, partial(_jpegs, {**drawn, "before": places.before[name]}))
                else:
                    work.add(name, row)
        return ShapeResult(
            share, checked.settled, checked.frequencies, checked.agreement, checked.fault(),
            tuple(int(answer) for answer in answers), (len(before), len(result.gaussians)),
        )  # fmt: skip

    def read_extra(self, data: Json) -> ShapeResult:
        """Read from the record's entry ``shape``."""
        return ShapeResult.from_json(data)


def places_of(study: Study, scene: Scene) -> list[str]:
    """Names of the edits that are a scene's places.

    Raises:
        StudyError: an edit that the scene lacks, or a scene without edits that change shapes.
    """
    there = [edit.name for edit in scene.edits]
    named = study.part(ShapePart).places.get(scene.name)
    if named is None:
        number = scene.name.rpartition("-")[2]
        first = int(number) if number.isdecimal() else 0
        named = [f"{KINDS[(k + first) % len(KINDS)]}-{k}" for k in range(3)]
    for name in named:
        if name not in there:
            raise StudyError(
                f"places.{scene.name}: no edit {name!r}{did_you_mean(name, there)}; scenes drawn"
                " with shapes: true have such edits"
            )
    return named


def _after(variant: Variant) -> bool:
    return variant.part(ShapeVariantPart).scene_after


def _places(world: World, names: tuple[str, ...], edits: Sequence[str], spp: int) -> Places:
    """The places of a scene, which all variants share; kept as long as its world."""
    key = ("places", names, tuple(edits), spp)
    if key not in world.made:
        world.made[key] = Places.of_edits(
            world.scene, [world.camera(name) for name in names],
            [world.scene.edit(name) for name in edits], spp,
        )  # fmt: skip
    places: Places = world.made[key]
    return places


def _truth(world: World, places: Places, answers: npt.NDArray[np.int64]) -> ShapeTruth:
    key = ("shape truth", id(places), tuple(answers))
    if key not in world.made:
        world.made[key] = ShapeTruth(world.scene, places, answers, world.geometry)
    truth: ShapeTruth = world.made[key]
    return truth


def _edit_source(
    world: World, places: Places, before: Gaussians, editor: Editor, settings: Json
) -> Image:
    """The source's edit, which no other view changes."""
    own = AttentionWarpingSettings.from_dict({**settings, "iterations": 0, "stages": 1})
    picture = places.before[world.source.name]
    edited = attention_warping(before, [world.source], [picture], editor, WORDS, own).edited
    return edited[0].astype(np.float32) / np.float32(255)


def _pictures(places: Places, truth: ShapeTruth, names: Sequence[str]) -> EditTruth:
    """The true pictures of the source's answers for a method."""
    masks = {name: labels >= 0 for name, labels in places.labels.items()}
    pictures = {name: truth.picture(name) for name in names}
    return EditTruth(places.before, {"source": pictures}, {"source": masks}, masks)


def _depths(
    world: World, names: Sequence[str], before: Gaussians, after: Gaussians
) -> dict[str, npt.NDArray[np.float64]]:
    cameras = [world.camera(name) for name in names]
    near = near_of(cameras, before)
    with torch.no_grad():
        surfaces = [render_surface(after, camera, WarpSettings(), near=near) for camera in cameras]
    return {
        name: np.asarray(surface.depth, dtype=np.float64)
        for name, surface in zip(names, surfaces, strict=True)
    }


def _jpegs(pictures: Mapping[str, Image]) -> dict[str, bytes]:
    return {name: jpeg(picture) for name, picture in pictures.items()}
