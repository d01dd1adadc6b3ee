"""Checkpoints: what a fit that was stopped needs to give the bits of one that was not.

A file is one line of text, which names the format and the SHA-256 of the rest, and what torch.save
writes.
"""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import Any

import torch

from attnwarp.io import FileFormatError
from attnwarp.io.file import write_atomically

FORMAT = 2
"""Raised when a checkpoint's content changes meaning; older ones are then refused rather than
misread.
"""

REMEDY = "remove it to begin again"

_MAGIC = b"attnwarp checkpoint"


def save(path: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) atomically: a fit that is killed leaves this one
    or the one before.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = buffer.getvalue()
    head = b"%s %d %s\n" % (_MAGIC, FORMAT, hashlib.sha256(data).hexdigest().encode())

    write_atomically(path, lambda stream: stream.write(head + data))


def load(path: str | os.PathLike[str], remedy: str = REMEDY) -> dict[str, Any]:
    """What :func:`save` wrote. Only tensors and plain values are read; a file cannot run code.

    Args:
        path: of the file.
        remedy: the end of a message.

    Raises:
        FileFormatError: it is damaged in any bit, of another format, or something else altogether.
    """
    path = Path(path)
    head, _, data = path.read_bytes().partition(b"\n")
    words = head.split()
    if words[:2] != _MAGIC.split() or len(words) != 4:
        raise FileFormatError(path, f"not a checkpoint of this version; {remedy}")
    if words[2] != str(FORMAT).encode():
        raise FileFormatError(
            path,
            f"got a checkpoint of format {words[2].decode('ascii', 'replace')}, expected {FORMAT};"
            f" {remedy}",
            field="format",
        )
    if words[3] != hashlib.sha256(data).hexdigest().encode():
        raise FileFormatError(path, f"its checksum does not match, so it is damaged; {remedy}")
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    # A checksum that matches leaves a file made on purpose. torch's message advises to load it all
    # the same, which runs its code, and is not passed on.
    except Exception as error:
        raise FileFormatError(
            path,
            f"holds something other than tensors and plain values ({type(error).__name__}); do not"
            f" use it, {remedy}",
        ) from None
    if not isinstance(state, dict):
        raise FileFormatError(path, f"holds {type(state).__name__}, expected a dict; {remedy}")
    return state
