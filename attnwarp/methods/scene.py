"""Inputs of an edit: cameras, pictures before the edit, and segments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.digest import digest, digest_each
from attnwarp.fit import FitSettings, Views, extent_of
from attnwarp.gaussians import Gaussians
from attnwarp.methods.pictures import Image, Segment
from attnwarp.render import render

Segments: TypeAlias = Sequence[npt.NDArray[Any]] | Callable[[int, Image], npt.NDArray[Any]]
"""(H, W) masks of the edited part, bool or soft in [0, 1]: one for each view, or a function of a
view's number and its picture."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Views before the edit.

    Attributes:
        images: (H, W, 3) sRGB, uint8, uint16 or float32 in [0, 1]. Photographs keep their type in
            memory; :meth:`picture` converts one.
        segments: (H, W) bool, or float32 in [0, 1] with soft edges; None if everything is edited.
    """

    cameras: list[Camera]
    images: list[npt.NDArray[Any]]
    segments: list[Segment] | None

    @classmethod
    def checked(
        cls,
        cameras: Sequence[Camera],
        images: Sequence[npt.NDArray[Any]],
        segments: Segments | None,
    ) -> Scene:
        """Validate external inputs."""
        if len(images) != len(cameras):
            raise ValueError(f"images: got {len(images)}, expected {len(cameras)}, as cameras")
        stored = []
        for k, (image, camera) in enumerate(zip(images, cameras, strict=True)):
            name = f"images[{k}] ({camera.name})"
            check.shape(np.asarray(image), (camera.height, camera.width, 3), name)
            stored.append(checked_image(image, name))
        if segments is None:
            return cls(list(cameras), stored, None)
        given = (
            [segments(k, to_float(image)) for k, image in enumerate(stored)]
            if callable(segments)
            else segments
        )
        if len(given) != len(cameras):
            raise ValueError(f"segments: got {len(given)}, expected {len(cameras)}, as cameras")
        masks = []
        for k, (segment, camera) in enumerate(zip(given, cameras, strict=True)):
            name = f"segments[{k}] ({camera.name})"
            mask = np.asarray(segment)
            check.shape(mask, (camera.height, camera.width), name)
            if mask.dtype != np.bool_:
                if mask.dtype.kind != "f":
                    raise ValueError(f"{name}: got {mask.dtype}, expected bool, or floating")
                mask = checked_image(mask, name)
            masks.append(mask)
        if not any((mask > 0.5).any() for mask in masks):
            raise ValueError("segments: every one is empty, so nothing may change; True is edited")
        return cls(list(cameras), stored, masks)

    def picture(self, view: int) -> Image:
        """Convert a view's picture to (H, W, 3) float32 in [0, 1]."""
        return to_float(self.images[view])

    def digest(self) -> dict[str, str | None]:
        """Hash cameras, pictures and segments (SHA-256)."""
        cameras = [{**camera.to_dict(), "name": camera.name} for camera in self.cameras]
        return {
            "cameras": digest(cameras),
            "images": digest_each(map(to_float, self.images)),
            "segments": None if self.segments is None else digest(*self.segments),
        }


def checked_image(image: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    """Check a picture: 8 or 16 bits stay unchanged, floating values become float32."""
    array = np.asarray(image)
    if array.dtype in (np.uint8, np.uint16):
        return array
    if array.dtype.kind != "f":
        raise ValueError(f"{name}: got {array.dtype}, expected uint8, uint16 or floating")
    check.finite(array, name)
    if array.min() < 0 or array.max() > 1:
        raise ValueError(f"{name}: got values in [{array.min()}, {array.max()}], expected [0, 1]")
    # A float32 picture is copied only if torch cannot share its memory.
    return np.require(array, np.float32, ["C", "W"])


def to_float(image: npt.NDArray[Any]) -> Image:
    """Convert a checked image to (H, W, 3) float32 in [0, 1]."""
    if image.dtype.kind == "f":
        return image
    return image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)


def images_of(views: Views) -> list[npt.NDArray[Any]]:
    """List each view's stored picture (H, W, 3); transparent pictures over black, as float32."""
    return [
        image if image.shape[2] == 3 else views.target(k, np.zeros(3)).numpy()
        for k, image in enumerate(views.images)
    ]


def check_cameras(cameras: Any) -> list[Camera]:
    """Return the cameras as a list."""
    if isinstance(cameras, Camera) or not isinstance(cameras, Iterable):
        raise TypeError(f"cameras: got {type(cameras).__name__}, expected a list of cameras")
    listed = list(cameras)
    if not listed:
        raise ValueError("cameras: got none, expected at least one")
    for camera in listed:
        check.instance(camera, Camera, "cameras", "attnwarp.Camera")
    return listed


def check_loaded(editor: Any) -> None:
    """Raise TypeError if an editor is a name or a path."""
    if isinstance(editor, str | Path):
        raise TypeError(
            f"editor: got {str(editor)!r}, expected an editor; load it with"
            f" attnwarp.editing.small.load_editor({str(editor)!r})"
        )


def near_of(cameras: Sequence[Camera], gaussians: Gaussians) -> float:
    """Near-plane depth, equal to the one used in the tuning of these splats."""
    return FitSettings().near * extent_of(cameras, gaussians.world_means())


def render_picture(gaussians: Gaussians, camera: Camera, near: float, backend: str) -> Image:
    """Render a view over black, (H, W, 3) float32 in [0, 1]."""
    with torch.no_grad():
        color = render(gaussians, camera, backend=backend, near=near).color
    if bool(color.isnan().any()):
        raise RuntimeError(f"view {camera.name!r} renders as NaN; lower the learning rates")
    return np.asarray(color.clamp(0, 1).float().cpu().numpy())
