"""The processor's ray marcher: the march of march.glsl (normative text and readable twin: `kpc.player.cpu.reference`)
in float32, for numba.

LANES rays advance side by side. In each round every ray looks at the cell that its next sample lies in; rays in empty
cells skip them, the others take their sample, and finished rays make room for new ones. So while one ray waits for
memory or arithmetic others go on, and most loops are over vectors; a software OpenGL driver instead makes the rays of a
square of pixels wait for each other.
"""

import math
from typing import NamedTuple

import numpy as np

from kpc.format.scene import space
from kpc.format.scene.scene import LOG_DENSITY_LIMIT, TERMINATION
from kpc.jit import compiled
from kpc.player.cpu.field_kernels import displace, sample_corner_grid, sample_planes
from kpc.player.cpu.lanes import (
    BLUE,
    CORNERS,
    DENSITY_SCALE,
    DEPTH,
    FAR,
    FAST,
    GREEN,
    KEPT,
    LANES,
    LOG_DENSITY,
    LOGIT_BLUE,
    LOGIT_GREEN,
    LOGIT_RED,
    NEAR,
    ONE,
    POSITION_X,
    POSITION_Y,
    POSITION_Z,
    RATE_X,
    RATE_Y,
    RATE_Z,
    RED,
    SAMPLES,
    STEP,
    STEP_SCALE,
    TRANS,
    ZERO,
    F,
    I,
    Lanes,
    T,
    U,
    X,
    Y,
    Z,
    clamped,
    kernel_part,
    whole_vectors,
)
from kpc.player.cpu.reference import PARALLEL

# In `Lanes.free`: the ray is finished.
DONE = -1

HALF, TWO, FOUR, TINY = F(0.5), F(2), F(4), F(1e-30)
EPSILON, ALMOST, FARTHEST, LIMIT, END = F(PARALLEL), F(1e-3), F(1e6), F(LOG_DENSITY_LIMIT), F(TERMINATION)
# Where a ray in contracted space ends, in s over the contraction's uniform distance.
LAST = F(2 - 1 / space.FAR)
LOG2_E, MOST_DOUBLINGS = F(1 / math.log(2)), 126
# Taylor series of 2^x.
E1, E2, E3, E4, E5 = (F(math.log(2) ** power / math.factorial(power)) for power in range(1, 6))


class View(NamedTuple):
    """A camera and the box that its rays cross."""

    size: tuple[int, int]  # width, height, pixels
    lens: np.ndarray  # (4,) float32: fl_x, fl_y, cx, cy, pixels
    axes: np.ndarray  # (3, 3) float32: right, up and backward in the world, as columns
    start: (
        np.ndarray
    )  # (3,) float32: the eye in [0, 1]^3 over the box; contracted space: in half edges from the box's middle
    box: np.ndarray  # (3,) float32: edges of the box; contracted space: half edges


class March(NamedTuple):
    """The settings of a march."""

    stride: np.float32  # distance between samples
    tau: np.float32  # stride over the longest edge of the box
    termination: np.float32  # a ray ends once its transmittance is below this
    background: np.ndarray  # (3,) float32


class Occupancy(NamedTuple):
    """Distances to occupied cells, x fastest."""

    free: np.ndarray  # (Nz * Ny * Nx,) uint8, as `kpc.player.atlas.empty_distances`
    size: tuple[int, int, int]  # Nx, Ny, Nz


@compiled(**FAST)
def march_blocks(blocks, side, view, march, uniform_distance, occupancy, motion, corners, planes, picture):
    """March the pixels of blocks into a picture.

    Args:
        blocks: (N, 2) int64, row and column of each block, in blocks of `side` x `side` pixels, rows from below.
        view, march, occupancy: a View, a March, an Occupancy.
        uniform_distance: in contracted space, how far along a ray samples are evenly spaced, float32; else None.
        motion: a Grid of displacements; without nodes where nothing is displaced.
        corners: CornerGridArrays, or None.
        planes: PlaneArrays, or None; one of the two is None.
        picture: the `kpc.player.cpu.picture.Picture` to write to.
    """
    # Made here, not in a function: the compiler then knows that these arrays do not overlap, which saves 6 % to 15 % of
    # the time.
    lanes = Lanes(
        np.zeros((DENSITY_SCALE + 1, LANES), np.float32),
        np.zeros((LOG_DENSITY + 1, LANES), np.float32),
        np.empty(LANES, np.int32),
        np.empty(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.zeros(LANES, np.int32),
        np.zeros((6, LANES), np.int32),
        np.empty(CORNERS * LANES + 1, np.int32),
    )
    if planes is not None:
        if len(planes.b1) > 0:
            for lane in range(LANES):
                lanes.weights_of[lane] = lane
    # Plain zeros would have a type of their own, for which parts would be compiled once more.
    taken, count = np.int64(0), np.int64(0)
    while taken < len(blocks) or count > 0:
        while taken < len(blocks) and count + side * side <= LANES:
            count = _start_rays(blocks[taken], side, view, uniform_distance, count, lanes)
            taken += 1
        _locate_samples(count, view.start, uniform_distance, march.stride, occupancy, lanes)
        if uniform_distance is None:
            _skip_empty(count, march.stride, occupancy.size, lanes)
        else:
            _skip_empty_contracted(count, view.start, uniform_distance, march.stride, occupancy.size, lanes)
        found = _collect_samples(count, uniform_distance, lanes)
        if found > 0:
            if len(motion.nodes) > 0:
                displace(found, motion, lanes)
            if corners is not None:
                sample_corner_grid(found, corners, lanes)
            if planes is not None:
                sample_planes(found, view.box, planes, lanes)
            _shade(found, uniform_distance, march.tau, lanes)
            _composite(found, march.termination, lanes)
        count = _finish_rays(count, march, view.size, lanes, picture)


@kernel_part
def _exp(x):
    """Return e^x as a power of two by a Taylor series, relative error at most 2.4e-6; the library's exp is not
    vectorised."""
    y = x * LOG2_E
    y = y if y > F(-MOST_DOUBLINGS) else F(-MOST_DOUBLINGS)  # where it is NaN, too
    y = y if y < F(MOST_DOUBLINGS) else F(MOST_DOUBLINGS)
    whole = I(y + F(MOST_DOUBLINGS + 0.5)) - I(MOST_DOUBLINGS)
    e = y - F(whole)
    return (ONE + e * (E1 + e * (E2 + e * (E3 + e * (E4 + e * E5))))) * I((whole + I(127)) << I(23)).view(np.float32)


@kernel_part
def _nonzero(x):
    """Keep a direction's component away from 0."""
    return x if abs(x) >= EPSILON else -EPSILON if x < ZERO else EPSILON


@kernel_part
def _largest(x, y, z):
    return max(abs(x), max(abs(y), abs(z)))


@kernel_part
def _distance(s, uniform_distance):
    """Return t of s, `distance_of` of space.glsl."""
    return s if s <= uniform_distance else uniform_distance / (TWO - s / uniform_distance)


@kernel_part
def _parameter(t, uniform_distance):
    """Return s of t, `parameter_of` of space.glsl."""
    return t if t <= uniform_distance else uniform_distance * (TWO - uniform_distance / t)


@kernel_part
def _start_rays(block, side, view, uniform_distance, count, lanes):
    """Add the rays of a block to the `count` that are under way; return how many there are then."""
    rays, pixel = lanes.rays, lanes.pixel
    lens, axes, start, box = view.lens, view.axes, view.start, view.box
    width, height = view.size
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
        x, y, z = _nonzero(x / length) / box[0], _nonzero(y / length) / box[1], _nonzero(z / length) / box[2]
        rays[RATE_X, i], rays[RATE_Y, i], rays[RATE_Z, i] = x, y, z
        rays[STEP, i], rays[TRANS, i] = ZERO, ONE
        rays[RED, i], rays[GREEN, i], rays[BLUE, i], rays[DEPTH, i], rays[SAMPLES, i] = ZERO, ZERO, ZERO, ZERO, ZERO
        if uniform_distance is not None:
            rays[NEAR, i], rays[FAR, i] = ZERO, _distance(LAST * uniform_distance, uniform_distance)
            continue
        x_low, y_low, z_low = -start[0] / x, -start[1] / y, -start[2] / z
        x_high, y_high, z_high = (ONE - start[0]) / x, (ONE - start[1]) / y, (ONE - start[2]) / z
        rays[NEAR, i] = max(max(min(x_low, x_high), min(y_low, y_high)), max(min(z_low, z_high), ZERO))
        rays[FAR, i] = min(min(max(x_low, x_high), max(y_low, y_high)), max(z_low, z_high))
    return count


@kernel_part
def _locate_samples(count, start, uniform_distance, stride, occupancy, lanes):
    """Find where next samples lie, and the distance of their cells to the nearest occupied one."""
    rays, cell, free = lanes.rays, lanes.cell, lanes.free
    nx, ny, nz = occupancy.size
    for i in range(whole_vectors(count)):
        t = rays[NEAR, i] + (rays[STEP, i] + HALF) * stride
        if uniform_distance is not None:
            t = _distance(min(t, LAST * uniform_distance), uniform_distance)
        x, y, z = start[0] + t * rays[RATE_X, i], start[1] + t * rays[RATE_Y, i], start[2] + t * rays[RATE_Z, i]
        if uniform_distance is not None:
            radius = max(_largest(x, y, z), ONE)
            shrunk = F(0.25) * (TWO - ONE / radius) / radius
            x, y, z = x * shrunk + HALF, y * shrunk + HALF, z * shrunk + HALF
            scale = max(t / uniform_distance, ONE) / radius
            rays[DENSITY_SCALE, i] = scale * scale
        rays[T, i], rays[X, i], rays[Y, i], rays[Z, i] = t, x, y, z
        row = I(clamped(z * F(nz), F(nz - 1))) * I(ny) + I(clamped(y * F(ny), F(ny - 1)))
        cell[i] = row * I(nx) + I(clamped(x * F(nx), F(nx - 1)))
    for i in range(U(count)):
        free[i] = occupancy.free[U(cell[i])]


@kernel_part
def _way_out(x, rate, reach, count):
    """Return how far, in t, x is from the faces of the block that reaches `reach` cells from its own, of `count`, in
    both directions."""
    cell = F(I(clamped(x * count, count - ONE)))
    return ((cell + (reach if rate > ZERO else ONE - reach)) / count - x) / rate


@kernel_part
def _block_faces(u, reach, count):
    """Return the faces, in the cube [-2, 2]^3, of the block that reaches `reach` cells from the cell of u."""
    cell = F(I(clamped(u * count, count - ONE)))
    return FOUR * (cell + ONE - reach) / count - TWO, FOUR * (cell + reach) / count - TWO


@kernel_part
def _straight_way_out(y, rate, low, high):
    """Return how far, in t, y within the box is from those faces, as far as the box reaches."""
    return ((min(high, ONE) if rate > ZERO else max(low, -ONE)) - y) / rate


@kernel_part
def _skip_empty(count, stride, cells, lanes):
    """Advance rays in empty cells to the first sample behind the empty block."""
    rays, free = lanes.rays, lanes.free
    nx, ny, nz = cells
    for i in range(whole_vectors(count)):
        reach = F(free[i])
        leave_x = _way_out(rays[X, i], rays[RATE_X, i], reach, F(nx))
        leave_y = _way_out(rays[Y, i], rays[RATE_Y, i], reach, F(ny))
        leave_z = _way_out(rays[Z, i], rays[RATE_Z, i], reach, F(nz))
        steps = min(min(leave_x, min(leave_y, leave_z)) / stride - ALMOST, FARTHEST)
        further = rays[STEP, i] + F(max(I(steps), I(0))) + ONE
        rays[STEP, i] = further if free[i] > 0 else rays[STEP, i]


@kernel_part
def _skip_empty_contracted(count, start, uniform_distance, stride, cells, lanes):
    """Advance rays as `_skip_empty` does, by the lower bound that `way_out` of occupancy.glsl derives."""
    rays, free = lanes.rays, lanes.free
    nx, ny, nz = cells
    for i in range(whole_vectors(count)):
        t, reach = rays[T, i], F(free[i])
        vx, vy, vz = rays[RATE_X, i], rays[RATE_Y, i], rays[RATE_Z, i]
        x, y, z = start[0] + t * vx, start[1] + t * vy, start[2] + t * vz
        x_low, x_high = _block_faces(rays[X, i], reach, F(nx))
        y_low, y_high = _block_faces(rays[Y, i], reach, F(ny))
        z_low, z_high = _block_faces(rays[Z, i], reach, F(nz))
        straight_x, straight_y = _straight_way_out(x, vx, x_low, x_high), _straight_way_out(y, vy, y_low, y_high)
        straight = min(straight_x, min(straight_y, _straight_way_out(z, vz, z_low, z_high)))
        at_x, at_y, at_z = FOUR * rays[X, i] - TWO, FOUR * rays[Y, i] - TWO, FOUR * rays[Z, i] - TWO
        margin_x, margin_y, margin_z = (
            min(at_x - x_low, x_high - at_x),
            min(at_y - y_low, y_high - at_y),
            min(at_z - z_low, z_high - at_z),
        )
        margin = max(min(min(margin_x, margin_y), margin_z), ZERO)
        speed = _largest(vx, vy, vz)
        turn = _largest(start[1] * vz - start[2] * vy, start[2] * vx - start[0] * vz, start[0] * vy - start[1] * vx)
        nearest = _largest(at_x, at_y, at_z) - margin
        bound = F(4 / 3) * speed
        closer = min(bound, (speed + TWO * turn) * (TWO - nearest) * (TWO - nearest))
        curved = margin / max(closer if nearest > ONE else bound, TINY)
        way = straight if _largest(x, y, z) < ONE else curved
        steps = min(
            (_parameter(t + way, uniform_distance) - _parameter(t, uniform_distance)) / stride - ALMOST, FARTHEST
        )
        further = rays[STEP, i] + F(max(I(steps), I(0))) + ONE
        rays[STEP, i] = further if free[i] > 0 else rays[STEP, i]


@kernel_part
def _collect_samples(count, uniform_distance, lanes):
    """Collect the rays that take a sample and return their number; mark those beyond the box as finished."""
    rays, samples, free, ray_of = lanes.rays, lanes.samples, lanes.free, lanes.ray_of
    found = U(0)
    for i in range(U(count)):
        inside, is_free = rays[T, i] < rays[FAR, i], free[i] > 0
        free[i] = free[i] if inside else I(DONE)
        ray_of[found] = i
        samples[POSITION_X, found], samples[POSITION_Y, found], samples[POSITION_Z, found] = (
            rays[X, i],
            rays[Y, i],
            rays[Z, i],
        )
        if uniform_distance is not None:
            samples[STEP_SCALE, found] = rays[DENSITY_SCALE, i]
        found += U(inside & ~is_free)  # a branch would often be mispredicted
    return found


@kernel_part
def _shade(found, uniform_distance, tau, lanes):
    """Turn logits and log densities into colours and alphas."""
    samples = lanes.samples
    for j in range(whole_vectors(found)):
        density = _exp(min(max(samples[LOG_DENSITY, j], -LIMIT), LIMIT))
        thickness = tau if uniform_distance is None else tau * samples[STEP_SCALE, j]
        samples[LOG_DENSITY, j] = ONE - _exp(-density * thickness)
        samples[LOGIT_RED, j] = ONE / (ONE + _exp(-samples[LOGIT_RED, j]))
        samples[LOGIT_GREEN, j] = ONE / (ONE + _exp(-samples[LOGIT_GREEN, j]))
        samples[LOGIT_BLUE, j] = ONE / (ONE + _exp(-samples[LOGIT_BLUE, j]))


@kernel_part
def _composite(found, termination, lanes):
    """Add each sample to its ray, which advances by one step or is finished."""
    rays, samples, free = lanes.rays, lanes.samples, lanes.free
    for j in range(U(found)):
        i = U(lanes.ray_of[j])
        weight = rays[TRANS, i] * samples[LOG_DENSITY, j]
        rays[RED, i] += weight * samples[LOGIT_RED, j]
        rays[GREEN, i] += weight * samples[LOGIT_GREEN, j]
        rays[BLUE, i] += weight * samples[LOGIT_BLUE, j]
        rays[DEPTH, i] += weight * rays[T, i]
        rays[SAMPLES, i] += ONE
        rays[STEP, i] += ONE
        rays[TRANS, i] -= weight
        if rays[TRANS, i] < termination:
            free[i] = DONE


@kernel_part
def _finish_rays(count, march, size, lanes, picture):
    """Write finished rays to the picture, move others to their lanes, and return how many are left."""
    rays, pixel, free, weights_of = lanes.rays, lanes.pixel, lanes.free, lanes.weights_of
    rgba, sums, termination = picture.rgba, picture.sums, march.termination
    for done in range(count - 1, -1, -1):
        if free[done] != DONE:
            continue
        trans, scale = rays[TRANS, done], ONE
        if (
            trans < termination and termination > END
        ):  # sooner than the format says: the remaining light gets the colour met so far
            scale, trans = ONE / (ONE - trans), ZERO
        row, column = divmod(pixel[done], I(size[0]))
        for channel in range(3):
            rgba[row, column, channel] = scale * rays[RED + channel, done] + trans * march.background[channel]
        rgba[row, column, 3] = ONE - trans
        sums[row, column, 0], sums[row, column, 1] = scale * rays[DEPTH, done], rays[SAMPLES, done]
        count -= 1
        for line in range(KEPT):
            rays[line, done] = rays[line, count]
        pixel[done] = pixel[count]
        weights_of[done], weights_of[count] = weights_of[count], weights_of[done]
    return count
