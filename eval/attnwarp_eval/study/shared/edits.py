"""Edits of scenes by methods: study keys shared by several probes, and entries of a cell's spec."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.probe import Probe
from attnwarp_eval.study.record import Extra, Json
from attnwarp_eval.study.schema import Part, Study, StudyError, Variant, Whole, did_you_mean
from attnwarp_eval.study.shared.controls import (
    OTHER_SCENE,
    SCENE_STEP,
    Control,
)
from attnwarp_eval.study.shared.drifts import DriftPart
from attnwarp_eval.study.shared.edit_truth import answers_of
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS
from attnwarp_eval.study.shared.splats import splats_meaning, splats_spec

E = TypeVar("E", bound=Extra)

LEAST_PIXELS = 16
"""Least compared pixels for agreement to be defined: the area of one latent cell of the bundled
editors. Views have equal weight in a mean, so a single pixel would weigh as much as a whole
view."""


class IdealPart(Part):
    """The ideal editor (docs/measuring/ideal-editor.md).

    ``parts`` of the thing, each in one of ``colors``; ``settled``: mean share of the steps until
    an answer holds; ``cross``: output of cross-attention.
    """

    parts: Annotated[Whole, Field(ge=1, le=1000)] = 12
    colors: Annotated[Whole, Field(ge=1, le=12)] = 4
    settled: Annotated[float, Field(gt=0, lt=1)] = 0.4
    cross: Literal["paint", "word", "swapped"] = "paint"


class EditorPart(Part):
    """An editor of single views.

    ``name`` is a bundled editor or a folder in diffusers' format. Guidance defaults to the
    editor's. ``draws: false`` removes a bundled editor's choice of answer by the noise's mean.
    ``ideal`` selects the ideal editor instead, for the probe ``ideal``.
    """

    name: str = "small-plain"
    text_guidance: float | None = Field(default=None, ge=0)
    image_guidance: float | None = Field(default=None, ge=0)
    draws: bool = True
    ideal: IdealPart | None = None


class Editing(Part):
    """Settings that all variants share.

    ``edits``: by scene, an edit's name, or ``edit=answer`` for a single answer, with the words for
    the editor; null for the edit's words. Scenes that are left out have all their edits.
    """

    editor: EditorPart = EditorPart()
    edits: dict[str, dict[str, str | None]] = Field(default_factory=dict)
    options: dict[str, Any] = Field(
        default_factory=dict, description="fields of attnwarp.methods.AttentionWarpingSettings"
    )


class EditingPart(Part):
    """Keys of a study: the edits and the editor."""

    editing: Editing = Editing()


class VariantPart(Part):
    """Keys of a variant: the method and its limits.

    ``options`` are fields of the method's settings that override the study's; a ``preset`` among
    them is applied before the variant's. ``{source}`` in ``source_prompt`` stands for the edit's
    ``source`` words. ``mask: truth`` injects where the source truly sees the
    surface, ``geometry: truth`` warps by exact depth.
    ``control`` takes features from the wrong place or scene
    (:mod:`attnwarp_eval.study.shared.controls`). ``drift`` makes the editor move what it edits.
    """

    method: str = "attention_warping"
    options: dict[str, Any] = Field(default_factory=dict)
    mask: Literal["rules", "truth"] = "rules"
    editor: EditorPart | None = None
    control: Control | None = None
    drift: DriftPart | None = None


class MethodProbe(Probe[E]):
    """Base of probes that run a variant's editing method."""

    edits = True

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """The method with its settings, the editor, and the sources of splats and warps."""
        own = variant.part(VariantPart)
        settings = settings_of(study, variant, seed)
        return {
            "spp": study.spp,
            "method": own.method,
            "settings": settings,
            "editor": editor_identity(editor_of(study, variant)),
            "geometry": variant.geometry,
            "mask": own.mask,
            **splats_spec(study, variant, seed),
            **({"control": own.control} if own.control else {}),
            **({"drift": own.drift.model_dump()} if own.drift else {}),
        }

    def other_scene(
        self, study: Study, variant: Variant, scene: str, scenes: Mapping[str, Scene]
    ) -> tuple[Json, dict[str, str]]:
        """Entries of a cell's spec and sources for features of the next scene.

        Raises:
            StudyError: the study has no other scene.
        """
        if variant.part(VariantPart).control != OTHER_SCENE:
            return {}, {}
        names = list(scenes)
        other = names[(names.index(scene) + 1) % len(names)]
        if other == scene:
            raise StudyError(
                f"control: {OTHER_SCENE!r} takes features of the next scene, and the run has"
                f" {scene!r} alone; name a second scene, or leave the variant out"
            )
        files = dict(zip(study.scene_names, study.scenes, strict=True))
        entry = {"scene": scenes[other].content_hash, **self.of_other_scene(study, scenes[other])}
        return {"other": entry}, {"other scene": str(files[other])}

    def of_other_scene(self, study: Study, scene: Scene) -> Json:
        """Further entries of a cell's spec on the other scene."""
        return {}

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Everything that decides a cell except its seed."""
        own = variant.part(VariantPart)
        settings = settings_of(study, variant, 0)
        return (
            own.method, settings, variant.geometry, own.mask, splats_meaning(study, variant),
            editor_of(study, variant), own.control, own.drift,
        )  # fmt: skip


def scene_seed(study: Study, scene: str, seed: int) -> int:
    """Seed of a scene's noise: the study's seed, offset for each drawn scene.

    An open instruction's answer follows from the noise's mean, so one seed would give most scenes
    the same answer. Scenes of a sample must be independent.
    """
    sample = study.population.names if study.population else []
    return seed + SCENE_STEP * sample.index(scene) if scene in sample else seed


def noise_seed(scene: Scene, seed: int) -> int:
    """Seed of the noise of a drawn or named scene: the study's, offset by the scene's name.

    :func:`scene_seed` has the reason; it leaves named scenes one seed. The content would not do:
    its hash changes with the versions of what reads it, and with it every edit's figures.
    """
    return seed + SCENE_STEP * int(digest(scene.name)[:5], 16)


def settings_of(study: Study, variant: Variant, seed: int) -> dict[str, Any]:
    """Settings of a variant's method: a preset, the study's fields, the variant's, and the
    fields of its warp. A dictionary changes the fields that it names.

    Raises:
        ValueError: an unknown preset or field, or a value out of range.
    """
    own, shared = variant.part(VariantPart), study.part(EditingPart).editing.options
    fields = dict(shared)
    for key, value in own.options.items():
        both = isinstance(value, dict) and isinstance(fields.get(key), dict)
        fields[key] = {**fields[key], **value} if both else value
    if "seed" in fields:
        raise ValueError("options.seed: the seeds are the study's own; set seeds there")
    presets = (own.options.get("preset"), variant.preset, fields.pop("preset", None))
    name = next((preset for preset in presets if preset is not None), None)
    warp = {f"warp.{key}": value for key, value in variant.set.items()}
    return EDITING_METHODS[own.method].settings(name, {**fields, **warp}, seed)


def editor_of(study: Study, variant: Variant) -> EditorPart:
    """The variant's editor, else the study's."""
    return variant.part(VariantPart).editor or study.part(EditingPart).editing.editor


def editor_identity(editor: EditorPart) -> Json:
    """Entries that decide an editor's pictures: its files and guidance, not its folder.

    Raises:
        StudyError: no editor of that name, or no draw to leave out.
    """
    from attnwarp.editing.small import guide_of

    if editor.ideal is not None:
        return {"ideal": editor.ideal.model_dump()}
    guidance = {"text": editor.text_guidance, "image": editor.image_guidance}
    identity = {"sha256": files_digest(editor.name), "guidance": guidance}
    if editor.draws:
        return identity
    if guide_of(editor.name) == "depth":
        raise StudyError(f"editor.draws: {editor.name!r} has no draw; leave the key out")
    return {**identity, "draws": False}


@lru_cache
def files_digest(name: str) -> str:
    """SHA-256 of an editor's files.

    Raises:
        StudyError: no editor of that name.
    """
    from attnwarp.editing.identity import file_digest
    from attnwarp.editing.small import SUMS, folders_of

    try:
        folder, control = folders_of(name)
    except InputError as error:
        raise StudyError(str(error)) from None
    files = {path.relative_to(folder): path for path in folder.rglob("*")}
    if control is not None and control != folder / "controlnet":
        # Name it as if in the folder; a ControlNet in the folder is not read.
        files = {place: path for place, path in files.items() if place.parts[0] != "controlnet"}
        files |= {"controlnet" / path.relative_to(control): path for path in control.rglob("*")}
    sums = [
        [place.as_posix(), file_digest(path)]
        for place, path in sorted(files.items())
        if path.suffix in (".json", ".safetensors") and path.name != SUMS
    ]
    return hashlib.sha256(json.dumps(sums).encode()).hexdigest()


def edits_of(study: Study, scene: Scene) -> Iterator[Json]:
    """Entries for a cell's spec, one for each of a scene's edits.

    Raises:
        StudyError: the study names an edit or an answer that the scene lacks.
    """
    own = {edit.name: edit for edit in scene.edits}
    wanted = study.part(EditingPart).editing.edits.get(scene.name) or dict.fromkeys(own)
    if not wanted:
        raise StudyError(f"probes.editing: scene {scene.name!r} names no edits; leave it out")
    for key, words in wanted.items():
        title, _, answer = key.partition("=")
        if title not in own:
            raise StudyError(
                f"editing.edits.{scene.name}: no edit {title!r}{did_you_mean(title, own)}"
            )
        try:
            answers = answers_of(scene, key)
        except ValueError as error:
            raise StudyError(f"editing.edits.{scene.name}: {error}") from None
        edit = own[title]
        targets = [one.target for one in edit.answers if one.name == answer]
        yield {
            "name": key,
            "instruction": words or edit.instruction,
            "source": edit.source,
            "target": targets[0] if targets else edit.target,
            "answers": [[one, scene.edited(title, of).content_hash] for one, of in answers],
        }
