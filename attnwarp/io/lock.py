"""Locks between processes; a process's end releases its locks."""

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
    """Hold a lock file, creating it if missing; it has the number of the process that holds it.

    Raises:
        BlockingIOError: another process holds the lock, and ``wait`` is False.
        OSError: the file cannot be written.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.truncate(file, 0)
        os.write(file, str(os.getpid()).encode())
        yield
    finally:
        os.close(file)


@contextmanager
def alone_in(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Hold a folder against other runs that would write to it; create it if missing.

    The folder itself is locked, so no lock file remains. File systems without folder locks make
    this a no-op.

    Raises:
        InputError: another run holds the folder.
        FileExistsError: the path is a file.
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
            with suppress(OSError):  # the folder has files by now
                folder.rmdir()


def _held(folder: Path) -> int | None:
    """Open and lock the folder, returning its descriptor; None if locking is impossible."""
    try:
        file = os.open(folder, os.O_RDONLY)
    except PermissionError:  # the folder is writable but not listable
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
