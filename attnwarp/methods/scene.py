"""Inputs of an edit: their checks and hashes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.digest import digest, digest_each
from attnwarp.fit import FitSettings, Views, extent_of
from attnwarp.fit.views import to_float
from attnwarp.gaussians import Gaussians
from attnwarp.methods.pictures import Image, Segment
from attnwarp.render import render

Segments: TypeAlias = Sequence[npt.NDArray[Any]] | Callable[[int, Image], npt.NDArray[Any]]
"""(H, W) masks of the edited part, bool or soft in [0, 1]: one for each view, or a function of a
view's number and its picture."""


def checked_segments(segments: Segments | None, views: Views) -> list[Segment] | None:
    """Validate the masks of the edited part: (H, W) bool, or float32 in [0, 1]; None edits
    everything."""
    if segments is None:
        return None
    given = (
        [segments(k, views.picture(k)) for k in range(len(views))]
        if callable(segments)
        else segments
    )
    if len(given) != len(views):
        raise ValueError(f"segments: got {len(given)}, expected {len(views)}, as cameras")
    masks = []
    for k, (segment, camera) in enumerate(zip(given, views.cameras, strict=True)):
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
    return masks


def digests(views: Views, segments: Sequence[Segment] | None) -> dict[str, str | None]:
    """Hash cameras, pictures and segments (SHA-256), and masks and exposures if there are any."""
    cameras = [{**camera.to_dict(), "name": camera.name} for camera in views.cameras]
    parts: dict[str, Sequence[Any]] = {"masks": views.masks, "exposures": views.exposures}
    return {
        "cameras": digest(cameras),
        "images": digest_each(map(views.picture, range(len(views)))),
        "segments": None if segments is None else digest(*segments),
        **{
            name: digest(*(v if v is None else np.asarray(v) for v in values))
            for name, values in parts.items()
            if any(value is not None for value in values)
        },
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
    return to_float(array)


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


def render_picture(
    gaussians: Gaussians,
    camera: Camera,
    near: float,
    backend: str,
    exposed: Callable[[torch.Tensor], torch.Tensor] = lambda color: color,
) -> Image:
    """Render a view over black, (H, W, 3) float32 in [0, 1].

    Args:
        exposed: change of the colours, such as a picture's exposure.
    """
    with torch.no_grad():
        color = exposed(render(gaussians, camera, backend=backend, near=near).color)
    if bool(color.isnan().any()):
        raise RuntimeError(f"view {camera.name!r} renders as NaN; lower the learning rates")
    return np.asarray(color.clamp(0, 1).float().cpu().numpy())
