"""The configuration of a training run, and its presets."""

from dataclasses import dataclass, replace

from kpc.format.common.errors import UsageError

APPEARANCES = ("none", "camera", "image")

# What is refined of cameras: nothing; poses, focal lengths and distortion; clocks and exposures, too.
REFINEMENTS = ("none", "cameras", "all")


@dataclass(frozen=True)
class Variation:
    """How the total variation of planes weighs differences d between neighbours.

    The penalty is the mean of log(1 + steep d^2) / steep, or of d^2 where `steep` is 0.

    Attributes:
        space: weight on space planes.
        transient: weight on space-time planes, along space only.
        steep: >= 0; differences well above steep^-0.5 are penalised logarithmically, so that edges stay sharp.
    """

    space: float
    transient: float
    steep: float


@dataclass(frozen=True)
class TrainConfig:
    """All that decides the outcome of a training run besides the dataset.

    A comment stands above each field and names the source of the default. "K-Planes" is arXiv:2301.10241, "measured"
    points to docs/design/training.md. Shares are in [0, 1].
    """

    # --- Model

    # Texels along the longest edge of the box, by scale, coarse to fine (K-Planes, section 3.1).
    resolutions: tuple[int, ...] = (64, 128, 256)
    # M, channels of a plane. K-Planes uses 32 on a GPU; here file size and playback pay for each.
    channels: int = 8
    # Frames per row of a space-time plane (K-Planes: 300 frames in 150 rows). With cameras that stand still it is
    # measured on the pictures instead (`kpc.encoder.training.temporal_resolution`).
    frames_per_row: float = 2.0
    # Root mean square error that linear interpolation between rows may leave on changing pixels, as a share of the full
    # range (measured). 0: always use `frames_per_row`.
    time_tolerance: float = 0.055
    # Cells of the motion grid (`kpc.format.scene.motion`) along the longest edge of the box; 0 for no motion grid.
    # Not for objects in static surroundings: a cell then holds some of both, and liam loses 4.6 dB.
    motion_cells: int = 0
    # Lower and upper corner of the area in which things move, in shares of the space that the planes cover. Each of
    # `resolutions` then makes two scales: one without space-time planes, and one with them that holds nothing outside
    # the area (`with_moving_area`). None: scales of six planes that cover everything.
    moving_area: tuple[float, ...] | None = None
    # What replaces `resolutions` and `channels` where there is such an area; (): nothing does (measured).
    layered_resolutions: tuple[int, ...] = ()
    layered_channels: int = 0
    # Texels of such a scale along the longest edge of the area, as a share of those of the other along that of the box;
    # 0: no such scales.
    moving_texels: float = 0.6
    # Its rows in time, at most one for each frame, as a multiple of what `frames_per_row` gives.
    moving_rows: float = 2.0
    # Share of the run in which cells stay occupied where something is seen to move (measured).
    moving_kept: float = 0.5
    # Whether to use the hybrid decoder, two small MLPs per sample (`kpc.format.scene.scene.HybridDecoder`).
    hybrid: bool = False
    # Width of its layers. K-Planes uses 64, and three layers.
    hybrid_width: int = 32
    # Whether planes are summed rather than multiplied: an ablation (K-Planes, section 4.4) that no file can hold.
    summed: bool = False
    # H, width of the MLP that maps a view direction to the colour basis.
    hidden: int = 16
    # Whether that MLP is trained; otherwise colour is view-independent.
    view_dependent: bool = True
    # What has an appearance embedding (K-Planes, section 3.3), which is added to that MLP's hidden layer: each "image",
    # each "camera", or "none". Needs `view_dependent`.
    appearance: str = "none"
    # Steps along the longest edge of the box; a little finer than the finest plane is enough.
    samples_across: int = 320
    # Cells of the occupancy grid along the longest edge of the box.
    cells_across: int = 96
    # Whether the hybrid decoder's layers compute in bfloat16 on a GPU (`Field.mixed`).
    mixed_precision: bool = True

    # --- Optimisation

    # Optimiser steps where no time budget is given.
    steps: int = 6000
    # The same for an object on its own that one moving camera filmed (`for_single_object`).
    object_steps: int = 18000
    # The most rays per step (K-Planes: 4,096); fewer while rays have many samples.
    rays: int = 4096
    # The most samples per step, on average. It bounds the time of a step before the occupancy grid has formed.
    samples: int = 98304
    # Samples of less weight have their gradients computed in a share of the cases only, on a CPU (measured;
    # `kpc.encoder.field.kernels.backward`); 0: the gradients of all are computed.
    full_weight: float = 1 / 64
    # Share of the rays drawn from around the opaque part of pictures with alpha (measured).
    object_rays: float = 0.5
    # Share of the run after which rays are drawn by how much their pixels change over time, with cameras that stand
    # still (IST: DyNeRF, arXiv:2103.02597; K-Planes, section 3.4); 1 for never (measured).
    temporal_start: float = 0.5
    # The least change that counts for that, as a share of the full range: still pixels are drawn, too (measured).
    temporal_floor: float = 0.1
    # Share of the channels that a step drops, different ones each step.
    channel_dropout: float = 0.0
    # Share of the run after which no channels are dropped (measured).
    dropout_until: float = 0.5
    # Share of the run that trains the coarsest scale alone, so that displacements are found on smooth pictures, as
    # cameras are in BARF (arXiv:2104.06405). Soldier gains 0.2 dB with 0.3.
    coarse_until: float = 0.0
    # Share of the steps that drop the finer scales from a random one on, so that coarse scales make a picture by
    # themselves, the first that a player shows of a scene that is being received (measured).
    scale_dropout: float = 0.0
    # Peak learning rate of the planes. K-Planes uses 1e-2 with 30,000 steps.
    learning_rate: float = 4e-2
    # Peak learning rate of factors on whole rows and columns of planes that hold what stands still, where something
    # moves, as a share of `learning_rate`; 0 for none (measured; `kpc.encoder.training.line_steps`).
    line_rate: float = 0.5
    # Peak learning rate of the decoder.
    decoder_learning_rate: float = 1e-2
    # Peak learning rate of the motion grid, in box edges. Soldier loses 0.1 dB with 5e-3, 0.2 dB with 2e-2.
    motion_learning_rate: float = 1e-2
    # Steps between updates of the motion grid, whose gradient takes a fifth of a step. Soldier loses 0.3 dB with 2.
    motion_every: int = 1
    # Peak learning rate of the appearance codes (measured).
    appearance_learning_rate: float = 1e-2
    # Steps over which learning rates rise from 0; then they fall along half a cosine to 1 % of their peak.
    warmup: int = 50
    # Seed of all random numbers.
    seed: int = 0
    # Whether `for_single_object` may change this configuration for scenes of its kind.
    adapts_to_object: bool = True

    # --- Refinement of cameras (`kpc.encoder.training.refinement`)

    # What of them is learnt with the scene, one of REFINEMENTS.
    refine: str = "none"
    # Share of the run after which cameras are moved: there has to be a picture first.
    refine_from: float = 0.1

    # --- Priors, each a weight on a mean over the texels of a plane, summed over planes and scales

    # Total variation of the space planes. K-Planes uses 1e-4 to 1e-3 with 30,000 steps; with a few thousand,
    # soldier gains 0.6 dB and room 0.3 dB with 5e-3.
    space_variation: float = 5e-3
    # Total variation of the space-time planes, along space only. 5e-3 costs soldier 0.3 dB.
    transient_variation: float = 2e-4
    # Share of the run after which total variation is robust (Cauchy) rather than quadratic as in K-Planes; 1 for never.
    # The quadratic one finds shapes but blurs edges; the robust one grows as the bits of d do (measured).
    robust_tv_from: float = 0.7
    # Scale e of the robust penalty e^2 log(1 + d^2 / e^2).
    robust_tv_scale: float = 0.1
    # `space_variation` from then on (measured).
    robust_space_variation: float = 2e-2
    # Squared second difference of the space-time planes in time. K-Planes finds the best near 0.01.
    time_smoothness: float = 1e-2
    # L1 distance of the space-time planes from 1. K-Planes uses 1e-4.
    sparse_transients: float = 1e-4
    # Squared second difference of the motion grid in time. Twice as many rows need ten times the weight.
    motion_smoothness_time: float = 0.3
    # Squared second difference of the motion grid in space.
    motion_smoothness_space: float = 1.0
    # Mean square of the appearance codes (measured).
    appearance_decay: float = 1e-3
    # Distortion loss (mip-NeRF 360, arXiv:2111.12077, eq. 15), against fog. K-Planes uses 1e-3.
    distortion: float = 1e-3
    # The planes' priors enter every so many steps, times that number: unbiased, at a fraction of the cost.
    regularise_every: int = 4

    # --- Proposal sampling, which replaces the occupancy grid in training (`kpc.encoder.field.proposals`)

    # Whether to sample by proposals.
    proposals: bool = False
    # Texels along the longest edge of the box, of the coarse and the fine proposal.
    proposal_resolutions: tuple[int, int] = (64, 128)
    # Channels of the proposals, as in K-Planes.
    proposal_channels: int = 8
    # Samples per ray: uniform for the first proposal, by its weights for the second, by the second's for the field.
    proposal_samples: tuple[int, int, int] = (96, 48, 32)
    # Weight of the histogram loss (arXiv:2111.12077, eq. 13), which trains the proposals only.
    histogram: float = 1.0

    # --- Occupancy grid

    # Steps during which every visible cell is occupied.
    occupancy_start: int = 128
    # Length of a step of the rays until then, in steps of the rest of the run.
    warmup_stride: float = 3.0
    # Steps between updates of the grid (Instant-NGP, arXiv:2201.05989, appendix E).
    occupancy_every: int = 16
    # Time slots of the grid, at most one per frame. Soldier, which over the clip fills a third of its box, takes 9.3
    # samples per ray rather than 15.5; with 16 slots 10.5.
    occupancy_slots: int = 32
    # Steps between updates of which slots hold density.
    occupancy_split_every: int = 512
    # A cell is empty if a step through it has a smaller alpha than this.
    occupancy_alpha: float = 1e-2

    # --- File

    # Share of the permitted coding loss on training views that pruning of view dependence, channels and scales may
    # spend (`kpc.encoder.rdo.prune`); 0 for no pruning (measured).
    prune_share: float = 0.02
    # Steps of fine-tuning after each group of planes is quantised (`kpc.encoder.rdo.sequential_finetune`); 0 for none.
    # Room: with 100, files are 2 % smaller at equal error.
    tune_steps: int = 60
    # Steps of training from which on coding takes its full effort (`coding_effort`); 0 for full effort always. A run of
    # fewer steps than this is a trial, which would otherwise be coded for longer than it is trained.
    thorough_from: int = 1000

    def __post_init__(self) -> None:
        positive = (
            "channels",
            "steps",
            "object_steps",
            "rays",
            "samples",
            "hidden",
            "hybrid_width",
            "samples_across",
            "cells_across",
            "warmup",
            "regularise_every",
            "motion_every",
            "occupancy_every",
            "occupancy_slots",
            "occupancy_split_every",
        )
        for name in positive:
            if getattr(self, name) < 1:
                raise UsageError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not self.robust_tv_scale > 0:
            raise UsageError(f"robust_tv_scale must be positive, not {self.robust_tv_scale}")
        if self.tune_steps < 0:
            raise UsageError(f"tune_steps must be at least 0, not {self.tune_steps}")
        for name in ("object_rays", "channel_dropout", "scale_dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise UsageError(f"{name} must be at least 0 and less than 1, not {getattr(self, name)}")
        for name in (
            "temporal_start",
            "temporal_floor",
            "time_tolerance",
            "moving_kept",
            "prune_share",
            "dropout_until",
            "coarse_until",
            "robust_tv_from",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"{name} must be from 0 to 1, not {getattr(self, name)}")
        if self.appearance not in APPEARANCES:
            raise UsageError(f"appearance must be one of {', '.join(APPEARANCES)}, not {self.appearance}")
        if self.appearance != "none" and not self.view_dependent:
            raise UsageError(f"appearance {self.appearance} needs view_dependent: codes act through the direction MLP")
        if not self.resolutions or min(self.resolutions + self.layered_resolutions) < 2:
            raise UsageError(
                f"resolutions {self.resolutions + self.layered_resolutions}: every scale needs at least 2 texels"
            )
        if self.layered_resolutions and self.layered_channels < 1:
            raise UsageError(f"layered_channels must be at least 1, not {self.layered_channels}")

    def variation(self, fraction: float) -> Variation:
        """Return the total variation at a fraction of the run."""
        if fraction < self.robust_tv_from:
            return Variation(self.space_variation, self.transient_variation, 0.0)
        return Variation(self.robust_space_variation, self.transient_variation, self.robust_tv_scale**-2)

    def coding_effort(self, steps: float) -> float:
        """Return the share of the usual effort that coding takes after so many steps of training, in [1 / 16, 1]."""
        return 1.0 if steps >= self.thorough_from else max(steps / self.thorough_from, 1 / 16)

    @property
    def prunes(self) -> bool:
        """Whether the model may be pruned, for which its decoder has to be linear, as the explicit one is."""
        return self.prune_share > 0 and not self.hybrid

    def with_moving_area(self, area: tuple[float, ...]) -> "TrainConfig":
        """Return this configuration with scales of their own for what moves in an area, `moving_area`.

        Each resolution makes two scales then, so one resolution of more channels may do. All stay where coarse scales
        are to make a picture by themselves.
        """
        if not self.layered_resolutions or self.scale_dropout:
            return replace(self, moving_area=area)
        resolutions, channels = self.layered_resolutions, self.layered_channels
        return replace(self, moving_area=area, resolutions=resolutions, channels=channels)

    def for_single_object(self) -> "TrainConfig":
        """Return this configuration, adapted to a moving object without surroundings that one moving camera filmed.

        A motion grid warps to the canonical pose, so time rows may be twice as far apart. More channels and a
        view-independent colour follow from there being one view at a time, as direction would encode time and overfit
        each picture. Half the resolution needs half the samples. Measured in docs/design/training.md.
        """
        finest = max(self.resolutions)
        return replace(
            self,
            resolutions=(min(max(16, finest // 4), 32), max(16, finest // 2)),
            channels=32 if finest <= 256 else 64,
            frames_per_row=2 * self.frames_per_row,
            motion_cells=10,
            channel_dropout=0.4,
            coarse_until=0.3,
            view_dependent=False,
            robust_tv_from=1.0,
            samples_across=max(32, self.samples_across // 2),
            steps=self.object_steps,
        )


# `scale_dropout` of scenes that are to be shown while they are being received.
PROGRESSIVE_SCALE_DROPOUT = 0.1

PRESETS = {
    "draft": TrainConfig(
        resolutions=(48, 96),
        channels=8,
        samples_across=160,
        cells_across=64,
        steps=1500,
        object_steps=4500,
        occupancy_start=64,
        tune_steps=0,
        thorough_from=6000,
    ),
    "fast": TrainConfig(
        resolutions=(64, 160),
        channels=8,
        layered_resolutions=(160,),
        layered_channels=16,
        samples_across=224,
        cells_across=80,
        steps=4000,
        object_steps=9000,
    ),
    # Two scales of 16 channels rather than three of 8 (measured).
    "balanced": TrainConfig(
        resolutions=(96, 256),
        channels=16,
        steps=10000,
        object_steps=30000,
        temporal_start=0.75,
        temporal_floor=0.3,
    ),
    "best": TrainConfig(
        resolutions=(64, 128, 256, 448),
        channels=16,
        samples_across=512,
        cells_across=128,
        steps=40000,
        object_steps=120000,
        robust_space_variation=5e-3,
    ),
    # K-Planes' own settings (section 3.1 and appendix), except that rays are marched through an occupancy grid.
    # Needs a GPU.
    "paper": TrainConfig(
        resolutions=(64, 128, 256, 512),
        channels=32,
        samples_across=640,
        cells_across=128,
        steps=30000,
        samples=131072,
        occupancy_every=32,
        learning_rate=1e-2,
        space_variation=1e-3,
        robust_tv_from=1.0,
        adapts_to_object=False,
    ),
}
