"""Locks between processes; the end of a process lets go of its own."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from attnwarp.errors import InputError

WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EBADF, errno.EINVAL)
"""Error numbers of a file system without locks of folders."""


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[None]:
    """Hold a lock file, which is made.

    Args:
        path: path of the file, in a folder that exists.
        wait: until whoever holds it lets go.

    Raises:
        BlockingIOError: another holds it, and ``wait`` is False.
        OSError: it cannot be written.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(file)


@contextmanager
def alone_in(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Hold a folder against other runs that would write to it; it is made if need be.

    The folder itself is locked, so that no file is left in it. Without effect where the file system
    has no such locks.

    Args:
        folder: path of the results. If nothing was written to it and it was made here, it is
            removed.

    Raises:
        InputError: another run holds it.
        FileExistsError: it is a file.

    Example:
        >>> from attnwarp.io.lock import alone_in
        >>> with alone_in("results"):
        ...     with alone_in("results"):
        ...         pass
        Traceback (most recent call last):
        attnwarp.errors.InputError: results: another run writes to this folder; ...
    """
    folder = Path(folder)
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    held = _held(folder)
    try:
        yield
    finally:
        if held is not None:
            os.close(held)
        if made:
            with suppress(OSError):  # it has files by now
                folder.rmdir()


def _held(folder: Path) -> int | None:
    """The number of the open folder, locked; None where that cannot be."""
    try:
        file = os.open(folder, os.O_RDONLY)
    except PermissionError:  # it can be written to, and not listed
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        raise InputError(
            f"{folder}: another run writes to this folder; wait until it ends, or name another"
            " folder"
        ) from None
    except OSError as error:
        os.close(file)
        if error.errno not in WITHOUT_LOCKS:
            raise
        return None
    return file
