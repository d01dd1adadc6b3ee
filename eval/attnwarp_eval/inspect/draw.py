"""Parts of the 3D view in a PyVista plotter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from attnwarp import Camera
from attnwarp_eval.inspect.pair import Image
from attnwarp_eval.inspect.scene import Part, as_bytes
from attnwarp_eval.inspect.subject import Subject

if TYPE_CHECKING:
    import pyvista


def add_part(plotter: Any, part: Part) -> Any:
    """Draw a part, in place of the one of its name; the actor is returned."""
    how: dict[str, Any] = {"color": part.color}
    if part.picture is not None:
        how = {"texture": texture(part.picture())}
    elif part.color is None:
        how = {"scalars": "colors", "rgb": True}
    return plotter.add_mesh(
        part.mesh(),
        **how,
        opacity=part.opacity,
        lighting=part.name == "whole surface",
        line_width=3,
        point_size=14,
        render_points_as_spheres=True,
        copy_mesh=False,
        reset_camera=False,
        pickable=part.name == "seen",
        name=part.name,
    )


def texture(image: Image) -> pyvista.Texture:
    """A texture of an (H, W, 3) sRGB picture in [0, 1]."""
    import pyvista

    return pyvista.Texture(np.ascontiguousarray(as_bytes(image)))


def outside(subject: Subject, cameras: tuple[Camera, Camera]) -> list[Any]:
    """Position, focal point and upward axis of a view of the scene and of two cameras."""
    center, up = subject.center, subject.up
    eyes = np.stack([camera.position for camera in cameras]) - center
    away = eyes.mean(0)
    if np.linalg.norm(away) <= 0.3 * np.linalg.norm(eyes[0]):
        away = np.cross(eyes[0], up)
    reach = np.linalg.norm(eyes, axis=1).max()
    direction = away / max(float(np.linalg.norm(away)), 1e-12) + 0.5 * up
    return [center + 2.1 * reach * direction / np.linalg.norm(direction), center, up]
