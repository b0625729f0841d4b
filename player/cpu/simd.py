"""Vector operations for `kpc.player.cpu.raymarch`: sums over grid nodes and over channels.

Left to itself, numba makes vectors of loops only. Four channels are too few for a loop, which it would process number
by number at four times the cost, and it sums up the vectors of a dot product one by one.
"""

from collections.abc import Sequence
from functools import reduce
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kpc.player.cpu.serving import CHANNELS, NARROW, WIDE
from kpc.vectors import (
    FLOAT,
    INDEX,
    LANE,
    SHORT,
    added,
    array_of,
    constant,
    load,
    product,
    spread,
    store,
    sums,
    vector_type,
)

# Sums are clamped to this.
LARGEST = 1e30


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
            array_of(context, builder, signature, arguments, 0),
            array_of(context, builder, signature, arguments, 8),
        )
        one = ir.Constant(FLOAT, 1.0)
        ways = [(step, builder.fsub(one, share), share) for step, share in ((right, x), (up, y), (back, z))]
        terms = []
        for number in range(1 << len(ways)):
            node, weight = first, one
            for bit, (step, near, far) in enumerate(ways):
                node = builder.add(node, step) if number >> bit & 1 else node
                weight = builder.fmul(weight, far if number >> bit & 1 else near)
            values = load(builder, nodes.data, builder.mul(node, INDEX(CHANNELS)), CHANNELS)
            terms.append(product(builder, values, spread(builder, weight, CHANNELS)))
        total = added(builder, *terms)
        columns = builder.extract_value(out.shape, 1)
        for channel in range(CHANNELS):
            at = builder.add(builder.mul(builder.add(line, INDEX(channel)), columns), column)
            builder.store(builder.extract_element(total, LANE(channel)), builder.gep(out.data, [at]))
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
        weights, out = (array_of(context, builder, signature, arguments, n) for n in (2, 4))
        count = builder.extract_value(factors[0].shape, 0)
        nothing = constant(0.0, WIDE)
        totals = [cgutils.alloca_once_value(builder, nothing) for _ in range(CHANNELS)]
        for sum_ in totals:  # once a call, where the line above is once a function
            builder.store(nothing, sum_)
        with cgutils.for_range_slice(builder, INDEX(0), count, INDEX(WIDE), inc=True) as (m, _):
            of_wholes = [
                builder.sitofp(load(builder, array.data, m, WIDE, SHORT), vector_type(WIDE)) for array in wholes
            ]
            feature = reduce(builder.fmul, [*of_wholes, *(load(builder, array.data, m, WIDE) for array in factors)])
            for channel, sum_ in enumerate(totals):
                weight = load(builder, weights.data, builder.add(builder.mul(count, INDEX(channel)), m), WIDE)
                builder.store(added(builder, builder.load(sum_), product(builder, feature, weight)), sum_)
        total = sums(builder, [builder.load(sum_) for sum_ in totals], WIDE)
        total = builder.fadd(total, builder.insert_element(constant(0.0, CHANNELS), bias, LANE(CHANNELS - 1)))
        is_number = builder.fcmp_ordered("ord", total, total)
        for limit, keeps in ((LARGEST, "<"), (-LARGEST, ">")):
            total = builder.select(
                builder.fcmp_ordered(keeps, total, constant(limit, CHANNELS)), total, constant(limit, CHANNELS)
            )
        store(
            builder,
            builder.select(is_number, total, constant(0.0, CHANNELS)),
            out.data,
            builder.mul(row, INDEX(CHANNELS)),
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
        rows: (N,) float32; each texel has `wide` numbers. None where all rows are 1.
        starts: three uint64, in the rows along x, y, z, where the texel before the sample begins.
        shares: three float32, of the way to the next texel along x, y, z.
        weights: (N,) float32.
        first: uint64.
        halves: tuple whose length, known when compiled, is wide / NARROW.
        into: (lines, columns) float32.
        line, column: uint64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        planes, weights, out = (array_of(context, builder, signature, arguments, n) for n in (0, 6, 9))
        texels, ups, starts, shares = (cgutils.unpack_tuple(builder, arguments[n]) for n in (1, 2, 4, 5))
        row_data = []
        if signature.args[3] != types.none:
            row_data = [array_of(context, builder, signature, arguments, 3).data] * len(starts)
        first, line, column = (arguments[n] for n in (7, 10, 11))
        wide = NARROW * len(signature.args[8])
        one = ir.Constant(FLOAT, 1.0)
        corners = []
        for texel, up, axes in zip(texels, ups, ((0, 1), (0, 2), (1, 2)), strict=True):
            above, next_ = builder.add(texel, up), INDEX(wide)
            places = texel, builder.add(texel, next_), above, builder.add(above, next_)
            across, along = ((builder.fsub(one, shares[axis]), shares[axis]) for axis in axes)
            factors = [spread(builder, builder.fmul(x, y), NARROW) for y in along for x in across]
            corners.append(list(zip(places, factors, strict=True)))
        ways, totals = [spread(builder, share, NARROW) for share in shares], [constant(0.0, NARROW)] * CHANNELS
        for half in range(0, wide, NARROW):
            m, factors = INDEX(half), []
            for plane in corners:
                wholes = [load(builder, planes.data, builder.add(place, m), NARROW, SHORT) for place, _ in plane]
                floats = [builder.sitofp(whole, vector_type(NARROW)) for whole in wholes]
                terms = (product(builder, x, factor) for x, (_, factor) in zip(floats, plane, strict=True))
                factors.append(added(builder, *terms))
            for data, start, way in zip(row_data, starts, ways, strict=False):
                before, behind = (
                    load(builder, data, builder.add(start, INDEX(half + further)), NARROW) for further in (0, wide)
                )
                factors.append(added(builder, before, product(builder, way, builder.fsub(behind, before))))
            feature = reduce(builder.fmul, factors)
            for c in range(CHANNELS):
                weight = load(builder, weights.data, builder.add(first, INDEX(wide * c + half)), NARROW)
                totals[c] = added(builder, totals[c], product(builder, feature, weight))
        total = sums(builder, totals, NARROW)
        columns = builder.extract_value(out.shape, 1)
        for c in range(CHANNELS):
            place = builder.gep(out.data, [builder.add(builder.mul(builder.add(line, INDEX(c)), columns), column)])
            builder.store(builder.fadd(builder.load(place), builder.extract_element(total, LANE(c))), place)
        return context.get_dummy_value()

    return types.void(planes, texels, ups, rows, starts, shares, weights, first, halves, into, line, column), generate
