"""Memory pool of arrays, since fresh pages cost more than the work on them.

A picture of 512 x 512 with 50,000 splats takes 30 MB, and each page that the system must find and
clear costs a microsecond or two: a quarter of the picture's time. A block returns to the pool once
the last array in it is gone, whoever holds it: results kept by the caller are never overwritten.

Each view of a million splats or more takes and returns hundreds of megabytes, so the held amount
follows the recent need, and falls again after smaller views.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

SMALLEST = 1 << 14
"""Smallest pooled size in bytes; numpy allocates smaller arrays."""
LEAST = 256 << 20
"""Bytes that may always be held for reuse, after views of any size."""
SLACK = 1.25
"""Most bytes held, in multiples of the most taken at one time. Blocks of different sizes replace
each other within a view, so its blocks sum to up to 1.12 times that (measured, 50,000 to 3 million
splats, with and without gradients)."""
WINDOW = 512
"""Number of allocations after which an earlier need is forgotten; a view makes 36 to 86."""
ALIGNMENT = 64

_free: dict[int, list[np.ndarray]] = {}
_held = 0
_leased = 0
_low = 0  # the least of _leased in this window: what callers keep, which is no view's need
_need = [0, 0]  # the highest rise of _leased above _low, in the window before and in this one
_taken = 0


class _Lease:
    """Owner that an array taken from the pool keeps alive; the block returns when it dies."""

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
    # Dictionaries and lists are thread-safe; the sums may be off by a block, which is harmless.
    # No lock: the garbage collector may call this at any moment, even from inside this
    # module.
    global _held, _leased, _low
    _leased -= raw.nbytes
    _low = min(_low, _leased)
    _make_room(raw.nbytes)
    if raw.nbytes > _most():
        return
    _held += raw.nbytes
    _free.setdefault(raw.nbytes, []).append(raw)


def _most() -> float:
    return max(LEAST, SLACK * max(_need))


def _make_room(size: int) -> None:
    """Release all unused blocks if ``size`` more bytes exceed the limit: sizes have changed."""
    if _held + _leased - _low + size > _most():
        clear()


def _count(size: int) -> None:
    """Count an allocated block."""
    global _leased, _low, _need, _taken
    _leased += size
    _taken += 1
    if _taken % WINDOW == 0:
        _need, _low = [_need[1], 0], _leased
    _need[1] = max(_need[1], _leased - _low)


def clear() -> None:
    """Return all unused blocks to the system."""
    global _held
    _free.clear()
    _held = 0


def empty(shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
    """Allocate like ``np.empty``, on a 64-byte boundary for 16 KiB or more."""
    global _held
    # Not numpy's product, which allocates an array per shape: a picture has dozens.
    length = math.prod(shape) if isinstance(shape, tuple) else int(shape)
    size = length * np.dtype(dtype).itemsize
    if size < SMALLEST:
        return np.empty(shape, dtype)
    # Eight block sizes between consecutive powers of two.
    step = 1 << max(size.bit_length() - 4, 0)
    whole = -(-size // step) * step + ALIGNMENT
    try:
        raw = _free[whole].pop()
        _held -= whole
    except (KeyError, IndexError):
        _make_room(whole)
        raw = np.empty(whole, np.uint8)
    _count(whole)
    return np.asarray(_Lease(raw, size)).view(dtype).reshape(shape)


def zeros(shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
    """Allocate like ``np.zeros``."""
    result = empty(shape, dtype)
    result.fill(0)
    return result
