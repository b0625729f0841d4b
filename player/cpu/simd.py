"""Vector operations that numba has no types for, written in LLVM's terms for `kpc.player.cpu.raymarch`: sums over grid
nodes and over channels.

Left to itself, numba makes vectors of loops only. Four channels are too few for a loop, which it would process number
by number at four times the cost, and it sums up the vectors of a dot product one by one. LLVM fits the vectors asked
for here to those that the processor has.
"""

from collections.abc import Sequence
from functools import reduce
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kpc.player.cpu.serving import CHANNELS, NARROW, WIDE

# Sums are clamped to this.
LARGEST = 1e30

_INDEX, _LANE, _SHORT, _FLOAT = ir.IntType(64), ir.IntType(32), ir.IntType(16), ir.FloatType()
_CONTRACT = ["contract"]


@intrinsic
def interpolate(
    _: Any,
    grid: Any,
    first: Any,
    right: Any,
    up: Any,
    back: Any,
    x: Any,
    y: Any,
    z: Any,
    into: Any,
    line: Any,
    column: Any,
) -> Any:
    """Interpolate a grid trilinearly: into[line + c, column] = sum over the eight nodes around of weight * grid[node,
    c], c = 0 to 3.

    Its parameters are many because an intrinsic takes values in registers, not tuples of them.

    Args:
        grid: (N, 4) float32.
        first: uint64, the node before the point along all axes.
        right, up, back: uint64, distance from a node to the next along x, y, z.
        x, y, z: float32, share of the way to the next node.
        into: (lines, columns) float32.
        line, column: uint64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, first, right, up, back, x, y, z, _, line, column = arguments
        nodes, out = (
            _array(context, builder, signature, arguments, 0),
            _array(context, builder, signature, arguments, 8),
        )
        one = ir.Constant(_FLOAT, 1.0)
        ways = [(step, builder.fsub(one, share), share) for step, share in ((right, x), (up, y), (back, z))]
        terms = []
        for number in range(1 << len(ways)):
            node, weight = first, one
            for bit, (step, near, far) in enumerate(ways):
                node = builder.add(node, step) if number >> bit & 1 else node
                weight = builder.fmul(weight, far if number >> bit & 1 else near)
            values = _load(builder, nodes.data, builder.mul(node, _INDEX(CHANNELS)), CHANNELS)
            terms.append(builder.fmul(values, _spread(builder, weight, CHANNELS), flags=_CONTRACT))
        total = _sum(builder, terms)
        columns = builder.extract_value(out.shape, 1)
        for channel in range(CHANNELS):
            at = builder.add(builder.mul(builder.add(line, _INDEX(channel)), columns), column)
            builder.store(builder.extract_element(total, _LANE(channel)), builder.gep(out.data, [at]))
        return context.get_dummy_value()

    return types.void(grid, first, right, up, back, x, y, z, into, line, column), generate


@intrinsic
def decode_corner(_: Any, wholes: Any, factors: Any, weights: Any, bias: Any, into: Any, row: Any) -> Any:
    """Apply a linear decoder: into[row, c] = sum over m of weights[c, m] * product of all wholes[m] and factors[m], c =
    0 to 3, plus `bias` for c = 3. The result is finite: clamped to LARGEST, 0 for NaN.

    Args:
        wholes: tuple of (M,) int16, M a multiple of WIDE.
        factors: tuple of (M,) float32.
        weights: (4, M) float32.
        bias: float32.
        into: (N, 4) float32.
        row: uint64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        wholes, factors = (
            [context.make_array(kind.dtype)(context, builder, array) for array in cgutils.unpack_tuple(builder, arrays)]
            for kind, arrays in zip(signature.args[:2], arguments[:2], strict=True)
        )
        _, _, _, bias, _, row = arguments
        weights, out = (_array(context, builder, signature, arguments, n) for n in (2, 4))
        count = builder.extract_value(factors[0].shape, 0)
        nothing = _constant(0.0, WIDE)
        sums = [cgutils.alloca_once_value(builder, nothing) for _ in range(CHANNELS)]
        for sum_ in sums:  # once a call, where the line above is once a function
            builder.store(nothing, sum_)
        with cgutils.for_range_slice(builder, _INDEX(0), count, _INDEX(WIDE), inc=True) as (m, _):
            of_wholes = [builder.sitofp(_load(builder, array.data, m, WIDE, _SHORT), _vector(WIDE)) for array in wholes]
            feature = reduce(builder.fmul, [*of_wholes, *(_load(builder, array.data, m, WIDE) for array in factors)])
            for channel, sum_ in enumerate(sums):
                weight = _load(builder, weights.data, builder.add(builder.mul(count, _INDEX(channel)), m), WIDE)
                builder.store(
                    builder.fadd(builder.load(sum_), builder.fmul(feature, weight, flags=_CONTRACT), flags=_CONTRACT),
                    sum_,
                )
        total = _sums(builder, [builder.load(sum_) for sum_ in sums], WIDE)
        total = builder.fadd(total, builder.insert_element(_constant(0.0, CHANNELS), bias, _LANE(CHANNELS - 1)))
        is_number = builder.fcmp_ordered("ord", total, total)
        for limit, keeps in ((LARGEST, "<"), (-LARGEST, ">")):
            total = builder.select(
                builder.fcmp_ordered(keeps, total, _constant(limit, CHANNELS)), total, _constant(limit, CHANNELS)
            )
        _store(
            builder,
            builder.select(is_number, total, _constant(0.0, CHANNELS)),
            out.data,
            builder.mul(row, _INDEX(CHANNELS)),
        )
        return context.get_dummy_value()

    return types.void(wholes, factors, weights, bias, into, row), generate


@intrinsic
def accumulate_features(
    _: Any,
    planes: Any,
    texels: Any,
    ups: Any,
    rows: Any,
    starts: Any,
    shares: Any,
    weights: Any,
    first: Any,
    halves: Any,
    into: Any,
    line: Any,
    column: Any,
) -> Any:
    """Add what one group of features contributes: into[line + c, column] += sum over m < wide of weights[first + wide c
    + m] * product of all planes and rows at a sample, interpolated, c = 0 to 3.

    It is one function because it writes one sequence of instructions, and its parameters are many because an intrinsic
    takes values in registers.

    Args:
        planes: (N,) int16; each texel has `wide` numbers.
        texels: three uint64, in xy, xz, yz, where the texel before the sample begins; the next along the first axis
            follows it.
        ups: three uint64, distance from there to the next texel along the second axis.
        rows: (N,) float32; each texel has `wide` numbers.
        starts: three uint64, in the rows along x, y, z, where the texel before the sample begins.
        shares: three float32, of the way to the next texel along x, y, z.
        weights: (N,) float32.
        first: uint64.
        halves: tuple whose length, known when compiled, is wide / NARROW.
        into: (lines, columns) float32.
        line, column: uint64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        planes, rows, weights, out = (_array(context, builder, signature, arguments, n) for n in (0, 3, 6, 9))
        texels, ups, starts, shares = (cgutils.unpack_tuple(builder, arguments[n]) for n in (1, 2, 4, 5))
        first, line, column = (arguments[n] for n in (7, 10, 11))
        wide = NARROW * len(signature.args[8])
        one = ir.Constant(_FLOAT, 1.0)
        corners = []
        for texel, up, axes in zip(texels, ups, ((0, 1), (0, 2), (1, 2)), strict=True):
            above, next_ = builder.add(texel, up), _INDEX(wide)
            places = texel, builder.add(texel, next_), above, builder.add(above, next_)
            across, along = ((builder.fsub(one, shares[axis]), shares[axis]) for axis in axes)
            factors = [_spread(builder, builder.fmul(x, y), NARROW) for y in along for x in across]
            corners.append(list(zip(places, factors, strict=True)))
        ways, sums = [_spread(builder, share, NARROW) for share in shares], [_constant(0.0, NARROW)] * CHANNELS
        for half in range(0, wide, NARROW):
            m, factors = _INDEX(half), []
            for plane in corners:
                wholes = [_load(builder, planes.data, builder.add(place, m), NARROW, _SHORT) for place, _ in plane]
                floats = [builder.sitofp(whole, _vector(NARROW)) for whole in wholes]
                factors.append(
                    _sum(
                        builder,
                        [
                            builder.fmul(x, factor, flags=_CONTRACT)
                            for x, (_, factor) in zip(floats, plane, strict=True)
                        ],
                    )
                )
            for start, way in zip(starts, ways, strict=True):
                before, behind = (
                    _load(builder, rows.data, builder.add(start, _INDEX(half + further)), NARROW)
                    for further in (0, wide)
                )
                factors.append(
                    _sum(builder, [before, builder.fmul(way, builder.fsub(behind, before), flags=_CONTRACT)])
                )
            feature = reduce(builder.fmul, factors)
            for c in range(CHANNELS):
                weight = _load(builder, weights.data, builder.add(first, _INDEX(wide * c + half)), NARROW)
                sums[c] = _sum(builder, [sums[c], builder.fmul(feature, weight, flags=_CONTRACT)])
        total = _sums(builder, sums, NARROW)
        columns = builder.extract_value(out.shape, 1)
        for c in range(CHANNELS):
            place = builder.gep(out.data, [builder.add(builder.mul(builder.add(line, _INDEX(c)), columns), column)])
            builder.store(builder.fadd(builder.load(place), builder.extract_element(total, _LANE(c))), place)
        return context.get_dummy_value()

    return types.void(planes, texels, ups, rows, starts, shares, weights, first, halves, into, line, column), generate


def _sum(builder: Any, terms: Sequence[Any]) -> Any:
    return reduce(lambda sum, term: builder.fadd(sum, term, flags=_CONTRACT), terms)


def _sums(builder: Any, vectors: Sequence[Any], wide: int) -> Any:
    """Return the sums of the numbers of each of four vectors, as one vector of four."""
    while wide > CHANNELS:
        wide //= 2
        halves = range(wide), range(wide, 2 * wide)
        vectors = [builder.fadd(*(_picked(builder, vector, vector, lanes) for lanes in halves)) for vector in vectors]
    a, b, c, d = vectors
    one, other = (
        builder.fadd(_picked(builder, x, y, (0, 4, 1, 5)), _picked(builder, x, y, (2, 6, 3, 7)))
        for x, y in ((a, b), (c, d))
    )
    return builder.fadd(_picked(builder, one, other, (0, 1, 4, 5)), _picked(builder, one, other, (2, 3, 6, 7)))


def _array(context: Any, builder: Any, signature: Any, arguments: Sequence[Any], number: int) -> Any:
    return context.make_array(signature.args[number])(context, builder, arguments[number])


def _vector(count: int, kind: Any = _FLOAT) -> ir.VectorType:
    return ir.VectorType(kind, count)


def _constant(value: float, count: int) -> ir.Constant:
    return ir.Constant(_vector(count), [value] * count)


def _load(builder: Any, data: Any, at: Any, count: int, kind: Any = _FLOAT) -> Any:
    vector = builder.load(builder.bitcast(builder.gep(data, [at]), _vector(count, kind).as_pointer()))
    vector.align = 2 if kind is _SHORT else 4
    return vector


def _store(builder: Any, vector: Any, data: Any, at: Any) -> None:
    builder.store(vector, builder.bitcast(builder.gep(data, [at]), vector.type.as_pointer())).align = 4


def _spread(builder: Any, value: Any, count: int) -> Any:
    """A vector of so many of one number."""
    vector = builder.insert_element(ir.Constant(_vector(count), ir.Undefined), value, _LANE(0))
    return _picked(builder, vector, vector, [0] * count)


def _picked(builder: Any, one: Any, other: Any, lanes: Sequence[int] | range) -> Any:
    """The numbers of a vector and another, counted through, that these are."""
    return builder.shuffle_vector(one, other, ir.Constant(_vector(len(lanes), _LANE), list(lanes)))
