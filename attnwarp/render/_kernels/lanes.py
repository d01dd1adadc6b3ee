"""Sixteen float32, or eight float64, as one value inside numba kernels: a whole loop can keep its
sums in vector registers.

LLVM vectorises loops over arrays, but then every sum lives in memory: 16 loads and 16 stores for
each splat and 16 pixels, which was most of the time. ``Lanes`` has the usual arithmetic (numbers
are broadcast), comparisons that give a ``Mask``, and the functions below; ``Wide`` and ``WideMask``
are the same of eight float64. LLVM splits them where the machine's vectors are shorter.

Products and sums may be fused but are not reordered: the exponential's rounding relies on that.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import (
    intrinsic,
    lower_builtin,
    lower_cast,
    models,
    register_jitable,
    register_model,
)

WIDTH = 16
FUSED = ("contract",)
FLOATS, BITS, INTS = (
    ir.VectorType(kind, WIDTH) for kind in (ir.FloatType(), ir.IntType(1), ir.IntType(32))
)
DOUBLES, WIDE_BITS, LONGS = (
    ir.VectorType(kind, 8) for kind in (ir.DoubleType(), ir.IntType(1), ir.IntType(64))
)


class Lanes(types.Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__("Lanes")


class Mask(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__("Mask")


class Wide(types.Type):
    """Eight float64."""

    def __init__(self) -> None:
        super().__init__("Wide")


class WideMask(types.Type):
    """Eight truth values."""

    def __init__(self) -> None:
        super().__init__("WideMask")


lanes, mask, wide, wide_mask = Lanes(), Mask(), Wide(), WideMask()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, FLOATS)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BITS)


@register_model(Wide)
class _WideModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, DOUBLES)


@register_model(WideMask)
class _WideMaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, WIDE_BITS)


def _spread(builder: Any, value: Any, kind: Any = FLOATS) -> Any:
    empty = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(empty, value, ir.IntType(32)(0))
    return builder.shuffle_vector(
        one, empty, ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
    )


@lower_cast(types.Number, Lanes)
def _broadcast(context: Any, builder: Any, kind: Any, _: Any, value: Any) -> Any:
    return _spread(builder, context.cast(builder, value, kind, types.float32))


@lower_cast(types.Number, Wide)
def _broadcast_wide(context: Any, builder: Any, kind: Any, _: Any, value: Any) -> Any:
    return _spread(builder, context.cast(builder, value, kind, types.float64), DOUBLES)


def _operate(
    symbol: Any, operands: types.Type, result: types.Type, build: Callable[[Any, Any, Any], Any]
) -> None:
    @infer_global(symbol)
    class _Template(AbstractTemplate):
        key = symbol

        def generic(self, args: Any, kws: Any) -> Any:
            numbers = operands in (lanes, wide)
            taken = all(a == operands or (numbers and isinstance(a, types.Number)) for a in args)
            return (
                signature(result, *[operands] * len(args)) if taken and operands in args else None
            )

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return build(builder, *args)

    lower_builtin(symbol, *[type(operands)] * (1 if symbol is operator.neg else 2))(lower)


for _numbers, _truths in ((lanes, mask), (wide, wide_mask)):
    _operate(operator.add, _numbers, _numbers, lambda b, x, y: b.fadd(x, y, flags=FUSED))
    _operate(operator.sub, _numbers, _numbers, lambda b, x, y: b.fsub(x, y, flags=FUSED))
    _operate(operator.mul, _numbers, _numbers, lambda b, x, y: b.fmul(x, y, flags=FUSED))
    _operate(operator.truediv, _numbers, _numbers, lambda b, x, y: b.fdiv(x, y, flags=FUSED))
    _operate(operator.lt, _numbers, _truths, lambda b, x, y: b.fcmp_ordered("<", x, y))
    _operate(operator.le, _numbers, _truths, lambda b, x, y: b.fcmp_ordered("<=", x, y))
    _operate(operator.gt, _numbers, _truths, lambda b, x, y: b.fcmp_ordered(">", x, y))
    _operate(operator.ge, _numbers, _truths, lambda b, x, y: b.fcmp_ordered(">=", x, y))
    _operate(operator.eq, _numbers, _truths, lambda b, x, y: b.fcmp_ordered("==", x, y))
    _operate(operator.neg, _numbers, _numbers, lambda b, x, *_: b.fneg(x))
    _operate(operator.and_, _truths, _truths, lambda b, x, y: b.and_(x, y))
    _operate(operator.or_, _truths, _truths, lambda b, x, y: b.or_(x, y))


def _kind(*args: Any) -> Any:
    """Type that numbers are broadcast to."""
    return wide if wide in args or wide_mask in args else lanes


def _pointer(context: Any, builder: Any, kind: Any, to: Any, array: Any, item: Any) -> Any:
    data = cgutils.create_struct_proxy(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [item]), to.as_pointer())


@intrinsic
def load(typing: Any, array: Any, item: Any) -> Any:
    """Sixteen consecutive numbers of a float32 array from ``item`` on, counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], FLOATS, *args), align=4)

    return lanes(array, types.int64), codegen


@intrinsic
def store(typing: Any, array: Any, item: Any, value: Any) -> Any:
    """Put ``value`` into a float32 array from ``item`` on, counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, sig.args[0], FLOATS, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), codegen


@intrinsic
def load8(typing: Any, array: Any, item: Any) -> Any:
    """Eight consecutive numbers of a float64 array from ``item`` on, counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, sig.args[0], DOUBLES, *args), align=8)

    return wide(array, types.int64), codegen


@intrinsic
def store8(typing: Any, array: Any, item: Any, value: Any) -> Any:
    """Put ``value`` into a float64 or, rounded, a float32 array from ``item`` on, counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, kind = args[2], DOUBLES
        if array.dtype == types.float32:
            kind = ir.VectorType(ir.FloatType(), 8)
            value = builder.fptrunc(value, kind)
        builder.store(value, _pointer(context, builder, sig.args[0], kind, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, wide), codegen


@intrinsic
def narrow(typing: Any, array: Any, item: Any, source: Any, begin: Any) -> Any:
    """Eight float64 of ``source`` from ``begin`` on, as float32 to ``array`` from ``item`` on; both
    counted flat.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        wide, short = ir.VectorType(ir.DoubleType(), 8), ir.VectorType(ir.FloatType(), 8)
        value = builder.load(_pointer(context, builder, sig.args[2], wide, *args[2:]), align=8)
        builder.store(
            builder.fptrunc(value, short),
            _pointer(context, builder, sig.args[0], short, *args[:2]),
            align=4,
        )
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64), codegen


@intrinsic
def select(typing: Any, chosen: Any, yes: Any, no: Any) -> Any:
    """``yes`` in the lanes that are chosen, ``no`` in the others."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    kind = _kind(chosen)
    return kind(chosen, kind, kind), codegen


@intrinsic
def minimum(typing: Any, x: Any, y: Any) -> Any:
    """The smaller one in each lane; y where one is NaN."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    kind = _kind(x, y)
    return kind(kind, kind), codegen


@intrinsic
def maximum(typing: Any, x: Any, y: Any) -> Any:
    """The larger one in each lane; y where one is NaN."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    kind = _kind(x, y)
    return kind(kind, kind), codegen


@intrinsic
def fma(typing: Any, x: Any, y: Any, z: Any) -> Any:
    """x y + z, rounded once where the machine can."""
    kind = _kind(x, y, z)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = args[0].type
        function = ir.FunctionType(vector, [vector] * 3)
        name = "llvm.fmuladd." + ("v8f64" if kind == wide else "v16f32")
        return builder.call(cgutils.get_or_insert_function(builder.module, function, name), args)

    return kind(kind, kind, kind), codegen


def _has_avx512(context: Any) -> bool:
    """Return True if numba compiles for a processor with AVX-512, which need not be this one: see
    NUMBA_CPU_NAME, NUMBA_CPU_FEATURES and NUMBA_ENABLE_AVX.
    """
    _, _, features = context.codegen().magic_tuple()
    return "+avx512f" in features.split(",")


def _approach(builder: Any, x: Any, name: str) -> tuple[Any, Any]:
    """The processor's estimate, to 14 bits, of 1 / x ("rcp14") or of 1 / sqrt(x) ("rsqrt14"), with
    AVX-512; and the function that fuses a product and a sum."""
    single = x.type == FLOATS
    lanes_here = ir.IntType(x.type.count if x.type.count > 8 else 8)
    kind = ir.FunctionType(x.type, [x.type, x.type, lanes_here])
    whole = f"llvm.x86.avx512.{name}.{'ps' if single else 'pd'}.512"
    estimate = cgutils.get_or_insert_function(builder.module, kind, whole)
    kind = ir.FunctionType(x.type, [x.type] * 3)
    fused = cgutils.get_or_insert_function(
        builder.module, kind, "llvm.fma.v16f32" if single else "llvm.fma.v8f64"
    )
    return builder.call(estimate, [x, ir.Constant(x.type, ir.Undefined), lanes_here(-1)]), fused


@intrinsic
def reciprocal(typing: Any, x: Any) -> Any:
    """1 / x to the last bit or two; anything where x is 0, infinite or below 1e-38 (float64:
    1e-308).

    With AVX-512 an estimate of 14 bits and a step or two of Newton's: three times as fast as a
    division.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, one = args[0], ir.Constant(args[0].type, [1.0] * args[0].type.count)
        if not _has_avx512(context):
            return builder.fdiv(one, x)
        r, fused = _approach(builder, x, "rcp14")
        for _ in range(1 if x.type == FLOATS else 2):
            miss = builder.call(fused, [builder.fneg(x), r, one])
            r = builder.call(fused, [r, miss, r])
        return r

    return _kind(x)(_kind(x)), codegen


@intrinsic
def reciprocal_sqrt(typing: Any, x: Any) -> Any:
    """1 / sqrt(x) of float64, to the last bits; anything where x is 0, negative or infinite."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = args[0]
        one, half = (ir.Constant(DOUBLES, [value] * 8) for value in (1.0, 0.5))
        if not _has_avx512(context):
            kind = ir.FunctionType(DOUBLES, [DOUBLES])
            return builder.fdiv(
                one,
                builder.call(
                    cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v8f64"), [x]
                ),
            )
        r, fused = _approach(builder, x, "rsqrt14")
        for _ in range(2):
            miss = builder.call(fused, [builder.fneg(builder.fmul(x, r)), r, one])
            r = builder.call(fused, [builder.fmul(r, half), miss, r])
        return r

    return wide(wide), codegen


@intrinsic
def approximate_sqrt(typing: Any, x: Any) -> Any:
    """A square root of x > 0 that is right or too large by at most 1.3e-4 of itself: several times
    as fast.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = args[0]
        if not _has_avx512(context):
            kind = ir.FunctionType(FLOATS, [FLOATS])
            return builder.call(
                cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v16f32"), [x]
            )
        r, _ = _approach(builder, x, "rsqrt14")
        return builder.fmul(builder.fmul(x, ir.Constant(FLOATS, [1 + 2.0**-14] * WIDTH)), r)

    return lanes(lanes), codegen


def _unary(name: str, document: str) -> Any:
    @intrinsic
    def operation(typing: Any, x: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            vector = args[0].type
            kind = ir.FunctionType(vector, [vector])
            whole = f"llvm.{name}." + ("v8f64" if x == wide else "v16f32")
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, whole), args)

        return _kind(x)(_kind(x)), codegen

    operation.__doc__ = document
    return operation


floor = _unary("floor", "Largest whole number that is not above x, in each lane.")
ceil = _unary("ceil", "Smallest whole number that is not below x, in each lane.")
absolute = _unary("fabs", "x without its sign, in each lane.")


@intrinsic
def exponent(typing: Any, x: Any) -> Any:
    """k of x = f 2^k with f in [1, 2), for x > 0 that is not denormal."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        raw = builder.lshr(builder.bitcast(args[0], LONGS), ir.Constant(LONGS, [52] * 8))
        return builder.sitofp(builder.sub(raw, ir.Constant(LONGS, [1023] * 8)), DOUBLES)

    return wide(wide), codegen


@intrinsic
def fraction(typing: Any, x: Any) -> Any:
    """f of x = f 2^k with f in [1, 2), for x > 0 that is not denormal."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        raw = builder.and_(builder.bitcast(args[0], LONGS), ir.Constant(LONGS, [(1 << 52) - 1] * 8))
        return builder.bitcast(builder.or_(raw, ir.Constant(LONGS, [1023 << 52] * 8)), DOUBLES)

    return wide(wide), codegen


@intrinsic
def invert(typing: Any, chosen: Any) -> Any:
    """The lanes that are not chosen."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.not_(args[0])

    return chosen(chosen), codegen


@intrinsic
def times_power_of_2(typing: Any, x: Any, shifted: Any) -> Any:
    """x 2^k, where ``shifted`` is k + 1.5 2^23, so that k is its lowest bits; no range is
    checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, k = (builder.bitcast(a, INTS) for a in args)
        return builder.bitcast(
            builder.add(x, builder.shl(k, ir.Constant(INTS, [23] * WIDTH))), FLOATS
        )

    return lanes(lanes, lanes), codegen


@intrinsic
def sum_lanes(typing: Any, x: Any) -> Any:
    """Sum of the lanes, in an order that never changes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = args[0]
        for half in (8, 4, 2, 1):
            empty = ir.Constant(x.type, ir.Undefined)
            low, high = (
                builder.shuffle_vector(
                    x, empty, ir.Constant(ir.VectorType(ir.IntType(32), half), list(places))
                )
                for places in (range(half), range(half, 2 * half))
            )
            x = builder.fadd(low, high)
        return builder.extract_element(x, ir.IntType(32)(0))

    return types.float32(lanes), codegen


def _fold(half: int) -> Any:
    places = [[g * 2 * half + k for g in range(WIDTH // half)] for k in range(half)]
    # Of both vectors, one after the other: the first and the second ``half`` of every group of 2
    # ``half``.
    low = sorted(place for row in places for place in row)
    high = [place + half for place in low]

    @intrinsic
    def fold(typing: Any, x: Any, y: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            first, second = (
                builder.shuffle_vector(*args, ir.Constant(INTS, which)) for which in (low, high)
            )
            return builder.fadd(first, second)

        return lanes(lanes, lanes), codegen

    return fold


_fold8, _fold4, _fold2, _fold1 = (_fold(half) for half in (8, 4, 2, 1))


@register_jitable(inline="always")
def sum_each(a, b, c, d, e, f, g, h, i, j, k, m, n, o, p, q):  # type: ignore[no-untyped-def]
    """The sums of the lanes of sixteen vectors, as one vector: a transposition that adds on its
    way.
    """
    low = _fold2(_fold4(_fold8(a, b), _fold8(c, d)), _fold4(_fold8(e, f), _fold8(g, h)))
    high = _fold2(_fold4(_fold8(i, j), _fold8(k, m)), _fold4(_fold8(n, o), _fold8(p, q)))
    return _fold1(low, high)


@register_jitable(inline="always")
def sum_each8(a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """Sums of the lanes of eight vectors, as :func:`sum_each`; the sums stand twice."""
    low = _fold2(_fold4(_fold8(a, b), _fold8(c, d)), _fold4(_fold8(e, f), _fold8(g, h)))
    return _fold1(low, low)


def _as_bits(builder: Any, chosen: Any) -> Any:
    return builder.bitcast(chosen, ir.IntType(chosen.type.count))


@intrinsic
def count_true(typing: Any, chosen: Any) -> Any:
    """Number of chosen lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.ctpop(_as_bits(builder, args[0])), ir.IntType(64))

    return types.int64(chosen), codegen


@intrinsic
def any_true(typing: Any, chosen: Any) -> Any:
    """True if any lane is chosen."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = _as_bits(builder, args[0])
        return builder.icmp_unsigned("!=", bits, bits.type(0))

    return types.boolean(chosen), codegen


@intrinsic
def to_bits(typing: Any, chosen: Any) -> Any:
    """A bit for each lane that is chosen."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(_as_bits(builder, args[0]), ir.IntType(64))

    return types.int64(chosen), codegen


@intrinsic
def broadcast(typing: Any, array: Any, item: Any) -> Any:
    """The number at ``item`` of a float32 array, counted flat, in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(
            builder, builder.load(_pointer(context, builder, sig.args[0], ir.FloatType(), *args))
        )

    return lanes(array, types.int64), codegen


@intrinsic
def with_any_bit(typing: Any, array: Any, item: Any, wanted: Any) -> Any:
    """Mask of sixteen int32 of ``array`` from ``item`` on, counted flat: a bit for each that has
    one of the wanted bits.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        words = builder.load(_pointer(context, builder, sig.args[0], INTS, *args[:2]), align=4)
        mask = _spread(builder, builder.trunc(args[2], ir.IntType(32)), INTS)
        matches = builder.icmp_unsigned(
            "!=", builder.and_(words, mask), ir.Constant(INTS, [0] * WIDTH)
        )
        return builder.zext(_as_bits(builder, matches), ir.IntType(64))

    return types.int64(array, types.int64, types.int64), codegen


@intrinsic
def lowest_bit(typing: Any, bits: Any) -> Any:
    """The place of the lowest bit that is set; ``bits`` must not be 0."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), codegen


@intrinsic
def store_intervals(typing: Any, array: Any, item: Any, first: Any, last: Any) -> Any:
    """Put first | last << 16, of sixteen whole numbers each, into an int32 array from ``item`` on,
    counted flat.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        low, high = (builder.fptosi(value, INTS) for value in args[2:])
        both = builder.or_(low, builder.shl(high, ir.Constant(INTS, [16] * WIDTH)))
        builder.store(both, _pointer(context, builder, sig.args[0], INTS, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes, lanes), codegen


@intrinsic
def store_integers(typing: Any, array: Any, item: Any, value: Any) -> Any:
    """Put sixteen whole numbers into an int32 array from ``item`` on, counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = builder.fptosi(args[2], INTS)
        builder.store(whole, _pointer(context, builder, sig.args[0], INTS, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), codegen


def _swap(step: int) -> Any:
    @intrinsic
    def swap(typing: Any, x: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            places = ir.Constant(INTS, [k ^ step for k in range(WIDTH)])
            return builder.shuffle_vector(args[0], ir.Constant(FLOATS, ir.Undefined), places)

        return lanes(lanes), codegen

    swap.__doc__ = f"Lane k of x in lane k ^ {step}."
    return swap


swap1, swap2 = _swap(1), _swap(2)


QUAD = ir.VectorType(ir.FloatType(), 4)
FOUR = ir.VectorType(ir.IntType(32), 4)


@intrinsic
def copy4_integers(typing: Any, array: Any, item: Any, source: Any, begin: Any) -> Any:
    """Four int32 of ``source`` from ``begin`` on to ``array`` from ``item`` on; both counted
    flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig.args[2], FOUR, *args[2:]), align=4)
        builder.store(value, _pointer(context, builder, sig.args[0], FOUR, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64), codegen


@intrinsic
def copy4(typing: Any, array: Any, item: Any, source: Any, begin: Any) -> Any:
    """Four float32 of ``source`` from ``begin`` on to ``array`` from ``item`` on; both counted
    flat.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig.args[2], QUAD, *args[2:]), align=4)
        builder.store(value, _pointer(context, builder, sig.args[0], QUAD, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64), codegen


@intrinsic
def interleave4(typing: Any, array: Any, item: Any, source: Any, begin: Any, step: Any) -> Any:
    """Four float32 of ``source`` from each of ``begin``, + step, + 2 step on, as four triples to
    ``array``.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        begin, step = args[3:]
        first, second, third = (
            builder.load(_pointer(context, builder, sig.args[2], QUAD, args[2], place), align=4)
            for place in (
                begin,
                builder.add(begin, step),
                builder.add(begin, builder.add(step, step)),
            )
        )

        def places(*which: int) -> Any:
            return ir.Constant(ir.VectorType(ir.IntType(32), len(which)), list(which))

        pair = builder.shuffle_vector(first, second, places(0, 4, 1, 5, 2, 6, 3, 7))
        wide = builder.shuffle_vector(
            third, ir.Constant(QUAD, ir.Undefined), places(0, 1, 2, 3, 0, 0, 0, 0)
        )
        triples = builder.shuffle_vector(pair, wide, places(0, 1, 8, 2, 3, 9, 4, 5, 10, 6, 7, 11))
        to = _pointer(context, builder, sig.args[0], triples.type, *args[:2])
        builder.store(triples, to, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64, types.int64), codegen


@intrinsic
def separate4(typing: Any, array: Any, item: Any, step: Any, source: Any, begin: Any) -> Any:
    """The reverse of :func:`interleave4`: four triples of ``source`` from ``begin`` on, their first
    numbers to ``array`` from ``item`` on, the second to + ``step``, the third to + 2 ``step``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        item, step = args[1:3]
        twelve = ir.VectorType(ir.FloatType(), 12)
        triples = builder.load(_pointer(context, builder, sig.args[3], twelve, *args[3:]), align=4)
        empty = ir.Constant(twelve, ir.Undefined)
        for part in range(3):
            places = ir.Constant(
                ir.VectorType(ir.IntType(32), 4), [part, part + 3, part + 6, part + 9]
            )
            to = _pointer(context, builder, sig.args[0], QUAD, args[0], item)
            builder.store(builder.shuffle_vector(triples, empty, places), to, align=4)
            item = builder.add(item, step)
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, source, types.int64), codegen
