"""Sixteen float32 as one value inside numba kernels, so that a whole loop can keep its sums in vector registers.

LLVM vectorises loops over arrays, but then every sum lives in memory: 16 loads and 16 stores for each splat and 16
pixels, which was most of the time. ``Lanes`` has the usual arithmetic (numbers are broadcast), comparisons that give a
``Mask``, and the functions below. LLVM splits it where the machine's vectors are shorter.

Products and sums may be fused but are not reordered: the exponential's rounding relies on that.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_jitable, register_model

WIDTH = 16
FUSED = ("contract",)
FLOATS, BITS, INTS = (ir.VectorType(kind, WIDTH) for kind in (ir.FloatType(), ir.IntType(1), ir.IntType(32)))


class Lanes(types.Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__("Lanes")


class Mask(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__("Mask")


lanes, mask = Lanes(), Mask()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, FLOATS)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BITS)


def _spread(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, ir.Constant(FLOATS, ir.Undefined), ir.Constant(INTS, [0] * WIDTH))


@lower_cast(types.Number, Lanes)
def _broadcast(context: Any, builder: Any, kind: Any, _: Any, value: Any) -> Any:
    return _spread(builder, context.cast(builder, value, kind, types.float32))


def _operate(symbol: Any, operands: types.Type, result: types.Type, build: Callable[[Any, Any, Any], Any]) -> None:
    @infer_global(symbol)
    class _Template(AbstractTemplate):
        key = symbol

        def generic(self, args: Any, kws: Any) -> Any:
            taken = all(a == operands or (operands == lanes and isinstance(a, types.Number)) for a in args)
            return signature(result, *[operands] * len(args)) if taken and operands in args else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return build(builder, *args)

    lower_builtin(symbol, *[type(operands)] * (1 if symbol is operator.neg else 2))(lower)


_operate(operator.add, lanes, lanes, lambda b, x, y: b.fadd(x, y, flags=FUSED))
_operate(operator.sub, lanes, lanes, lambda b, x, y: b.fsub(x, y, flags=FUSED))
_operate(operator.mul, lanes, lanes, lambda b, x, y: b.fmul(x, y, flags=FUSED))
_operate(operator.truediv, lanes, lanes, lambda b, x, y: b.fdiv(x, y, flags=FUSED))
_operate(operator.lt, lanes, mask, lambda b, x, y: b.fcmp_ordered("<", x, y))
_operate(operator.le, lanes, mask, lambda b, x, y: b.fcmp_ordered("<=", x, y))
_operate(operator.eq, lanes, mask, lambda b, x, y: b.fcmp_ordered("==", x, y))
_operate(operator.neg, lanes, lanes, lambda b, x, *_: b.fneg(x))
_operate(operator.and_, mask, mask, lambda b, x, y: b.and_(x, y))
_operate(operator.or_, mask, mask, lambda b, x, y: b.or_(x, y))


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
def narrow(typing: Any, array: Any, item: Any, source: Any, begin: Any) -> Any:
    """Eight float64 of ``source`` from ``begin`` on, as float32 to ``array`` from ``item`` on; both counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        wide, short = ir.VectorType(ir.DoubleType(), 8), ir.VectorType(ir.FloatType(), 8)
        value = builder.load(_pointer(context, builder, sig.args[2], wide, *args[2:]), align=8)
        builder.store(builder.fptrunc(value, short), _pointer(context, builder, sig.args[0], short, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64), codegen


@intrinsic
def where(typing: Any, chosen: Any, yes: Any, no: Any) -> Any:
    """``yes`` in the lanes that are chosen, ``no`` in the others."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return lanes(mask, lanes, lanes), codegen


@intrinsic
def least(typing: Any, x: Any, y: Any) -> Any:
    """The smaller one in each lane; y where one is NaN."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes(lanes, lanes), codegen


@intrinsic
def most(typing: Any, x: Any, y: Any) -> Any:
    """The larger one in each lane; y where one is NaN."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return lanes(lanes, lanes), codegen


@intrinsic
def fma(typing: Any, x: Any, y: Any, z: Any) -> Any:
    """x y + z, rounded once where the machine can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(FLOATS, [FLOATS] * 3)
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.v16f32"), args)

    return lanes(lanes, lanes, lanes), codegen


@intrinsic
def inverse(typing: Any, x: Any) -> Any:
    """1 / x to the last bit or two, and NaN where x is 0, infinite or below 1e-38.

    With AVX-512 an estimate of 14 bits and one step of Newton's: three times as fast as a division.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, one = args[0], ir.Constant(FLOATS, [1.0] * WIDTH)
        if not llvm.get_host_cpu_features().get("avx512f"):
            return builder.fdiv(one, x)
        kind = ir.FunctionType(FLOATS, [FLOATS, FLOATS, ir.IntType(WIDTH)])
        estimate = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.rcp14.ps.512")
        r = builder.call(estimate, [x, ir.Constant(FLOATS, ir.Undefined), ir.IntType(WIDTH)(-1)])
        kind = ir.FunctionType(FLOATS, [FLOATS] * 3)
        fused = cgutils.get_or_insert_function(builder.module, kind, "llvm.fma.v16f32")
        miss = builder.call(fused, [builder.fneg(x), r, one])
        return builder.call(fused, [r, miss, r])

    return lanes(lanes), codegen


@intrinsic
def rough_root(typing: Any, x: Any) -> Any:
    """A square root of x > 0 that is right or too large by at most 1.3e-4 of itself: several times as fast."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = args[0]
        if not llvm.get_host_cpu_features().get("avx512f"):
            kind = ir.FunctionType(FLOATS, [FLOATS])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v16f32"), [x])
        kind = ir.FunctionType(FLOATS, [FLOATS, FLOATS, ir.IntType(WIDTH)])
        estimate = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.rsqrt14.ps.512")
        r = builder.call(estimate, [x, ir.Constant(FLOATS, ir.Undefined), ir.IntType(WIDTH)(-1)])
        return builder.fmul(builder.fmul(x, ir.Constant(FLOATS, [1 + 2.0**-14] * WIDTH)), r)

    return lanes(lanes), codegen


def _unary(name: str, document: str) -> Any:
    @intrinsic
    def operation(typing: Any, x: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.FunctionType(FLOATS, [FLOATS])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v16f32"), args)

        return lanes(lanes), codegen

    operation.__doc__ = document
    return operation


down = _unary("floor", "Largest whole number that is not above x, in each lane.")
up = _unary("ceil", "Smallest whole number that is not below x, in each lane.")


@intrinsic
def flipped(typing: Any, chosen: Any) -> Any:
    """The lanes that are not chosen."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.not_(args[0])

    return mask(mask), codegen


@intrinsic
def times_power(typing: Any, x: Any, shifted: Any) -> Any:
    """x 2^k, where ``shifted`` is k + 1.5 2^23, so that k is its lowest bits; no range is checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, k = (builder.bitcast(a, INTS) for a in args)
        return builder.bitcast(builder.add(x, builder.shl(k, ir.Constant(INTS, [23] * WIDTH))), FLOATS)

    return lanes(lanes, lanes), codegen


@intrinsic
def total(typing: Any, x: Any) -> Any:
    """Sum of the lanes, in an order that never changes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = args[0]
        for half in (8, 4, 2, 1):
            empty = ir.Constant(x.type, ir.Undefined)
            low, high = (
                builder.shuffle_vector(x, empty, ir.Constant(ir.VectorType(ir.IntType(32), half), list(places)))
                for places in (range(half), range(half, 2 * half))
            )
            x = builder.fadd(low, high)
        return builder.extract_element(x, ir.IntType(32)(0))

    return types.float32(lanes), codegen


def _fold(half: int) -> Any:
    places = [[g * 2 * half + k for g in range(WIDTH // half)] for k in range(half)]
    # Of both vectors, one after the other: the first and the second ``half`` of every group of 2 ``half``.
    low = sorted(place for row in places for place in row)
    high = [place + half for place in low]

    @intrinsic
    def fold(typing: Any, x: Any, y: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            first, second = (builder.shuffle_vector(*args, ir.Constant(INTS, which)) for which in (low, high))
            return builder.fadd(first, second)

        return lanes(lanes, lanes), codegen

    return fold


_fold8, _fold4, _fold2, _fold1 = (_fold(half) for half in (8, 4, 2, 1))


@register_jitable(inline="always")
def totals(a, b, c, d, e, f, g, h, i, j, k, m, n, o, p, q):  # type: ignore[no-untyped-def]
    """The sums of the lanes of sixteen vectors, as one vector: a transposition that adds on its way."""
    low = _fold2(_fold4(_fold8(a, b), _fold8(c, d)), _fold4(_fold8(e, f), _fold8(g, h)))
    high = _fold2(_fold4(_fold8(i, j), _fold8(k, m)), _fold4(_fold8(n, o), _fold8(p, q)))
    return _fold1(low, high)


@register_jitable(inline="always")
def totals8(a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """As :func:`totals` of eight; the sums stand twice."""
    low = _fold2(_fold4(_fold8(a, b), _fold8(c, d)), _fold4(_fold8(e, f), _fold8(g, h)))
    return _fold1(low, low)


@intrinsic
def count(typing: Any, chosen: Any) -> Any:
    """How many lanes are chosen."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.zext(builder.ctpop(bits), ir.IntType(64))

    return types.int64(mask), codegen


@intrinsic
def some(typing: Any, chosen: Any) -> Any:
    """Whether any lane is chosen."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.IntType(WIDTH)(0))

    return types.boolean(mask), codegen


@intrinsic
def spread(typing: Any, array: Any, item: Any) -> Any:
    """The number at ``item`` of a float32 array, counted flat, in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(builder, builder.load(_pointer(context, builder, sig.args[0], ir.FloatType(), *args)))

    return lanes(array, types.int64), codegen


QUAD = ir.VectorType(ir.FloatType(), 4)


@intrinsic
def copy4(typing: Any, array: Any, item: Any, source: Any, begin: Any) -> Any:
    """Four float32 of ``source`` from ``begin`` on to ``array`` from ``item`` on; both counted flat."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig.args[2], QUAD, *args[2:]), align=4)
        builder.store(value, _pointer(context, builder, sig.args[0], QUAD, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64), codegen


@intrinsic
def interleave4(typing: Any, array: Any, item: Any, source: Any, begin: Any, step: Any) -> Any:
    """Four float32 of ``source`` from each of ``begin``, + step, + 2 step on, as four triples to ``array``."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        begin, step = args[3:]
        first, second, third = (
            builder.load(_pointer(context, builder, sig.args[2], QUAD, args[2], place), align=4)
            for place in (begin, builder.add(begin, step), builder.add(begin, builder.add(step, step)))
        )

        def places(*which: int) -> Any:
            return ir.Constant(ir.VectorType(ir.IntType(32), len(which)), list(which))

        pair = builder.shuffle_vector(first, second, places(0, 4, 1, 5, 2, 6, 3, 7))
        wide = builder.shuffle_vector(third, ir.Constant(QUAD, ir.Undefined), places(0, 1, 2, 3, 0, 0, 0, 0))
        triples = builder.shuffle_vector(pair, wide, places(0, 1, 8, 2, 3, 9, 4, 5, 10, 6, 7, 11))
        to = _pointer(context, builder, sig.args[0], triples.type, *args[:2])
        builder.store(triples, to, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, source, types.int64, types.int64), codegen
