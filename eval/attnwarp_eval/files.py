"""Atomic writing of files and pictures."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp.io.picture import encode_picture


def write_atomic(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write so that ``path`` keeps its old content or has all of ``data``, even after a power cut.

    Missing folders are created.

    Args:
        durable: False skips the flush, which takes milliseconds; after a power cut the file
            may then be missing or damaged.

    Raises:
        OSError: the disk is full, or the folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda stream: stream.write(data), durable=durable)
    if not durable:
        return
    # The name is stored in the folder, which must be flushed as well.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_picture(path: Path, image: npt.ArrayLike, **jpeg: Any) -> Path:
    """Write a picture atomically, as PNG or JPEG by its name's suffix; return ``path``.

    Args:
        path: path of the file; missing folders are created.
        image: picture, as for :func:`attnwarp.io.picture.encode_picture`.
        jpeg: its ``quality`` and ``chroma``.
    """
    write_atomic(path, encode_picture(image, path.suffix, **jpeg))
    return path
