"""Direct light on diffuse surfaces, by ray casting: what a surface point looks like from anywhere that sees it.

For a diffuse surface under the sun and the sky without interreflection the outgoing radiance is
albedo / pi * (E_sun max(0, n.s) V + integral of the sky's radiance times cosine over the free part of the hemisphere),
the same in every direction. Mitsuba's pictures of such scenes converge to it, which the tests check.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from attnwarp_eval.textures import albedo, linear_rgb
from attnwarp_eval.truth.raycast import Geometry

if TYPE_CHECKING:
    from attnwarp_eval.scene import Scene, SkySpec, SunSpec

Array = npt.NDArray[np.float64]


def sun_direction(sun: SunSpec) -> Array:
    """(3,) unit vector toward the sun; azimuth counts from +x toward +y."""
    e, a = math.radians(sun.elevation), math.radians(sun.azimuth)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def sky_radiance(sky: SkySpec, directions: npt.ArrayLike) -> Array:
    """(..., 3) linear radiance from unit ``directions`` (..., 3): horizon to zenith with the sine of the elevation.

    Below the horizon the sky keeps its horizon's colour.
    """
    z = np.clip(np.asarray(directions)[..., 2:3], 0, 1)
    return sky.radiance * (np.array(linear_rgb(sky.horizon)) * (1 - z) + np.array(linear_rgb(sky.zenith)) * z)


def object_albedo(scene: Scene, geometry: Geometry, points: Array, primitive_id: npt.NDArray[np.int64]) -> Array:
    """(N, 3) linear albedo of surface points, from their objects' textures and tints."""
    objects = geometry.object_of(primitive_id)
    color = np.zeros((len(points), 3))
    for k, item in enumerate(scene.spec.objects):
        mine = objects == k
        if mine.any():
            color[mine] = albedo(item.texture, points[mine])
    return color * geometry.tint(points, primitive_id)


def irradiance(
    scene: Scene, geometry: Geometry, points: Array, normals: Array, primitive_id: npt.NDArray[np.int64], rays: int = 64
) -> Array:
    """(N, 3) direct irradiance at surface points, on the side that ``normals`` point to.

    Args:
        points, normals: (N, 3) world, normals unit.
        primitive_id: (N,) what each point lies on.
        rays: directions toward the sky a point (a rotated Hammersley set, cosine-weighted). The standard error at 64
            is about 2 % of the sky's share for a half-covered point, 0 for a free one under a uniform sky.
    """
    from attnwarp_eval.scene import SkySpec, SunSpec

    total = np.zeros((len(points), 3))
    for light in scene.spec.lights:
        if isinstance(light, SunSpec):
            toward = sun_direction(light)
            cosine = normals @ toward
            lit = np.flatnonzero(cosine > 0)
            # From outside the scene to the point, as everywhere: no offset from the surface is needed.
            eyes = points[lit] + 2 * geometry.extent * toward
            lit = lit[geometry.reached(eyes, points[lit], primitive_id[lit])]
            total[lit] += cosine[lit, None] * light.irradiance * np.array(linear_rgb(light.color))
        elif isinstance(light, SkySpec):
            total += _sky_irradiance(light, geometry, points, normals, primitive_id, rays)
    return total


def _sky_irradiance(
    sky: SkySpec, geometry: Geometry, points: Array, normals: Array, primitive_id: npt.NDArray[np.int64], rays: int
) -> Array:
    k = np.arange(rays)
    radical = np.array([int(f"{i:032b}"[::-1], 2) / 2**32 for i in k])
    tangent, bitangent = frames(normals)
    # One rotation a point (golden-ratio sequence) turns the shared pattern's bias into noise.
    turn = (np.arange(len(points)) * 0.6180339887498949) % 1.0
    total = np.zeros((len(points), 3))
    for i in k:
        r, phi = math.sqrt((i + 0.5) / rays), 2 * np.pi * (radical[i] + turn)
        x, y, z = r * np.cos(phi), r * np.sin(phi), math.sqrt(1 - (i + 0.5) / rays)
        direction = x[:, None] * tangent + y[:, None] * bitangent + z * normals
        free = geometry.reached(points + 2 * geometry.extent * direction, points, primitive_id)
        total[free] += sky_radiance(sky, direction[free])
    return total * (np.pi / rays)


def frames(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors perpendicular to each normal and to each other, t x b = n.

    The construction of Duff et al. 2017, which has no singular direction.

    Args:
        normals: (N, 3) unit.

    Returns:
        tangent, bitangent: (N, 3).
    """
    x, y, z = normals.T
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (
        np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1),
        np.stack([b, sign + y * y * a, -y], axis=-1),
    )
