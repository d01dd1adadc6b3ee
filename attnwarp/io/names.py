"""File names of views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from attnwarp.camera import Camera


def file_stems(cameras: Sequence[Camera]) -> list[str]:
    """A file name without suffix for each camera: the last part of its own name, numbered where
    several are the same.

    Example:
        >>> from attnwarp import Camera
        >>> view = dict(width=8, height=6, fov_y=40)
        >>> names = ["a/1.png", "b/1.png", "b/2.png"]
        >>> file_stems([Camera.look_at((3, 0, 0), (0, 0, 0), name=n, **view) for n in names])
        ['0000-1', '0001-1', '2']
    """
    stems = [Path(camera.name).stem or "view" for camera in cameras]
    return [
        stem if stems.count(stem) == 1 else f"{index:04d}-{stem}"
        for index, stem in enumerate(stems)
    ]
