"""Cameras, spheres and planes whose views have a closed form, in float64."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera

Array = npt.NDArray[np.float64]


def orbit(
    yaw: float,
    *,
    size: int = 64,
    distance: float = 4.0,
    fov: float = 45.0,
    height: float = 0.0,
    width: int | None = None,
) -> Camera:
    """A camera on a circle around the origin, looking at the origin.

    Args:
        yaw: degrees.
        size: height of the image in px, and its width unless ``width`` is given.
        distance: distance of the circle's radius, in scene units.
        fov: vertical, degrees.
        height: above the circle's plane, in scene units.
        width: width of the image in px.
    """
    angle = np.radians(yaw)
    position = (distance * np.cos(angle), distance * np.sin(angle), height)
    return Camera.look_at(position, (0, 0, 0), width=width or size, height=size, fov_y=fov)


def plane_depth(camera: Camera, normal: Sequence[float], offset: float) -> Array:
    """(H, W) depth of the plane normal . X = offset; NaN behind the camera."""
    rays = camera.directions() @ camera.rotation
    with np.errstate(divide="ignore"):
        z = (offset - np.dot(normal, camera.position)) / (rays @ np.asarray(normal, float))
    return np.where(z > 0, z, np.nan)


def sphere(camera: Camera, radius: float = 1.0) -> tuple[Array, Array]:
    """(H, W) depth and (H, W, 3) outward normals of a sphere at the origin, NaN outside."""
    rays = camera.directions() @ camera.rotation
    length = np.linalg.norm(rays, axis=-1)
    unit = rays / length[..., None]
    along = unit @ camera.position
    # r^2 - |oc - (oc.d) d|^2 keeps its digits at the outline, where b^2 - c does not.
    half = radius**2 - ((camera.position - along[..., None] * unit) ** 2).sum(-1)
    t = np.where(half > 0, -along - np.sqrt(np.maximum(half, 0)), np.nan)
    return t / length, (camera.position + t[..., None] * unit) / radius
