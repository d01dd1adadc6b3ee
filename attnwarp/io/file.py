"""Helpers of readers and writers: the error for a bad file, and atomic writes."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import BinaryIO

from attnwarp.errors import InputError


class FileFormatError(InputError):
    """Error for a file that does not have its claimed format.

    The message names the file, the property or field, the first bad row if any (counted from 0),
    and a remedy.

    Attributes:
        path: path of the file.
        field: faulty property or key, or None for the file as a unit.
        row: first bad row or frame, counted from 0, or None.

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
    """Return True if the file exists; False also for a name invalid in every file system."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def named_file(folder: Path, name: str, suffixes: Sequence[str] = ()) -> Path:
    """Find the file of a name in a folder: as written, or with backslashes as slashes, as of
    Windows, and with one of the suffixes. Without one, return the path of the name.

    Example:
        >>> Path("views").mkdir()
        >>> Path("views/a.png").touch()
        >>> named_file(Path("."), ".\\\\views\\\\a", [".png"]).as_posix()
        'views/a.png'
    """
    slashes = name.replace("\\", "/")
    each = (folder / f"{way}{suffix}" for way in (name, slashes) for suffix in ("", *suffixes))
    return next(filter(is_file, each), folder / slashes)


def check_other(out: Path, source: Path, what: str) -> None:
    """Refuse to overwrite an input."""
    if out.exists() and source.exists() and out.samefile(source):
        raise InputError(f"{out}: is {what}; choose another name for the result")


def inside(folder: Path, name: str | os.PathLike[str]) -> Path:
    """Return the path of an untrusted name in a folder.

    Raises:
        InputError: the path leaves the folder, by ``..``, as an absolute path or by a link.

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
    except (OSError, ValueError, RuntimeError):  # an invalid name or broken links
        stays = False
    if not stays:
        raise InputError(f"{str(name)!r}: leads out of {folder}, expected a path inside it")
    return path


def existing_file(path: str | os.PathLike[str]) -> Path:
    """Return ``path`` as a Path to an existing file.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: the path is a folder, or the file is empty.
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
    """Call ``write`` on a temporary file in the folder of ``path``, then rename it to ``path``.

    A reader sees the old file or the new one and never a part, even if the run is killed. If
    ``write`` raises, the old file stays and the temporary one is removed. The temporary file of a
    killed process is removed by the next process that writes to the folder.

    Args:
        path: path of the file; its folder must exist.
        write: function called with the open temporary file.
        durable: True makes the content survive a power cut, which costs milliseconds. A file with a
            checksum that can be regenerated does not need it.
        follow_link: True writes the target of a link ``path``. False replaces the link, so that
            nothing outside a program's folder is written.

    Raises:
        FileNotFoundError: the folder does not exist.
        IsADirectoryError: the path is a folder.
        OSError: the disk is full, or the folder is not writable.
    """
    path = Path(path)
    if follow_link and path.is_symlink():
        path = path.resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; make it first")
    if path.is_dir() and not path.is_symlink():
        raise IsADirectoryError(f"{path}: is a folder, expected a file; choose another name")
    _sweep(path.parent.resolve(), os.getpid())
    # Opened by name, since tempfile.mkstemp would make the result readable by its owner only. A
    # long name is shortened, so that the temporary name fits the file system.
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
        # write() reports a full disk without a path, and an unwritable folder is reported for the
        # temporary file, whose name means nothing to the user.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        temporary.unlink(missing_ok=True)
        raise


def visible(paths: Iterable[Path]) -> list[Path]:
    """Sort the paths of a listing, without hidden ones.

    macOS writes ``._a.jpg`` beside ``a.jpg`` on disks of other systems and into archives.

    Example:
        >>> [path.name for path in visible([Path("b.jpg"), Path("._a.jpg"), Path("a.jpg")])]
        ['a.jpg', 'b.jpg']
    """
    return sorted(path for path in paths if not path.name.startswith("."))


ABANDONED_SECONDS = 24 * 3600
"""Age in seconds at which another machine's temporary file counts as abandoned, since its process
cannot be queried from here.
"""

NAME_PART = 40
"""Characters of a file's name kept in its temporary name: at most 160 bytes, within a file system's
limit of 255."""

_TEMPORARY = re.compile(r"\..+\.(?P<host>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{32}\.tmp")


def remove_abandoned(folder: str | os.PathLike[str]) -> int:
    """Remove temporary files of dead processes in ``folder``; return their number.

    Only files of :func:`write_atomically` are removed, and never those of a live process.
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
    """Call :func:`remove_abandoned` once per folder and process, by a cache."""
    # A folder that cannot be listed may still be writable.
    with contextlib.suppress(OSError):
        remove_abandoned(folder)


@cache
def _host() -> str:
    """Compute eight hexadecimal digits that identify the scope of process numbers: the machine's
    name, and on Linux the PID namespace, since containers may share the name.
    """
    try:
        namespace = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        namespace = ""
    return hashlib.sha256((platform.node() + namespace).encode()).hexdigest()[:8]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 only tests for existence
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # another user's process
    return True
