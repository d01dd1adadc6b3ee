"""Machine code is looked up by keys that tell apart what numba's own types tell apart."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from attnwarp.render import dispatch


class Pair(NamedTuple):
    first: Any
    second: Any


class Other(NamedTuple):
    first: Any
    second: Any


def _read_only() -> np.ndarray:
    array = np.zeros((2, 3))
    array.flags.writeable = False
    return array


def _unaligned() -> np.ndarray:
    return np.zeros(33, np.uint8)[1:].view(np.float64)


class Subclass(np.ndarray):
    pass


def _double(value: float) -> float:
    return 2 * value


VALUES = [
    np.zeros((2, 3)),
    np.zeros((2, 3), np.float32),
    np.zeros((2, 3), np.int64),
    np.zeros((2, 3), np.uint64),
    np.zeros((2, 3), np.bool_),
    np.zeros((2, 3, 4)),
    np.zeros((3, 2)).T,
    np.zeros((4, 6))[::2, ::2],
    np.zeros((0, 3)),
    _read_only(),
    _unaligned(),
    1,
    -1,
    2**63,
    True,
    1.0,
    np.float32(1),
    np.float64(1),
    np.int32(1),
    np.zeros((2, 3)).view(Subclass),
    np.zeros((2, 3), np.float32).view(Subclass),
    [1],
    [1.0],
    numba.njit(_double),
    (1, 2),
    (1, 2.0),
    (1, 2, 3),
    Pair(1, np.zeros(3)),
    Pair(1, np.zeros(3, np.float32)),
    Pair(1, _read_only()),
    Other(1, np.zeros(3)),
    Pair(Other(1, 2), np.zeros(3)),
]


@pytest.mark.parametrize("first", range(len(VALUES)))
def test_equal_keys_are_equal_types(first: int) -> None:
    for second in VALUES:
        keys = [dispatch._type_key(value) for value in (VALUES[first], second)]
        types = [numba.typeof(value) for value in (VALUES[first], second)]
        if keys[0] == keys[1]:
            assert types[0] == types[1], (VALUES[first], second)
    # A key that is new each time would compile at every call.
    assert dispatch._type_key(VALUES[first]) == dispatch._type_key(VALUES[first])


def test_a_call_gives_what_numba_gives() -> None:
    @numba.njit
    def total(pair: Pair, factor: float) -> float:
        return factor * pair.first.sum() + pair.second

    for array in (np.arange(6.0), np.arange(6, dtype=np.float32), np.arange(12.0)[::2]):
        for _ in range(2):
            result = dispatch.call(total, Pair(array, 1), 0.5)
            assert result == total(Pair(array, 1), 0.5) == 0.5 * array.sum() + 1
    # Of float64, float32 and every other float64, each compiled once.
    assert sum(key[0] is total for key in dispatch._machine_code) == 3


def test_a_function_of_python_is_called_as_it_is() -> None:
    assert dispatch.call(max, 2, 3) == 3
