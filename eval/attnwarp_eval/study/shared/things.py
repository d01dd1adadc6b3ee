"""The thing of a scene: the objects with distinct parts."""

from __future__ import annotations

from pydantic import Field

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.schema import Part, Study, StudyError, did_you_mean


class ThingsPart(Part):
    """Keys of a study: by scene, the names of the objects that make up the thing.

    The default is the objects of the scene's first edit with several right answers.
    """

    things: dict[str, list[str]] = Field(default_factory=dict)


def thing_of(study: Study, scene: Scene) -> list[str]:
    """Names of the objects that make up a scene's thing.

    Raises:
        StudyError: an object that the scene lacks, or a scene without both objects and such an
            edit.
    """
    named = study.part(ThingsPart).things.get(scene.name)
    if named is None:
        edit = next((edit for edit in scene.edits if edit.ambiguous), None)
        if edit is None:
            raise StudyError(
                f"things: scene {scene.name!r} has no edit with several answers; name the objects"
                f" of its thing in things.{scene.name}"
            )
        return [change.object for change in edit.answers[0].changes]
    for name in named:
        if name not in scene.object_names:
            near = did_you_mean(name, scene.object_names)
            raise StudyError(f"things.{scene.name}: no object {name!r}{near}")
    if not named:
        raise StudyError(f"things.{scene.name}: names no object, expected at least one")
    return list(named)
