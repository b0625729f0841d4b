"""Short first training passes that find the part of the box that the scene fills, so that no texel is wasted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.training.train import Report, Trainer
from kpc.format.scene.space import DeviceCoordinates

# Passes at most where near and far were found with the cameras, else there is one; another follows where the last made
# the longest edge shorter by SHRINKAGE or more, as a share.
PASSES, SHRINKAGE = 3, 0.05

# Steps of a pass. What fewer than MIN_STEPS find is not reliable.
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

    A coarse field is trained on the CPU for a tenth of `config.steps`, but for at most MAX_STEPS. The result spans the
    OUTLIERS to 1 - OUTLIERS quantiles of the points where rays hit a surface, and MARGIN more, within `aabb`. A pass
    changes nothing after fewer than MIN_STEPS, or where less than 1 % of the rays hit a surface.

    Near and far of found cameras have wide margins, and in a box much larger than the scene the coarse field is fog in
    places. With such cameras there are up to PASSES passes, each in the box that the last one found, until one leaves
    the longest edge e at (1 - SHRINKAGE) e or more (docs/design/training.md). All passes take a tenth of the time
    budget at most, where one is given.

    Returns:
        The box, and the seconds that this took.

    Raises:
        TrainingError: as `Trainer.run`.
    """
    steps = max(1, min(MAX_STEPS, config.steps // 10))
    if time_budget_s is None and steps < MIN_STEPS:
        return aabb, 0.0
    elapsed_s, left_s = 0.0, time_budget_s and time_budget_s / 10
    passes = PASSES if dataset.poses_found else 1
    for done in range(passes):

        def report_pass(part: Report, done: int = done) -> None:
            report(replace(part, fraction=(done + part.fraction) / passes))

        before = aabb
        aabb, took_s = _trim_once(dataset, replace(config, steps=steps), before, report_pass, left_s, mapping)
        elapsed_s += took_s
        if _longest_edge(aabb) > (1 - SHRINKAGE) * _longest_edge(before):
            break
        if left_s is not None and (left_s := left_s - took_s) < took_s:  # not enough for another
            break
    return aabb, elapsed_s


def _longest_edge(aabb: np.ndarray) -> float:
    return float((aabb[1] - aabb[0]).max())


def _trim_once(
    dataset: Dataset,
    config: TrainConfig,
    aabb: np.ndarray,
    report: Callable[[Report], None],
    time_budget_s: float | None,
    mapping: DeviceCoordinates | None,
) -> tuple[np.ndarray, float]:
    """Do one pass of `trim_box` of `config.steps`, or of a time budget; return the box and the seconds it took."""
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
        occupancy_start=64,
        refine="none",
    )
    trainer = Trainer(dataset, coarse, aabb, "cpu", mapping=mapping)
    trainer.run(report, time_budget_s=time_budget_s, most_steps=MAX_STEPS)
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
