"""Variants of a training run with one thing changed, to measure what it gains: `kpbench ablate`.

The selection follows K-Planes (arXiv:2301.10241), section 4.4.
"""

from collections.abc import Callable
from dataclasses import replace

from kpc.encoder.field.config import PROGRESSIVE_SCALE_DROPOUT, TrainConfig

BASELINE = "baseline"

# What each ablation changes, by name; the unchanged run comes first. "view-independent colour" also removes appearance
# embeddings, which act through the direction MLP. Runs with appearance embeddings are scored on the right halves of
# pictures (`kpc.encoder.evaluation.evaluate`), runs without on whole pictures.
ABLATIONS: dict[str, Callable[[TrainConfig], TrainConfig]] = {
    BASELINE: lambda c: c,
    "finest scale only": lambda c: replace(c, resolutions=c.resolutions[-1:], layered_resolutions=()),
    "coarsest scale only": lambda c: replace(c, resolutions=c.resolutions[:1], layered_resolutions=()),
    "half the channels": lambda c: _with_channels(c, 0.5),
    "twice the channels": lambda c: _with_channels(c, 2),
    "view-independent colour": lambda c: replace(c, view_dependent=False, appearance="none"),
    "no time smoothness": lambda c: replace(c, time_smoothness=0.0),
    "time smoothness x 10": lambda c: replace(c, time_smoothness=10 * c.time_smoothness),
    "no sparse transients": lambda c: replace(c, sparse_transients=0.0),
    "sparse transients x 10": lambda c: replace(c, sparse_transients=10 * c.sparse_transients),
    "sparse transients x 100": lambda c: replace(c, sparse_transients=100 * c.sparse_transients),
    "no space variation": lambda c: replace(c, space_variation=0.0, robust_space_variation=0.0),
    "quadratic variation throughout": lambda c: replace(c, robust_tv_from=1.0),
    "no distortion loss": lambda c: replace(c, distortion=0.0),
    "uniform ray sampling": lambda c: replace(c, temporal_start=1.0, object_rays=0.0),
    "no appearances": lambda c: replace(c, appearance="none"),
    "no motion grid": lambda c: replace(c, motion_cells=0),
    "what moves in all scales": lambda c: c if c.motion_cells else replace(c, moving_texels=0.0),
    "no steps of whole lines": lambda c: c if c.motion_cells else replace(c, line_rate=0.0),
    "planes summed": lambda c: replace(c, summed=True, sparse_transients=0.0),
    "hybrid decoder": lambda c: replace(c, hybrid=True),
    "the preset's time rows": lambda c: replace(c, time_tolerance=0.0),
    "no sequential fine-tuning": lambda c: replace(c, tune_steps=0),
    "no pruning": lambda c: replace(c, prune_share=0.0),
    "no channel dropout": lambda c: replace(c, channel_dropout=0.0),
    "all scales from the start": lambda c: replace(c, coarse_until=0.0),
    "scale dropout": lambda c: replace(c, scale_dropout=PROGRESSIVE_SCALE_DROPOUT),
}


def _with_channels(config: TrainConfig, factor: float) -> TrainConfig:
    layered = max(1, int(factor * config.layered_channels)) if config.layered_resolutions else 0
    return replace(config, channels=max(1, int(factor * config.channels)), layered_channels=layered)


def effective_ablations(config: TrainConfig) -> list[str]:
    """Return the names of the baseline and of all ablations that change `config`."""
    return [name for name in ABLATIONS if name == BASELINE or ABLATIONS[name](config) != config]
