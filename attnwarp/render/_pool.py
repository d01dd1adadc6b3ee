"""Memory that is used again: fresh pages cost more than what is done with them.

A picture of 512 x 512 with 50,000 splats takes 30 MB, and each page of it that the system has to
find and clear costs a microsecond or two: a quarter of the time that the picture takes. A block
goes back to the pool when the last array that lies in it is gone, whoever holds it: results that
the caller keeps are never written again.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

SMALLEST = 1 << 14
"""Bytes; what is smaller is left to numpy."""
MOST = 256 << 20
"""Bytes held for further use. When there are more, all of them are given up: sizes have changed."""
ALIGNMENT = 64

_free: dict[int, list[np.ndarray]] = {}
_held = 0


class _Lease:
    """What an array taken from the pool keeps alive; the block returns when it dies."""

    __slots__ = ("__array_interface__", "raw")

    def __init__(self, raw: np.ndarray, size: int) -> None:
        self.raw = raw
        address = -(-raw.ctypes.data // ALIGNMENT) * ALIGNMENT
        self.__array_interface__ = {
            "shape": (size,),
            "typestr": "|u1",
            "data": (address, False),
            "version": 3,
        }

    def __del__(self, ending: Callable[[], bool] = sys.is_finalizing) -> None:
        if not ending():
            _give(self.raw)


def _give(raw: np.ndarray) -> None:
    # Dictionaries and lists are safe to use from several threads; the sum may be off by a block,
    # which is no harm. No lock: the garbage collector may come here at any moment, from inside of
    # this module too.
    global _held
    if _held + raw.nbytes > MOST:
        clear()
    if raw.nbytes > MOST:
        return
    _held += raw.nbytes
    _free.setdefault(raw.nbytes, []).append(raw)


def clear() -> None:
    """Give all unused blocks back to the system."""
    global _held
    _free.clear()
    _held = 0


def empty(shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array like ``np.empty``'s, on a 64-byte boundary if it has 16 KiB or more."""
    global _held
    # Not numpy's product, which makes an array of each shape: a picture takes dozens.
    length = math.prod(shape) if isinstance(shape, tuple) else int(shape)
    size = length * np.dtype(dtype).itemsize
    if size < SMALLEST:
        return np.empty(shape, dtype)
    # Eight sizes between a power of two and the next.
    step = 1 << max(size.bit_length() - 4, 0)
    whole = -(-size // step) * step + ALIGNMENT
    try:
        raw = _free[whole].pop()
        _held -= whole
    except (KeyError, IndexError):
        raw = np.empty(whole, np.uint8)
    return np.asarray(_Lease(raw, size)).view(dtype).reshape(shape)


def zeros(shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array like ``np.zeros``'s."""
    result = empty(shape, dtype)
    result.fill(0)
    return result
