"""What every reader and writer here shares: the error a bad file gets, and a write that cannot
leave half a file.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable
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


def write_atomically(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Call ``write`` on a temporary file beside ``path``, flush it to disk and rename it to
    ``path``.

    A reader, or a run that is killed, sees the old file or the new one and never a part. When
    ``write`` raises, the old file stays and the temporary one is removed. The folder must exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; make it first")
    # Opened by name instead of tempfile.mkstemp, which would leave the result readable by its owner
    # alone.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
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
