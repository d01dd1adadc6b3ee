"""File names of views."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from attnwarp.camera import Camera


def file_stems(cameras: Sequence[Camera]) -> list[str]:
    """A file name without suffix for each camera: the last part of its own name, numbered where
    several are the same. No two cameras get one name.

    Example:
        >>> from attnwarp import Camera
        >>> view = dict(width=8, height=6, fov_y=40)
        >>> names = ["a/1.png", "b/1.png", "b/2.png"]
        >>> file_stems([Camera.look_at((3, 0, 0), (0, 0, 0), name=n, **view) for n in names])
        ['0000-1', '0001-1', '2']
    """
    stems = [Path(camera.name).stem or "view" for camera in cameras]
    counts = Counter(stems)
    alone = {stem for stem, count in counts.items() if count == 1}
    result = []
    for index, stem in enumerate(stems):
        name = stem
        # A numbered name may be that of another view.
        while counts[stem] > 1 and (name == stem or name in alone):
            name = f"{index:04d}-{name}"
        result.append(name)
    return result
