"""Parts of the 3D view in a PyVista plotter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp import Camera
from attnwarp_eval.inspect.pair import Image
from attnwarp_eval.inspect.scene import Part, as_bytes, frustum, frustum_depth
from attnwarp_eval.inspect.subject import Subject

if TYPE_CHECKING:
    import pyvista

VIEW_ANGLE = 30.0
"""Height of the view from outside, in degrees."""

FILLED = 0.8
"""Largest share of that view for the frusta; the sliders are below."""


def add_part(plotter: Any, part: Part) -> Any:
    """Draw a part, replacing the part of the same name; return the actor."""
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


def add_lighter(plotter: Any, name: str, mesh: pyvista.PolyData) -> Any:
    """Draw a part's simplified version for moving views; return the actor, hidden."""
    actor = plotter.add_mesh(
        mesh,
        scalars="colors",
        rgb=True,
        lighting=False,
        point_size=3,
        copy_mesh=False,
        reset_camera=False,
        pickable=False,
        name=f"moving {name}",
    )
    actor.visibility = False
    return actor


def texture(image: Image) -> pyvista.Texture:
    """A texture of an (H, W, 3) sRGB picture in [0, 1]."""
    import pyvista

    return pyvista.Texture(np.ascontiguousarray(as_bytes(image)))


def outside(
    subject: Subject, cameras: tuple[Camera, Camera], aspect: float = 1.0
) -> list[npt.NDArray[np.float64]]:
    """Position, focal point and upward axis of a view of the scene and of two cameras.

    Args:
        subject: subject with the centre of the view.
        cameras: source and target; their frusta are wholly in view, above the sliders.
        aspect: width by height of the view, which is :data:`VIEW_ANGLE` degrees high.
    """
    center, up = subject.center, subject.up
    eyes = np.stack([camera.position for camera in cameras]) - center
    away = eyes.mean(0)
    if np.linalg.norm(away) <= 0.3 * np.linalg.norm(eyes[0]):
        away = np.cross(eyes[0], up)
    direction = away / max(float(np.linalg.norm(away)), 1e-12) + 0.5 * up
    direction /= np.linalg.norm(direction)
    right = np.cross(up, direction)
    right /= max(float(np.linalg.norm(right)), 1e-12)
    reach = frustum_depth(subject, cameras[0])
    points = np.vstack([center, *(frustum(camera, reach)[0].points for camera in cameras)])
    # Columns: right, up, toward the viewer.
    axes = np.stack([right, np.cross(direction, right), direction], axis=1)
    local = (points - center) @ axes
    middle = (local.min(axis=0) + local.max(axis=0)) / 2 * [1, 1, 0]
    across, along, toward = (local - middle).T
    # A point's distance from the viewer is the viewer's distance from the middle, minus its depth.
    slope = FILLED * np.tan(np.radians(VIEW_ANGLE / 2))
    distance = (np.maximum(abs(across) / aspect, abs(along)) / slope + toward).max()
    focus = center + axes @ middle
    return [focus + distance * direction, focus, up]
