"""Inputs for the tests of the codecs: planes of symbols, transform blocks, motion grids and occupancy grids."""

import numpy as np

from kpc.encoder.coding.predictive import trellis_transition
from kpc.encoder.coding.transform import OFFSET_COUNT, TransformBlocks, coded_blocks
from kpc.format.container.segments import DEPENDENT, PredictionWeights
from kpc.tools.vectors.scenes import walked

PLANE_PATTERNS = {
    "noise": lambda rng, shape: rng.integers(-128, 128, shape),
    "extremes": lambda rng, shape: rng.choice([-128, 127], shape),
    "ramps": lambda rng, shape: rng.integers(-3, 4, shape).cumsum(0).cumsum(1),  # wraps in the corner
    "nearly flat": lambda rng, shape: rng.random(shape) < 0.05,
    "constant": lambda rng, shape: np.full(shape, rng.choice([-128, -1, 0, 127])),
}


def plane_pattern(paint: str, shape: tuple[int, int, int], seed: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    symbols = PLANE_PATTERNS[paint](rng, shape).astype(np.int8)
    coded = rng.random(shape[:2]) < share
    symbols[~coded] = 0
    return symbols, coded


def textured(rows: int = 60, columns: int = 70, channels: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Smooth waves and noise, stronger on one side, within an ellipse."""
    rng = np.random.default_rng(0)
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    waves = sum(
        np.multiply.outer(np.sin(a * x + b * y + c), 25 * rng.normal(0, 1, channels))
        for a, b, c in rng.normal(0, 3, (4, 3))
    )
    symbols = np.clip(np.rint(waves + (1.5 + x)[..., None] * rng.normal(0, 1, waves.shape)), -128, 127).astype(np.int8)
    coded = x * x + y * y < 0.9
    symbols[~coded] = 0
    return symbols, coded


def on_trellis(symbols: np.ndarray, coded: np.ndarray) -> np.ndarray:
    """The symbols, the last bit of each changed where it has to be."""
    symbols = symbols.copy()
    for y, m in np.ndindex(len(symbols), symbols.shape[2]):
        state = 0
        for x in np.flatnonzero(coded[y]):
            symbols[y, x, m] = symbols[y, x, m] & ~1 | state & 1
            state = trellis_transition(state, int(symbols[y, x, m]))
    return symbols


def followed(symbols: np.ndarray, coded: np.ndarray, side_info: PredictionWeights) -> np.ndarray:
    """Symbols near to these, none at the ends of 8 bits, that follow a side_info."""
    symbols = np.clip(symbols, -126, 126)
    walked(symbols, coded, side_info.weights, DEPENDENT)
    return symbols


def random_blocks(
    side: int, rows: int, columns: int, share: float, seed: int, channels: int = 3
) -> tuple[TransformBlocks, np.ndarray]:
    """Blocks and coded texels, of which the first 20 columns hold none, if there are more."""
    rng = np.random.default_rng(seed)
    coded = rng.random((rows, columns)) < share
    coded[:, :20] &= columns <= 20 or share == 1
    shape = (channels, *coded_blocks(coded, side).shape, side, side)
    levels = np.trunc(rng.laplace(0, 3, shape) / (1 + np.add.outer(np.arange(side), np.arange(side)))).astype(np.int64)
    levels[..., 0, 0] *= 7
    return TransformBlocks(levels, rng.integers(0, OFFSET_COUNT, shape[1:3]), int(rng.integers(1, 100))), coded


GRID_PATTERNS = {
    "noise": lambda rng, shape: rng.integers(-32768, 32768, shape),
    "extremes": lambda rng, shape: rng.choice([-32768, 32767], shape),
    "small": lambda rng, shape: rng.integers(-2, 3, shape),
    "slopes": lambda rng, shape: rng.integers(-30, 31, shape).cumsum(0).cumsum(1).cumsum(2).cumsum(3),
    "constant": lambda rng, shape: np.full(shape, rng.choice([-32768, -1, 0, 32767])),
}


def grid_pattern(paint: str, shape: tuple[int, ...], seed: int) -> np.ndarray:
    return GRID_PATTERNS[paint](np.random.default_rng(seed), shape).astype(np.int16)


def swaying(rows: int = 20, nz: int = 8, ny: int = 6, nx: int = 6) -> np.ndarray:
    """(rows, nz, ny, nx, 3) int16: waves that travel, and a little noise."""
    rng = np.random.default_rng(0)
    places = np.indices((rows, nz, ny, nx))
    waves = [
        300 * np.sin(sum(np.tensordot(k, places, 1) for k in rng.normal(0, 0.3, (1, 4))) + 9 * rng.random())
        for _ in range(9)
    ]
    field = np.stack([sum(waves[c::3]) for c in range(3)], -1)
    return np.rint(field + rng.normal(0, 0.5, field.shape)).astype(np.int16)


def drifting() -> np.ndarray:
    """(25, 11, 6, 6, 3) int16: what bends slowly, and some noise."""
    t, z, y, x = np.indices((25, 11, 6, 6))
    slow = np.stack([np.sin(t / 9 + z / 7 + c) * np.cos(y / 6 - x / 8) for c in range(3)], -1)
    return np.rint(40 * (slow + np.random.default_rng(0).normal(0, 0.02, slow.shape))).astype(np.int16)


def rolling(slots: int = 5, nz: int = 32, ny: int = 36, nx: int = 40) -> np.ndarray:
    """(slots, nz, ny, nx) bool: where waves that travel are high, with borders that fray."""
    rng = np.random.default_rng(0)
    places = np.indices((slots, nz, ny, nx))
    height = sum(
        np.sin(np.tensordot(rng.normal(0, (0.1, 0.3, 0.3, 0.3)), places, 1) + 9 * rng.random()) for _ in range(6)
    )
    return height + rng.normal(0, 0.2, (nz, ny, nx)) > 1.5
