"""Vector instructions in LLVM's terms, of which numba intrinsics are written.

Numba has no types for vectors and makes vector instructions of loops only, as far as LLVM proves that their arrays do
not overlap. What is written with these functions LLVM fits to the vectors that the processor has.

Each function takes numba's builder of instructions first. Arrays are float32 in the order of C, and their numbers are
counted from their beginning.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

from llvmlite import ir
from numba.core import cgutils

INDEX, LANE, SHORT, FLOAT = ir.IntType(64), ir.IntType(32), ir.IntType(16), ir.FloatType()

# Between these, e^x is a normal number.
EXPONENTS = -87.0, 88.0

# ln 2 in two parts, of which the first has so few digits that its products with small whole numbers are exact.
_LN2 = 0.693359375, math.log(2) - 0.693359375

# Added to a number and taken away, it rounds to the nearest whole number: 1.5 2^23.
_ROUNDER = 12582912.0

# Lets a product and a sum become one instruction.
_CONTRACT = ["contract"]


def array_of(context: Any, builder: Any, signature: Any, arguments: Sequence[Any], number: int) -> Any:
    """Return the array that is argument `number` of an intrinsic."""
    return context.make_array(signature.args[number])(context, builder, arguments[number])


def array_data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return a pointer to the first number of an array of a type `kind`."""
    return context.make_array(kind)(context, builder, array).data


def vector_type(count: int, kind: Any = FLOAT) -> ir.VectorType:
    """Return the type of a vector of `count` numbers."""
    return ir.VectorType(kind, count)


def constant(value: float, count: int) -> ir.Constant:
    """Return a vector of `count` times one number that is known when compiled."""
    return ir.Constant(vector_type(count), [value] * count)


def load(builder: Any, data: Any, at: Any, count: int, kind: Any = FLOAT) -> Any:
    """Load `count` numbers of `data` from `at` on."""
    vector = builder.load(builder.bitcast(builder.gep(data, [at]), vector_type(count, kind).as_pointer()))
    vector.align = 2 if kind is SHORT else 4
    return vector


def store(builder: Any, vector: Any, data: Any, at: Any) -> None:
    """Store a vector of float32 in `data` from `at` on."""
    builder.store(vector, builder.bitcast(builder.gep(data, [at]), vector.type.as_pointer())).align = 4


def prefetch(builder: Any, place: Any) -> None:
    """Have the processor fetch the line of its cache that holds a place, without waiting for it."""
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, LANE, LANE, LANE])
    read, all_levels, data = LANE(0), LANE(3), LANE(1)
    fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
    builder.call(fetch, [builder.bitcast(place, byte), read, all_levels, data])


def spread(builder: Any, value: Any, count: int) -> Any:
    """Return a vector of `count` times one number."""
    vector = builder.insert_element(ir.Constant(vector_type(count, value.type), ir.Undefined), value, LANE(0))
    return picked(builder, vector, vector, [0] * count)


def picked(builder: Any, one: Any, other: Any, lanes: Sequence[int] | range) -> Any:
    """Return these numbers of two vectors, counted through."""
    return builder.shuffle_vector(one, other, ir.Constant(vector_type(len(lanes), LANE), list(lanes)))


def padded(builder: Any, vector: Any, count: int, wide: int) -> Any:
    """Return a vector of `wide` numbers: the `count` of another one, and then zeros."""
    return picked(builder, vector, constant(0.0, count), [*range(count), *[count] * (wide - count)])


def product(builder: Any, *factors: Any) -> Any:
    """Return the product, from left to right; with `added` it can become one instruction."""
    return reduce(lambda product, factor: builder.fmul(product, factor, flags=_CONTRACT), factors)


def added(builder: Any, *terms: Any) -> Any:
    """Return the sum, from left to right."""
    return reduce(lambda sum, term: builder.fadd(sum, term, flags=_CONTRACT), terms)


def folded(builder: Any, vector: Any, wide: int, to: int) -> Any:
    """Return a vector of `to` sums of the `wide` numbers of a vector; both are powers of two."""
    while wide > to:
        wide //= 2
        halves = range(wide), range(wide, 2 * wide)
        vector = builder.fadd(*(picked(builder, vector, vector, lanes) for lanes in halves))
    return vector


def sums(builder: Any, four: Sequence[Any], wide: int) -> Any:
    """Return the sums of the numbers of each of four vectors, as one vector of four."""
    a, b, c, d = (folded(builder, vector, wide, 4) for vector in four)
    one, other = (
        builder.fadd(picked(builder, x, y, (0, 4, 1, 5)), picked(builder, x, y, (2, 6, 3, 7)))
        for x, y in ((a, b), (c, d))
    )
    return builder.fadd(picked(builder, one, other, (0, 1, 4, 5)), picked(builder, one, other, (2, 3, 6, 7)))


def clamped(builder: Any, vector: Any, least: Any, most: Any) -> Any:
    """Return a vector clamped between two others; `least` for NaN."""
    vector = builder.select(builder.fcmp_ordered(">", vector, least), vector, least)
    return builder.select(builder.fcmp_ordered("<", vector, most), vector, most)


def exponential(builder: Any, x: Any, wide: int) -> Any:
    """Return e^x to a relative error of 3e-7, for x clamped to EXPONENTS; NaN for NaN.

    LLVM would call the C library for each number.

    e^x = 2^n e^r,   n = x / ln 2 rounded,   r = x - n ln 2,   e^r by its Taylor series to r^7
    """
    within, rounder = clamped(builder, x, *(constant(limit, wide) for limit in EXPONENTS)), constant(_ROUNDER, wide)
    n = builder.fsub(builder.fadd(builder.fmul(within, constant(1 / math.log(2), wide)), rounder), rounder)
    rest = within
    for part in _LN2:
        rest = added(builder, rest, product(builder, n, constant(-part, wide)))
    series = constant(1 / math.factorial(7), wide)
    for order in range(6, -1, -1):
        series = added(builder, constant(1 / math.factorial(order), wide), product(builder, series, rest))
    whole = builder.fptosi(n, vector_type(wide, LANE))
    bias, mantissa = (ir.Constant(vector_type(wide, LANE), [number] * wide) for number in (127, 23))
    power = builder.bitcast(builder.shl(builder.add(whole, bias), mantissa), vector_type(wide))
    return builder.select(builder.fcmp_unordered("uno", x, x), x, builder.fmul(series, power))


def for_each_vector(builder: Any, count: Any, widths: Sequence[int], emit: Callable[[Any, int], None]) -> None:
    """Write loops over `count` numbers, one for each width: as many as it fits, and then the next over what remains.

    Args:
        count: int64.
        widths: powers of two from large to small, of which the last is 1.
        emit: writes the body, given the first number and the width of this loop.
    """
    start = INDEX(0)
    for width in widths:
        stop = builder.and_(count, INDEX(-width))
        with cgutils.for_range_slice(builder, start, stop, INDEX(width), inc=True) as (at, _):
            emit(at, width)
        start = stop
