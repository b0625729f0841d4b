"""What the field holds at the samples of the processor's ray marcher: displacement, the corner grid, and planes with
time rows.

A sample of planes takes about 60 ns of a core (room, two scales of 16 channels, two hyperthreads), 46 of them in
`simd.accumulate_features`. Corners of the grid are computed when a sample first needs them.
"""

from typing import NamedTuple

import numpy as np

from kpc.jit import compiled
from kpc.player.cpu.lanes import (
    CORNERS,
    FAST,
    FRACTION_X,
    FRACTION_Y,
    FRACTION_Z,
    LANES,
    LOG_DENSITY,
    LOGIT_BLUE,
    LOGIT_GREEN,
    LOGIT_RED,
    ONE,
    POSITION_X,
    POSITION_Y,
    POSITION_Z,
    RATE_X,
    RATE_Y,
    RATE_Z,
    SAMPLES,
    VALUES,
    ZERO,
    F,
    Grid,
    I,
    U,
    clamped,
    find_nodes,
    kernel_part,
    new_lanes,
    node_strides,
    whole_vectors,
)
from kpc.player.cpu.serving import CHANNELS, NARROW
from kpc.player.cpu.simd import accumulate_features, decode_corner, interpolate

# Flags of a corner: its value is computed; so are those of the seven corners that follow it along x, y and z.
COMPUTED, CELL_COMPUTED = 1, 2


class CornerGridArrays(NamedTuple):
    """The corner grid of a scene at a time: logits of red, green and blue and the log density at the corners of
    texels."""

    grid: Grid  # values; those of corners that are not COMPUTED are stale
    known: np.ndarray  # (Nz * Ny * Nx,) uint8, flags of each corner
    planes: tuple[np.ndarray, ...]  # xy, xz, yz at corners, (rows * columns, M) int16
    rows: tuple[np.ndarray, ...]  # time rows along x, y, z at corners, (N, M) float32
    weights: np.ndarray  # (4, M) float32, times the quantisation steps of the planes
    bias: np.float32  # of the log density


class PlaneArrays(NamedTuple):
    """The planes of a scene, the time rows of a time, and its explicit decoder, for `simd.accumulate_features`.
    Channels are in groups."""

    halves: tuple[int, ...]  # its length is the width of a group over NARROW, known when compiled
    planes: np.ndarray  # (N,) int16
    rows: np.ndarray  # (N,) float32
    firsts: np.ndarray  # (groups, 6) int64, where xy, xz, yz and the rows of x, y, z begin
    sizes: np.ndarray  # (groups, 4) int64, texels along x, y, z, at least two; 1 where rows are other than 1, else 0
    areas: np.ndarray  # (groups, 2, 3) float32, `kpc.player.areas.feature_area`
    w1: np.ndarray  # (H, 9) float32; H is 0 for view-independent colour
    b1: np.ndarray  # (H,) float32, with the appearance code added
    w2: np.ndarray  # (H, 4 F) float32, 0 for the density, times the quantisation steps of the planes, as the next
    weights: np.ndarray  # (4 F,) float32, b2 and the weights of the density
    bias: np.float32  # of the log density
    ray_weights: np.ndarray  # (LANES, 4 F) float32, room for the weights of each ray; for H = 0, (1, 4 F), `weights`


@compiled(**FAST)
def log_densities_at(positions, motion, planes, out):
    """Compute the log density at positions, (N, 3) float32 in [0, 1]^3, to (N,) float32; `planes` have view-independent
    weights."""
    lanes = new_lanes()
    for first in range(0, len(positions), LANES):
        found = min(LANES, len(positions) - first)
        for j in range(found):
            for axis in range(3):
                lanes.samples[POSITION_X + axis, j] = positions[first + j, axis]
        if len(motion.nodes) > 0:
            displace(found, motion, lanes)
        sample_planes(found, positions[0], planes, lanes)
        for j in range(found):
            out[first + j] = lanes.samples[LOG_DENSITY, j]


@kernel_part
def displace(found, motion, lanes):
    """Move samples by the motion grid (`kpc.format.scene.motion.displace`); positions are still to be clamped."""
    samples = lanes.samples
    find_nodes(found, motion.size, lanes)
    _interpolate_grid(found, motion, lanes)
    for j in range(whole_vectors(found)):
        samples[POSITION_X, j] += samples[VALUES, j]
        samples[POSITION_Y, j] += samples[VALUES + 1, j]
        samples[POSITION_Z, j] += samples[VALUES + 2, j]


@kernel_part
def sample_corner_grid(found, corners, lanes):
    """Write logits and log densities from the corner grid, after computing the corners that are missing."""
    find_nodes(found, corners.grid.size, lanes)
    _compute_corners(_missing_corners(found, corners, lanes), corners, lanes)
    _interpolate_grid(found, corners.grid, lanes)


@kernel_part
def sample_planes(found, box, planes, lanes):
    """Write logits and log densities from planes and time rows; `box` turns rates back into directions."""
    if len(planes.b1) > 0:
        _weights_of_rays(found, box, planes, lanes)
    samples = lanes.samples
    for j in range(whole_vectors(found)):
        samples[POSITION_X, j] = clamped(samples[POSITION_X, j], ONE)
        samples[POSITION_Y, j] = clamped(samples[POSITION_Y, j], ONE)
        samples[POSITION_Z, j] = clamped(samples[POSITION_Z, j], ONE)
        samples[LOGIT_RED, j], samples[LOGIT_GREEN, j], samples[LOGIT_BLUE, j] = ZERO, ZERO, ZERO
        samples[LOG_DENSITY, j] = planes.bias
    for group in range(U(len(planes.sizes))):
        _find_texels(found, group, planes, lanes)
        if not _is_whole(planes.areas[group]):
            count = _find_in_area(found, planes.areas[group], lanes)
            _accumulate_group(count, lanes.missing, group, planes.rows, planes, lanes)
        elif planes.sizes[group, 3]:
            _accumulate_group(found, None, group, planes.rows, planes, lanes)
        else:
            _accumulate_group(found, None, group, None, planes, lanes)


@kernel_part
def _interpolate_grid(found, grid, lanes):
    """Write what a grid holds at each sample, whose nodes have been found."""
    samples, cell = lanes.samples, lanes.cell
    right, up, back = node_strides(grid.size)
    for j in range(U(found)):
        x, y, z = samples[FRACTION_X, j], samples[FRACTION_Y, j], samples[FRACTION_Z, j]
        interpolate(grid.nodes, U(cell[j]), right, up, back, x, y, z, samples, U(VALUES), j)


@kernel_part
def _missing_corners(found, corners, lanes):
    """List the corners around samples that are not computed, mark them as computed, and return how many they are."""
    known, cell, missing = corners.known, lanes.cell, lanes.missing
    count, (right, up, back) = U(0), node_strides(corners.grid.size)
    for j in range(U(found)):
        first = U(cell[j])
        if known[first] & CELL_COMPUTED:
            continue
        for number in range(CORNERS):
            along_x, along_y, along_z = (
                (right if number & 1 else U(0)),
                (up if number & 2 else U(0)),
                (back if number & 4 else U(0)),
            )
            corner = first + along_x + along_y + along_z
            missing[count] = corner
            count += U(known[corner] == 0)
            known[corner] |= COMPUTED
        known[first] |= CELL_COMPUTED
    return count


@kernel_part
def _compute_corners(count, corners, lanes):
    """Compute the listed corners: the decoder's weights times the product of planes and rows."""
    planes, rows, missing = corners.planes, corners.rows, lanes.missing
    nx, ny, _ = corners.grid.size
    for j in range(count):
        corner = np.uint32(missing[j])
        line = corner // np.uint32(nx)
        z = line // np.uint32(ny)
        x, y = corner - line * np.uint32(nx), line - z * np.uint32(ny)
        texels = planes[0][U(y) * U(nx) + U(x)], planes[1][U(z) * U(nx) + U(x)], planes[2][U(line)]
        factors = rows[0][U(x)], rows[1][U(y)], rows[2][U(z)]
        decode_corner(texels, factors, corners.weights, corners.bias, corners.grid.nodes, U(corner))


@kernel_part
def _weights_of_rays(found, box, planes, lanes):
    """Compute the direction-dependent weights of features for rays that take their first sample."""
    rays, w1, out = lanes.rays, planes.w1, planes.ray_weights
    for j in range(U(found)):
        i = U(lanes.ray_of[j])
        if rays[SAMPLES, i] > ZERO:
            continue
        x, y, z = rays[RATE_X, i] * box[0], rays[RATE_Y, i] * box[1], rays[RATE_Z, i] * box[2]
        row = U(lanes.weights_of[i])
        for m in range(U(len(planes.weights))):
            out[row, m] = planes.weights[m]
        for h in range(U(len(planes.b1))):
            linear = w1[h, 0] * x + w1[h, 1] * y + w1[h, 2] * z
            squares = w1[h, 3] * x * x + w1[h, 4] * y * y + w1[h, 5] * z * z
            products = w1[h, 6] * x * y + w1[h, 7] * y * z + w1[h, 8] * z * x
            hidden = planes.b1[h] + linear + squares + products
            if hidden > ZERO:
                for m in range(U(len(planes.weights))):
                    out[row, m] += hidden * planes.w2[h, m]


@kernel_part
def _is_whole(area):
    """Return whether an area holds all positions."""
    low, high = max(area[0, 0], max(area[0, 1], area[0, 2])), min(area[1, 0], min(area[1, 1], area[1, 2]))
    return (low < ZERO) & (high > ONE)


@kernel_part
def _find_in_area(found, area, lanes):
    """List the samples in an area in `lanes.missing`, and return how many they are."""
    samples, is_inside, chosen = lanes.samples, lanes.cell, lanes.missing
    x_low, y_low, z_low, x_high, y_high, z_high = area[0, 0], area[0, 1], area[0, 2], area[1, 0], area[1, 1], area[1, 2]
    for j in range(whole_vectors(found)):
        x, y, z = samples[POSITION_X, j], samples[POSITION_Y, j], samples[POSITION_Z, j]
        is_inside[j] = (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high) & (z > z_low) & (z < z_high)
    count = U(0)
    for j in range(U(found)):
        chosen[count] = j
        count += U(is_inside[j])  # a branch would often be mispredicted
    return count


@kernel_part
def _find_texels(found, group, planes, lanes):
    """Find the texels before each sample in the planes and rows of a group of channels."""
    samples, texels = lanes.samples, lanes.texels
    nx, ny, nz = planes.sizes[group, 0], planes.sizes[group, 1], planes.sizes[group, 2]
    for j in range(whole_vectors(found)):
        x, y, z = (
            samples[POSITION_X, j] * F(nx - 1),
            samples[POSITION_Y, j] * F(ny - 1),
            samples[POSITION_Z, j] * F(nz - 1),
        )
        column, row, layer = min(I(x), I(nx - 2)), min(I(y), I(ny - 2)), min(I(z), I(nz - 2))
        samples[FRACTION_X, j], samples[FRACTION_Y, j], samples[FRACTION_Z, j] = x - F(column), y - F(row), z - F(layer)
        texels[0, j], texels[1, j], texels[2, j] = row * I(nx) + column, layer * I(nx) + column, layer * I(ny) + row
        texels[3, j], texels[4, j], texels[5, j] = column, row, layer


@kernel_part
def _accumulate_group(count, chosen, group, rows, planes, lanes):
    """Add what a group of channels contributes to the logits and log densities of the first samples, or those that are
    `chosen`. `rows` is None where those of the group are 1."""
    samples, texels, firsts = lanes.samples, lanes.texels, planes.firsts
    weights, width = planes.ray_weights.reshape(-1), U(planes.ray_weights.shape[1])
    wide = U(NARROW * len(planes.halves))
    xy, xz, yz = U(firsts[group, 0]), U(firsts[group, 1]), U(firsts[group, 2])
    of_x, of_y, of_z = U(firsts[group, 3]), U(firsts[group, 4]), U(firsts[group, 5])
    up, up_yz = wide * U(planes.sizes[group, 0]), wide * U(planes.sizes[group, 1])
    for k in range(U(count)):
        j = U(k) if chosen is None else U(chosen[k])
        first_weight = U(lanes.weights_of[U(lanes.ray_of[j])]) * width + group * wide * U(CHANNELS)
        accumulate_features(
            planes.planes,
            (xy + wide * U(texels[0, j]), xz + wide * U(texels[1, j]), yz + wide * U(texels[2, j])),
            (up, up, up_yz),
            rows,
            (of_x + wide * U(texels[3, j]), of_y + wide * U(texels[4, j]), of_z + wide * U(texels[5, j])),
            (samples[FRACTION_X, j], samples[FRACTION_Y, j], samples[FRACTION_Z, j]),
            weights, first_weight, planes.halves, samples, U(LOGIT_RED), j,
        )  # fmt: skip
