"""What a training run is told to do: one frozen record, every number with its meaning and where it comes from."""

from dataclasses import dataclass, replace

from kpc.format.common.errors import UsageError

APPEARANCES = ("none", "camera", "image")


@dataclass(frozen=True)
class Variation:
    """How differences d between neighbours in planes are weighed: by the mean of log(1 + steep d^2) / steep, which is d^2 where `steep` is 0.

    Attributes:
        space: weight on space planes. transient: on space-time planes, along space.
    """

    space: float
    transient: float
    steep: float


@dataclass(frozen=True)
class TrainConfig:
    """All that decides the outcome of a run besides the dataset. "K-Planes" stands for arXiv:2301.10241."""

    # --- the model
    resolutions: tuple[int, ...] = (64, 128, 256)
    """Texels along the longest edge of the box, one number a scale, coarse to fine (K-Planes, section 3.1)."""
    channels: int = 8
    """Features a plane holds at each scale, M. The paper's knee is 32 on a GPU; the file and the player pay for each."""
    frames_per_row: float = 2.0
    """Frames of the clip to one row of a space-time plane (K-Planes trains 300 frames on 150 rows). A row for every frame costs
    room 0.2 dB and a fifth of its size, and the default scene time, for no gain in held-out PSNR. Where the cameras stand still
    it is measured instead, `kpc.encoder.training.temporal_resolution`."""
    time_tolerance: float = 0.055
    """What straight lines between rows may leave of the pixels that change, root mean square as a share of the full range; the
    rows are as far apart as that allows. 0: `frames_per_row` as it is. The default scene and room get a row for 2 frames (0.0546
    and 0.0452 are left; with one for 3, 0.072 and 0.060), liam one for 6 (0.053; for 8, 0.061). Held-out PSNR and size after
    short runs of `fast`, and with a row for 2: liam, 6 frames, 23.19 dB and 128 KB, 23.13 dB and 143 KB (1,000 steps); room, 3
    frames, 20.35 dB and 105 KB, 20.18 dB and 115 KB (600 steps)."""
    motion_cells: int = 0
    """Cells of the motion grid (`kpc.format.scene.motion`) along the longest edge of the box; 0 for none. It has a row for each row of
    the time planes. Not for objects in surroundings that stand still: a cell holds some of both, and liam loses 4.6 dB."""
    hybrid: bool = False
    """The hybrid decoder, two small MLPs for each sample, in place of the explicit one (`kpc.format.scene.scene`)."""
    hybrid_width: int = 32
    """Width of its layers (K-Planes uses 64, and three of them)."""
    summed: bool = False
    """The planes are added up in place of being multiplied: to be compared with (K-Planes, section 4.4), not to be stored."""
    hidden: int = 16
    """Width of the MLP that maps a view direction to the colour basis."""
    view_dependent: bool = True
    """Whether that MLP is trained; else colour is the same from everywhere."""
    appearance: str = "none"
    """What has an appearance, a code added to that MLP's hidden layer (K-Planes, section 3.3): each "image", each "camera", or
    "none". Goes with view_dependent alone."""
    samples_across: int = 320
    """Steps along the longest edge of the box; a little finer than the finest plane is enough."""
    cells_across: int = 96
    """Cells of the occupancy grid along the longest edge of the box."""

    mixed_precision: bool = True
    """On a GPU the hybrid decoder's layers compute in bfloat16, with sums in float32 (`Field.mixed`)."""

    # --- the optimiser
    steps: int = 6000
    """Optimiser steps when no time budget is given."""
    rays: int = 4096
    """Rays a step at most (K-Planes uses 4,096); fewer while the occupancy grid still lets many samples through."""
    samples: int = 98304
    """Samples a step at most, on average. It bounds the time of a step before the occupancy grid has formed."""
    object_rays: float = 0.5
    """Share of the rays drawn from about what is not transparent, where pictures have alpha: most of a picture is empty and
    soon right. Soldier gains 0.3 dB after 2,500 steps of `fast`; 0.8 gains less."""
    temporal_start: float = 0.5
    """Share of the run, in steps or time, from which on rays are drawn by how much their pixels change, where cameras stand
    still (IST: DyNeRF, arXiv:2103.02597; K-Planes, section 3.4); 1 for never. Gain in held-out PSNR, and of that where something
    moves alone: default scene 1.2 and 2.1 dB (2,000 steps of `fast`); liam 0.1 and 0.9 dB, room 0.0 and 0.9 dB (the last 500 of
    1,500 steps of `balanced`). What rests pays for it in long runs: after 5,000 steps liam has 28.5 dB, without it 28.9. So
    `balanced` starts late, with a higher floor: room has 29.5 dB then, after 10,000 steps. A step takes 4 to 8 % longer: what
    moves has more samples."""
    temporal_floor: float = 0.1
    """Least change that counts, as a share of the full range: what rests is still drawn. The default scene gains 0.7 dB at 0.3,
    and 1.3 dB at 0.03, where what rests loses 0.8 dB; at 0.1 it loses 0.1 dB, room 0.6 dB."""
    channel_dropout: float = 0.0
    """Share of the channels that a step leaves out, others each step, so that none relies on another."""
    dropout_until: float = 0.5
    """Share of the run after which all are there. Soldier, after 2,500 steps of `fast`: 26.5 dB if they are left out to the end, 26.7
    with 0.8, 26.9 with 0.5, 26.8 with 0.3."""
    coarse_until: float = 0.0
    """Share of the run that trains the coarsest scale alone: displacements are sought where pictures are smooth. (As cameras are in
    arXiv:2104.06405.) Soldier gains 0.2 dB with 0.3."""
    scale_dropout: float = 0.0
    """Share of the steps that leave out the finer scales, from any of them on, so that the coarser ones make a picture alone, the first
    that a player shows of a scene that arrives (spec/kpc-format.md, section 10). After 3,000 steps of `fast` the coarse scale of the
    default scene has 13.3 dB alone; with 0.1, 27.4 and 26.7 dB (two seeds), and all scales together 0.3 and 0.4 dB less."""
    learning_rate: float = 4e-2
    """Of the planes at its peak. K-Planes uses 1e-2 with 30,000 steps."""
    decoder_learning_rate: float = 1e-2
    """Of the density weights and the direction MLP."""
    motion_learning_rate: float = 1e-2
    """Of the motion grid, in box edges. 5e-3 gives soldier 0.1 dB less, 2e-2 0.2 dB."""
    motion_every: int = 1
    """The motion grid is moved every so many steps. Its gradient takes a fifth of a step's time, but with 2 soldier has 0.3 dB
    less after 2,500 steps of `fast` (26.06 and 26.09 dB with two seeds, 26.36 with 1)."""
    appearance_learning_rate: float = 1e-2
    """Of the codes of appearances. A ball in 28 images of unequal exposure and white balance (`write_varying_exposure` of the tests, 400
    steps) has a held-out PSNR of 25.2 dB with 3e-3, 25.5 with 1e-2, 25.3 with 3e-2, 25.0 with 1e-1, and 20.1 without codes."""
    warmup: int = 50
    """Steps over which the learning rate rises from 0; then it falls along half a cosine to 1 % of its peak."""
    seed: int = 0
    adapts_to_object: bool = True
    """Whether `for_single_object` may change all this for a scene of its kind."""

    # --- the priors; each is a weight on a mean over the texels of a plane, summed over planes and scales
    space_variation: float = 5e-3
    """Total variation of the space planes. K-Planes uses 1e-4 to 1e-3 with 30,000 steps; on a few thousand, soldier and room are
    both better at 5e-3 (held-out PSNR +0.6 and +0.3 dB)."""
    transient_variation: float = 2e-4
    """Total variation of the space-time planes, along space only. 5e-3 costs soldier 0.3 dB."""
    robust_tv_from: float = 0.7
    """Share of the run from which on total variation lets edges be; 1 for never. As K-Planes has it, it sums squares of differences d between
    neighbours: so shapes are found, but what is sharp is soft. From then on it is e^2 log(1 + d^2 / e^2), which grows as the bits do that tell d.
    From the start it does not hold few pictures together: the default scene loses 3 dB with `robust_space_variation` 5e-3."""
    edge: float = 0.1
    """e of that."""
    robust_space_variation: float = 2e-2
    """`space_variation` from then on. Held-out PSNR of room (`balanced`) and of the default scene (`fast`) as trained, and of their files: with squares to
    the end 30.68 dB, 30.58 at 1.01 bits a parameter; 33.74, 33.44 at 0.58. With 2e-2 30.76 dB, 30.66 at 0.99 bits; 33.83, 33.50 at 0.59. With 5e-3
    31.11 dB, 30.98 at 1.04 bits; 34.09, 33.60 at 0.57: more at equal size, but room loses 0.13 dB when coded so, 0.10 with 2e-2."""
    time_smoothness: float = 1e-2
    """Squared second difference in time. K-Planes finds the best near 0.01."""
    sparse_transients: float = 1e-4
    """L1 distance of the space-time planes from 1. K-Planes uses 1e-4."""
    motion_smoothness_time: float = 0.3
    """Squared second difference of the motion grid in time. With rows half as far apart it has to be ten times that, for the same."""
    motion_smoothness_space: float = 1.0
    """The same in space."""
    appearance_decay: float = 1e-3
    """Mean square of the codes of appearances. The same ball has 25.4 dB with 0, 25.2 with 1e-4, 25.5 with 1e-3, 25.2 with 1e-2,
    24.5 with 1e-1; in images that are equal, 26.4 dB with codes and 26.5 without."""
    distortion: float = 1e-3
    """Distortion loss (arXiv:2111.12077, eq. 15): pulls the weights of a ray together, against fog. K-Planes uses 1e-3."""
    regularise_every: int = 4
    """The priors enter every so many steps, multiplied by that number: unbiased, and a fraction of the cost."""

    # --- proposal sampling, in place of the march through the occupancy grid while training (`kpc.encoder.field.proposals`)
    proposals: bool = False
    proposal_resolutions: tuple[int, int] = (64, 128)
    """Texels along the longest edge of the box, of the coarse and of the fine proposal."""
    proposal_channels: int = 8
    """As in K-Planes."""
    proposal_samples: tuple[int, int, int] = (96, 48, 32)
    """Samples a ray: evenly for the first proposal, by its weights for the second, by that one's for the field."""
    histogram: float = 1.0
    """Weight of the histogram loss (arXiv:2111.12077, eq. 13), which trains the proposals and nothing else."""

    # --- the occupancy grid
    occupancy_start: int = 128
    """Steps with every visible cell occupied."""
    warmup_stride: float = 3.0
    """Length of a sample step until then, in steps of the march that follows."""
    occupancy_every: int = 16
    """Steps between updates of the grid (Instant-NGP, arXiv:2201.05989, appendix E)."""
    occupancy_slots: int = 32
    """Parts of the clip told apart, where there are as many frames. Soldier, whose body fills a third of its box over the clip,
    takes 9.3 samples a ray instead of 15.5; with 16 parts, 10.5."""
    occupancy_split_every: int = 512
    """Steps between two looks at the parts of the clip."""
    occupancy_alpha: float = 1e-2
    """A cell is empty if a step through it absorbs less than this."""

    # --- the file
    prune_share: float = 0.02
    """Of what coding may cost on training views, what may be spent on leaving out view dependence, channels and scales, `kpc.encoder.rdo.prune`;
    0: they all stay. Soldier, at equal size, held-out views: with a twentieth errors are 5 to 7 % larger, without any as large; with a quarter its
    files are 4 to 5 % larger at equal loss and liam's up to 2 %, the default scene's the same."""
    tune_steps: int = 60
    """Of training that a group of planes gets to make up for the errors of those that are coded, `kpc.encoder.rdo.sequential_finetune`; 0 for none. Room: with
    100 files are 2 % smaller at equal error."""

    def __post_init__(self) -> None:
        positive = (
            "channels",
            "steps",
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
        if not self.edge > 0:
            raise UsageError(f"edge must be positive, not {self.edge}")
        if self.tune_steps < 0:
            raise UsageError(f"tune_steps must be at least 0, not {self.tune_steps}")
        for name in ("object_rays", "channel_dropout", "scale_dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise UsageError(f"{name} must be at least 0 and less than 1, not {getattr(self, name)}")
        for name in (
            "temporal_start",
            "temporal_floor",
            "time_tolerance",
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
        if not self.resolutions or min(self.resolutions) < 2:
            raise UsageError(f"resolutions {self.resolutions}: every scale needs at least 2 texels")

    def variation(self, fraction: float) -> Variation:
        """At a fraction of the run."""
        if fraction < self.robust_tv_from:
            return Variation(self.space_variation, self.transient_variation, 0.0)
        return Variation(self.robust_space_variation, self.transient_variation, self.edge**-2)

    @property
    def prunes(self) -> bool:
        """Whether anything may be left out: the explicit decoder alone is linear, as `kpc.encoder.rdo.prune` wants it."""
        return self.prune_share > 0 and not self.hybrid

    def for_single_object(self) -> "TrainConfig":
        """For an object without surroundings that one moving camera has seen: soldier, and D-NeRF's scenes.

        A motion grid leads every instant back to one pose; rows of time may then be twice as far apart. What is left asks for
        more terms in the sum of products, as all of it moves; one view at a time leaves fine detail open; and direction tells
        the time, so a colour that depends on it learns each picture by heart. Held-out PSNR of soldier after 2,500 steps of
        `fast`: 23.5 dB as it was, 24.2 with 16 channels at (32, 64, 128), 24.7 with 32, 25.0 without the direction. 64 are better
        only step by step: with channel dropout in the first half and the coarse scale first, 27.1 dB in 303 s, and 32 after twice the
        steps 27.3 in 339 s; 27.4 if each step leaves out 0.4 of them and not a quarter; and a sample costs half in the player.
        Edges let be (`robust_tv_from`) change nothing, 27.57 dB and 27.55 with them (`fast`). Half the resolution needs
        half the samples: 25.0 dB in 69 s, 24.9 in 92 s with all of them. A motion grid of 6 cells gives 25.9 dB, of 10
        26.05, of 14 25.8 (with bending held in the same proportion to the cells: 0.1, 1, 3); with 4 frames to a row
        26.2, with 6 26.1, with 1 24.9. After 8,000 steps it is 27.1 dB, and 27.3 with (32, 128) in place of (32, 80):
        two scales do, their steps take two thirds of the time. Surroundings change the matter: shelf_hand loses 3.3 dB
        without the direction.
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
            steps=3 * self.steps,
        )


PROGRESSIVE_SCALE_DROPOUT = 0.1
"""`scale_dropout` of scenes that are to be seen while they arrive."""

PRESETS = {
    "draft": TrainConfig(
        resolutions=(48, 96),
        channels=8,
        samples_across=160,
        cells_across=64,
        steps=1500,
        occupancy_start=64,
        tune_steps=0,
    ),
    "fast": TrainConfig(resolutions=(64, 160), channels=8, samples_across=224, cells_across=80, steps=3000),
    # Room, held-out views of 3,000 steps and the file of quality 70: with (64, 128, 256) and 8 channels 27.98 dB and 156 KB, with (96, 256) and 12
    # channels 28.44 dB and 183 KB, in as many texels looked up a sample and no more time; with 16 channels 28.95 dB and 213 KB, in 1.2 times the time
    # that a frame takes to play; with (64, 128, 256) and 12 channels 28.87 dB and 196 KB, in as much.
    "balanced": TrainConfig(resolutions=(96, 256), channels=16, steps=10000, temporal_start=0.75, temporal_floor=0.3),
    "best": TrainConfig(
        resolutions=(64, 128, 256, 448),
        channels=16,
        samples_across=512,
        cells_across=128,
        steps=40000,
        robust_space_variation=5e-3,
    ),
    # K-Planes' own settings (section 3.1 and its appendix), but for the march through occupied cells. It wants a GPU.
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
