# mypy: ignore-errors
"""Sums and votes over the 32 threads of a GPU's warp, which are neighbouring pixels.

On Warp's CPU device a thread is alone, so a sum is the thread's value. On a GPU every thread of the
warp must reach these calls together, so they appear only in branches taken by all.
"""

from __future__ import annotations

import warp as wp

COLUMNS = 22
"""Number of columns of a splat's gradient row common to all pictures."""

Sums = wp.types.vector(length=COLUMNS, dtype=wp.float32)


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, value) != 0;
#else
    return value;
#endif
"""
)
def any_lane(value: wp.bool) -> wp.bool:
    """Return True if ``value`` is True for any thread of the warp."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    for (int s = 16; s > 0; s >>= 1) value = max(value, __shfl_xor_sync(0xffffffffu, value, s));
#endif
    return value;
"""
)
def most_of_lanes(value: wp.int32) -> wp.int32:
    """Return the largest value of the warp's threads."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    for (int s = 16; s > 0; s >>= 1) value += __shfl_xor_sync(0xffffffffu, value, s);
    if ((threadIdx.x & 31) != 0) return;
#endif
    wp::atomic_add(target, at, (wp::int64)((double)value * unit));
"""
)
def add_whole(value: wp.float32, unit: wp.float64, target: wp.array(dtype=wp.int64), at: wp.int32):
    """Add the warp's sum, as an integer multiple of 1 / ``unit``, to ``target``: integers have the
    same sum in any order."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    for (int s = 16; s > 0; s >>= 1) value += __shfl_xor_sync(0xffffffffu, value, s);
    if ((threadIdx.x & 31) != 0) return;
#endif
    wp::atomic_add(target, row, column, (wp::float64)value);
"""
)
def add_single(
    value: wp.float32, target: wp.array2d(dtype=wp.float64), row: wp.int32, column: wp.int32
):
    """Add the warp's sum to one number of ``target``."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    for (int s = 16; s > 0; s >>= 1) value += __shfl_xor_sync(0xffffffffu, value, s);
    if ((threadIdx.x & 31) != 0) return;
#endif
    wp::atomic_add(target, at, value);
"""
)
def add_double(value: wp.float64, target: wp.array(dtype=wp.float64), at: wp.int32):
    """Add the warp's sum to one number of ``target``."""
    ...


# Columns over threads: at each step a thread passes one half of its columns to the thread whose
# number differs in that bit, and adds the received half to the other. In the end thread k has the
# sum of column k: 31 exchanges instead of 5 per column, and one addition to memory for all.
@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    float v[32];
#pragma unroll
    for (int c = 0; c < 32; ++c) v[c] = c < 22 ? sums[c] : 0.0f;
#define ATTNWARP_FOLD(s)                                                              \\
    _Pragma("unroll") for (int c = 0; c < s; ++c) {                                   \\
        const bool upper = (lane & s) != 0;                                           \\
        const float given = __shfl_xor_sync(0xffffffffu, upper ? v[c] : v[c + s], s); \\
        v[c] = (upper ? v[c + s] : v[c]) + given;                                     \\
    }
    ATTNWARP_FOLD(16)
    ATTNWARP_FOLD(8)
    ATTNWARP_FOLD(4)
    ATTNWARP_FOLD(2)
    ATTNWARP_FOLD(1)
#undef ATTNWARP_FOLD
    if (lane < 22) wp::atomic_add(target, row, lane, (wp::float64)v[0]);
#else
    for (int c = 0; c < 22; ++c) wp::address(target, row, c)[0] += (wp::float64)sums[c];
#endif
"""
)
def add_columns(sums: Sums, target: wp.array2d(dtype=wp.float64), row: wp.int32):
    """Add the warp's sums of each column to a row of ``target``."""
    ...


@wp.func_native("""return fmaf(a, b, c);""")
def fma(a: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32:
    """Compute a b + c, rounded once."""
    ...
