"""Pictures of random worlds by ray casting: every look of a world from one set of rays.

Direct light of sun and sky on the surfaces, as in :mod:`attnwarp_eval.truth.shading`, and one reflection on
shiny and metal surfaces. About twenty pictures a second; Mitsuba, which renders a share of the data, makes five.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from attnwarp_eval.colors import to_srgb
from attnwarp_eval.drawn.worlds import FINISHES, Look
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import SceneSpec, SkySpec, SunSpec
from attnwarp_eval.scene.textures import albedo
from attnwarp_eval.truth import Geometry
from attnwarp_eval.truth.raycast import Hits
from attnwarp_eval.truth.shading import hemisphere, sky_radiance, sun_direction
from training.worlds.draw import World

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

SKY_RAYS = 12
"""Toward the sky from each point, shared by all looks. Their error is noise, which training may see."""

REFLECTANCE = {"golden": (1.0, 0.77, 0.34), "silver": (0.96, 0.96, 0.95), "bronze": (0.75, 0.44, 0.25)}
"""At normal incidence, linear (measured metals, bronze with the tint that scenes give it)."""


def pictures(world: World, looks: Sequence[Look], size: int, *, view: int = 0) -> tuple[list[Image], Hits]:
    """One view of a world in several looks.

    Args:
        looks: how; geometry is traced once for all of them.
        size: width and height in pixels.

    Returns:
        (size, size, 3) sRGB pictures, and what the rays hit.
    """
    scenes = [world.scene(look, size) for look in looks]
    # Details have their colours in the shape; a statue's look leaves them out when it is shaded.
    geometry = Geometry(Scene(SceneSpec.model_validate(world.spec(looks[0], size, statue=False))))
    camera = scenes[0].cameras[view]
    hits = geometry.trace(camera)
    hit = hits.valid
    points, normals, ids = hits.point[hit], hits.normal[hit], hits.primitive_id[hit]
    directions = camera.directions() @ camera.rotation
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    sky_rays = [(d, geometry.reached(points + 2 * geometry.extent * d, points, ids)) for d in hemisphere(normals, SKY_RAYS)]
    count = len(world.surfaces(looks[0]))
    mirrored = _mirrored(geometry, points, normals, directions[hit], ids, count)
    out = []
    for scene, look in zip(scenes, looks, strict=True):
        radiance = _sky(scene, directions.reshape(-1, 3)).reshape(*hit.shape, 3)
        surfaces = world.surfaces(look)
        radiance[hit] = _radiance(scene, surfaces, geometry, points, normals, ids, directions[hit], sky_rays, mirrored)
        out.append(np.rint(255 * to_srgb(radiance)).astype(np.uint8))
    return out, hits


def _mirrored(
    geometry: Geometry, points: Array, normals: Array, directions: Array, ids: npt.NDArray[np.int64], count: int
) -> tuple[Array, npt.NDArray[np.int64], Array, Array, npt.NDArray[np.int64]]:
    """Mirror rays of the first ``count`` objects: direction, index of the point, and the point and normal that each hits."""
    on_object = np.flatnonzero(geometry.object_of(ids) < count)
    d, n = directions[on_object], normals[on_object]
    away = d - 2 * np.einsum("ij,ij->i", d, n)[:, None] * n
    reflected_hits = geometry.trace_rays(points[on_object] + 1e-4 * geometry.extent * n, away)
    hit = np.isfinite(reflected_hits.point).all(axis=-1)
    return away, on_object, reflected_hits.point[hit], reflected_hits.normal[hit], np.where(hit, np.cumsum(hit) - 1, -1)


def light_on(
    scene: Scene, geometry: Geometry, points: Array, normals: Array, ids: npt.NDArray[np.int64],
    sky_rays: list[tuple[Array, npt.NDArray[np.bool_]]],
) -> Array:  # fmt: skip
    """(N, 3) irradiance of points: sun and sky."""
    light = np.zeros((len(points), 3))
    for spec in scene.spec.lights:
        if isinstance(spec, SunSpec):
            toward = sun_direction(spec)
            cosine = normals @ toward
            facing = np.flatnonzero(cosine > 0)
            facing = facing[geometry.reached(points[facing] + 2 * geometry.extent * toward, points[facing], ids[facing])]
            light[facing] += cosine[facing, None] * spec.irradiance * np.array(linear_rgb(spec.color))
    for direction, reached in sky_rays:
        light += np.where(reached[:, None], _sky(scene, direction), 0) * (np.pi / len(sky_rays))
    return light


def _radiance(
    scene: Scene, surfaces: tuple[Look, ...], geometry: Geometry, points: Array, normals: Array, ids: npt.NDArray[np.int64],
    directions: Array, sky_rays: list[tuple[Array, npt.NDArray[np.bool_]]],
    mirrored: tuple[Array, npt.NDArray[np.int64], Array, Array, npt.NDArray[np.int64]],
) -> Array:  # fmt: skip
    color = _albedo(scene, surfaces, geometry, points, ids)
    light = light_on(scene, geometry, points, normals, ids, sky_rays)
    radiance = color * light / np.pi
    for k, surface in enumerate(surfaces):
        if FINISHES[surface.finish] == "shiny" or FINISHES[surface.finish] in REFLECTANCE:
            _reflect(radiance, k, len(surfaces), surface, scene, geometry, normals, ids, directions, light, mirrored)
    return radiance


def _reflect(
    radiance: Array, which: int, count: int, surface: Look, scene: Scene, geometry: Geometry, normals: Array,
    ids: npt.NDArray[np.int64], directions: Array, light: Array,
    mirrored: tuple[Array, npt.NDArray[np.int64], Array, Array, npt.NDArray[np.int64]],
) -> None:  # fmt: skip
    """Add one reflection to an object's radiance, in place; ``count`` objects come before the ground."""
    away, on_objects, reflected_points, _, index = mirrored
    chosen = geometry.object_of(ids[on_objects]) == which
    away, on_object, index = away[chosen], on_objects[chosen], index[chosen]
    # Surfaces in a reflection get an even light: their shadows are not traced.
    ambient = _sky(scene, np.array([[0.0, 0.0, 1.0]]))[0] * 0.6 + _sun(scene) * 0.25
    reflected = _sky(scene, away) + _glint(scene, away, surface)
    hit = index >= 0
    if hit.any():
        ground = np.array([linear_rgb(c) for c in scene.spec.objects[count].texture.colors]).mean(axis=0)  # type: ignore[union-attr]
        low = reflected_points[index[hit]][:, 2:3] < 1e-3
        reflected[hit] = np.where(low, ground, 0.25) * ambient
    cosine = np.clip(-np.einsum("ij,ij->i", directions[on_object], normals[on_object]), 0, 1)[:, None]
    if FINISHES[surface.finish] == "shiny":
        base = np.full(3, 0.04)
        fresnel = base + (1 - base) * (1 - cosine) ** 5
        radiance[on_object] = (1 - fresnel) * radiance[on_object] + fresnel * reflected
        return
    base = np.array(REFLECTANCE[FINISHES[surface.finish]])
    fresnel = base + (1 - base) * (1 - cosine) ** 5
    # A rough metal scatters some of the light about it, which the mirror ray alone would miss.
    radiance[on_object] = fresnel * (0.65 * reflected + 0.35 * light[on_object] / np.pi)


def _albedo(scene: Scene, surfaces: tuple[Look, ...], geometry: Geometry, points: Array, ids: npt.NDArray[np.int64]) -> Array:
    objects = geometry.object_of(ids)
    color = np.zeros((len(points), 3))
    for k, item in enumerate(scene.spec.objects):
        on_object = objects == k
        if on_object.any():
            color[on_object] = albedo(item.texture, points[on_object])
    tint = geometry.tint(points, ids)
    # Details have colours of their own; of a thing in one piece, a statue's have none.
    return color if len(surfaces) == 1 and surfaces[0].statue else color * tint


def _sky(scene: Scene, directions: Array) -> Array:
    total = np.zeros((len(directions), 3))
    for spec in scene.spec.lights:
        if isinstance(spec, SkySpec):
            total += sky_radiance(spec, directions)
    return total


def _sun(scene: Scene) -> Array:
    suns = [s for s in scene.spec.lights if isinstance(s, SunSpec)]
    return sum((s.irradiance * np.array(linear_rgb(s.color)) for s in suns), np.zeros(3)) / np.pi


def _glint(scene: Scene, away: Array, look: Look) -> Array:
    """The sun in a rough mirror: a lobe as wide as the roughness, with the sun's irradiance in it."""
    total = np.zeros((len(away), 3))
    width = 0.1 if FINISHES[look.finish] == "shiny" else 0.25
    for spec in scene.spec.lights:
        if isinstance(spec, SunSpec):
            angle = 1 - away @ sun_direction(spec)
            lobe = np.exp(-2 * angle / width**2) / (np.pi * width**2)
            total += lobe[:, None] * spec.irradiance * np.array(linear_rgb(spec.color))
    return total
