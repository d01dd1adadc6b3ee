"""What readers and writers share: the error for a bad file, and a write that is whole or not."""

from __future__ import annotations

import hashlib
import os
import re
import socket
import uuid
from collections.abc import Callable
from contextlib import suppress
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
    """

    def __init__(
        self, path: Path, message: str, *, field: str | None = None, row: int | None = None
    ) -> None:
        self.path = path
        self.field = field
        self.row = row
        super().__init__(f"{path}: {field}: {message}" if field else f"{path}: {message}")


def is_file(path: Path) -> bool:
    """Whether there is such a file; False too for a name that no file system can hold."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


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


@cache
def _host() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


@cache
def _sweep(folder: Path, own: int) -> None:
    """Remove what processes of this machine that were killed left half-written in ``folder``.

    Once for a folder and process: the cache remembers it.
    """
    pattern = re.compile(rf"\..+\.{_host()}-(\d+)-[0-9a-f]{{12}}\.tmp")
    # A folder that cannot be listed or swept may be written to all the same.
    with suppress(OSError):
        for path in folder.iterdir():
            match = pattern.fullmatch(path.name)
            if match and int(match[1]) != own and not _alive(int(match[1])):
                path.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def write_atomically(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Call ``write`` on a temporary file beside ``path``, flush it to disk and rename it to
    ``path``.

    A reader, or a run that is killed, sees the old file or the new one and never a part. When
    ``write`` raises, the old file stays and the temporary one is removed; that of a process that
    was killed is removed by the next one that writes to the folder. The folder must exist.

    Args:
        path: the file; an older one is replaced.
        write: writes the content to the binary stream that it is given.

    Raises:
        FileNotFoundError: there is no such folder.
        OSError: the disk is full, or a permission is missing; it names ``path``.

    Example:
        >>> from pathlib import Path
        >>> from attnwarp.io.file import write_atomically
        >>> write_atomically("a.txt", lambda stream: stream.write(b"whole"))
        >>> Path("a.txt").read_text()
        'whole'
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; make it first")
    _sweep(path.parent.resolve(), os.getpid())
    # Opened by name instead of tempfile.mkstemp, which would leave the result readable by its owner
    # alone.
    temporary = path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{uuid.uuid4().hex[:12]}.tmp")
    try:
        with temporary.open("xb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException as error:
        # A full disk is found by write(), which does not know what it wrote to.
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            error.filename = str(path)
        temporary.unlink(missing_ok=True)
        raise
