"""File names of views."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from attnwarp.camera import Camera


def file_stems(cameras: Sequence[Camera]) -> list[str]:
    """Build a file name without suffix for each camera: the last part of the camera's name,
    numbered if several are equal. No two cameras share a name."""
    return numbered([Path(camera.name).stem or "view" for camera in cameras])


def numbered(names: Sequence[str]) -> list[str]:
    """Insert a number before the last part of equal names.

    Example:
        >>> from attnwarp.io.names import numbered
        >>> numbered(["left/a.png", "left/a.png", "b.png"])
        ['left/0000-a.png', 'left/0001-a.png', 'b.png']
    """
    counts = Counter(names)
    alone = {name for name, count in counts.items() if count == 1}
    result = []
    for index, own in enumerate(names):
        name = own
        # A numbered name may equal another view's name.
        while counts[own] > 1 and (name == own or name in alone):
            folder, slash, last = name.rpartition("/")
            name = f"{folder}{slash}{index:04d}-{last}"
        result.append(name)
    return result
