"""Compilation of the kernels: decorators, casts, and prefetches."""

from __future__ import annotations

import hashlib
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

from attnwarp.numba_cache import CACHE

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# NaN and infinity are left to IEEE rules: selects rely on comparisons with them.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def fingerprint(folder: Path = Path(__file__).parent) -> str:
    """SHA-256 of all that is compiled: the modules of ``folder``, and two modules beside it."""
    beside = [folder.parent / name for name in ("constants.py", "harmonics.py")]
    files = [*sorted(folder.glob("*.py")), *beside]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


FINGERPRINT = fingerprint()


def by_one_process(dispatcher: Any) -> Any:
    """Let one process at a time compile a kernel that is cached; the others then read it from disk.

    Workers that begin together would each spend half a minute on the same kernels.
    """
    if fcntl is not None and hasattr(dispatcher, "_cache"):
        compile_here = dispatcher.compile

        def compile_or_read(signature: Any) -> Any:
            # numba's lock first: a thread that holds it may come here for a kernel it calls.
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
    except OSError:  # no cache either, where nothing can be written
        yield
        return
    with file:
        with suppress(OSError):  # where the file system has no locks, each process compiles
            fcntl.flock(file, fcntl.LOCK_EX)  # until it is closed
        yield


def _compiled(**options: Any) -> Any:
    """numba's decorator, with a cache on disk that is discarded when any of the modules changes.

    numba alone looks at the function's own file only, and would reuse what was inlined from others.
    """

    def decorate(function: Any) -> Any:
        dispatcher = numba.njit(
            nogil=True, cache=CACHE, error_model="numpy", fastmath=FAST, **options
        )(function)
        # There is no cache where numba is told to compile nothing.
        file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if file is not None:
            file._source_stamp = FINGERPRINT
        return by_one_process(dispatcher)

    return decorate


jit = _compiled()


def exact(function: Any) -> Any:
    """numba's decorator for kernels whose every operation is rounded by itself, in its order.

    Without numba's reference counts: two threads that count the same array up and down for every
    token spend more on that than on the token. Such kernels allocate nothing.
    """
    return by_one_process(numba.njit(**_EXACT)(function))


def exact_inlined(function: Any) -> Any:
    """Compile as :func:`exact` does, for functions that kernels call for each pixel: LLVM puts it
    into its callers.

    By itself LLVM leaves the larger ones apart, and each call then hands over 50 fields.
    """
    return by_one_process(numba.njit(forceinline=True, **_EXACT)(function))


def exact_pasted(function: Any) -> Any:
    """Compile as :func:`exact` does, as part of each caller: for closures, which numba's cache
    never finds again, and for functions that take longer to compile than to run."""
    return numba.njit(inline="always", **{**_EXACT, "cache": False})(function)


_EXACT: Any = {"nogil": True, "cache": CACHE, "error_model": "numpy", "_nrt": False}


# Without numba's reference counts: LLVM cannot remove those of arrays passed to inlined functions,
# and two threads that count the same array up and down for every splat spend a third of their time
# on it. Such kernels allocate nothing.
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
