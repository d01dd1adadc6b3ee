"""Dispatch of a kernel's calls to machine code.

numba infers the types of all arguments at every call, which takes microseconds for each array of a
structure. A small picture takes milliseconds and dozens of calls with dozens of arrays, so the
inference would take a fifth of its time: this module caches the machine code by type.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

SCALARS = frozenset({bool, int, float, np.float32, np.float64, np.int32, np.int64})
"""Types whose numba type follows from Python's; that of an integer of more bits follows from its
value.
"""

PLAIN, WRITEABLE = 0x101, 0x400
"""numpy's flags of arrays: C-contiguous and aligned (NPY_ARRAY_CARRAY_RO), writeable. Read as one
number, since access by name would create an object for each flag."""

_machine_code: dict[tuple[Any, ...], Callable[..., Any]] = {}


def _type_key(value: Any) -> Any:
    """Compute a key that is equal for two values only if numba gives them the same type."""
    kind = type(value)
    if kind is np.ndarray:
        flags = value.flags.num
        if flags & PLAIN == PLAIN:
            return value.dtype, value.ndim, flags & WRITEABLE
    elif isinstance(value, tuple):
        return kind, *map(_type_key, value)
    elif kind in SCALARS and (kind is not int or value.bit_length() < 64):
        return kind
    return numba.typeof(value)


def machine_code(kernel: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., Any]:
    """Return the machine code of ``kernel`` for the arguments' types, compiling it if missing.

    If numba's compilation is disabled, the kernel is a plain function and is returned.
    """
    if not hasattr(kernel, "typeof_pyval"):
        return kernel
    key = (kernel, *map(_type_key, arguments))
    if key not in _machine_code:
        _machine_code[key] = kernel.compile(tuple(map(kernel.typeof_pyval, arguments)))  # type: ignore[attr-defined]
    return _machine_code[key]


def call(kernel: Callable[..., Any], *arguments: Any) -> Any:
    """Call ``kernel(*arguments)``."""
    return machine_code(kernel, arguments)(*arguments)


def typed(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``kernel`` for calls that have the types of the first, found once, as jobs have."""
    found: list[Callable[..., Any]] = []

    def called(*arguments: Any) -> Any:
        if not found:
            found.append(machine_code(kernel, arguments))
        return found[0](*arguments)

    return called
