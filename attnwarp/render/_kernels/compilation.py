"""Compilation of the kernels: decorators, casts, and prefetches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic

from attnwarp.numba_cache import CACHE, KEY

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# NaN and infinity are left to IEEE rules: selects rely on comparisons with them.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def by_one_process(dispatcher: Any) -> Any:
    """Let one process at a time compile a cached kernel; the others then read it from disk.

    Workers that start together would otherwise each spend half a minute on the same kernels.
    """
    if fcntl is not None and hasattr(dispatcher, "_cache"):
        compile_here = dispatcher.compile

        def compile_or_read(signature: Any) -> Any:
            # numba's lock first: a thread that holds it may compile a called kernel here.
            with global_compiler_lock, _alone(dispatcher):
                return compile_here(signature)

        dispatcher.compile = compile_or_read
    return dispatcher


@contextmanager
def _alone(dispatcher: Any) -> Iterator[None]:
    path = Path(dispatcher._cache.cache_path) / f"{dispatcher.__qualname__}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError:  # unwritable, so there is no cache either
        yield
        return
    with file:
        with suppress(OSError):  # without file locks, each process compiles
            fcntl.flock(file, fcntl.LOCK_EX)  # until it is closed
        yield


def _compiled(**options: Any) -> Any:
    """Apply numba's decorator, with a disk cache that is discarded if any module changes.

    numba tracks only the function's file, and would reuse outdated code inlined from other files.
    """

    def decorate(function: Any) -> Any:
        dispatcher = numba.njit(
            nogil=True, cache=CACHE, error_model="numpy", fastmath=FAST, **options
        )(function)
        # There is no cache if numba's compilation is disabled.
        file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if file is not None:
            file._source_stamp = KEY
        return by_one_process(dispatcher)

    return decorate


jit = _compiled()


def exact(function: Any) -> Any:
    """Apply numba's decorator for kernels whose every operation is rounded separately, in order.

    numba's reference counts are off: two threads that count the same array up and down for every
    token spend more on the counting than on the token. Such kernels must not allocate.
    """
    return by_one_process(numba.njit(**_EXACT)(function))


def exact_inlined(function: Any) -> Any:
    """Compile as :func:`exact` does, for functions called for each pixel: LLVM inlines them into
    their callers.

    By default LLVM does not inline the larger ones, and each call then passes 50 fields.
    """
    return by_one_process(numba.njit(forceinline=True, **_EXACT)(function))


def exact_pasted(function: Any) -> Any:
    """Compile as :func:`exact` does, as part of each caller: for closures, which numba's cache
    never finds again, and for functions that take longer to compile than to run."""
    return numba.njit(inline="always", **{**_EXACT, "cache": False})(function)


_EXACT: Any = {"nogil": True, "cache": CACHE, "error_model": "numpy", "_nrt": False}


# numba's reference counts are off: LLVM cannot remove those of arrays passed to inlined functions,
# and two threads that count the same array up and down for every splat spend a third of their
# time on it. Such kernels must not allocate.
bare = _compiled(_nrt=False)
inlined = _compiled(inline="always")

f32 = np.float32
f64 = np.float64
# Indices are unsigned in inner loops: numba's test for negative ones stops vectorisation.
u64 = np.uint64


def _prefetcher(write: int) -> Any:
    @intrinsic
    def prefetch_item(typing: Any, array: Any, item: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = cgutils.create_struct_proxy(signature.args[0])(context, builder, args[0]).data
            pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
            word = ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), word, word, word])
            call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
            builder.call(call, [pointer, word(write), word(3), word(1)])
            return word(0)

        return numba.int32(array, numba.int64), codegen

    return prefetch_item


# Load the cache line of an array's item (counted flat) ahead of its use, for reading or writing.
prefetch, prefetch_to_write = _prefetcher(0), _prefetcher(1)
