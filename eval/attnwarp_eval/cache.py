"""Derived files: their location, checksums, and sharing between processes."""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError
from attnwarp.io.file import remove_abandoned, write_atomically
from attnwarp.process import cache_dir
from attnwarp_eval.canonical_json import digest


def content_key(*parts: Any) -> str:
    """SHA-256 (hex) of the canonical JSON of ``parts``: sorted keys, no spaces, NaN refused."""
    return digest(list(parts))


SEAL = b"attnwarp sha256 "
"""Seal before the checksum at a file's end, which NumPy ignores when it reads the npz."""

_warned: set[Path] = set()
"""Damaged files already reported by this process."""


def read_arrays(kind: str, key: str) -> dict[str, npt.NDArray[Any]] | None:
    """The arrays stored under ``kind``/``key``, or None if they must be computed.

    A file whose checksum does not match its content is reported on stderr, once, and treated as
    missing: the caller computes the arrays and :func:`write_arrays` replaces it. zip's checksum is
        not
    enough: NumPy does not verify it if an array's header was changed.
    """
    path = cache_dir() / kind / f"{key}.npz"
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content, seal = data[:-_SEAL_SIZE], data[-_SEAL_SIZE:]
    if seal != _seal(kind, key, content):
        if path not in _warned:
            _warned.add(path)
            print(f"attnwarp-eval: {path}: damaged; it is computed again", file=sys.stderr)
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


_SEAL_SIZE = len(SEAL) + hashlib.sha256().digest_size


def _seal(kind: str, key: str, content: bytes) -> bytes:
    """The last bytes of a file, which include its name: it cannot be mistaken for another."""
    return SEAL + hashlib.sha256(f"{kind}/{key}\n".encode() + content).digest()


def write_arrays(kind: str, key: str, arrays: Mapping[str, Any]) -> None:
    """Store ``arrays`` under ``kind``/``key``.

    The file appears under its name only when complete, so a reader never sees a partial file and
    the last of several writers wins. An unwritable folder is no error: the value is
    computed again next time.

    Raises:
        InputError: ``ATTNWARP_CACHE_GB`` is not a number of gigabytes.
    """
    limit = limit_bytes()
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    content = buffer.getvalue()
    data = content + _seal(kind, key, content)
    folder = cache_dir() / kind
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        # Not durable: a partial file fails its checksum, and a mesh takes less time than a flush.
        write_atomically(folder / f"{key}.npz", lambda stream: stream.write(data), durable=False)
        _keep_within(limit, len(data))


_unseen: float = float("inf")
"""Bytes written by this process since it scanned the folder; it scans at the first write."""


def _keep_within(limit: int, written: int) -> None:
    """Trim the folder, scanning it only after every hundredth of the limit written.

    A scan costs a call for each file: at every write, storing thousands of small meshes took longer
    than computing them.
    """
    global _unseen
    _unseen += written
    if _unseen > limit / 100:
        _unseen = 0.0
        trim(limit)


DEFAULT_LIMIT_GB = 10.0
"""A study of all scenes at 512 px keeps about 1 GB."""


def limit_bytes() -> int:
    """Limit of the folder's size: ``$ATTNWARP_CACHE_GB``, else :data:`DEFAULT_LIMIT_GB`.

    Raises:
        InputError: the variable is not a number of gigabytes.
    """
    text = os.environ.get("ATTNWARP_CACHE_GB", "")
    try:
        limit = 1e9 * (float(text) if text else DEFAULT_LIMIT_GB)
    except ValueError:
        limit = math.nan
    if not 0 <= limit < math.inf:
        raise InputError(
            f"ATTNWARP_CACHE_GB: got {text!r}, expected a number of gigabytes such as 10"
        )
    return int(limit)


def _files() -> list[tuple[Path, os.stat_result]]:
    """Every stored file with its state; files removed meanwhile by another process are left out."""
    files = []
    for path in cache_dir().glob("*/*.npz"):
        with contextlib.suppress(OSError):
            files.append((path, path.stat()))
    return files


def usage() -> dict[str, tuple[int, int]]:
    """Files and bytes by kind."""
    table: dict[str, tuple[int, int]] = {}
    for path, state in _files():
        count, size = table.get(path.parent.name, (0, 0))
        table[path.parent.name] = (count + 1, size + state.st_size)
    return dict(sorted(table.items()))


def trim(limit: int) -> int:
    """Remove the files written longest ago until at most ``limit`` bytes are left; return how many
    bytes were removed.

    Temporary files of dead processes are removed too. Safe with concurrent processes: a reader with
    an open file keeps it, and a later one computes it again.
    """
    for folder in cache_dir().glob("*/"):
        remove_abandoned(folder)
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
