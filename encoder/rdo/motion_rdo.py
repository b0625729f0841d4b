"""Which displacements a motion grid is told: as coarse as pictures allow, and where they matter little, whatever takes few bits.

Symbols are found in the order in which they are told (`kpc.format.coding.motion_codec`), again and again, each of several that makes least of

    u^2 + 2 u * sum over neighbours of BESIDE^distance * their u + PRICE * FINER^level * bits(symbol | those before it)

with u = sqrt(worth) times its error in steps, and the worth of what colours change with it (`kpc.encoder.rdo.curvature`), as a share of the mean.
Half of the nodes of soldier are where nothing ever is, and then take next to no bits. Coarse nodes have those between them to lead, so they
are told more exactly.
"""

import math
from dataclasses import replace

import numpy as np
from kpc.encoder.evaluation.validation_rays import Measure
from kpc.encoder.rdo.distortion import EDGE_COUPLING, magnitude_bits
from kpc.format.coding.motion_codec import CONTEXTS, coding_passes, interpolate, neighbour_residuals, residual_context
from kpc.format.common.jit import compiled, inlined
from kpc.format.scene.motion import FINEST_STEP
from kpc.format.scene.scene import Scene

SHARE, MAX_MULTIPLE = 0.1, 64
"""Of the error that coding may bring, how much of it displacements may; and how many of `kpc.format.scene.motion.FINEST_STEP` they may be rounded to.
Soldier: a motion grid takes 1.2 KB for an error e times smaller, planes 18 KB; at equal slopes it is a fifteenth."""
MOTION_LAM, LEVEL_LAM_RATIO = 0.1, 0.5
"""Soldier, at equal error of pictures: a motion grid takes as many bytes to 2 % with prices of 0.05 and 0.2; and 5 % more with 1 in place of
FINER."""
MIN_WEIGHT = 2e-3
"""Of a displacement, as a share of the mean. With 1e-2 soldier's grid takes 5 % more bytes, with 1e-4 10 %."""
SEARCHES = 5
MAGNITUDE_BINS = 40
"""Magnitudes of what predictions miss whose bits are told apart."""
EXPECTED = 0.05 + 0.1 * 2.0 ** (np.arange(CONTEXTS) / 2)
"""Of them, in each context, before anything is known."""


def coarsen_motion(scene: Scene, worth: np.ndarray | None, measure: Measure, most: float, own: int = 0) -> Scene:
    """The scene with displacements in as coarse a multiple of `kpc.format.scene.motion.FINEST_STEP` as adds at most SHARE of an error.

    Itself where there are none, or no multiple is coarser than its own.

    Args:
        worth: (T, Nz, Ny, Nx, 3), what a squared error in each costs; None: symbols are the nearest.
        most: the error that coding may bring, in squares of 8-bit levels.
        own: the multiple that a file has been told with; 0 of none.
    """
    if scene.motion is None:
        return scene
    multiple, known, error = MAX_MULTIPLE, measure(scene).mse, SHARE * most  # of what was left out
    while multiple > own:
        step = np.float32(multiple * FINEST_STEP)
        wanted = scene.motion / np.float64(step)
        symbols = np.rint(wanted) if worth is None else quantise_motion(wanted, worth)
        candidate = replace(scene, motion=symbols.astype(np.float32) * step)
        found = measure(candidate).mse - known
        if found <= error:
            return candidate
        multiple = (
            min(multiple - 1, int(multiple * math.sqrt(error / found))) if found > error else 0
        )  # errors grow with a step's square
    return scene


def quantise_motion(wanted: np.ndarray, worth: np.ndarray) -> np.ndarray:
    """(T, Nz, Ny, Nx, 3) int64 symbols near to `wanted`, in steps, where an error costs `worth`."""
    symbols, order = np.rint(wanted).astype(np.int64), list(coding_passes(wanted.shape[:4]))
    root = np.sqrt(np.maximum(worth / max(float(worth.mean()), 1e-30), MIN_WEIGHT))
    errors, counts = root * (symbols - wanted), np.zeros((CONTEXTS, MAGNITUDE_BINS + 1))
    for _ in range(SEARCHES):
        bits, missed = magnitude_bits(counts, EXPECTED, 2.0), np.zeros_like(symbols)
        counts = np.zeros_like(counts)
        for one in order:
            values, r, aim, weight, err = (np.moveaxis(a, one.axis, 0) for a in (symbols, missed, wanted, root, errors))
            _search(
                values,
                r,
                aim,
                weight,
                err,
                one.new,
                one.references,
                one.weights,
                *one.others,
                MOTION_LAM * LEVEL_LAM_RATIO ** (one.level - 1),
                bits,
                counts,
            )
    return symbols


@compiled()
def _search(values, r, wanted, root, errors, new, sides, weights, first, second, third, price, bits, counts):
    """Find the symbols of a `Pass` anew, as `kpc.format.coding.motion_codec.walk` goes through them."""
    for n in range(new.size):
        for i in range(first.size):
            for j in range(second.size):
                for k in range(third.size):
                    a, b, c = first[i], second[j], third[k]
                    beside = neighbour_residuals(r, new[n], first, second, third, i, j, k)
                    for m in range(values.shape[4]):
                        usual = interpolate(values, sides[n], weights[n], a, b, c, m)
                        context = residual_context(r, new[n], sides[n], weights[n], beside, a, b, c, m)
                        own = root[new[n], a, b, c, m]
                        away = _others(errors, new[n], a, b, c, m) / own
                        best = wanted[new[n], a, b, c, m] - min(max(away, -1.0), 1.0)
                        value = _cheapest(best, usual, own * own, price, bits[context])
                        values[new[n], a, b, c, m] = value
                        errors[new[n], a, b, c, m] = own * (value - wanted[new[n], a, b, c, m])
                        r[new[n], a, b, c, m] = abs(value - usual)
                        counts[context, min(abs(value - usual), MAGNITUDE_BINS)] += 1


@inlined
def _others(errors, t, a, b, c, m):
    """What errors of neighbours make of one."""
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
def _cheapest(best, usual, worth, price, bits):
    """Of the symbol nearest to the best, the next towards the usual one, and that, the one of least cost."""
    nearest = int(math.floor(min(max(best + 0.5, -32768.0), 32767.0)))
    found, least = usual, np.inf
    for which in range(3):
        value = nearest if which == 0 else usual if which == 2 else nearest - 1 if nearest > usual else nearest + 1
        away = abs(value - usual)
        cost = worth * (value - best) ** 2 + price * (
            bits[min(away, MAGNITUDE_BINS)] + 2 * math.log2(max(away, MAGNITUDE_BINS) / MAGNITUDE_BINS)
        )
        if cost < least:
            found, least = min(max(value, -32768), 32767), cost
    return found
