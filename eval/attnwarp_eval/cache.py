"""Where derived files live, and how they are written so that two processes can share the folder."""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp_eval.files import digest


def cache_dir() -> Path:
    """The folder of derived files: ``$ATTNWARP_CACHE``, else ``$XDG_CACHE_HOME/attnwarp``, else
    ``~/.cache/attnwarp``.

    Everything in it can be recomputed and may be deleted at any time.
    """
    named = os.environ.get("ATTNWARP_CACHE")
    if named:
        return Path(named).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "attnwarp"


def content_key(*parts: Any) -> str:
    """SHA-256 (hex) of the canonical JSON of ``parts``: sorted keys, no spaces, NaN refused."""
    return digest(list(parts))


def read_arrays(kind: str, key: str) -> dict[str, npt.NDArray[Any]] | None:
    """The arrays stored under ``kind``/``key``, or None when there are none or the file is
    damaged."""
    path = cache_dir() / kind / f"{key}.npz"
    try:
        # Opened here, since np.load leaves a damaged file open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return None


def write_arrays(kind: str, key: str, arrays: Mapping[str, Any]) -> None:
    """Store ``arrays`` under ``kind``/``key``.

    The file appears under its name only when it is whole (written beside it, then renamed), so a
    reader never sees half of one and the last of several writers wins. A folder that cannot be
    written is no error: the value is simply computed again next time.
    """
    folder = cache_dir() / kind
    temporary: Path | None = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{key[:16]}-", suffix=".tmp", dir=folder)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **arrays)
        size = temporary.stat().st_size
        temporary.replace(folder / f"{key}.npz")
        _keep_within_limit(size)
    except OSError:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


_unseen: float = float("inf")
"""Bytes that this process has written since it last looked at the whole folder; it looks at its
first write.
"""


def _keep_within_limit(written: int) -> None:
    """Trim the folder, but look at all of it only after every hundredth of the limit.

    To look costs a call for each file: done at every write, keeping thousands of small meshes took
    longer than making them.
    """
    global _unseen
    _unseen += written
    limit = limit_bytes()
    if _unseen > limit / 100:
        _unseen = 0.0
        trim(limit)


DEFAULT_LIMIT_GB = 10.0
"""A study of all scenes at 512 px keeps about 1 GB."""


def limit_bytes() -> int:
    """How large the folder may grow: ``$ATTNWARP_CACHE_GB``, else :data:`DEFAULT_LIMIT_GB`.

    Raises:
        InputError: the variable is not a number of gigabytes.
    """
    said = os.environ.get("ATTNWARP_CACHE_GB", "")
    try:
        limit = float(said) if said else DEFAULT_LIMIT_GB
    except ValueError:
        limit = -1.0
    if not limit >= 0:
        raise InputError(
            f"ATTNWARP_CACHE_GB: got {said!r}, expected a number of gigabytes such as 10"
        )
    return int(limit * 1e9)


def _files() -> list[tuple[Path, os.stat_result]]:
    """Every stored file with its state; one that another process removes meanwhile is left out."""
    found = []
    for path in cache_dir().glob("*/*.npz"):
        with contextlib.suppress(OSError):
            found.append((path, path.stat()))
    return found


def usage() -> dict[str, tuple[int, int]]:
    """Files and bytes by kind."""
    table: dict[str, tuple[int, int]] = {}
    for path, state in _files():
        count, size = table.get(path.parent.name, (0, 0))
        table[path.parent.name] = (count + 1, size + state.st_size)
    return dict(sorted(table.items()))


def trim(limit: int) -> int:
    """Remove the files written longest ago until at most ``limit`` bytes are left; how many bytes
    went.

    Safe beside other processes: a reader that has a file open keeps it, and one that comes later
    computes it again.
    """
    files = sorted(_files(), key=lambda item: item[1].st_mtime)
    excess = sum(state.st_size for _, state in files) - limit
    removed = 0
    for path, state in files:
        if removed >= excess:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            removed += state.st_size
    return removed
