"""Parts of readers and writers: the error for a bad file, and a write that is whole or not."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import time
import uuid
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import BinaryIO

from attnwarp.errors import InputError


class FileFormatError(InputError):
    """A file that cannot be read as what it claims to be.

    The message names the file, the property or field, the first bad row where there is one (counted
    from 0), and what to do.

    Attributes:
        path: the file.
        field: the property or key at fault, or None when it is the file as a whole.
        row: the first bad row or frame, counted from 0, or None.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.io import FileFormatError
        >>> error = FileFormatError(Path("a.ply"), "got NaN, expected numbers", field="x", row=3)
        >>> print(error, error.row)
        a.ply: x: got NaN, expected numbers 3
    """

    def __init__(
        self, path: Path, message: str, *, field: str | None = None, row: int | None = None
    ) -> None:
        self.path = path
        self.field = field
        self.row = row
        super().__init__(f"{path}: {field}: {message}" if field else f"{path}: {message}")


def is_file(path: Path) -> bool:
    """Return True if there is such a file; False too for a name that no file system can hold."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def check_other(out: Path, source: Path, what: str) -> None:
    """Refuse to write over what is read.

    Args:
        out: where a result goes.
        source: name of the input that it is made from.
        what: the source is, for the message.

    Raises:
        InputError: both are one file or folder, under one name or two, or by a link.
    """
    if out.exists() and source.exists() and out.samefile(source):
        raise InputError(f"{out}: is {what}; choose another name for the result")


def inside(folder: Path, name: str | os.PathLike[str]) -> Path:
    """Return the path of a name in a folder, for names that a file or another person gives.

    Args:
        folder: the folder that the path has to stay in.
        name: path from there.

    Raises:
        InputError: it leads out of the folder, by ``..``, as an absolute path or by a link.

    Example:
        >>> inside(Path("run"), "pictures/a.png").as_posix()
        'run/pictures/a.png'
        >>> inside(Path("run"), "../a.png")
        Traceback (most recent call last):
        attnwarp.errors.InputError: '../a.png': leads out of run, expected a path inside it
    """
    path = folder / name
    try:
        stays = path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # a name or links that lead nowhere
        stays = False
    if not stays:
        raise InputError(f"{str(name)!r}: leads out of {folder}, expected a path inside it")
    return path


def existing_file(path: str | os.PathLike[str]) -> Path:
    """``path`` as a Path.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: it is a folder, or it is empty.
    """
    path = Path(path)
    try:
        exists = path.exists()
    except ValueError:  # a zero byte in the name
        exists = False
    if not exists:
        raise FileNotFoundError(f"{path}: no such file")
    if path.is_dir():
        raise FileFormatError(path, "is a folder, expected a file")
    if path.stat().st_size == 0:
        raise FileFormatError(
            path, "the file is empty; write it again, the program that made it probably failed"
        )
    return path


def write_atomically(
    path: str | os.PathLike[str],
    write: Callable[[BinaryIO], object],
    *,
    durable: bool = True,
    follow_link: bool = False,
) -> None:
    """Call ``write`` on a temporary file beside ``path`` and rename it to ``path``.

    A reader, or a run that is killed, sees the old file or the new one and never a part. When
    ``write`` raises, the old file stays and the temporary one is removed. The temporary file of a
    killed process is removed by the next one that writes to the folder.

    Args:
        path: path of the file; its folder must exist.
        write: called with the open temporary file.
        durable: whether the content survives a power cut too, which costs milliseconds. A file
            that carries a checksum and can be made again does without.
        follow_link: where ``path`` is a link, write the file that it leads to. Without, the link is
            replaced, so that nothing outside a program's own folder is written.

    Raises:
        FileNotFoundError: the folder does not exist.
        IsADirectoryError: the path is a folder's.
        OSError: the disk is full, or the folder cannot be written to.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.io.file import write_atomically
        >>> write_atomically("a.txt", lambda stream: stream.write(b"whole"))
        >>> Path("a.txt").read_text()
        'whole'
    """
    path = Path(path)
    if follow_link and path.is_symlink():
        path = path.resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; make it first")
    if path.is_dir() and not path.is_symlink():
        raise IsADirectoryError(f"{path}: is a folder, expected a file; choose another name")
    _sweep(path.parent.resolve(), os.getpid())
    # Opened by name instead of tempfile.mkstemp, which would leave the result readable by its owner
    # alone. Of a long name a part, so that this one is not too long for the file system.
    part = path.name[:NAME_PART]
    temporary = path.with_name(f".{part}.{_host()}-{os.getpid()}-{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("xb") as stream:
            write(stream)
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException as error:
        # A full disk is found by write(), which does not know what it wrote to, and a folder that
        # cannot be written to by the temporary file, which means nothing to a person.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        temporary.unlink(missing_ok=True)
        raise


ABANDONED_SECONDS = 24 * 3600
"""A temporary file of another machine counts as abandoned when nothing was written to it for this
long: whether its process is alive cannot be asked from here.
"""

NAME_PART = 40
"""Characters of a file's name in that of its temporary one: at most 160 bytes, where a file system
takes 255."""

_TEMPORARY = re.compile(r"\..+\.(?P<host>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{32}\.tmp")


def remove_abandoned(folder: str | os.PathLike[str]) -> int:
    """Remove the temporary files that dead processes left in ``folder``; return how many.

    Files of :func:`write_atomically` alone are touched, and none of a process that is alive.
    """
    removed = 0
    for path in Path(folder).glob(".*.tmp"):
        name = _TEMPORARY.fullmatch(path.name)
        if name is None:
            continue
        with contextlib.suppress(OSError):  # another process may be sweeping, too
            if name["host"] == _host():
                abandoned = not _alive(int(name["process"]))
            else:
                abandoned = time.time() - path.stat().st_mtime > ABANDONED_SECONDS
            if abandoned:
                path.unlink()
                removed += 1
    return removed


@cache
def _sweep(folder: Path, process: int) -> None:
    """:func:`remove_abandoned`, once for a folder and a process: the cache remembers it."""
    # A folder that cannot be listed may be written to all the same.
    with contextlib.suppress(OSError):
        remove_abandoned(folder)


@cache
def _host() -> str:
    """Eight hexadecimal digits of where a process's number means this process: the machine's name,
    and on Linux the namespace, as containers may share the name and not the numbers.
    """
    try:
        namespace = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        namespace = ""
    return hashlib.sha256((platform.node() + namespace).encode()).hexdigest()[:8]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 asks and sends nothing
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # it is another user's
    return True
