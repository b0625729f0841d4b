"""A short first pass that finds where in the box the scene is, so that no texel is spent on the rest."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.training.train import Report, Trainer
from kpc.format.scene.space import DeviceCoordinates

MOST_STEPS = 300
LEAST_STEPS = 100
"""What a shorter pass finds is not to be believed."""

RAYS = 1 << 17
"""Training rays whose mean depths make the survey."""

OUTLIERS = 1e-3
"""Share of the surfaces that the box may leave out at each of its six sides, before MARGIN is added."""

MARGIN = 0.04
"""Of the longest edge, added on every side: the survey is blurred, and what moves fast was seen by few rays."""


def trim_box(
    dataset: Dataset,
    config: TrainConfig,
    aabb: np.ndarray,
    report: Callable[[Report], None],
    *,
    time_budget_s: float | None = None,
    mapping: DeviceCoordinates | None = None,
) -> tuple[np.ndarray, float]:
    """The part of a (2, 3) box that holds what the pictures show, and the seconds it took to find out.

    A coarse field is trained on the CPU for a tenth of `config.steps`, or of the time budget where given, but for at most MOST_STEPS.
    The box then goes from the OUTLIERS quantile to the 1 - OUTLIERS quantile of the points where rays end in something, and
    MARGIN further; never beyond `aabb`. After fewer than LEAST_STEPS, or where nearly all rays end in nothing, it is `aabb`.

    Raises:
        TrainingError: as `Trainer.run`.
    """
    steps = min(MOST_STEPS, config.steps // 10)
    if time_budget_s is None and steps < LEAST_STEPS:
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
    )
    trainer = Trainer(dataset, coarse, aabb, "cpu", mapping=mapping)
    trainer.run(report, time_budget_s=time_budget_s and time_budget_s / 10, most_steps=MOST_STEPS)
    if trainer.step < LEAST_STEPS:
        return aabb, trainer.elapsed_s
    rays, _ = trainer.sampler.draw(np.random.default_rng(config.seed), RAYS, trainer.background)
    origins, directions, times = (a.numpy() for a in (rays.origins, rays.directions, rays.times))
    _, opacities, depths = SceneRenderer(trainer.scene()).render(origins, directions, times)
    ends = (origins + depths[:, None] * directions)[opacities > 0.5]
    if len(ends) < RAYS // 100:
        return aabb, trainer.elapsed_s
    corners = np.quantile(ends, (OUTLIERS, 1 - OUTLIERS), axis=0)
    margin = MARGIN * (corners[1] - corners[0]).max()
    trimmed = np.stack([np.maximum(aabb[0], corners[0] - margin), np.minimum(aabb[1], corners[1] + margin)])
    return trimmed.astype(np.float32), trainer.elapsed_s
