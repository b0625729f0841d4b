"""A short first training pass that finds the part of the box that the scene fills, so that no texel is wasted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.training.train import Report, Trainer
from kpc.format.scene.space import DeviceCoordinates

# Steps of the pass. What fewer than MIN_STEPS find is not reliable.
MAX_STEPS = 300
MIN_STEPS = 100

# Training rays whose mean depths are measured.
RAYS = 1 << 17

# Share of the surface points that each of the six sides of the box may cut off, before MARGIN is added.
OUTLIERS = 1e-3

# Margin on every side, as a share of the longest edge: the coarse field is blurred, and few rays show fast motion.
MARGIN = 0.04


def trim_box(
    dataset: Dataset,
    config: TrainConfig,
    aabb: np.ndarray,
    report: Callable[[Report], None],
    *,
    time_budget_s: float | None = None,
    mapping: DeviceCoordinates | None = None,
) -> tuple[np.ndarray, float]:
    """Find the part of a box (2, 3) that holds what the pictures show.

    A coarse field is trained on the CPU for a tenth of `config.steps`, or of the time budget where given, but for at
    most MAX_STEPS. The result spans the OUTLIERS to 1 - OUTLIERS quantiles of the points where rays hit a surface, and
    MARGIN more, within `aabb`. It is `aabb` after fewer than MIN_STEPS, or where less than 1 % of the rays hit one.

    Returns:
        The box, and the seconds that this took.

    Raises:
        TrainingError: as `Trainer.run`.
    """
    steps = max(1, min(MAX_STEPS, config.steps // 10))
    if time_budget_s is None and steps < MIN_STEPS:
        return aabb, 0.0
    coarse = replace(
        config,
        hybrid=False,
        summed=False,
        resolutions=(32, 64),
        channels=8,
        motion_cells=0,
        channel_dropout=0.0,
        temporal_start=1.0,
        samples_across=160,
        cells_across=64,
        steps=steps,
        occupancy_start=64,
        refine="none",
    )
    trainer = Trainer(dataset, coarse, aabb, "cpu", mapping=mapping)
    trainer.run(report, time_budget_s=time_budget_s and time_budget_s / 10, most_steps=MAX_STEPS)
    if trainer.step < MIN_STEPS:
        return aabb, trainer.elapsed_s
    rays, _ = trainer.sampler.draw(np.random.default_rng(config.seed), RAYS, trainer.background)
    origins, directions, times = (a.numpy() for a in (rays.origins, rays.directions, rays.times))
    _, opacities, depths = SceneRenderer(trainer.scene()).render(origins, directions, times)
    surfaces = (origins + depths[:, None] * directions)[opacities > 0.5]
    if len(surfaces) < RAYS // 100:
        return aabb, trainer.elapsed_s
    corners = np.quantile(surfaces, (OUTLIERS, 1 - OUTLIERS), axis=0)
    margin = MARGIN * (corners[1] - corners[0]).max()
    trimmed = np.stack([np.maximum(aabb[0], corners[0] - margin), np.minimum(aabb[1], corners[1] + margin)])
    return trimmed.astype(np.float32), trainer.elapsed_s
