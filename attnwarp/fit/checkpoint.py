"""Fits that can be stopped at any moment and taken up again, with the same bits as if they had not
been.
"""

from __future__ import annotations

import io
import os
import pickle
from pathlib import Path
from typing import Any

import torch

from attnwarp.io import FileFormatError
from attnwarp.io.file import write_atomically

FORMAT = 1
"""Raised when a checkpoint's content changes meaning; older ones are then refused rather than
misread.
"""


def save(path: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) atomically: a fit that is killed leaves this one
    or the one before.
    """
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **state}, buffer)
    write_atomically(path, lambda stream: stream.write(buffer.getbuffer()))


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What :func:`save` wrote. Only tensors and plain values are read; a file cannot run code.

    Raises:
        FileFormatError: it is damaged, of another format, or something else altogether.
    """
    path = Path(path)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, OSError, EOFError, pickle.UnpicklingError, KeyError, ValueError) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise FileFormatError(
            path, f"not a checkpoint that can be read ({first}); remove it to begin again"
        ) from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        came = state.get("format") if isinstance(state, dict) else type(state).__name__
        raise FileFormatError(
            path,
            f"got a checkpoint of format {came!r}, expected {FORMAT}; remove it to begin again",
            field="format",
        )
    return state
