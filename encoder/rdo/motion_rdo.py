"""Quantisation of a motion grid: as coarse as pictures permit, with symbols chosen by rate and distortion.

Symbols are found in coding order (`kpc.encoder.coding.motion_codec`), in several searches; of several candidates each
is the one that minimises the Lagrangian cost

    u^2 + 2 u * sum over neighbours of EDGE_COUPLING^distance * their u
        + MOTION_LAM * LEVEL_LAM_RATIO^(level - 1) * bits(symbol | symbols before it)

with u = sqrt(weight) times its error in steps, where the weight is the curvature (`kpc.encoder.rdo.curvature`)
relative to its mean. Nodes where nothing ever is then take next to no bits; coarse nodes, from which finer ones are
predicted, are more exact.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kpc.encoder.coding.motion_codec import CONTEXTS, coding_passes, interpolate, neighbour_residuals, residual_context
from kpc.encoder.evaluation.validation_rays import Measure
from kpc.encoder.rdo.distortion import EDGE_COUPLING, magnitude_bits
from kpc.format.scene.motion import FINEST_STEP
from kpc.format.scene.scene import Scene
from kpc.jit import compiled, inlined

# Figures behind these constants: docs/design/rate-distortion.md, "Motion".
SHARE = 0.1  # of the allowed error that displacements may take
MAX_MULTIPLE = 64  # of `kpc.format.scene.motion.FINEST_STEP` that displacements may be rounded to
MOTION_LAM = 0.1  # lambda of the finest nodes, in squared steps per bit
LEVEL_LAM_RATIO = 0.5  # lambda of each coarser level, relative to the next finer one
MIN_WEIGHT = 2e-3  # least distortion weight of a displacement
SEARCHES = 5
MAGNITUDE_BINS = 40  # magnitudes of residuals whose bits are distinguished
EXPECTED = 0.05 + 0.1 * 2.0 ** (np.arange(CONTEXTS) / 2)  # magnitudes by context, before any are known


def coarsen_motion(
    scene: Scene,
    curvature: np.ndarray | None,  # (T, Nz, Ny, Nx, 3)
    measure: Measure,
    mse: float,
    own_multiple: int = 0,
) -> Scene:
    """Round displacements to the coarsest multiple of FINEST_STEP that adds at most SHARE of an error.

    Args:
        scene: with or without displacements.
        curvature: cost of a squared error in each displacement; None to round to the nearest symbols.
        measure: judges scenes.
        mse: error that coding may bring, on the 8-bit scale.
        own_multiple: the multiple that displacements of a file have already; 0 for none.

    Returns:
        The scene with rounded displacements; itself where no coarser multiple is found, or it has none.
    """
    if scene.motion is None:
        return scene
    multiple, known, allowed = MAX_MULTIPLE, measure(scene).mse, SHARE * mse
    while multiple > own_multiple:
        step = np.float32(multiple * FINEST_STEP)
        wanted = scene.motion / np.float64(step)
        symbols = np.rint(wanted) if curvature is None else quantise_motion(wanted, curvature)
        candidate = replace(scene, motion=symbols.astype(np.float32) * step)
        added = measure(candidate).mse - known
        if added <= allowed:
            return candidate
        # Errors grow with the square of the step.
        multiple = min(multiple - 1, int(multiple * math.sqrt(allowed / added))) if added > allowed else 0
    return scene


def quantise_motion(wanted: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Choose symbols for displacements by rate and distortion.

    Args:
        wanted: (T, Nz, Ny, Nx, 3), displacements in steps.
        curvature: (T, Nz, Ny, Nx, 3), cost of a squared error in each.

    Returns:
        (T, Nz, Ny, Nx, 3) int64.
    """
    symbols, passes = np.rint(wanted).astype(np.int64), list(coding_passes(wanted.shape[:4]))
    root = np.sqrt(np.maximum(curvature / max(float(curvature.mean()), 1e-30), MIN_WEIGHT))
    errors, counts = root * (symbols - wanted), np.zeros((CONTEXTS, MAGNITUDE_BINS + 1))
    for _ in range(SEARCHES):
        bits, residuals = magnitude_bits(counts, EXPECTED, 2.0), np.zeros_like(symbols)
        counts = np.zeros_like(counts)
        for one in passes:
            grid = _Grid(*(np.moveaxis(a, one.axis, 0) for a in (symbols, residuals, wanted, root, errors)))
            nodes = _Nodes(one.new, one.references, one.weights, *one.others)
            _search(grid, nodes, MOTION_LAM * LEVEL_LAM_RATIO ** (one.level - 1), bits, counts)
    return symbols


class _Grid(NamedTuple):
    """Arrays of a search, each (n, a, b, c, 3) with the axis of the current pass first."""

    symbols: np.ndarray  # int64, updated
    residuals: np.ndarray  # int64 magnitudes, updated
    wanted: np.ndarray  # float64, in steps
    root: np.ndarray  # square roots of distortion weights
    errors: np.ndarray  # weighted errors u, updated


class _Nodes(NamedTuple):
    """The nodes of a pass, as in `kpc.encoder.coding.motion_codec.CodingPass`."""

    new: np.ndarray
    references: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    second: np.ndarray
    third: np.ndarray


@compiled()
def _search(grid, nodes, lam, bits, counts):
    """Choose the symbols of a pass anew, in coding order, and count their residuals by context and magnitude."""
    symbols, residuals, wanted, root, errors = grid.symbols, grid.residuals, grid.wanted, grid.root, grid.errors
    new, references, weights = nodes.new, nodes.references, nodes.weights
    first, second, third = nodes.first, nodes.second, nodes.third
    for n in range(new.size):
        t = new[n]
        for i in range(first.size):
            for j in range(second.size):
                for k in range(third.size):
                    a, b, c = first[i], second[j], third[k]
                    beside = neighbour_residuals(residuals, t, first, second, third, i, j, k)
                    for m in range(symbols.shape[4]):
                        usual = interpolate(symbols, references[n], weights[n], a, b, c, m)
                        context = residual_context(residuals, t, references[n], weights[n], beside, a, b, c, m)
                        own = root[t, a, b, c, m]
                        away = _coupled_errors(errors, t, a, b, c, m) / own
                        best = wanted[t, a, b, c, m] - min(max(away, -1.0), 1.0)
                        value = _cheapest(best, usual, own * own, lam, bits[context])
                        symbols[t, a, b, c, m] = value
                        errors[t, a, b, c, m] = own * (value - wanted[t, a, b, c, m])
                        residuals[t, a, b, c, m] = abs(value - usual)
                        counts[context, min(abs(value - usual), MAGNITUDE_BINS)] += 1


@inlined
def _coupled_errors(errors, t, a, b, c, m):
    """Return the coupled errors of the neighbours of a node, including diagonal ones."""
    total = 0.0
    for i in range(max(t - 1, 0), min(t + 2, errors.shape[0])):
        for j in range(max(a - 1, 0), min(a + 2, errors.shape[1])):
            for k in range(max(b - 1, 0), min(b + 2, errors.shape[2])):
                for n in range(max(c - 1, 0), min(c + 2, errors.shape[3])):
                    distance = abs(i - t) + abs(j - a) + abs(k - b) + abs(n - c)
                    if distance > 0:
                        total += EDGE_COUPLING**distance * errors[i, j, k, n, m]
    return total


@inlined
def _cheapest(best, usual, weight, lam, bits):
    """Return the cheapest of three symbols: nearest to the best, next to it towards the usual symbol, and the usual."""
    nearest = math.floor(min(max(best + 0.5, -32768.0), 32767.0))
    found, least = usual, np.inf
    for which in range(3):
        value = nearest if which == 0 else usual if which == 2 else nearest - 1 if nearest > usual else nearest + 1
        away = abs(value - usual)
        cost = weight * (value - best) ** 2 + lam * (
            bits[min(away, MAGNITUDE_BINS)] + 2 * math.log2(max(away, MAGNITUDE_BINS) / MAGNITUDE_BINS)
        )
        if cost < least:
            found, least = min(max(value, -32768), 32767), cost
    return found
