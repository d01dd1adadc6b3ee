"""Files that the harness writes: atomically, pictures, and locks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp.io.picture import encode_picture


def write_atomic(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write so that ``path`` keeps its old content or has all of ``data``, even after a power cut.

    Folders that are missing are made.

    Args:
        path: of the file.
        data: its content.
        durable: False does without the flush, which takes milliseconds; after a power cut the file
            may then be missing or damaged.

    Raises:
        OSError: the disk is full, or the folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda stream: stream.write(data), durable=durable)
    if not durable:
        return
    # The name is the folder's content: it lasts only when the folder is flushed as well.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_picture(path: Path, image: npt.ArrayLike, **jpeg: Any) -> Path:
    """Write a picture atomically, as PNG or JPEG by its name's suffix; return ``path``.

    Args:
        path: of the file; missing folders are made.
        image: see :func:`attnwarp.io.picture.encode_picture`.
        jpeg: its ``quality`` and ``chroma``.
    """
    write_atomic(path, encode_picture(image, path.suffix, **jpeg))
    return path


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[None]:
    """Hold a lock file, which is made; the end of a process lets go of it too.

    Args:
        path: of the file, in a folder that exists.
        wait: until whoever holds it lets go.

    Raises:
        BlockingIOError: another holds it, and ``wait`` is False.
        OSError: it is a symbolic link (``errno.ELOOP``), or cannot be written.
    """
    import fcntl  # not on Windows

    # Neither followed nor emptied: in a folder from elsewhere it may link to any file.
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(file)
