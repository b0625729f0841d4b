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

# The same of the points nearest to the box on the rays of opaque pixels: a hand that is stretched out now and then has
# few pixels, and alpha has few errors (docs/design/training.md).
OPAQUE_OUTLIERS = 1e-4

# How often the box is made larger, as other points are the nearest to a larger one.
OPAQUE_ROUNDS = 4

# Halvings of the part of a line in which the point that is nearest to a box lies.
HALVINGS = 30

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
    changes nothing after fewer than MIN_STEPS, or where less than 1 % of the rays hit a surface. In pictures with alpha
    what is opaque lies in the box, so it is made large enough to be crossed by the rays of all such pixels: the coarse
    field lacks thin limbs that move fast.

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
    if dataset.has_alpha and dataset.masks is None:
        corners = _reaching_opaque_rays(corners, trainer)
    margin = MARGIN * (corners[1] - corners[0]).max()
    trimmed = np.stack([np.maximum(aabb[0], corners[0] - margin), np.minimum(aabb[1], corners[1] + margin)])
    return trimmed.astype(np.float32), trainer.elapsed_s


def _reaching_opaque_rays(corners: np.ndarray, trainer: Trainer) -> np.ndarray:
    """Return a box (2, 3) made larger, so that it is crossed by the rays of opaque pixels, but for OPAQUE_OUTLIERS."""
    dataset, sampler, rng = trainer.dataset, trainer.sampler, np.random.default_rng(trainer.config.seed)
    pixels = sampler.draw_pixels(rng, RAYS, object_rays=1.0)
    places = pixels.row * dataset.pictures.width[pixels.picture] + pixels.column
    alpha = dataset.pixels.read(dataset.pictures.offset[pixels.picture] + places)[:, 3]
    rays, _ = sampler.rays(rng, pixels, trainer.background)
    opaque = alpha > 127
    origins, directions = rays.origins.numpy()[opaque], rays.directions.numpy()[opaque]
    for _ in range(OPAQUE_ROUNDS if opaque.any() else 0):
        nearest = nearest_to_box(corners, origins, directions)
        low, high = np.quantile(nearest, (OPAQUE_OUTLIERS, 1 - OPAQUE_OUTLIERS), axis=0)
        corners = np.stack([np.minimum(corners[0], low), np.maximum(corners[1], high)])
    return corners


def nearest_to_box(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the point of each line o + t d that is nearest to a box (2, 3), (N, 3); one in the box if it crosses it.

    The distance is convex in t, so the place where its derivative, which has the sign of d . (p - q) with q the point
    of the box that is nearest to p, changes its sign is found by bisection.
    """
    units = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    middle = ((corners.mean(0) - origins) * units).sum(1)
    beside = np.linalg.norm(origins + middle[:, None] * units - corners.mean(0), axis=1)
    reach = beside + np.linalg.norm(corners[1] - corners[0])
    low, high = middle - reach, middle + reach
    for _ in range(HALVINGS):
        t = (low + high) / 2
        points = origins + t[:, None] * units
        is_past = ((points - np.clip(points, *corners)) * units).sum(1) > 0
        low, high = np.where(is_past, low, t), np.where(is_past, t, high)
    return points
