"""Files that the harness writes: canonical JSON and names made from it, atomic writes, pictures."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.io.file import write_atomically
from attnwarp.io.picture import encode_picture


def canonical_json(value: Any) -> str:
    """The one JSON text of a value: sorted keys, no spaces, no NaN.

    >>> canonical_json({"b": 1, "a": [2.5, None]})
    '{"a":[2.5,null],"b":1}'
    """
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True
    )


def digest(value: Any) -> str:
    """SHA-256 of a value's canonical JSON, as 64 hexadecimal digits."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def without_nan(value: Any) -> Any:
    """``value`` with null for every number that JSON lacks: NaN and the infinities.

    Mappings and sequences are gone through; NumPy's numbers become Python's.

    >>> without_nan({"psnr": float("inf"), "views": [1, np.float64("nan"), "a"]})
    {'psnr': None, 'views': [1, None, 'a']}
    """
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_atomic(path: Path, data: bytes) -> None:
    """Write so that ``path`` keeps its old content or has all of ``data``, even after a power cut.

    Folders that are missing are made.

    Raises:
        OSError: the disk is full, or the folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda stream: stream.write(data))
    # The name is the folder's content: it lasts only when the folder is flushed as well.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_json(path: Path, value: Any, *, sort_keys: bool = True) -> None:
    """Write ``value`` as JSON that a person can read, atomically.

    Raises:
        ValueError: a number that JSON lacks; see :func:`without_nan`.
    """
    text = json.dumps(value, indent=1, sort_keys=sort_keys, allow_nan=False) + "\n"
    write_atomic(path, text.encode())


def write_picture(path: Path, image: npt.ArrayLike, **jpeg: Any) -> Path:
    """Write a picture atomically, as PNG or JPEG by its name's suffix; return ``path``.

    Args:
        path: of the file; missing folders are made.
        image: see :func:`attnwarp.io.picture.encode_picture`.
        jpeg: its ``quality`` and ``chroma``.
    """
    write_atomic(path, encode_picture(image, path.suffix, **jpeg))
    return path
