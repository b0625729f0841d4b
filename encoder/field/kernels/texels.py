"""The texels of planes and the nodes of a motion grid around a point, by vectors over channels.

Texels are found, then fetched, and read when those of other samples have been found, too: most are not in the
processor's nearest cache, and it would wait for them. Each intrinsic does what a sample needs of one scale at once, so
that the numbers of six planes stay in the processor's registers. A place is an array and a position in it, which counts
its numbers from the beginning: (array, int64).
"""

from collections.abc import Iterator, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kpc.encoder.field.kernels.vectors import WIDTHS
from kpc.vectors import (
    FLOAT,
    INDEX,
    LANE,
    added,
    array_data,
    array_of,
    clamped,
    constant,
    folded,
    for_each_vector,
    load,
    picked,
    prefetch,
    product,
    spread,
    store,
    vector_type,
)

# The axes of the planes xy xz yz xt yt zt along their columns and rows, as positions in "xyzt".
AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))

# Columns of each half of `PlaneSet.places`, and of `RayBuffers.texels` for each scale.
PLACES = 8

# Numbers of a line of the processor's cache.
LINE = 16

# Columns of `RayBuffers.points`, and where the point before displacement begins in a row.
POINT, UNDISPLACED = 8, 4

_ONE = ir.Constant(FLOAT, 1.0)


def _texel_and_share(builder: Any, point: Any, interval: Any) -> tuple[Any, Any]:
    """Return, for four coordinates in [0, 1], the texel below and the share of the way to the next.

    Coordinates beyond are clamped, and NaN is 0: a texel must lie in the plane.
    """
    nothing, one = constant(0.0, 4), constant(1.0, 4)
    position = builder.fmul(point, interval)
    below = clamped(builder, position, nothing, builder.fsub(interval, one))
    texel = builder.fptosi(below, vector_type(4, LANE))
    return texel, clamped(builder, builder.fsub(position, builder.sitofp(texel, vector_type(4))), nothing, one)


class _Scale:
    """What the intrinsics of one scale have in common, unpacked from their first six arguments.

    Attributes:
        texels: for each plane, pointers to the four texels around the point.
        shares: float32, along x, y, z, t, of the way to the next texel.
        channels: M.
    """

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> None:
        grid, number, around, sample, self.channels, _ = arguments[:6]
        self.builder = builder
        of_grid, _, of_around, _, _, planes = signature.args[:6]
        data, places, self._intervals = _unpacked(context, builder, of_grid, grid)
        texels, shares, values = _unpacked(context, builder, of_around, around)
        self._number = number
        self._values = builder.gep(values, [builder.mul(sample, builder.mul(self.channels, INDEX(len(AXES))))])
        at = builder.mul(sample, INDEX(4))
        self.shares = [builder.load(builder.gep(shares, [builder.add(at, INDEX(axis))])) for axis in range(4)]
        self.texels = []
        for c in range(planes.literal_value):
            start, below = (
                builder.sext(builder.load(builder.gep(whole, [builder.add(at, INDEX(c))])), INDEX)
                for whole, at in ((texels, builder.mul(sample, INDEX(PLACES))), (places, _of_rows(builder, number)))
            )
            rows = start, builder.add(start, below)
            ends = [end for row in rows for end in (row, builder.add(row, self.channels))]
            self.texels.append([builder.gep(data, [end]) for end in ends])

    def intervals(self) -> Any:
        """Return four float32, between texels along each axis."""
        return load(self.builder, self._intervals, self.builder.mul(self._number, INDEX(4)), 4)

    def planes(self, m: Any, wide: int) -> Iterator[tuple[list[Any], Any, Any]]:
        """Yield, for each plane, pointers to its texels from channel m on, and the shares along columns and rows."""
        shares = [spread(self.builder, share, wide) for share in self.shares]
        for texels, (column_axis, row_axis) in zip(self.texels, AXES, strict=False):
            yield [self.builder.gep(texel, [m]) for texel in texels], shares[column_axis], shares[row_axis]

    def value(self, c: int, m: Any) -> Any:
        """Return a pointer to channel m of what plane c holds at the point."""
        return self.builder.gep(self._values, [self.builder.add(self.builder.mul(self.channels, INDEX(c)), m)])

    def gradients(self, feature: Any, m: Any, wide: int) -> list[Any]:
        """Return the gradient of channel m of what each plane holds at the point, given that of the product."""
        builder = self.builder
        values = [load(builder, self.value(c, m), INDEX(0), wide) for c in range(len(self.texels))]
        before = [load(builder, feature, m, wide)]  # times the values of the planes before
        for value in values[:-1]:
            before.append(product(builder, before[-1], value))
        gradients, behind = [before[-1]], values[-1]  # product of the values of the planes behind
        for c in reversed(range(len(values) - 1)):
            gradients.append(product(builder, before[c], behind))
            behind = product(builder, values[c], behind)
        return gradients[::-1]


def _unpacked(context: Any, builder: Any, kinds: Any, arrays: Any) -> list[Any]:
    """Return pointers to the first number of each of a tuple of arrays."""
    members = cgutils.unpack_tuple(builder, arrays)
    return [array_data(context, builder, kind, array) for kind, array in zip(kinds, members, strict=True)]


def _of_rows(builder: Any, scale: Any) -> Any:
    """Return where in `PlaneSet.places` the numbers in a row of each plane of a scale are."""
    return builder.add(builder.mul(scale, INDEX(2 * PLACES)), INDEX(PLACES))


def _place_type(place: Any) -> Any:
    """Return the type of a place, given that of an argument."""
    return types.Tuple((place[0], types.int64))


def _signature(grid: Any, around: Any, planes: Any, *more: Any) -> Any:
    """Return the types of what `_Scale` unpacks, given those of the arguments, and of `more` after it."""
    return types.void(grid, types.int64, around, types.int64, types.int64, planes, *more)


def _place(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return a pointer to a place in an array."""
    array, at = cgutils.unpack_tuple(builder, value)
    return builder.gep(array_data(context, builder, kind[0], array), [at])


def _between(builder: Any, a: Any, b: Any, share: Any) -> Any:
    """Return a + share (b - a)."""
    return added(builder, a, product(builder, share, builder.fsub(b, a)))


@intrinsic
def locate_scale(_: Any, grid: Any, scale: Any, point: Any, channels: Any, around: Any, sample: Any) -> Any:
    """Find the texels around a point in the planes of one scale.

    texels[PLACES sample + c] is set to where in theta the first texel of plane c around the point begins, and
    shares[4 sample + axis] to the share of the way to the next along x, y, z, t.

    Args:
        grid: theta or its gradient, `PlaneSet.places` and `PlaneSet.intervals`.
        scale: int64.
        point: place of u, v, w and the time, each in [0, 1] or clamped to it.
        channels: int64, M.
        around: texels, shares and values of `RayBuffers`.
        sample: int64, number of the sample times the number of scales, plus the scale.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        grid, number, point, channels, around, sample = arguments
        _, places, intervals = _unpacked(context, builder, signature.args[0], grid)
        texels, shares, _ = _unpacked(context, builder, signature.args[4], around)
        point = load(builder, _place(context, builder, signature.args[2], point), INDEX(0), 4)
        texel, share = _texel_and_share(builder, point, load(builder, intervals, builder.mul(number, INDEX(4)), 4))
        first = load(builder, places, builder.mul(number, INDEX(2 * PLACES)), PLACES, LANE)
        per_row = load(builder, places, _of_rows(builder, number), PLACES, LANE)
        column, row = (picked(builder, texel, texel, [axes[n] for axes in AXES] + [0, 0]) for n in (0, 1))
        wide = spread(builder, builder.trunc(channels, LANE), PLACES)
        for step, size in ((row, per_row), (column, wide)):
            first = builder.add(first, builder.mul(step, size))
        store(builder, first, texels, builder.mul(sample, INDEX(PLACES)))
        store(builder, share, shares, builder.mul(sample, INDEX(4)))
        return context.get_dummy_value()

    return types.void(grid, types.int64, _place_type(point), types.int64, around, types.int64), generate


@intrinsic(prefer_literal=True)
def fetch_scale(_: Any, grid: Any, scale: Any, around: Any, sample: Any, channels: Any, planes: Any) -> Any:
    """Have the processor fetch the texels that `locate_scale` found, before they are needed.

    Args:
        grid, scale, around, sample, channels: as of `locate_scale`.
        planes: 6, or 3 in a static scene; a constant.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        at = _Scale(context, builder, signature, arguments)
        with cgutils.for_range_slice(builder, INDEX(0), at.channels, INDEX(LINE), inc=True) as (m, _):
            for texels in at.texels:
                for texel in texels:
                    prefetch(builder, builder.gep(texel, [m]))
        return context.get_dummy_value()

    return _signature(grid, around, planes), generate


@intrinsic(prefer_literal=True)
def sample_scale(
    _: Any, grid: Any, scale: Any, around: Any, sample: Any, channels: Any, planes: Any, features: Any
) -> Any:
    """Sample the planes of one scale around a point, and multiply what they hold.

    values[(6 sample + c) M + m] is set to channel m of plane c, and features[m] to the product over planes.

    Args:
        grid, scale, around, sample, channels, planes: as of `fetch_scale`.
        features: place of M numbers.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        at = _Scale(context, builder, signature, arguments)
        features = _place(context, builder, signature.args[6], arguments[6])

        def emit(m: Any, wide: int) -> None:
            held = []
            for texels, fc, fr in at.planes(m, wide):
                a, b, c, d = (load(builder, texel, INDEX(0), wide) for texel in texels)
                held.append(_between(builder, _between(builder, a, b, fc), _between(builder, c, d, fc), fr))
            for n, value in enumerate(held):
                store(builder, value, at.value(n, m), INDEX(0))
            store(builder, product(builder, *held), features, m)

        for_each_vector(builder, at.channels, WIDTHS, emit)
        return context.get_dummy_value()

    return _signature(grid, around, planes, _place_type(features)), generate


@intrinsic(prefer_literal=True)
def scatter_scale(
    _: Any, grid: Any, scale: Any, around: Any, sample: Any, channels: Any, planes: Any, g_features: Any
) -> Any:
    """Add the gradient of the planes of one scale, given that of the product over planes: `sample_scale`'s transpose.

    Args:
        grid: the gradient of theta, `PlaneSet.places` and `PlaneSet.intervals`.
        scale, around, sample, channels, planes: as of `sample_scale`.
        g_features: place of M numbers.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        at = _Scale(context, builder, signature, arguments)
        g_features = _place(context, builder, signature.args[6], arguments[6])

        def emit(m: Any, wide: int) -> None:
            for gradient, (texels, fc, fr) in zip(at.gradients(g_features, m, wide), at.planes(m, wide), strict=True):
                lower = product(builder, fr, gradient)
                parts = []
                for row in (builder.fsub(gradient, lower), lower):
                    right = product(builder, fc, row)
                    parts += [builder.fsub(row, right), right]
                held = [load(builder, texel, INDEX(0), wide) for texel in texels]
                for texel, number, part in zip(texels, held, parts, strict=True):
                    store(builder, added(builder, number, part), texel, INDEX(0))

        for_each_vector(builder, at.channels, WIDTHS, emit)
        return context.get_dummy_value()

    return _signature(grid, around, planes, _place_type(g_features)), generate


@intrinsic(prefer_literal=True)
def add_slopes(
    _: Any, grid: Any, scale: Any, around: Any, sample: Any, channels: Any, planes: Any, g_features: Any, g_point: Any
) -> Any:
    """Add the gradient of the point's coordinates by way of one scale to g_point (4,).

    The other parameters are those of `scatter_scale`, but for `grid`, which is that of `sample_scale`.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        at = _Scale(context, builder, signature, arguments)
        g_features = _place(context, builder, signature.args[6], arguments[6])
        g_point = array_of(context, builder, signature, arguments, 7).data

        def emit(m: Any, wide: int) -> None:
            slopes = [constant(0.0, wide)] * 4
            planes = zip(at.gradients(g_features, m, wide), at.planes(m, wide), AXES, strict=False)
            for gradient, (texels, fc, fr), (column_axis, row_axis) in planes:
                a, b, c, d = (load(builder, texel, INDEX(0), wide) for texel in texels)
                along = _between(builder, builder.fsub(b, a), builder.fsub(d, c), fr)
                across = _between(builder, builder.fsub(c, a), builder.fsub(d, b), fc)
                for axis, slope in ((column_axis, along), (row_axis, across)):
                    slopes[axis] = added(builder, slopes[axis], product(builder, gradient, slope))
            total = ir.Constant(vector_type(4), ir.Undefined)
            for axis, slope in enumerate(slopes):
                number = builder.extract_element(folded(builder, slope, wide, 1), LANE(0))
                total = builder.insert_element(total, number, LANE(axis))
            held = load(builder, g_point, INDEX(0), 4)
            store(builder, added(builder, held, product(builder, at.intervals(), total)), g_point, INDEX(0))

        for_each_vector(builder, at.channels, WIDTHS, emit)
        return context.get_dummy_value()

    return _signature(grid, around, planes, _place_type(g_features), g_point), generate


class _MotionCell:
    """The nodes of a motion grid around a row of `RayBuffers.points`, before displacement.

    Attributes:
        nodes: pointers to the 16 nodes, and of each its factors along x, y, z, t, whose product is its weight, and
            whether it is the further one along each.
        shares: float32, along x, y, z, t, of the way to the next node.
        intervals: four float32, between nodes along each axis.
    """

    def __init__(self, builder: Any, grid: Any, points: Any, row: Any) -> None:
        self.builder = builder
        sizes = cgutils.unpack_tuple(builder, grid.shape)[3::-1]  # along x, y, z, t
        self.intervals = [builder.sitofp(builder.sub(size, INDEX(1)), FLOAT) for size in sizes]
        interval = constant(0.0, 4)
        for axis, number in enumerate(self.intervals):
            interval = builder.insert_element(interval, number, LANE(axis))
        at = builder.add(builder.mul(row, INDEX(POINT)), INDEX(UNDISPLACED))
        texel, share = _texel_and_share(builder, load(builder, points, at, 4), interval)
        self.shares = [builder.extract_element(share, LANE(axis)) for axis in range(4)]
        stride = INDEX(3)
        nodes: list[tuple[Any, tuple[Any, ...], tuple[bool, ...]]] = [(INDEX(0), (), ())]
        for axis, size in enumerate(sizes):
            lower = builder.mul(builder.sext(builder.extract_element(texel, LANE(axis)), INDEX), stride)
            on = self.shares[axis]
            ways = (lower, builder.fsub(_ONE, on), False), (builder.add(lower, stride), on, True)
            nodes = [
                (builder.add(node, step), (*factors, factor), (*further, is_further))
                for node, factors, further in nodes
                for step, factor, is_further in ways
            ]
            stride = builder.mul(stride, size)
        self.nodes = [(builder.gep(grid.data, [node]), *rest) for node, *rest in nodes]

    def weighted(self) -> Iterator[tuple[Any, Any]]:
        """Yield a pointer to each node, and its weight as a vector of three."""
        for node, factors, _ in self.nodes:
            yield node, spread(self.builder, product(self.builder, *factors), 3)


@intrinsic
def displace(_: Any, motion: Any, points: Any, k: Any) -> Any:
    """Set points[k, :3] to points[k, 4:7] + D: `kpc.format.scene.motion.displace` of points[k, 4:8], u and time.

    Args:
        motion: (T, Nz, Ny, Nx, 3) float32, at least two along each axis. points: (n, POINT) float32. k: int64.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        motion, points = (array_of(context, builder, signature, arguments, n) for n in range(2))
        at = builder.mul(arguments[2], INDEX(POINT))
        cell = _MotionCell(builder, motion, points.data, arguments[2])
        held = [load(builder, node, INDEX(0), 3) for node, *_ in cell.nodes]
        for share in reversed(cell.shares):  # nodes beside each other along the last axis follow each other
            on = spread(builder, share, 3)
            held = [_between(builder, *pair, on) for pair in zip(held[::2], held[1::2], strict=True)]
        undisplaced = load(builder, points.data, builder.add(at, INDEX(UNDISPLACED)), 3)
        store(builder, added(builder, undisplaced, *held), points.data, at)
        return context.get_dummy_value()

    return types.void(motion, points, types.int64), generate


@intrinsic
def displace_transpose(_: Any, g_motion: Any, points: Any, k: Any, g: Any) -> Any:
    """Add the gradient of the motion grid, given g (3,) or longer, that of points[k, :3] of `displace`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        g_motion, points, g = (array_of(context, builder, signature, arguments, n) for n in (0, 1, 3))
        gradient = load(builder, g.data, INDEX(0), 3)
        for node, weight in _MotionCell(builder, g_motion, points.data, arguments[2]).weighted():
            term = product(builder, weight, gradient)
            store(builder, added(builder, load(builder, node, INDEX(0), 3), term), node, INDEX(0))
        return context.get_dummy_value()

    return types.void(g_motion, points, types.int64, g), generate


@intrinsic
def add_displacement_slopes(_: Any, motion: Any, points: Any, k: Any, g: Any) -> Any:
    """Add to g (4,), the gradient of points[k, :3] of `displace` and of time, what the displacement contributes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        motion, points, g = (array_of(context, builder, signature, arguments, n) for n in (0, 1, 3))
        cell = _MotionCell(builder, motion, points.data, arguments[2])
        gradient, slopes = load(builder, g.data, INDEX(0), 3), [ir.Constant(FLOAT, 0.0)] * 4
        for node, factors, further in cell.nodes:
            parts = product(builder, load(builder, node, INDEX(0), 3), gradient)
            along = added(builder, *(builder.extract_element(parts, LANE(n)) for n in range(3)))
            for axis, is_further in enumerate(further):
                slope = product(builder, along, *factors[:axis], *factors[axis + 1 :])
                slopes[axis] = added(builder, slopes[axis], slope if is_further else builder.fneg(slope))
        for axis, (slope, interval) in enumerate(zip(slopes, cell.intervals, strict=True)):
            place = builder.gep(g.data, [INDEX(axis)])
            builder.store(added(builder, builder.load(place), product(builder, slope, interval)), place)
        return context.get_dummy_value()

    return types.void(motion, points, types.int64, g), generate
