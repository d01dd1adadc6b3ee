"""True pictures of an edit, from which right and flawed sets are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.metrics.arrays import Array, Mask
from attnwarp_eval.scene.edits import changed as changed_object
from attnwarp_eval.scene.edits import pick
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.materials import MetalMaterial
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import EditSpec, ObjectChange
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import StudyError
from attnwarp_eval.study.shared.edit_truth import answers_of
from attnwarp_eval.truth import appearance, two_view
from attnwarp_eval.truth.edits import edit_mask, touched
from attnwarp_eval.two_view import Hits
from attnwarp_eval.world import World, changed, turned
from attnwarp_lab.ideal.parts import part_labels
from attnwarp_lab.ideal.thing import Thing
from attnwarp_lab.probes.audit.flaws import Edited

RIGHT = ("right", "right_other")
"""Right pairs without highlights: one answer in both views, and another one in both."""

VARNISHED, METAL = TRAPS = ("right_varnished", "right_metal")
"""Right pairs that truly differ: the object's paint lies under a coat, which shows highlights, or
the object is of rough metal without paint, which shows its surroundings everywhere."""

PAIRS = (*RIGHT, *TRAPS)

ROUGH = MetalMaterial(type="metal", metal="Al", roughness=0.3)

ROUGH_SAMPLES = 2
"""Samples of metal for each of paint: its reflections of lamps are rare and bright, and the noise
of fewer samples would look like disagreement."""

COAT = 0.04
"""Share of light that a coat of refractive index 1.5 reflects at normal incidence."""

PARTS = 12
"""Number of the edited object's parts."""

Pictures = Mapping[str, Mapping[str, Array]]
"""State of the scene -> view -> (H, W, 3) sRGB."""


MOST_ANSWERS = 4
"""Number of an edit's answers whose true pictures are rendered."""


def some_answers(scene: Scene, edit: str) -> list[list[str]]:
    """Names and contents of an edit's first answers.

    Raises:
        StudyError: the scene has no such edit.
    """
    names = {one.name for one in scene.edits}
    answers = answers_of(scene, edit) if edit in names else []
    if len(answers) < 2:
        raise StudyError(
            f"audit.edits: scene {scene.name!r} has no edit {edit!r} with two answers; there are"
            f" {', '.join(one.name for one in scene.edits if one.answers) or 'none'}"
        )
    some = answers[:MOST_ANSWERS]
    return [[name, scene.edited(edit, answer).content_hash] for name, answer in some]


def edit_of_others(scene: Scene, edit: str) -> list[str] | None:
    """Name and content of the scene's first edit of other objects; None without one."""
    objects = set(touched(scene, edit))
    for one in scene.edits:
        others = _objects(scene, one)
        if others and not others & objects:
            return [one.name, scene.edited(one.name).content_hash]
    return None


def _objects(scene: Scene, edit: EditSpec) -> set[int]:
    """Objects whose surfaces an edit (its first answer) changes; none for an edit of the light."""
    return set() if (pick(edit) or edit).lights is not None else set(touched(scene, edit.name))


def true_pictures(work: Work) -> tuple[list[Camera], Pictures]:
    """Cameras of the cell's yaws, which are added to its world, and pictures from them.

    Returns:
        The cameras, and (H, W, 3) sRGB by state of the scene and name of the view, the source's
        too. States are "before" the edit, those of :data:`PAIRS`, its further answers by number,
        "misdirected", an edit of other objects, and "elsewhere", another scene, where the cell's
        spec names them.

    Raises:
        InputError: a file has changed since the cell was planned.
    """
    spec, world = work.spec, work.world
    cameras = {yaw: turned(world.scene, yaw) for yaw in spec["yaws"]}
    for camera in cameras.values():
        world.add(camera)
    views = [world.source, *cameras.values()]
    answers = [(spec["edit"], *answer) for answer in spec["answers"]]
    others = [(name, None, content) for name, content in filter(None, [spec["other_edit"]])]
    for edit, answer, content in (*answers, *others):
        if world.edited_hash(edit, answer) != content:
            raise changed(f"edit {edit!r} of scene {world.scene.name!r}")
    edited = [world.scene.edited(edit, answer) for edit, answer, _ in (*answers, *others)]
    named = [*answer_states(spec), "misdirected"]
    states = {"before": world.scene, **dict(zip(named, edited, strict=False))}
    states[METAL] = _metallic(edited[0], touched(world.scene, *answers[0][:2]))
    if spec["other"] is not None:
        neighbour = load_scene(work.cell.sources["other"])
        if neighbour.content_hash != spec["other"]:
            raise changed(f"scene {neighbour.name!r}")
        states["elsewhere"] = neighbour.with_size(spec["size"], spec["size"])
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
            edit_mask(world.scene, spec["edit"], hits, spec["answers"][0][0]),
        )
        for camera in views
    }
    return views[1:], {
        state: {name: to_srgb(np.clip(one, 0, 1)) for name, one in pictures.items()}
        for state, pictures in light.items()
    }


def answer_states(spec: Json) -> list[str]:
    """States of the pictures of each answer, in the order of the spec."""
    return [*RIGHT, *(f"answer {k}" for k in range(2, len(spec["answers"])))]


def answered_thing(
    world: World, spec: Json, pictures: Pictures, cameras: Sequence[Camera]
) -> Thing:
    """The edited object in parts, each in any of the edit's answers.

    Args:
        cameras: cameras of all views, the source first.
    """
    edit, answer = spec["edit"], spec["answers"][0][0]
    points = {}
    for camera in cameras:
        hits = world.geometry.trace(camera)
        mask = edit_mask(world.scene, edit, hits, answer)
        points[camera.name] = np.where(mask[..., None], hits.point, np.nan)
    states = answer_states(spec)

    def shown(state: str, view: str) -> npt.NDArray[np.float32]:
        return pictures[state][view].astype(np.float32)

    return Thing(
        part_labels(points, PARTS),
        {camera.name: shown("before", camera.name) for camera in cameras},
        {c.name: np.stack([shown(state, c.name) for state in states]) for c in cameras},
        PARTS,
    )


def ideal_thing(
    world: World, edit: str, spp: int, cameras: tuple[Camera, ...], parts: int, colors: int
) -> Thing:
    """The edited object in parts and colours that the ideal editor chooses equally often."""
    answers = world.scene.edit(edit).answers
    objects = [world.scene.object_names[one] for one in touched(world.scene, edit, answers[0].name)]
    return Thing.of(
        world.scene, world.geometry, cameras, objects, parts=parts, colors=colors, spp=spp
    )


def varnished(paint: Array, metal: Array, hits: Hits, mask: Mask) -> Array:
    """(H, W, 3) linear light of an object's paint under a rough clear coat.

    The coat reflects like rough metal, by the share of Schlick's formula, and transmits the rest to
    the paint.
    """
    share = np.where(mask, COAT + (1 - COAT) * (1 - np.nan_to_num(hits.cosine, nan=1)) ** 5, 0)
    return paint + share[..., None] * (metal - paint)


def _metallic(scene: Scene, objects: Sequence[int]) -> Scene:
    """The scene with some objects in rough metal."""
    items = [
        changed_object(item, ObjectChange(object=item.name, material=ROUGH))
        if place in objects and not item.emission
        else item
        for place, item in enumerate(scene.spec.objects)
    ]
    return Scene(scene.spec.model_copy(update={"objects": tuple(items)}), scene.path)


def edited_view(
    world: World, spec: Json, pictures: Pictures, camera: Camera, place: int = 0
) -> Edited:
    """A view of :func:`true_pictures` as input of flaws, with its exact relation to the source.

    Args:
        world: the cell's world.
        spec: the cell's spec.
        pictures: pictures by state and view.
        camera: camera of the view.
        place: number of the view, 0 for the source.
    """
    if place:
        truth = world.pair(camera.name, spec["size"])
    else:
        truth = two_view(world.geometry, camera, camera)
    name = camera.name
    return Edited(
        pair=truth,
        source=pictures["right"][world.source.name],
        before=pictures["before"][name],
        after=pictures["right"][name],
        another=pictures["right_other"][name],
        mask=edit_mask(world.scene, spec["edit"], truth.hits, spec["answers"][0][0]),
        elsewhere=pictures.get("elsewhere", {}).get(name),
        misdirected=pictures.get("misdirected", {}).get(name),
        seed=spec["seed"],
        place=place,
    )
