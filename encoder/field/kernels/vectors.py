"""Weighted sums, products and exponentials of many numbers at a time, by vectors.

As loops over slices they took twice as long and more: LLVM does not know how many channels there are, and checks for
each loop whether its arrays overlap. Positions in arrays count their numbers from the beginning. What is written must
not overlap what is read, unless it is the same.
"""

from collections.abc import Sequence
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kpc.vectors import (
    INDEX,
    LANE,
    added,
    array_of,
    constant,
    exponential,
    folded,
    for_each_vector,
    load,
    product,
    spread,
    store,
    sums,
    vector_type,
)

# Numbers of a vector.
WIDE = 8

_FOUR = types.UniTuple(types.float32, 4)


def runs(builder: Any, first: Any, below: Any, count: Any) -> list[Any]:
    """Return where four runs of `count` numbers begin: two, one after the other, and two more `below` behind them."""
    second_pair = builder.add(first, below)
    return [first, builder.add(first, count), second_pair, builder.add(second_pair, count)]


@intrinsic
def blend(_: Any, source: Any, first: Any, below: Any, weights: Any, count: Any, out: Any, at: Any) -> Any:
    """Set out[at + i], for i < count, to the weighted sum of number i of four runs, such as the texels around a point.

    Args:
        source: array.
        first: int64, where the first run begins; the second follows it.
        below: int64, distance from the first two to the others: from a row of texels to the next.
        weights: four float32.
        count: int64, length of a run.
        out: array. at: int64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, first, below, weights, count, _, at = arguments
        source, out = (array_of(context, builder, signature, arguments, n).data for n in (0, 5))
        four, weights = runs(builder, first, below, count), cgutils.unpack_tuple(builder, weights)

        def emit(i: Any, wide: int) -> None:
            terms = (
                product(builder, spread(builder, weight, wide), load(builder, source, builder.add(run, i), wide))
                for run, weight in zip(four, weights, strict=True)
            )
            store(builder, added(builder, *terms), out, builder.add(at, i))

        for_each_vector(builder, count, WIDE, emit)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(source, whole, whole, _FOUR, whole, out, whole), generate


@intrinsic
def blend_transpose(_: Any, out: Any, first: Any, below: Any, weights: Any, count: Any, g: Any, at: Any) -> Any:
    """Add weight * g[at + i], for i < count, to number i of each of four runs of `out`, which must not overlap."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, first, below, weights, count, _, at = arguments
        out, g = (array_of(context, builder, signature, arguments, n).data for n in (0, 5))
        four, weights = runs(builder, first, below, count), cgutils.unpack_tuple(builder, weights)

        def emit(i: Any, wide: int) -> None:
            gradient = load(builder, g, builder.add(at, i), wide)
            places = [builder.add(run, i) for run in four]
            held = [load(builder, out, place, wide) for place in places]
            for place, number, weight in zip(places, held, weights, strict=True):
                term = product(builder, spread(builder, weight, wide), gradient)
                store(builder, added(builder, number, term), out, place)

        for_each_vector(builder, count, WIDE, emit)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(out, whole, whole, _FOUR, whole, g, whole), generate


@intrinsic
def decode(_: Any, decoder: Any, features: Any, row: Any, count: Any, out: Any) -> Any:
    """Set out[4 row + c] to the sum over i < F of decoder[c F + i] features[row F + i], for four c.

    Args:
        decoder: (4 F,) float32. features: (n, F) float32. row: int64. count: int64, F. out: (n, 4) float32.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, _, row, count, _ = arguments
        decoder, features, out = (array_of(context, builder, signature, arguments, n).data for n in (0, 1, 4))
        starts = [builder.mul(count, INDEX(c)) for c in range(4)]
        totals = {wide: [cgutils.alloca_once(builder, vector_type(wide)) for _ in starts] for wide in (WIDE, 1)}
        for wide, four in totals.items():
            for total in four:
                builder.store(constant(0.0, wide), total)

        def emit(i: Any, wide: int) -> None:
            feature = load(builder, features, builder.add(builder.mul(row, count), i), wide)
            for total, start in zip(totals[wide], starts, strict=True):
                term = product(builder, feature, load(builder, decoder, builder.add(start, i), wide))
                builder.store(added(builder, builder.load(total), term), total)

        for_each_vector(builder, count, WIDE, emit)
        whole = sums(builder, [builder.load(total) for total in totals[WIDE]], WIDE)
        for c, total in enumerate(totals[1]):
            rest = builder.extract_element(builder.load(total), LANE(0))
            number = builder.extract_element(whole, LANE(c))
            whole = builder.insert_element(whole, builder.fadd(number, rest), LANE(c))
        store(builder, whole, out, builder.mul(row, INDEX(4)))
        return context.get_dummy_value()

    whole = types.int64
    return types.void(decoder, features, whole, whole, out), generate


@intrinsic
def sigmoids(_: Any, values: Any, row: Any) -> Any:
    """Replace the four numbers x of a row of `values` (n, 4) by 1 / (1 + exp(-x))."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        values = array_of(context, builder, signature, arguments, 0).data
        at, one = builder.mul(arguments[1], INDEX(4)), constant(1.0, 4)
        power = exponential(builder, builder.fsub(constant(0.0, 4), load(builder, values, at, 4)), 4)
        store(builder, builder.fdiv(one, builder.fadd(one, power)), values, at)
        return context.get_dummy_value()

    return types.void(values, types.int64), generate


@intrinsic
def absorb(_: Any, log_densities: Any, taus: Any, alphas: Any, first: Any) -> Any:
    """Set taus[k] *= exp(log_densities[k]) and alphas[k] = 1 - exp(-taus[k]) for WIDE samples from `first` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        log_densities, taus, alphas = (array_of(context, builder, signature, arguments, n).data for n in range(3))
        first = arguments[3]
        density = exponential(builder, load(builder, log_densities, first, WIDE), WIDE)
        tau = builder.fmul(density, load(builder, taus, first, WIDE))
        store(builder, tau, taus, first)
        passed = exponential(builder, builder.fsub(constant(0.0, WIDE), tau), WIDE)
        store(builder, builder.fsub(constant(1.0, WIDE), passed), alphas, first)
        return context.get_dummy_value()

    return types.void(log_densities, taus, alphas, types.int64), generate


@intrinsic
def dot(_: Any, a: Any, at: Any, b: Any, b_at: Any, count: Any) -> Any:
    """Return the sum of a[at + i] b[b_at + i] over i < count."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, at, _, b_at, count = arguments
        a, b = (array_of(context, builder, signature, arguments, n).data for n in (0, 2))
        sums = {wide: cgutils.alloca_once(builder, constant(0.0, wide).type) for wide in (WIDE, 1)}
        for wide, place in sums.items():
            builder.store(constant(0.0, wide), place)

        def add(i: Any, wide: int) -> None:
            term = product(builder, *(load(builder, x, builder.add(s, i), wide) for x, s in ((a, at), (b, b_at))))
            builder.store(added(builder, builder.load(sums[wide]), term), sums[wide])

        for_each_vector(builder, count, WIDE, add)
        total = added(builder, folded(builder, builder.load(sums[WIDE]), WIDE, 1), builder.load(sums[1]))
        return builder.extract_element(total, LANE(0))

    whole = types.int64
    return types.float32(a, whole, b, whole, whole), generate
