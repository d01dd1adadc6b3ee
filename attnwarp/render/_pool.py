"""Memory that is used again: fresh pages cost more than what is done with them.

A picture of 512 x 512 with 50,000 splats takes 30 MB, and each page of it that the system has to
find and clear costs a microsecond or two: a quarter of the time that the picture takes. A block
goes back to the pool when the last array that lies in it is gone, whoever holds it: results that
the caller keeps are never written again.

Each view of a million splats or more takes and returns hundreds of megabytes, so what is held
follows what was needed of late, and falls again once smaller views have followed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

SMALLEST = 1 << 14
"""Bytes; what is smaller is left to numpy."""
LEAST = 256 << 20
"""Bytes that may be held for further use after views of any size."""
SLACK = 1.25
"""Most bytes held, in multiples of the most taken at one time. Blocks of different sizes take the
place of each other within a view, so its blocks sum to up to 1.12 times that (measured, 50,000 to
3 million splats, with and without gradients)."""
WINDOW = 512
"""Arrays taken before an earlier need begins to be forgotten. A view takes 36 to 86."""
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
    # Dictionaries and lists are safe to use from several threads; the sums may be off by a block,
    # which is no harm. No lock: the garbage collector may come here at any moment, from inside of
    # this module too.
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
    """Give all unused blocks up if ``size`` more bytes are too many: sizes have changed."""
    if _held + _leased - _low + size > _most():
        clear()


def _count(size: int) -> None:
    """Count a block that is taken."""
    global _leased, _low, _need, _taken
    _leased += size
    _taken += 1
    if _taken % WINDOW == 0:
        _need, _low = [_need[1], 0], _leased
    _need[1] = max(_need[1], _leased - _low)


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
        _make_room(whole)
        raw = np.empty(whole, np.uint8)
    _count(whole)
    return np.asarray(_Lease(raw, size)).view(dtype).reshape(shape)


def zeros(shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array like ``np.zeros``'s."""
    result = empty(shape, dtype)
    result.fill(0)
    return result
