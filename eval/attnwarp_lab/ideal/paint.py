"""Answers of the ideal editor: a thing painted in one of several colours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from attnwarp_eval.scene.edits import apply
from attnwarp_eval.scene.materials import TEXTURED, DiffuseMaterial
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import EditSpec, ObjectChange
from attnwarp_eval.scene.textures import Plain

EDIT = "Paint its parts"
"""Words of the edit."""

LIGHTNESS, CHROMA = 62.0, 30.0
"""CIELAB of the colours: hues at equal angles, all within sRGB, all equally far from their mean. An
answer nearer to the mean would come more often."""


def answer_colors(count: int) -> list[str]:
    """Colours as #rrggbb, their hues at equal angles.

    Args:
        count: at least 1.

    Raises:
        ValueError: fewer than 1.

    Example:
        >>> answer_colors(2)
        ['#a89460', '#7298cb']
    """
    from skimage.color import lab2rgb

    if count < 1:
        raise ValueError(f"colors: got {count}, expected at least 1")
    colors = []
    for k in range(count):
        angle = math.tau * (k + 0.5) / count
        lab = [LIGHTNESS, CHROMA * math.cos(angle), CHROMA * math.sin(angle)]
        rgb = lab2rgb(np.array([[lab]]))[0, 0]
        colors.append("#" + "".join(f"{round(255 * float(c)):02x}" for c in rgb))
    return colors


def painted(scene: Scene, objects: Sequence[str], color: str) -> Scene:
    """The scene with some objects in shades of one colour.

    Materials without texture, such as metal and glass, become matt.

    Args:
        color: as #rrggbb.

    Raises:
        ValueError: no such object, or a lamp.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> red = painted(load_scene("spheres"), ["melon"], "#c04040")
        >>> red.content_hash == load_scene("spheres").content_hash
        False
    """
    edit = EditSpec(
        name="parts",
        instruction=EDIT,
        source=f"a photo of {scene.name}",
        target=f"a photo of {scene.name} in colours",
        changes=tuple(_change(scene, name, color) for name in objects),
    )
    return Scene(apply(scene.spec, edit), scene.path)


def _change(scene: Scene, name: str, color: str) -> ObjectChange:
    items = {item.name: item for item in scene.spec.objects}
    if name not in items or isinstance(items[name].material, TEXTURED):
        return ObjectChange(object=name, paint=color)
    return ObjectChange(
        object=name, material=DiffuseMaterial(), texture=Plain(color=color, variation=0.0)
    )
