"""Short training runs of small models, and the optimiser of other devices beside them, for the tests."""

from dataclasses import replace

import numpy as np

from kpc.encoder.datasets import Dataset
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.training.torch_optimiser import TorchOptimiser
from kpc.encoder.training.train import Report, Trainer
from kpc.format.scene.space import Contraction

CONFIG = TrainConfig(
    resolutions=(12, 24),
    samples_across=48,
    cells_across=16,
    steps=60,
    rays=256,
    samples=12288,
    warmup=5,
    occupancy_start=16,
    occupancy_every=8,
)
# A still shorter run, of commands that train and code.
TINY = TrainConfig(
    tune_steps=0,
    resolutions=(8, 16),
    samples_across=32,
    cells_across=12,
    steps=24,
    object_steps=72,
    rays=256,
    samples=8192,
    warmup=5,
    occupancy_start=8,
    occupancy_every=4,
)
BOX = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)


def trainer(dataset: Dataset, mapping: Contraction | None = None, **changes: object) -> Trainer:
    """Return a trainer of CONFIG with changes, which has not run yet."""
    return Trainer(dataset, replace(CONFIG, **changes), BOX, "cpu", mapping=mapping)  # type: ignore[arg-type]


def ignore(_: Report) -> None:
    """Do nothing with a report."""


def trained(dataset: Dataset, mapping: Contraction | None = None, **changes: object) -> Trainer:
    """Return a trainer of CONFIG with changes after its run."""
    run = trainer(dataset, mapping, **changes)
    run.run(ignore)
    return run


def torch_twin(fused: Trainer) -> TorchOptimiser:
    """Return the optimiser of other devices on a copy of a trainer's field."""
    motion = fused.field.motion
    nodes = None if motion is None else motion.shape[:4]
    field = Field(fused.field.layout, fused.config.hidden, motion_shape=nodes, appearances=len(fused.names))
    field.load_state_dict(fused.field.state_dict())
    return TorchOptimiser(field, fused.config, fused.grid.visible.shape, fused.mapping)  # type: ignore[arg-type]
