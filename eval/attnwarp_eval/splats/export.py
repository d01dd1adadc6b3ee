"""Export of a scene as a data set for fits: cameras around it, true pictures, first points; as
arrays or as a folder."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.fit.views import HELD_OUT_EVERY
from attnwarp.gaussians import SH_C0
from attnwarp.io.file import inside
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.scene import Scene, SceneError
from attnwarp_eval.scene.spec import SkySpec
from attnwarp_eval.splats.surface import surface_splats
from attnwarp_eval.truth import Geometry, appearance
from attnwarp_eval.truth.shading import sky_radiance

if TYPE_CHECKING:
    from attnwarp.io import Dataset

Array = npt.NDArray[np.float64]

SKY_SHARE = 0.1
"""Share of the first points that represent the sky, if a scene has one."""

SKY_DISTANCE = 4.0
"""Distance of those points from the scene's centre, in radii of the orbit: behind the whole
scene.
"""

RINGS = 5
"""Heights of the orbits. Coprime to 8, so that held-out views are spread over them."""


@dataclass(frozen=True, eq=False)
class FirstPoints:
    """A rough point cloud, as from structure from motion.

    Attributes:
        points: (P, 3) float64 world coordinates.
        colors: (P, 3) uint8 sRGB.
    """

    points: Array
    colors: npt.NDArray[np.uint8]


def orbit(scene: Scene, count: int, size: int | None = None) -> list[Camera]:
    """Cameras all around a scene, at the radius of its cameras and at five heights that span
    theirs.

    Yaws are evenly spaced. Each camera lies two rings above the one before, modulo the rings.

    Args:
        size: height and width of their images in px; by default the scene's.

    Raises:
        SceneError: a camera would be inside an object; the message names both.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> cameras = orbit(load_scene("spheres"), 8, size=32)
        >>> len(cameras), cameras[0].width
        (8, 32)
    """
    if count < 1:
        raise ValueError(f"count: got {count}, expected at least 1")
    spec = scene.spec.cameras
    width, height = (size, size) if size else spec.size
    heights = [camera.position[2] for camera in scene.cameras]
    low, high = min(heights), max(heights)
    solids = [(shape, scene.object_names[shape.object_id]) for shape in scene.shapes()]
    cameras = []
    for k in range(count):
        yaw = 2 * math.pi * k / count
        z = low + (high - low) * (2 * k % RINGS) / (RINGS - 1)
        x = spec.look_at[0] + spec.radius * math.cos(yaw)
        y = spec.look_at[1] + spec.radius * math.sin(yaw)
        name = orbit_name(k, count)
        camera = Camera.look_at(
            (x, y, z), spec.look_at, width=width, height=height, fov_y=spec.fov, name=name
        )
        for solid, owner in solids:
            if solid.contains(camera.position):
                position = ", ".join(f"{v:.4g}" for v in camera.position)
                raise SceneError(
                    f"{name} at ({position}) would be inside the object {owner!r}; change"
                    " cameras.radius"
                )
        cameras.append(camera)
    return cameras


EXPORTED = re.compile(r"orbit_\d+_of_\d+\.png")
"""Pictures of an export: its cameras' names are of :func:`orbit_name`."""


def orbit_name(index: int, count: int) -> str:
    """Name of a camera of :func:`orbit`; its digits are as many as the count of cameras needs.

    Example:
        >>> orbit_name(0, 64) == orbit_name(1, 64)
        False
    """
    return f"orbit_{index:03d}_of_{count}"


def held_out(count: int) -> list[bool]:
    """Flags of ``count`` views, True where held out: the first of every eight.

    Example:
        >>> [index for index, held in enumerate(held_out(20)) if held]
        [0, 8, 16]
    """
    return [k % HELD_OUT_EVERY == 0 for k in range(count)]


def held_out_names(count: int) -> list[str]:
    """Names of the cameras of :func:`orbit` that are held out.

    Example:
        >>> held_out_names(16) == [orbit_name(0, 16), orbit_name(8, 16)]
        True
    """
    return [orbit_name(k, count) for k, out in enumerate(held_out(count)) if out]


def first_points(
    scene: Scene, count: int, *, noise: float = 0.5, seed: int = 0, geometry: Geometry | None = None
) -> FirstPoints:
    """Points on the scene's surfaces, displaced at random, with their true colours.

    Where the scene has a sky, a tenth of them lie on the upper half of a sphere around everything,
    in the sky's colours.

    Args:
        count: number of points, at least 10.
        noise: standard deviation of the displacement along each axis, in local spacings of the
            points.
        seed: seed of the sampling and the noise.
        geometry: ``Geometry(scene)``, if already available.

    Raises:
        ValueError: a count below 10.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> scene = load_scene("spheres")
        >>> again = first_points(scene, 20, seed=3).points == first_points(scene, 20, seed=3).points
        >>> bool(again.all())
        True
    """
    if count < 10:
        raise ValueError(f"count: got {count}, expected at least 10")
    sky = next((light for light in scene.spec.lights if isinstance(light, SkySpec)), None)
    above = round(SKY_SHARE * count) if sky is not None else 0
    splats = surface_splats(
        scene, "2d", count - above, position_noise=noise, seed=seed, geometry=geometry
    )
    points = splats.world_means()
    colors = splats.sh[:, 0].numpy().astype(np.float64) * SH_C0 + 0.5
    if sky is not None:
        # Fibonacci's spiral over the upper half.
        k = np.arange(above) + 0.5
        z, turn = k / above, k * math.pi * (3 - math.sqrt(5))
        r = np.sqrt(1 - z * z)
        up = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)
        points = np.concatenate(
            [points, scene.center + SKY_DISTANCE * scene.spec.cameras.radius * up]
        )
        colors = np.concatenate([colors, to_srgb(sky_radiance(sky, up))])
    return FirstPoints(points, np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8))


def picture(scene: Scene, camera: Camera, spp: int) -> npt.NDArray[np.uint8]:
    """(H, W, 3) uint8 sRGB truth of a view, rounded as in an 8-bit file.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> scene = load_scene("spheres").with_size(8, 8)
        >>> image = picture(scene, scene.source, spp=1)
        >>> image.shape, image.dtype
        ((8, 8, 3), dtype('uint8'))
    """
    return np.round(255 * to_srgb(appearance(scene, camera, spp=spp))).astype(np.uint8)


def export(
    scene: Scene,
    folder: str | os.PathLike[str],
    *,
    views: int = 64,
    size: int = 256,
    spp: int = 16,
    points: int = 5000,
    noise: float = 0.5,
    seed: int = 0,
    report: Reporter = SILENT,
) -> Dataset:
    """Write a scene as a data set: transforms.json, images/*.png, masks/OBJECT/*.png, points.ply.

    One view of eight is in the split "test", the others in "train". A mask is white at the pixels
    whose centres show its object; objects that no view shows have none. Existing files are
    overwritten, and pictures of a former export removed; a folder without transforms.json is an
    unfinished export.

    Args:
        folder: output folder, created if missing.
        views, size: number of views, and the edge of their images in px.
        points, noise, seed: as for :func:`first_points`.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> data = export(load_scene("spheres"), "data", views=2, size=8, spp=1, points=20)
        >>> data.splits, [path.parent.name for path in data.image_paths]
        (['test', 'train'], ['images', 'images'])
    """
    from attnwarp.io import Dataset, write_transforms
    from attnwarp_eval.files import write_picture

    folder = Path(folder)
    mask_folders = [inside(folder / "masks", name) for name in scene.object_names]
    # Written last: until then no file may be mistaken for the cameras of this export.
    (folder / "transforms.json").unlink(missing_ok=True)
    report.step(0, views, "points")
    geometry = Geometry(scene)
    cloud = first_points(scene, points, noise=noise, seed=seed, geometry=geometry)
    cameras = orbit(scene, views, size)
    paths: list[Path | None] = []
    shown = []
    for k, camera in enumerate(cameras):
        report.step(k, views, f"view {k + 1}")
        path = folder / "images" / f"{camera.name}.png"
        paths.append(write_picture(path, picture(scene, camera, spp)))
        shown.append(geometry.trace(camera).object_id)
    masks = []
    for number in sorted({*np.unique(shown)} - {-1}):
        for camera, ids in zip(cameras, shown, strict=True):
            white = np.repeat(255 * (ids == number)[..., None].astype(np.uint8), 3, axis=-1)
            masks.append(write_picture(mask_folders[number] / f"{camera.name}.png", white))
    splits: list[str | None] = ["test" if out else "train" for out in held_out(views)]
    dataset = Dataset(cameras, paths, cloud.points, cloud.colors, splits)
    write_transforms(folder, dataset, points_name="points.ply")
    # Pictures of a former export with other views: readers of the folder would mix both.
    former = {*(folder / "images").glob("*.png"), *(folder / "masks").glob("*/*.png")}
    for other in former - {*paths, *masks}:
        if EXPORTED.fullmatch(other.name):
            other.unlink()
    return dataset
