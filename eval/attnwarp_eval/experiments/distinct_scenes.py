"""Scenes of a table whose rows, cells and pictures are named by scene."""

from __future__ import annotations

from collections.abc import Sequence

from attnwarp.errors import InputError
from attnwarp_eval.scene.scene import Scene


def distinct_scenes(names: Sequence[str]) -> list[Scene]:
    """Load scenes by name or path; their names are distinct, and a repeated one is loaded once.

    Raises:
        InputError: a scene that cannot be used, or two scenes with the same name.
    """
    from attnwarp_eval.scene.file import load_scene

    first: dict[str, tuple[str, Scene]] = {}
    for path in names:
        scene = load_scene(path)
        other, same = first.setdefault(scene.name, (path, scene))
        if same.content_hash != scene.content_hash:
            raise InputError(
                f"{other} and {path}: two scenes have the name {scene.name!r}, expected one of"
                " each name in a table; rename one of them"
            )
    return [scene for _, scene in first.values()]
