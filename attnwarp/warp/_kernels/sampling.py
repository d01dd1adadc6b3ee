# mypy: disallow-untyped-defs=False, check-untyped-defs=False
"""Sampling and blending of features: loops over taps, tokens and channels.

Every product and sum is rounded separately, in the order of the definition
(:mod:`attnwarp.warp.sampling`), so both give the same bits: fastmath must stay off here.

Half precision is passed as integers, since numba lacks those types: uint16 holds float16, int16
holds bfloat16. ``index`` and ``weight`` are the fields of :class:`attnwarp.warp.taps.Taps`.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from attnwarp.render._kernels.compilation import exact

PLANES = 8
"""Number of feature-map planes sampled together."""
HALF, BRAIN = types.uint16, types.int16


def _converts_half(context: Any) -> bool:
    """Return True if numba's target processor converts float16: all but x86 without F16C. LLVM
    would otherwise call library functions that this process may lack.
    """
    triple, _, features = context.codegen().magic_tuple()
    return not triple.startswith(("x86", "i686", "i386")) or "+f16c" in features.split(",")


def _from_half(builder: Any, bits: Any) -> Any:
    """Convert float16 to float32 by integer operations, exactly."""
    word, number = ir.IntType(32), ir.FloatType()
    wide = builder.zext(bits, word)
    magnitude = builder.and_(wide, word(0x7FFF))
    shifted = builder.shl(magnitude, word(13))
    # The exponent bias is 15 in float16 and 127 in float32.
    normal = builder.add(shifted, word((127 - 15) << 23))
    tiny = builder.fmul(builder.uitofp(magnitude, number), ir.Constant(number, 2.0**-24))
    value = builder.select(
        builder.icmp_unsigned("<", magnitude, word(0x400)), builder.bitcast(tiny, word), normal
    )
    endless = builder.or_(shifted, word(0x7F800000))
    value = builder.select(builder.icmp_unsigned(">=", magnitude, word(0x7C00)), endless, value)
    sign = builder.shl(builder.and_(wide, word(0x8000)), word(16))
    return builder.bitcast(builder.or_(value, sign), number)


def _to_half(builder: Any, value: Any) -> Any:
    """Convert float32 to float16 by integers, rounding to nearest, ties to even."""
    word, number = ir.IntType(32), ir.FloatType()
    bits = builder.bitcast(value, word)
    magnitude = builder.and_(bits, word(0x7FFFFFFF))
    odd = builder.and_(builder.lshr(magnitude, word(13)), word(1))
    rebiased = builder.sub(magnitude, word((127 - 15) << 23))
    normal = builder.lshr(builder.add(rebiased, builder.add(odd, word(0xFFF))), word(13))
    # A float32 sum with 2^23 has no fractional bits, so the addition rounds like float16.
    scaled = builder.fmul(builder.bitcast(magnitude, number), ir.Constant(number, 2.0**24))
    whole = builder.fadd(scaled, ir.Constant(number, 2.0**23))
    tiny = builder.sub(builder.bitcast(whole, word), word(0x4B000000))
    rounded = builder.select(
        builder.icmp_unsigned("<", magnitude, word((127 - 14) << 23)), tiny, normal
    )
    large = builder.icmp_unsigned(">=", magnitude, word(0x47800000))
    rounded = builder.select(large, word(0x7C00), rounded)
    nan = builder.or_(word(0x7E00), builder.lshr(builder.and_(bits, word(0x7FFFFF)), word(13)))
    rounded = builder.select(builder.icmp_unsigned(">", magnitude, word(0x7F800000)), nan, rounded)
    sign = builder.and_(builder.lshr(bits, word(16)), word(0x8000))
    return builder.trunc(builder.or_(rounded, sign), ir.IntType(16))


def _from_brain(builder: Any, bits: Any) -> Any:
    word = ir.IntType(32)
    return builder.bitcast(builder.shl(builder.zext(bits, word), word(16)), ir.FloatType())


def _to_brain(builder: Any, value: Any) -> Any:
    word = ir.IntType(32)
    bits = builder.bitcast(value, word)
    odd = builder.and_(builder.lshr(bits, word(16)), word(1))
    even = builder.lshr(builder.add(bits, builder.add(odd, word(0x7FFF))), word(16))
    # Rounding could carry a NaN's payload into an infinity.
    number = builder.fcmp_ordered("ord", value, value)
    return builder.trunc(builder.select(number, even, word(0x7FC0)), ir.IntType(16))


@intrinsic
def _wide(typing: Any, value: Any) -> Any:
    """Widen a stored value: float64 stays float64, all other types become float32."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if value == HALF and not _converts_half(context):
            return _from_half(builder, args[0])
        if value == HALF:
            return builder.fpext(builder.bitcast(args[0], ir.HalfType()), ir.FloatType())
        return _from_brain(builder, args[0]) if value == BRAIN else args[0]

    return (types.float32 if value in (HALF, BRAIN) else value)(value), build


@intrinsic
def _narrow(typing: Any, row: Any, value: Any) -> Any:
    """Convert a number to the storage type of ``row``, rounding to nearest, ties to even."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if row.dtype == HALF and not _converts_half(context):
            return _to_half(builder, args[1])
        if row.dtype == HALF:
            return builder.bitcast(builder.fptrunc(args[1], ir.HalfType()), ir.IntType(16))
        return _to_brain(builder, args[1]) if row.dtype == BRAIN else args[1]

    return row.dtype(row, value), build


@exact
def _all_used(weight, n):
    return weight[0, n] > 0 and weight[1, n] > 0 and weight[2, n] > 0 and weight[3, n] > 0


@exact
def _sum_used(plane, index, weight, n, zero):
    """Sum one plane's weighted taps. A tap of weight 0 may have any value, even NaN."""
    total = zero
    for k in range(4):
        if weight[k, n] > 0:
            total += weight[k, n] * _wide(plane[index[k, n]])
    return total


@exact
def sample_rows(begin, end, source, index, weight, result):
    """Compute tokens ``begin`` to ``end`` of ``result``.

    Args:
        source, result: (B, h*w, C) and (B, N, C), of one type.
        index, weight: (4, N) uint32, and (4, N).
    """
    zero = weight.dtype.type(0)
    for b in range(source.shape[0]):
        for n in range(begin, end):
            row = result[b, n]
            w0, w1, w2, w3 = weight[0, n], weight[1, n], weight[2, n], weight[3, n]
            r0, r1 = source[b, index[0, n]], source[b, index[1, n]]
            r2, r3 = source[b, index[2, n]], source[b, index[3, n]]
            if _all_used(weight, n):
                for c in range(row.size):
                    left = zero + w0 * _wide(r0[c]) + w1 * _wide(r1[c])
                    row[c] = _narrow(row, left + w2 * _wide(r2[c]) + w3 * _wide(r3[c]))
            else:
                for c in range(row.size):
                    total = zero
                    total += w0 * _wide(r0[c]) if w0 > 0 else zero
                    total += w1 * _wide(r1[c]) if w1 > 0 else zero
                    total += w2 * _wide(r2[c]) if w2 > 0 else zero
                    total += w3 * _wide(r3[c]) if w3 > 0 else zero
                    row[c] = _narrow(row, total)


@exact
def sample_maps(begin, end, source, index, weight, result):
    """Compute planes ``begin`` to ``end`` of ``result``.

    Args:
        source, result: (P, h*w) and (P, N), of one type; index, weight: as in :func:`sample_rows`.
    """
    zero = weight.dtype.type(0)
    for first in range(begin, end, PLANES):
        # Taps and weights, most of the memory traffic, are read once for several planes.
        last = min(first + PLANES, end)
        for n in range(result.shape[1]):
            if _all_used(weight, n):
                w0, w1, w2, w3 = weight[0, n], weight[1, n], weight[2, n], weight[3, n]
                i0, i1, i2, i3 = index[0, n], index[1, n], index[2, n], index[3, n]
                for p in range(first, last):
                    left = zero + w0 * _wide(source[p, i0]) + w1 * _wide(source[p, i1])
                    total = left + w2 * _wide(source[p, i2]) + w3 * _wide(source[p, i3])
                    result[p, n] = _narrow(result, total)
            else:
                for p in range(first, last):
                    result[p, n] = _narrow(result, _sum_used(source[p], index, weight, n, zero))


@exact
def scatter_rows(begin, end, gradient, index, weight, result):
    """Compute channels ``begin`` to ``end`` of the gradient in the source's tokens.

    Each thread handles separate channels and adds all positions in order, so the bits are the same
    for any number of threads.

    Args:
        gradient, result: (B, N, C) of the warped tokens; (B, h*w, C) zeros of the weights' type.
    """
    for b in range(gradient.shape[0]):
        for n in range(gradient.shape[1]):
            upstream = gradient[b, n]
            for k in range(4):
                factor = weight[k, n]
                if factor > 0:
                    row = result[b, index[k, n]]
                    for c in range(begin, end):
                        row[c] += factor * upstream[c]


@exact
def scatter_maps(begin, end, gradient, index, weight, result):
    """Compute planes ``begin`` to ``end`` of the gradient in the source's maps.

    Args:
        gradient, result: (P, N); (P, h*w) zeros of the weights' type.
    """
    for p in range(begin, end):
        for n in range(gradient.shape[1]):
            for k in range(4):
                if weight[k, n] > 0:
                    result[p, index[k, n]] += weight[k, n] * gradient[p, n]
