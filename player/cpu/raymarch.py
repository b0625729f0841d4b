"""Marching by a processor itself: by planes and rows, or through a grid of what they come to at the corners of texels, which is baked as rays come by.

The march is that of march.glsl (normative text and readable twin: kpc.player.cpu.reference), in float32. Rays go side by side, LANES of them: each
round, all look at the cell that their next sample lies in; those of which it is empty pass by it, the others take their sample; those that are
done make room. So one ray waits for memory, or for numbers, while others go on, and most loops are over vectors: a driver that draws by a
processor has rays of a square wait for each other instead.

A sample of planes takes some 60 ns of a core (room, two scales of 16 channels, two hyperthreads that share what multiplies), 46 of them in
`vectors.weigh`. A corner is baked when a sample first looks at it: where a picture of `soldier` looks at 80,000 of its 490,000 corners, samples of the slot
may look at 290,000.
"""

import math

import numpy as np
from kpc.format.common.jit import compiled
from kpc.format.scene import space
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TERMINATION
from kpc.player.cpu.reference import PARALLEL
from kpc.player.cpu.simd import CHANNELS, NARROW, WIDE, combine, interpolate, weigh

LANES = 512
"""Rays side by side. With 256 a picture takes 1.05 of the time, with 128 1.1; what they hold fits the two nearest caches."""
AROUND = 8
BAKED, WHOLE = 1, 2
"""Of a corner: it is baked; the seven that follow it along x, y and z are, too."""

DONE = -1
"""In place of how far all is empty around a ray's cell."""
RATE_X, RATE_Y, RATE_Z, NEAR, FAR, STEP, TRANS, RED, GREEN, BLUE, DEPTH, SAMPLES, T, X, Y, Z, STRETCH = range(17)
KEPT = SAMPLES + 1
"""Of each ray, as march.glsl has it, FAR in t. What is told of the sample it is at is made anew each round: t, the place, what its step counts."""
AT_X, AT_Y, AT_Z, PART_X, PART_Y, PART_Z, COUNTS, LOOKED_UP = range(8)
"""Of each sample: its place, its share of the way to the next node or corner, what its step counts for the density, and the first of four that it looks up there. Of corners those are ..."""
LOGIT_RED, LOGIT_GREEN, LOGIT_BLUE, LOG_DENSITY = range(LOOKED_UP, LOOKED_UP + 4)
"""... or what becomes of them: colours, and alpha."""

F, I, U = np.float32, np.int32, np.uint64
"""Numbers count from no array's end where they are unsigned, which lets loops be of vectors."""
ZERO, HALF, ONE, TWO, FOUR, TINY = F(0), F(0.5), F(1), F(2), F(4), F(1e-30)
EPSILON, ALMOST, FARTHEST, LIMIT, END = F(PARALLEL), F(1e-3), F(1e6), F(LOG_DENSITY_LIMIT), F(TERMINATION)
LAST = F(2 - 1 / space.FAR)
"""Where a ray in contracted space ends, in s over `even`."""
LOG2_E, MOST_DOUBLINGS = F(1 / math.log(2)), 126
E1, E2, E3, E4, E5 = (F(math.log(2) ** power / math.factorial(power)) for power in range(1, 6))

_FAST = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}
_part = compiled(forceinline=True, _nrt=False, **_FAST)
"""Of `march_blocks`: what makes no array."""


@compiled(**_FAST)
def march_blocks(
    blocks,
    side,
    origin,
    size,
    lens,
    axes,
    start,
    box,
    even,
    stride,
    tau,
    termination,
    background,
    free,
    cells,
    motion,
    nodes,
    baked,
    looked_up,
    seen,
    met,
):
    """March the pixels of blocks.

    `blocks`: (N, 2) int64 of row and column, each of `side` x `side` pixels, rows from below. `origin`: column and row of the pixel that comes
    first in `seen`, (h, w, 4) of rgb and opacity, and `met`, (h, w, 2), sum of weight t and samples. `size`: of the picture.
    `lens`, `axes` and the rest as in march.glsl; `start`: the eye in [0, 1]^3 over the box, of edges `box`. Where space is contracted `even` is how far
    along a ray steps are even, else None; then `box` are half edges, in which the eye is so far from its middle.

    Grids lie flat, x fastest; how many there are along x, y, z comes behind them: `free`, (N,) uint8, as occupancy.glsl has it; `motion`, (N, 4),
    of no nodes where nothing is displaced.

    One of two is None. `baked`: `grid`, (N, 4) of logits and log densities at those corners that are `known`, (N,) uint8 of BAKED and WHOLE, and
    how many `corners` there are. The others are baked from `planes`, xy, xz, yz at corners, (rows * columns, M) int16, `rows` of the time planes
    along x, y, z, (N, M), `weights`, (4, M), which make up for the planes' steps, and `bias`.

    `looked_up`: of samples, `halves`, `planes` and `rows` as `vectors.weigh` has them; `firsts`, (groups, 6) int64, where xy, xz, yz and the rows of x, y, z
    begin; `sizes`, (groups, 3) int64, of texels along x, y, z, at least two; and of the decoder `w1`, (H, 9), `b1`, with the code of an appearance,
    `w2`, (H, 4 F), 0 for the density, and `b2` and the density's weights, (4 F,), all of which make up for the planes' steps, and `bias`; and room for `weights`, (LANES, 4 F) as rays see them, or, where colours have no sides,
    (1, 4 F), those of all.
    """
    rays, samples = np.zeros((STRETCH + 1, LANES), np.float32), np.zeros((LOG_DENSITY + 1, LANES), np.float32)
    pixel, cell, around, of_ray = (
        np.empty(LANES, np.int32),
        np.empty(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.empty(LANES, np.int32),
    )
    wanted = np.empty(AROUND * LANES + 1, np.int32)
    texels, kept = np.zeros((6, LANES), np.int32), np.zeros(LANES, np.int32)
    if baked is not None:
        planes, rows, weights, bias, grid, known, corners = baked
    if looked_up is not None:
        halves, planes, rows, firsts, sizes, w1, b1, w2, of_all, bias, weights = looked_up
        if len(b1) > 0:
            kept[:] = np.arange(LANES)  # each ray's own weights
    taken, count = (
        np.int64(0),
        np.int64(0),
    )  # a plain 0 would be a type of its own, for which parts are compiled once more
    while taken < len(blocks) or count > 0:
        while taken < len(blocks) and count + side * side <= LANES:
            count = _begin(blocks[taken], side, size, lens, axes, start, box, even, count, rays, pixel)
            taken += 1
        _look(count, start, even, stride, free, cells, rays, cell, around)
        if even is None:
            _pass_by(count, stride, cells, rays, around)
        else:
            _pass_by_contracted(count, start, even, stride, cells, rays, around)
        found = _stopped(count, even, rays, around, samples, of_ray)
        if found > 0:
            if len(motion) > 0:
                _displace(found, motion, nodes, samples, cell)
            if baked is not None:
                _find(found, corners, samples, cell)
                _bake(_wanted(found, known, corners, cell, wanted), wanted, planes, rows, weights, bias, grid, corners)
                _look_up(found, grid, corners, samples, cell)
            if looked_up is not None:
                if len(b1) > 0:
                    _face(found, box, of_ray, rays, kept, w1, b1, w2, of_all, weights)
                _weigh(found, halves, planes, rows, firsts, sizes, weights, bias, of_ray, kept, samples, texels)
            _shade(found, even, tau, samples)
            _add(found, termination, samples, of_ray, rays, around)
        count = _end(count, termination, background, origin, size, rays, pixel, kept, around, seen, met)


@_part
def _whole(count):
    """Up to a multiple of WIDE: what is left over would be done one by one. Lanes beyond `count` hold what was there before."""
    return (U(count) + U(WIDE - 1)) // U(WIDE) * U(WIDE)


@_part
def _exp(x):
    """As a power of two, by Taylor's series around whole ones: off by 2.4e-6 of itself at most. The library's is not one of vectors."""
    y = x * LOG2_E
    y = y if y > F(-MOST_DOUBLINGS) else F(-MOST_DOUBLINGS)  # where it is not a number, too
    y = y if y < F(MOST_DOUBLINGS) else F(MOST_DOUBLINGS)
    whole = I(y + F(MOST_DOUBLINGS + 0.5)) - I(MOST_DOUBLINGS)
    e = y - F(whole)
    return (ONE + e * (E1 + e * (E2 + e * (E3 + e * (E4 + e * E5))))) * I((whole + I(127)) << I(23)).view(np.float32)


@_part
def _within(x, most):
    """From 0 to `most`; 0 where it is not a number: what is not may not become a place in an array."""
    x = x if x > ZERO else ZERO
    return x if x < most else most


@_part
def _slanted(x):
    return x if abs(x) >= EPSILON else -EPSILON if x < ZERO else EPSILON


@_part
def _largest(x, y, z):
    return max(abs(x), max(abs(y), abs(z)))


@_part
def _distance(s, even):
    return s if s <= even else even / (TWO - s / even)


@_part
def _progress(t, even):
    return t if t <= even else even * (TWO - even / t)


@_part
def _begin(block, side, size, lens, axes, start, box, even, count, rays, pixel):
    """The rays of a block beside those there are: how many these are then."""
    width, height = size
    first = count
    for within in range(side * side):
        row, column = block[0] * side + within // side, block[1] * side + within % side
        if row < height and column < width:
            pixel[count] = row * width + column
            rays[X, count], rays[Y, count] = F(column) + HALF, F(height - row) - HALF
            count += 1
    for i in range(U(first), U(count)):
        right, up = (rays[X, i] - lens[2]) / lens[0], (lens[3] - rays[Y, i]) / lens[1]
        x = axes[0, 0] * right + axes[0, 1] * up - axes[0, 2]
        y = axes[1, 0] * right + axes[1, 1] * up - axes[1, 2]
        z = axes[2, 0] * right + axes[2, 1] * up - axes[2, 2]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = _slanted(x / length) / box[0], _slanted(y / length) / box[1], _slanted(z / length) / box[2]
        rays[RATE_X, i], rays[RATE_Y, i], rays[RATE_Z, i] = x, y, z
        rays[STEP, i], rays[TRANS, i] = ZERO, ONE
        rays[RED, i], rays[GREEN, i], rays[BLUE, i], rays[DEPTH, i], rays[SAMPLES, i] = ZERO, ZERO, ZERO, ZERO, ZERO
        if even is not None:
            rays[NEAR, i], rays[FAR, i] = ZERO, _distance(LAST * even, even)
            continue
        x_low, y_low, z_low = -start[0] / x, -start[1] / y, -start[2] / z
        x_high, y_high, z_high = (ONE - start[0]) / x, (ONE - start[1]) / y, (ONE - start[2]) / z
        rays[NEAR, i] = max(max(min(x_low, x_high), min(y_low, y_high)), max(min(z_low, z_high), ZERO))
        rays[FAR, i] = min(min(max(x_low, x_high), max(y_low, y_high)), max(z_low, z_high))
    return count


@_part
def _look(count, start, even, stride, free, cells, rays, cell, around):
    """Where next samples lie, and how far around their cells all is empty."""
    nx, ny, nz = cells
    for i in range(_whole(count)):
        t = rays[NEAR, i] + (rays[STEP, i] + HALF) * stride
        if even is not None:
            t = _distance(min(t, LAST * even), even)
        x, y, z = start[0] + t * rays[RATE_X, i], start[1] + t * rays[RATE_Y, i], start[2] + t * rays[RATE_Z, i]
        if even is not None:
            radius = max(_largest(x, y, z), ONE)
            shrunk = F(0.25) * (TWO - ONE / radius) / radius
            x, y, z = x * shrunk + HALF, y * shrunk + HALF, z * shrunk + HALF
            stretch = max(t / even, ONE) / radius
            rays[STRETCH, i] = stretch * stretch
        rays[T, i], rays[X, i], rays[Y, i], rays[Z, i] = t, x, y, z
        row = I(_within(z * F(nz), F(nz - 1))) * I(ny) + I(_within(y * F(ny), F(ny - 1)))
        cell[i] = row * I(nx) + I(_within(x * F(nx), F(nx - 1)))
    for i in range(U(count)):
        around[i] = free[U(cell[i])]


@_part
def _leave(x, rate, reach, count):
    """How far, in t, it is from x to the faces of the block that reaches `reach` cells from that of x, of `count`, in both directions."""
    cell = F(I(_within(x * count, count - ONE)))
    return ((cell + (reach if rate > ZERO else ONE - reach)) / count - x) / rate


@_part
def _sides(u, reach, count):
    """Of the block that reaches `reach` cells from that of u, in the cube [-2, 2]^3."""
    cell = F(I(_within(u * count, count - ONE)))
    return FOUR * (cell + ONE - reach) / count - TWO, FOUR * (cell + reach) / count - TWO


@_part
def _straight(y, rate, low, high):
    """How far, in t, it is to them from y within the box, as far as that reaches."""
    return ((min(high, ONE) if rate > ZERO else max(low, -ONE)) - y) / rate


@_part
def _pass_by(count, stride, cells, rays, around):
    """Move on to the first sample behind what is empty."""
    nx, ny, nz = cells
    for i in range(_whole(count)):
        reach = F(around[i])
        leave_x = _leave(rays[X, i], rays[RATE_X, i], reach, F(nx))
        leave_y = _leave(rays[Y, i], rays[RATE_Y, i], reach, F(ny))
        leave_z = _leave(rays[Z, i], rays[RATE_Z, i], reach, F(nz))
        steps = min(min(leave_x, min(leave_y, leave_z)) / stride - ALMOST, FARTHEST)
        further = rays[STEP, i] + F(max(I(steps), I(0))) + ONE
        rays[STEP, i] = further if around[i] > 0 else rays[STEP, i]


@_part
def _pass_by_contracted(count, start, even, stride, cells, rays, around):
    """As `_pass_by`; `way_out` of occupancy.glsl, a bound from below, has the reasons."""
    nx, ny, nz = cells
    for i in range(_whole(count)):
        t, reach = rays[T, i], F(around[i])
        vx, vy, vz = rays[RATE_X, i], rays[RATE_Y, i], rays[RATE_Z, i]
        x, y, z = start[0] + t * vx, start[1] + t * vy, start[2] + t * vz
        x_low, x_high = _sides(rays[X, i], reach, F(nx))
        y_low, y_high = _sides(rays[Y, i], reach, F(ny))
        z_low, z_high = _sides(rays[Z, i], reach, F(nz))
        straight = min(
            _straight(x, vx, x_low, x_high), min(_straight(y, vy, y_low, y_high), _straight(z, vz, z_low, z_high))
        )
        at_x, at_y, at_z = FOUR * rays[X, i] - TWO, FOUR * rays[Y, i] - TWO, FOUR * rays[Z, i] - TWO
        margin = max(
            min(
                min(min(at_x - x_low, x_high - at_x), min(at_y - y_low, y_high - at_y)),
                min(at_z - z_low, z_high - at_z),
            ),
            ZERO,
        )
        speed = _largest(vx, vy, vz)
        turn = _largest(start[1] * vz - start[2] * vy, start[2] * vx - start[0] * vz, start[0] * vy - start[1] * vx)
        nearest = _largest(at_x, at_y, at_z) - margin
        bound = F(4 / 3) * speed
        closer = min(bound, (speed + TWO * turn) * (TWO - nearest) * (TWO - nearest))
        bent = margin / max(closer if nearest > ONE else bound, TINY)
        way = straight if _largest(x, y, z) < ONE else bent
        steps = min((_progress(t + way, even) - _progress(t, even)) / stride - ALMOST, FARTHEST)
        further = rays[STEP, i] + F(max(I(steps), I(0))) + ONE
        rays[STEP, i] = further if around[i] > 0 else rays[STEP, i]


@_part
def _stopped(count, even, rays, around, samples, of_ray):
    """Rays that take a sample: how many. Those beyond the box are done."""
    found = U(0)
    for i in range(U(count)):
        inside, is_free = rays[T, i] < rays[FAR, i], around[i] > 0
        around[i] = around[i] if inside else I(DONE)
        of_ray[found] = i
        samples[AT_X, found], samples[AT_Y, found], samples[AT_Z, found] = rays[X, i], rays[Y, i], rays[Z, i]
        if even is not None:
            samples[COUNTS, found] = rays[STRETCH, i]
        found += U(inside & ~is_free)  # a branch would often be foretold wrongly
    return found


@_part
def _strides(nodes):
    """From a node to the next along x, y, z, where there is one."""
    nx, ny, nz = nodes
    return U(1 if nx > 1 else 0), U(nx if ny > 1 else 0), U(nx * ny if nz > 1 else 0)


@_part
def _find(found, nodes, samples, cell):
    """In a grid with nodes at all corners and faces of [0, 1]^3: the one before each sample, and its share of the way to the next."""
    nx, ny, nz = nodes
    for j in range(_whole(found)):
        x, y, z = _within(samples[AT_X, j], ONE), _within(samples[AT_Y, j], ONE), _within(samples[AT_Z, j], ONE)
        samples[AT_X, j], samples[AT_Y, j], samples[AT_Z, j] = x, y, z
        x, y, z = x * F(nx - 1), y * F(ny - 1), z * F(nz - 1)
        column, row, layer = min(I(x), I(max(nx - 2, 0))), min(I(y), I(max(ny - 2, 0))), min(I(z), I(max(nz - 2, 0)))
        samples[PART_X, j], samples[PART_Y, j], samples[PART_Z, j] = x - F(column), y - F(row), z - F(layer)
        cell[j] = (layer * I(ny) + row) * I(nx) + column


@_part
def _look_up(found, grid, nodes, samples, cell):
    """What a grid holds at each sample, in between nodes."""
    right, up, back = _strides(nodes)
    for j in range(U(found)):
        x, y, z = samples[PART_X, j], samples[PART_Y, j], samples[PART_Z, j]
        interpolate(grid, U(cell[j]), right, up, back, x, y, z, samples, U(LOOKED_UP), j)


@_part
def _displace(found, motion, nodes, samples, cell):
    """`kpc.format.scene.motion.displace`; places still to be clamped."""
    _find(found, nodes, samples, cell)
    _look_up(found, motion, nodes, samples, cell)
    for j in range(_whole(found)):
        samples[AT_X, j] += samples[LOOKED_UP, j]
        samples[AT_Y, j] += samples[LOOKED_UP + 1, j]
        samples[AT_Z, j] += samples[LOOKED_UP + 2, j]


@_part
def _wanted(found, known, corners, cell, wanted):
    """Corners around samples that are not known yet, and count as known from now on: how many."""
    count, (right, up, back) = U(0), _strides(corners)
    for j in range(U(found)):
        first = U(cell[j])
        if known[first] & WHOLE:
            continue
        for number in range(AROUND):
            corner = (
                first + (right if number & 1 else U(0)) + (up if number & 2 else U(0)) + (back if number & 4 else U(0))
            )
            wanted[count] = corner
            count += U(known[corner] == 0)
            known[corner] |= BAKED
        known[first] |= WHOLE
    return count


@_part
def _bake(count, wanted, planes, rows, weights, bias, grid, corners):
    """Fill corners of the grid."""
    nx, ny, _ = corners
    for j in range(count):
        at = np.uint32(wanted[j])
        line = at // np.uint32(nx)
        z = line // np.uint32(ny)
        x, y = at - line * np.uint32(nx), line - z * np.uint32(ny)
        in_planes = planes[0][U(y) * U(nx) + U(x)], planes[1][U(z) * U(nx) + U(x)], planes[2][U(line)]
        combine(in_planes, (rows[0][U(x)], rows[1][U(y)], rows[2][U(z)]), weights, bias, grid, U(at))


@_part
def _face(found, box, of_ray, rays, kept, w1, b1, w2, of_all, weights):
    """Weights of features for colours as seen along rays that take their first sample."""
    for j in range(U(found)):
        i = U(of_ray[j])
        if rays[SAMPLES, i] > ZERO:
            continue
        x, y, z, row = rays[RATE_X, i] * box[0], rays[RATE_Y, i] * box[1], rays[RATE_Z, i] * box[2], U(kept[i])
        for m in range(U(len(of_all))):
            weights[row, m] = of_all[m]
        for h in range(U(len(b1))):
            sum_ = b1[h] + w1[h, 0] * x + w1[h, 1] * y + w1[h, 2] * z
            sum_ += (
                w1[h, 3] * x * x
                + w1[h, 4] * y * y
                + w1[h, 5] * z * z
                + w1[h, 6] * x * y
                + w1[h, 7] * y * z
                + w1[h, 8] * z * x
            )
            if sum_ > ZERO:
                for m in range(U(len(of_all))):
                    weights[row, m] += sum_ * w2[h, m]


@_part
def _weigh(found, halves, planes, rows, firsts, sizes, weights, bias, of_ray, kept, samples, texels):
    """Logits and log densities from planes and rows."""
    flat, each, wide = weights.reshape(-1), U(weights.shape[1]), U(NARROW * len(halves))
    for j in range(_whole(found)):
        samples[AT_X, j], samples[AT_Y, j], samples[AT_Z, j] = (
            _within(samples[AT_X, j], ONE),
            _within(samples[AT_Y, j], ONE),
            _within(samples[AT_Z, j], ONE),
        )
        samples[LOGIT_RED, j], samples[LOGIT_GREEN, j], samples[LOGIT_BLUE, j], samples[LOG_DENSITY, j] = (
            ZERO,
            ZERO,
            ZERO,
            bias,
        )
    for group in range(U(len(sizes))):
        nx, ny, nz = sizes[group, 0], sizes[group, 1], sizes[group, 2]
        for j in range(_whole(found)):
            x, y, z = samples[AT_X, j] * F(nx - 1), samples[AT_Y, j] * F(ny - 1), samples[AT_Z, j] * F(nz - 1)
            column, row, layer = min(I(x), I(nx - 2)), min(I(y), I(ny - 2)), min(I(z), I(nz - 2))
            samples[PART_X, j], samples[PART_Y, j], samples[PART_Z, j] = x - F(column), y - F(row), z - F(layer)
            texels[0, j], texels[1, j], texels[2, j] = row * I(nx) + column, layer * I(nx) + column, layer * I(ny) + row
            texels[3, j], texels[4, j], texels[5, j] = column, row, layer
        xy, xz, yz, of_x, of_y, of_z = (
            firsts[group, 0],
            firsts[group, 1],
            firsts[group, 2],
            firsts[group, 3],
            firsts[group, 4],
            firsts[group, 5],
        )
        up, up_yz = wide * U(nx), wide * U(ny)
        for j in range(U(found)):
            weigh(
                planes,
                (U(xy) + wide * U(texels[0, j]), U(xz) + wide * U(texels[1, j]), U(yz) + wide * U(texels[2, j])),
                (up, up, up_yz),
                rows,
                (U(of_x) + wide * U(texels[3, j]), U(of_y) + wide * U(texels[4, j]), U(of_z) + wide * U(texels[5, j])),
                (samples[PART_X, j], samples[PART_Y, j], samples[PART_Z, j]),
                flat, U(kept[U(of_ray[j])]) * each + group * wide * U(CHANNELS), halves, samples, U(LOGIT_RED), j,
            )  # fmt: skip


@_part
def _shade(found, even, tau, samples):
    """Colours and alphas in place of logits and log densities."""
    for j in range(_whole(found)):
        density = _exp(min(max(samples[LOG_DENSITY, j], -LIMIT), LIMIT))
        thickness = tau if even is None else tau * samples[COUNTS, j]
        samples[LOG_DENSITY, j] = ONE - _exp(-density * thickness)
        samples[LOGIT_RED, j] = ONE / (ONE + _exp(-samples[LOGIT_RED, j]))
        samples[LOGIT_GREEN, j] = ONE / (ONE + _exp(-samples[LOGIT_GREEN, j]))
        samples[LOGIT_BLUE, j] = ONE / (ONE + _exp(-samples[LOGIT_BLUE, j]))


@_part
def _add(found, termination, samples, of_ray, rays, around):
    """Each sample to its ray, which goes on by a step, or is done."""
    for j in range(U(found)):
        i = U(of_ray[j])
        weight = rays[TRANS, i] * samples[LOG_DENSITY, j]
        rays[RED, i] += weight * samples[LOGIT_RED, j]
        rays[GREEN, i] += weight * samples[LOGIT_GREEN, j]
        rays[BLUE, i] += weight * samples[LOGIT_BLUE, j]
        rays[DEPTH, i] += weight * rays[T, i]
        rays[SAMPLES, i] += ONE
        rays[STEP, i] += ONE
        rays[TRANS, i] -= weight
        if rays[TRANS, i] < termination:
            around[i] = DONE


@_part
def _end(count, termination, background, origin, size, rays, pixel, kept, around, seen, met):
    """Write what rays that are done have seen, and put others in their place: how many are left."""
    for done in range(count - 1, -1, -1):
        if around[done] != DONE:
            continue
        trans, share = rays[TRANS, done], ONE
        if trans < termination and termination > END:  # sooner than the format says: the rest is like what was met
            share, trans = ONE / (ONE - trans), ZERO
        row, column = divmod(pixel[done], I(size[0]))
        row, column = row - I(origin[1]), column - I(origin[0])
        for channel in range(3):
            seen[row, column, channel] = share * rays[RED + channel, done] + trans * background[channel]
        seen[row, column, 3] = ONE - trans
        met[row, column, 0], met[row, column, 1] = share * rays[DEPTH, done], rays[SAMPLES, done]
        count -= 1
        for line in range(KEPT):
            rays[line, done] = rays[line, count]
        pixel[done] = pixel[count]
        kept[done], kept[count] = kept[count], kept[done]
    return count
