"""A scene's truth and its splats, computed once for all cells of a process."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import Gaussians
from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp_eval.cache import content_key, read_arrays, write_arrays
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.file import load_scene, scene_file
from attnwarp_eval.scene.scene import Scene, orbit_camera
from attnwarp_eval.splats.surface import SurfaceSamples, colored_samples, surface_splats
from attnwarp_eval.truth import Geometry, appearance, edge_band, two_view
from attnwarp_eval.truth.features import SolidField
from attnwarp_eval.truth.mitsuba import forget
from attnwarp_eval.two_view import TwoView

SPLATS_PROTOCOL = 1
"""Version of the sampling; raised when the same settings give other splats."""

Features = npt.NDArray[np.float64]
Samples = tuple[SurfaceSamples, npt.NDArray[np.float64]]


class World:
    """Parts of a scene shared by all variants: truth, memoised by view.

    Attributes:
        content_hash: hash of the scene's file, as in a cell's spec.
        signed_yaw: degrees from the source in [-180, 180), by the target's name.
        yaw: the same folded to [0, 180].
        made: objects that a probe makes of the world for several cells, by a key of its own.
    """

    def __init__(self, scene: Scene, size: int) -> None:
        self.content_hash = scene.content_hash
        self._loaded = scene
        self.scene = scene = scene.with_size(size, size)
        self.geometry = Geometry(scene)
        self.source = scene.source
        self.targets = {camera.name: camera for camera in scene.targets}
        self.signed_yaw = {
            camera.name: (view.yaw - scene.spec.cameras.source.yaw + 180) % 360 - 180
            for camera, view in zip(scene.targets, scene.spec.cameras.targets, strict=True)
        }
        self.yaw = {name: abs(yaw) for name, yaw in self.signed_yaw.items()}
        self.made: dict[Hashable, Any] = {}
        # Cells of one scene use the same pairs; a world lives as long as its scene is in use.
        self.pair: Callable[[str, int], TwoView] = cache(self._pair)
        # Pairs of two targets are many, at 100 bytes a pixel each.
        self.between: Callable[[str, str], TwoView] = lru_cache(maxsize=64)(self._between)
        self.features: Callable[[str, int, int, int], Features] = cache(self._features)
        self.edge: Callable[[str, int], npt.NDArray[np.bool_]] = cache(self._edge)
        self.image: Callable[[str, int], npt.NDArray[np.float32]] = cache(self._image)
        self.samples: Callable[[int, int], Samples] = cache(self._samples)

    def edited_hash(self, edit: str, answer: str | None) -> str:
        """The hash of the scene's file after an edit, as in a cell's spec."""
        return self._loaded.edited(edit, answer).content_hash

    def add(self, camera: Camera) -> None:
        """Add a target camera under its name."""
        offset, source = (c.position[:2] - self.scene.center[:2] for c in (camera, self.source))
        cosine = offset @ source / (np.linalg.norm(offset) * np.linalg.norm(source))
        self.targets[camera.name] = camera
        yaw = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        self.yaw[camera.name] = yaw
        left = source[0] * offset[1] - source[1] * offset[0] >= 0  # yaw is counter-clockwise
        self.signed_yaw[camera.name] = yaw if left else -yaw

    def camera(self, name: str) -> Camera:
        """The source ("source") or a target by its name."""
        return self.source if name == self.source.name else self.targets[name]

    def _pair(self, target: str, size: int) -> TwoView:
        """The exact relation of the source and a target, on a grid of ``size`` x ``size``."""
        return two_view(
            self.geometry,
            self.source.resize(size, size),
            self.targets[target].resize(size, size),
            bands=(self.edge(self.source.name, size), self.edge(target, size)),
        )

    def _between(self, first: str, second: str) -> TwoView:
        """The exact relation of any two views."""
        if first == self.source.name:
            return self.pair(second, self.source.width)
        return two_view(self.geometry, self.camera(first), self.camera(second))

    def _edge(self, name: str, size: int) -> npt.NDArray[np.bool_]:
        """(size, size) bool: the band around the depth and object edges of a view."""
        return edge_band(self.geometry, self.camera(name).resize(size, size))

    def _image(self, name: str, spp: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) sRGB truth of a view in [0, 1]."""
        return to_srgb(appearance(self.scene, self.camera(name), spp=spp, seed=0))

    def _features(self, name: str, size: int, channels: int, seed: int) -> Features:
        """(C, h, w) feature field of a view; background 0 in the source, NaN in a target."""
        points = self.geometry.trace(self.camera(name).resize(size, size)).point
        background = 0.0 if name == self.source.name else np.nan
        return self._field(channels, seed).on_grid(points, background=background)

    def _samples(self, count: int, seed: int) -> Samples:
        """The points of ``count`` splats of every kind, with their colours."""
        return colored_samples(self.scene, count, seed=seed, geometry=self.geometry)

    def _field(self, channels: int, seed: int) -> SolidField:
        """The feature field, as wide as the field of view at the scene's centre."""
        distance = float(np.linalg.norm(self.source.position - self.scene.center))
        width = (
            2 * distance * float(np.tan(np.arctan(self.source.height / 2 / self.source.K[1, 1])))
        )
        return SolidField(self.scene.center, width, channels=channels, seed=seed)


def world(scene: str, size: int) -> World:
    """The world of a scene (name or path) at an image size; the last unchanged one is cached."""
    return _world(scene, size, scene_file(scene).read_bytes())


@lru_cache(maxsize=1)
def _world(scene: str, size: int, content: bytes) -> World:
    forget()  # data loaded for the pictures of the previous scene
    return World(load_scene(scene), size)


def turned(scene: Scene, yaw: float) -> Camera:
    """The source camera, ``yaw`` degrees further on its orbit; it looks where the source looks."""
    orbit = scene.spec.cameras
    further = {"yaw": orbit.source.yaw + yaw, "name": f"turned{yaw:g}"}
    return orbit_camera(orbit, orbit.source.model_copy(update=further), 1)


def changed(what: str) -> InputError:
    """The error of a scene that has changed since a cell was planned."""
    return InputError(f"{what} has changed since the run was planned; start the run again")


def splats(scene: str, size: int, seed: int, **settings: Any) -> Gaussians:
    """Gaussians on a scene's surfaces; the last few are cached in memory, all of them on disk.

    Args:
        scene, size: arguments of the :func:`world`.
        seed: seed of their places and their noise.
        settings: kind, count, position_noise and normal_noise of
            :func:`attnwarp_eval.splats.surface.surface_splats`.
    """
    content = world(scene, size).content_hash
    return _splats(content, scene, size, seed, tuple(settings.items()))


@lru_cache(maxsize=8)
def _splats(
    content: str, scene: str, size: int, seed: int, items: tuple[tuple[str, Any], ...]
) -> Gaussians:
    settings = dict(items)
    key = content_key("surface splats", SPLATS_PROTOCOL, content, seed, settings)
    stored = read_arrays("splats", key)
    names = ("means", "quats", "scales", "opacities", "sh")
    if stored is None:
        scene_world = world(scene, size)
        samples = scene_world.samples(settings["count"], seed)
        made = surface_splats(scene_world.scene, seed=seed, samples=samples, **settings)
        write_arrays(
            "splats",
            key,
            {**{name: getattr(made, name).numpy() for name in names}, "origin": made.origin},
        )
        return made
    means, quats, scales, opacities, sh = (torch.from_numpy(stored[name]) for name in names)
    return Gaussians(settings["kind"], means, quats, scales, opacities, sh, origin=stored["origin"])
