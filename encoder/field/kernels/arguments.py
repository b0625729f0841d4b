"""Named tuples of arrays that the kernels take.

They are flat, because numba's parallel loops take no nested tuples. What a scene lacks is empty or 0 rather than None,
which has a type of its own: numba would compile every kernel, for ten seconds and more, for each combination.
"""

from typing import NamedTuple

import numpy as np

# The gradients of a ray: of its origin (3), direction (3), time and colour (3).
RAY_GRADIENTS = 10


class PlaneSet(NamedTuple):
    """The planes of a field, and its motion grid."""

    theta: np.ndarray  # (n,) float32, all planes one after the other, each (rows, columns, M)
    places: np.ndarray  # (S, 16) int32: of xy xz yz xt yt zt where in theta they begin [0:6], numbers in a row [8:14]
    intervals: np.ndarray  # (S, 4) float32, between texels along x, y, z and t; -1 without planes in space and time
    channels: int  # M
    areas: np.ndarray  # (S, 8) float32, `kpc.encoder.field.layout.Layout.areas`
    motion: np.ndarray  # (T, Nz, Ny, Nx, 3) float32, displacements (`kpc.format.scene.motion`); T is 0: there are none


class Volume(NamedTuple):
    """Where rays take samples. Rays in device coordinates are given as such: to the kernels their scene is a box."""

    aabb: np.ndarray  # (2, 3) float32, lower and upper corner
    uniform_distance: np.float32  # of `kpc.format.scene.space.Contraction`; 0 where the scene ends at its box
    occupancy: np.ndarray  # (slots, Nz, Ny, Nx) uint8; 0, 1, or STRIDED of `kpc.encoder.field.occupancy_grid`
    step: np.float32  # length of a step, in s
    extent: np.float32  # longest edge of the box: densities are per this length


class RayBatch(NamedTuple):
    """Rays; sample k of a ray lies at s = near + (k + jitter) * step."""

    origins: np.ndarray  # (N, 3) float32
    directions: np.ndarray  # (N, 3) float32, unit vectors
    times: np.ndarray  # (N,) float32 in [0, 1]
    jitters: np.ndarray  # (N,) float32 in [0, 1)
    backgrounds: np.ndarray  # (N, 3) float32, RGB


class Gradients(NamedTuple):
    """Where gradients are added: a buffer for each worker."""

    theta: np.ndarray  # (workers, n) float32
    density: np.ndarray  # (workers, F + 1) float32
    basis: np.ndarray  # (N, 3, F) float32, of each ray; (workers, 3, F) where all rays share one basis
    motion: np.ndarray  # (workers, T, Nz, Ny, Nx, 3) float32
    wants_motion: bool  # whether the gradient of the motion grid is computed, which takes a fifth of the time
    rays: np.ndarray  # (N, RAY_GRADIENTS) float32, of each ray; (1, RAY_GRADIENTS) where they are not wanted
    wants_rays: bool  # whether the gradients of rays are computed
    full_weight: np.float32  # samples of less weight are drawn (`backpropagate`); 0: all are taken


class SampleArrays(NamedTuple):
    """Samples of a batch of rays, ray by ray, as `collect_samples` writes them; with n = 0 it only counts them."""

    points: np.ndarray  # (n, 3) float32, u before displacement
    s: np.ndarray  # (n,) float32
    density_scale: np.ndarray  # (n,) float32, `Contraction.density_scale`
    cells: np.ndarray  # (n, 3) int64, occupancy cell in the order z, y, x


class RayBuffers(NamedTuple):
    """One worker's memory for the samples of the current ray; K is the most that a ray can have."""

    values: np.ndarray  # (K, S * 6 * M) float32, what each plane holds at a sample
    features: np.ndarray  # (K, F) float32
    texels: np.ndarray  # (K * S, PLACES) int32, where the first texel of each plane begins; -1: outside of the area
    shares: np.ndarray  # (K * S, 4) float32, of the way to the next texel along x, y, z and t
    local: np.ndarray  # (1, 4) float32: u in the area of a scale, and time, of the current sample
    points: np.ndarray  # (K, POINT) float32: u displaced, time, u before displacement, time
    s: np.ndarray  # (K,) float32
    log_densities: np.ndarray  # (K,) float32, clipped
    taus: np.ndarray  # (K,) float32, optical thickness
    weights: np.ndarray  # (K,) float32, transmittance times alpha
    decoded: np.ndarray  # (K, 4) float32, log density without bias, and logits, which become colours
    g_weights: np.ndarray  # (K,) float32, gradient of the distortion loss with respect to the weights
    drawn: np.ndarray  # (K,) int32, the samples whose gradients are computed
    g_log_taus: np.ndarray  # (K,) float32, of each of them the gradient of the logarithm of its thickness
    g_features: np.ndarray  # (1, F) float32, of the current sample
    decoder: np.ndarray  # (4 * F,) float32, weights of the log density and of three colours, of the current ray
    g_decoder: np.ndarray  # (4 * F,) float32, their gradient
    g_point: np.ndarray  # (4,) float32, gradient with respect to u and time
    g_local: np.ndarray  # (4,) float32, the same with respect to `local`
