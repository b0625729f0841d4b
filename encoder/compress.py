"""From a trained field to symbols: how coarse each channel of each plane may be."""

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

from kpc.encoder.field import Field
from kpc.format.quantise import QuantisedScene, quantise_scene, reached_by
from kpc.format.scene import Scene

T = TypeVar("T")

FINEST, COARSEST = -12.0, 2.0
"""Base-two logarithms of the factors on all steps, between which one is sought."""
BISECTIONS = 7
PROBES = BISECTIONS + 2
"""Scenes that `compress` renders."""

Steps = list[dict[str, np.ndarray]]
"""One mapping a scale, plane name -> (M,) quantisation steps."""


def relative_steps(field: Field, curvature: np.ndarray) -> Steps:
    """Steps up to one common factor, such that a bit spent on any channel buys the same.

    A uniform quantiser of step d errs by d^2 / 12 on average; an error costs `curvature` h of it, a diagonal Fisher estimate
    (the running mean of squared gradients); its rate falls by one bit with each doubling of d. At equal slopes h d^2 is the same
    everywhere: d = 1 / sqrt(mean over texels of h). Channels that no gradient ever reached get the coarsest step of all.
    """
    M = field.layout.channels
    steps: Steps = [{} for _ in field.layout.resolution]
    for s, name, start, rows, columns in field.layout.planes():
        h = curvature[start : start + rows * columns * M].reshape(-1, M).mean(0, dtype=np.float64)
        steps[s][name] = h
    largest = max(h.max() for scale in steps for h in scale.values())
    if largest <= 0:
        return [{name: np.ones(M) for name in scale} for scale in steps]
    return [{name: 1 / np.sqrt(np.maximum(h / largest, 1e-8)) for name, h in scale.items()} for scale in steps]


def scaled(steps: Steps, factor: float) -> list[Mapping[str, np.ndarray]]:
    """All steps times a factor, as float32."""
    return [{name: (step * factor).astype(np.float32) for name, step in scale.items()} for scale in steps]


def compress(
    scene: Scene, steps: Steps, psnr: Callable[[Scene], float], max_loss_db: float
) -> tuple[QuantisedScene, float]:
    """The coarsest quantisation that costs at most `max_loss_db` of `psnr`, and what it costs.

    Bisects the common factor of the steps on a logarithmic scale from FINEST to COARSEST; the finest is taken where even
    that costs more.
    """
    reference, reached = psnr(scene), reached_by(scene)

    def attempt(exponent: float) -> tuple[QuantisedScene, float]:
        candidate = quantise_scene(scene, scaled(steps, 2.0**exponent), reached=reached)
        return candidate, reference - psnr(candidate.dequantise())

    return _farthest(FINEST, COARSEST, attempt, lambda found: found[1] <= max_loss_db and math.isfinite(found[1]))


def compress_to_size(
    scene: Scene, steps: Steps, target_bytes: int, size: Callable[[QuantisedScene], int]
) -> QuantisedScene:
    """The finest quantisation of at most `target_bytes` as `size` counts them; the coarsest where even that takes more.

    Bisects as `compress` does.
    """
    reached = reached_by(scene)
    return _farthest(
        COARSEST, FINEST, lambda exponent: quantise_scene(scene, scaled(steps, 2.0**exponent), reached=reached),
        lambda found: size(found) <= target_bytes,
    )


def _farthest(start: float, end: float, attempt: Callable[[float], T], accepts: Callable[[T], bool]) -> T:
    """What `attempt` makes of the exponent farthest from `start` towards `end` that `accepts`; of `start` where none does."""
    best = attempt(start)
    for _ in range(BISECTIONS):
        middle = (start + end) / 2
        candidate = attempt(middle)
        if accepts(candidate):
            start, best = middle, candidate
        else:
            end = middle
    return best
