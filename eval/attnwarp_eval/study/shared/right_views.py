"""True pictures of an edit, of which consistency metrics see sets that are right and sets with a
flaw.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.metrics.arrays import Array, Mask
from attnwarp_eval.scene.edits import changed as changed_object
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.materials import MetalMaterial
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import ObjectChange
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.edit_truth import answers_of
from attnwarp_eval.study.flaws import Edited
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study, StudyError
from attnwarp_eval.study.shared.encoders import MetricsProbe
from attnwarp_eval.truth import appearance
from attnwarp_eval.truth.edits import edit_mask, touched
from attnwarp_eval.two_view import Hits, TwoView
from attnwarp_eval.world import World, changed, turned

RIGHT = ("right", "right_other")
"""Right pairs without highlights: one answer in both views, and another one in both."""

VARNISHED, METAL = TRAPS = ("right_varnished", "right_metal")
"""Right pairs that truly differ: the object's paint lies under a coat, which shows highlights, or
the object is of rough metal without paint, which shows its surroundings everywhere."""

PAIRS = (*RIGHT, *TRAPS)

ROUGH = MetalMaterial(type="metal", metal="Al", roughness=0.3)

ROUGH_SAMPLES = 2
"""Samples of metal for each of paint: what it reflects of lamps is rare and bright, and the noise
of as few would be taken for disagreement."""

COAT = 0.04
"""Share of light that a coat of refractive index 1.5 reflects where it is seen straight on."""


def cells_of_edit(
    probe: MetricsProbe, study: Study, scenes: Mapping[str, Scene], edit: str, own: Json,
    sources: Mapping[str, str] | None = None,
) -> Iterator[Cell]:  # fmt: skip
    """One cell for each scene and seed. The next scene gives the pictures of another scene.

    Args:
        probe: its name is the study's key under which ``edit`` stands.
        edit: one with at least two answers.
        own: further inputs that decide the probe's numbers.
        sources: sources of the cells, beside the other scene's file.

    Raises:
        StudyError: a scene has no such edit.
    """
    files = dict(zip(study.scene_names, study.scenes, strict=True))
    order = list(scenes)
    for place, (name, scene) in enumerate(scenes.items()):
        answers = _two_answers(scene, edit, f"{probe.name}.edit")
        other = order[(place + 1) % len(order)]
        for seed in study.seeds:
            spec = {
                "probe": probe.name,
                "protocol": probe.protocol,
                "scene": scene.content_hash,
                "other": scenes[other].content_hash if other != name else None,
                "size": study.size,
                "seed": seed,
                "spp": study.spp,
                "edit": edit,
                "answers": answers,
                **own,
            }
            yield Cell(
                spec, name, "metrics", probe.name, seed, ("metrics",),
                sources={**(sources or {}), "other": files[other]},
            )  # fmt: skip


def _two_answers(scene: Scene, edit: str, key: str) -> list[list[str]]:
    """Names and contents of an edit's first two answers.

    Raises:
        StudyError: a scene has no such edit; ``key`` is the study's that names it.
    """
    names = {one.name for one in scene.edits}
    answers = answers_of(scene, edit) if edit in names else []
    if len(answers) < 2:
        raise StudyError(
            f"{key}: scene {scene.name!r} has no edit {edit!r} with two answers; there are"
            f" {', '.join(one.name for one in scene.edits if one.answers) or 'none'}"
        )
    return [[name, scene.edited(edit, answer).content_hash] for name, answer in answers[:2]]


def true_pictures(work: Work) -> tuple[list[Camera], dict[str, dict[str, Array]]]:
    """Cameras of the cell's yaws, which are added to its world, and pictures from them.

    Returns:
        The cameras, and (H, W, 3) sRGB by state of the scene and name of the view, the source's
        too. States are "before" the edit, those of :data:`PAIRS`, and "elsewhere", another scene,
        where the cell's spec names one.
    """
    spec, world = work.spec, work.world
    cameras = {yaw: turned(world.scene, yaw) for yaw in spec["yaws"]}
    for camera in cameras.values():
        world.add(camera)
    views = [world.source, *cameras.values()]
    edit = spec["edit"]
    for name, content in spec["answers"]:
        if world.edited_hash(edit, name) != content:
            raise changed(f"edit {edit!r} of scene {world.scene.name!r}")
    first, second = (world.scene.edited(edit, name) for name, _ in spec["answers"])
    states = {"before": world.scene, "right": first, "right_other": second}
    states[METAL] = _metallic(first, touched(world.scene, edit, spec["answers"][0][0]))
    if spec["other"] is not None:
        other = load_scene(work.cell.sources["other"])
        if other.content_hash != spec["other"]:
            raise changed(f"scene {other.name!r}")
        states["elsewhere"] = other.with_size(spec["size"], spec["size"])
    # Scene by scene: Mitsuba caches the last one, and loading costs more than rendering.
    light: dict[str, dict[str, Array]] = {
        state: {
            camera.name: appearance(
                scene,
                turned(scene, yaw) if state == "elsewhere" else camera,
                spp=spec["spp"] * (ROUGH_SAMPLES if state == METAL else 1),
                seed=0,
            ).astype(np.float64)
            for yaw, camera in zip((0.0, *cameras), views, strict=True)
        }
        for state, scene in states.items()
    }
    light[VARNISHED] = {
        camera.name: varnished(
            light["right"][camera.name],
            light[METAL][camera.name],
            hits := world.geometry.trace(camera),
            edit_mask(world.scene, edit, hits, spec["answers"][0][0]),
        )
        for camera in views
    }
    return views[1:], {
        state: {name: to_srgb(np.clip(one, 0, 1)) for name, one in pictures.items()}
        for state, pictures in light.items()
    }


def varnished(paint: Array, metal: Array, hits: Hits, mask: Mask) -> Array:
    """(H, W, 3) linear light of an object's paint under a rough clear coat.

    The coat reflects what rough metal does, by the share that Schlick's formula gives, and lets the
    rest through to the paint.
    """
    share = np.where(mask, COAT + (1 - COAT) * (1 - np.nan_to_num(hits.cosine, nan=1)) ** 5, 0)
    return paint + share[..., None] * (metal - paint)


def _metallic(scene: Scene, objects: Sequence[int]) -> Scene:
    """The scene whose objects are of rough metal."""
    items = [
        changed_object(item, ObjectChange(object=item.name, material=ROUGH))
        if place in objects and not item.emission
        else item
        for place, item in enumerate(scene.spec.objects)
    ]
    return Scene(scene.spec.model_copy(update={"objects": tuple(items)}), scene.path)


def edited_target(
    world: World,
    spec: Json,
    pictures: Mapping[str, Mapping[str, Array]],
    camera: Camera,
    truth: TwoView,
) -> Edited:
    """A target of :func:`true_pictures` as flaws take it, with its exact relation to the source."""
    return Edited(
        truth,
        pictures["right"][world.source.name],
        pictures["before"][camera.name],
        pictures["right"][camera.name],
        pictures["right_other"][camera.name],
        edit_mask(world.scene, spec["edit"], truth.hits, spec["answers"][0][0]),
        pictures["elsewhere"][camera.name] if "elsewhere" in pictures else None,
        spec["seed"],
    )
