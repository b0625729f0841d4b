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
    padded,
    product,
    spread,
    store,
    sums,
)

# Numbers of a vector where as many as there are samples in a block are computed at once.
WIDE = 8

# Numbers of the vectors of loops over channels or features.
WIDTHS = 16, 8, 1
WIDEST = WIDTHS[0]

_FOUR = types.UniTuple(types.float32, 4)


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
        totals = [cgutils.alloca_once_value(builder, constant(0.0, WIDEST)) for _ in starts]

        def emit(i: Any, wide: int) -> None:
            feature = load(builder, features, builder.add(builder.mul(row, count), i), wide)
            for total, start in zip(totals, starts, strict=True):
                term = product(builder, feature, load(builder, decoder, builder.add(start, i), wide))
                builder.store(added(builder, builder.load(total), padded(builder, term, wide, WIDEST)), total)

        for_each_vector(builder, count, WIDTHS, emit)
        whole = sums(builder, [builder.load(total) for total in totals], WIDEST)
        store(builder, whole, out, builder.mul(row, INDEX(4)))
        return context.get_dummy_value()

    whole = types.int64
    return types.void(decoder, features, whole, whole, out), generate


@intrinsic
def decode_transpose(_: Any, decoder: Any, g: Any, count: Any, g_features: Any) -> Any:
    """Set g_features[i], for i < F, to the sum over four c of g[c] decoder[c F + i], given the gradient g of `decode`.

    Args:
        decoder: (4 F,) float32. g: four float32. count: int64, F. g_features: (1, F) float32.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, g, count, _ = arguments
        decoder, g_features = (array_of(context, builder, signature, arguments, n).data for n in (0, 3))
        g = cgutils.unpack_tuple(builder, g)

        def emit(i: Any, wide: int) -> None:
            terms = []
            for c, number in enumerate(g):
                weights = load(builder, decoder, builder.add(builder.mul(count, INDEX(c)), i), wide)
                terms.append(product(builder, spread(builder, number, wide), weights))
            store(builder, added(builder, *terms), g_features, i)

        for_each_vector(builder, count, WIDTHS, emit)
        return context.get_dummy_value()

    return types.void(decoder, _FOUR, types.int64, g_features), generate


@intrinsic
def add_decoder_gradient(_: Any, g_decoder: Any, g: Any, count: Any, features: Any, row: Any) -> Any:
    """Add g[c] features[row F + i] to g_decoder[c F + i], for four c and i < F, given the gradient g of `decode`.

    Args:
        g_decoder: (4 F,) float32. g: four float32. count: int64, F. features: (n, F) float32. row: int64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, g, count, _, row = arguments
        g_decoder, features = (array_of(context, builder, signature, arguments, n).data for n in (0, 3))
        g = cgutils.unpack_tuple(builder, g)

        def emit(i: Any, wide: int) -> None:
            feature = load(builder, features, builder.add(builder.mul(row, count), i), wide)
            for c, number in enumerate(g):
                place = builder.add(builder.mul(count, INDEX(c)), i)
                term = product(builder, spread(builder, number, wide), feature)
                store(builder, added(builder, load(builder, g_decoder, place, wide), term), g_decoder, place)

        for_each_vector(builder, count, WIDTHS, emit)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(g_decoder, _FOUR, whole, features, whole), generate


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
        total = cgutils.alloca_once_value(builder, constant(0.0, WIDEST))

        def add(i: Any, wide: int) -> None:
            term = product(builder, *(load(builder, x, builder.add(s, i), wide) for x, s in ((a, at), (b, b_at))))
            builder.store(added(builder, builder.load(total), padded(builder, term, wide, WIDEST)), total)

        for_each_vector(builder, count, WIDTHS, add)
        return builder.extract_element(folded(builder, builder.load(total), WIDEST, 1), LANE(0))

    whole = types.int64
    return types.float32(a, whole, b, whole, whole), generate


@intrinsic
def add_scaled(_: Any, out: Any, at: Any, factor: Any, values: Any, values_at: Any, count: Any) -> Any:
    """Add factor * values[values_at + i] to out[at + i] for i < count."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _, at, factor, _, values_at, count = arguments
        out, values = (array_of(context, builder, signature, arguments, n).data for n in (0, 3))

        def emit(i: Any, wide: int) -> None:
            place = builder.add(at, i)
            term = product(
                builder, spread(builder, factor, wide), load(builder, values, builder.add(values_at, i), wide)
            )
            store(builder, added(builder, load(builder, out, place, wide), term), out, place)

        for_each_vector(builder, count, WIDTHS, emit)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(out, whole, types.float32, values, whole, whole), generate
