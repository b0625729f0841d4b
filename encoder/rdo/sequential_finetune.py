"""Planes coded group after group, and what is still to be coded trained to make up for the errors of what is.

Pictures show what all planes give together, so an error in one can be undone by the others, at least in part. The finest planes, which
take most of the bytes, are coded first. Then all others and the decoder learn, on random rays of the scene's cameras that may meet
something, to give the colours that the uncoded scene gives; then the next are coded, and so on; the decoder learns on when all
planes are. Nobody needs to know what was filmed.

So networks are quantised in parts (Zhou et al., "Incremental Network Quantization", arXiv:1702.03044). Why it pays: of what independent
errors of all numbers cost, their diagonal (`kpc.encoder.rdo.curvature`) has a twentieth of the sum of squares (liam). Liam, `balanced`, held-out
views, at equal steps: errors are 1.5 to 1.9 dB smaller for 1 to 2 % more bytes, which is 10 to 13 % at equal error. Where the space planes of a scale were coded together, and
all time planes, files were 3 to 4 % larger (room, 100 steps a group) and 2 to 3 % (soldier, 60).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from kpc.encoder.evaluation.evaluate import SceneRenderer, pad_channels, unpad_decoder
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.training.optimisers import FusedOptimiser, TorchOptimiser
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.common.progress import Progress
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Decoder, Scene

RAYS = 1 << 12
"""A step. Liam, 100 steps a scale: with 2,048 rays and 200 steps the same."""
SHARE = 0.2
"""Of the steps of training, that tuning once takes at most: a short run is not to be tuned for longer than it was trained."""
LEARNING_RATE, DECODER_LEARNING_RATE = 2e-3, 5e-4
"""At first; they fall to 0 along a line. With 5e-3 errors are 0.1 dB smaller, but planes, noisier, take 2 % more bytes."""

SPREAD = 0.2
"""Octaves of steps. At equal error of pictures files of room are 3 % smaller at 33 dB of agreement (4 with 0.4), of shelf_hand as large at 38 dB (1 % larger
with 0.4). With 0.3 room's are 2 % smaller at 43 dB, shelf_hand's 3 % smaller at 33 dB, but 3 larger at 43, where with 0.15 they are as large."""


def coding_order(scene: Scene) -> list[list[PlaneKey]]:
    """Which planes are coded together: each space plane alone, those of the finest scale first; at last the time planes, scale by scale."""
    finest_first = list(reversed(range(len(scene.scales))))
    groups = [[(s, name)] for s in finest_first for name in SPACE_PLANES]
    return groups + [[(s, name) for name in TIME_PLANES] for s in finest_first if scene.is_dynamic]


def step_factors(scene: Scene) -> dict[PlaneKey, float]:
    """By how much coarser than others each plane may be, as planes coded after it make up for some of its errors: 2^SPREAD for the first,
    2^-SPREAD for the last."""
    groups = coding_order(scene)
    return {
        plane: 2.0 ** (SPREAD * (1 - 2 * number / (len(groups) - 1)))
        for number, group in enumerate(groups)
        for plane in group
    }


def total_steps(scene: Scene, steps: int) -> int:
    """Of tuning once, with so many a group; half as many for the decoder alone at last."""
    return (len(coding_order(scene)) - 1) * steps + steps // 2


def steps_per_group(trained: int, scene: Scene, most: int) -> int:
    """A group, after so many steps of training; at most `most`."""
    return min(most, int(SHARE * trained / (len(coding_order(scene)) - 0.5)))


def quantise_sequentially(
    scene: Scene,
    whole: Scene,
    quantise: Callable[[Scene, Sequence[PlaneKey]], QuantisedScene],
    steps: int,
    shown: bool = False,
) -> QuantisedScene:
    """A scene quantised group by group.

    Args:
        whole, steps, shown: as of `code_sequentially`. quantise: a scene, of which only some planes matter.
    """
    settled: dict[PlaneKey, QuantisedPlane] = {}

    def coded(candidate: Scene, group: Sequence[PlaneKey]) -> dict[PlaneKey, np.ndarray]:
        quantised = quantise(candidate, group)
        found = {(s, name): quantised.scales[s][name] for s, name in group}
        settled.update(found)
        return {key: plane.dequantise() for key, plane in found.items()}

    rest = quantise(code_sequentially(scene, whole, coded, steps, shown), ())
    return replace(
        rest, scales=tuple({name: settled[s, name] for name in scale} for s, scale in enumerate(scene.scales))
    )


def code_sequentially(
    scene: Scene,
    whole: Scene,
    coded: Callable[[Scene, Sequence[PlaneKey]], Mapping[PlaneKey, np.ndarray]],
    steps: int,
    shown: bool = False,
) -> Scene:
    """A scene whose planes are what comes back from their coding, whatever codes them, group by group.

    Args:
        whole: whose colours it is to have. coded: some of a scene's planes, as they come back.
        steps: of training after each group, as `total_steps`.
        shown: whether progress is.
    """
    teacher, groups = SceneRenderer(whole), coding_order(scene)
    settled: set[PlaneKey] = set()
    with Progress("tune", total=total_steps(scene, steps), unit="step", shown=shown) as progress:
        for number, group in enumerate(groups):
            back = coded(scene, group)
            settled |= back.keys()
            scales = tuple(
                {name: back.get((s, name), plane) for name, plane in scale.items()}
                for s, scale in enumerate(scene.scales)
            )
            scene = replace(scene, scales=scales)
            scene = _taught(
                scene, teacher, settled, steps if number < len(groups) - 1 else steps // 2, number, progress
            )
    return scene


def _taught(
    scene: Scene, teacher: SceneRenderer, settled: Collection[PlaneKey], steps: int, seed: int, progress: Progress
) -> Scene:
    """With planes that are not settled, and the decoder, nearer to what the teacher shows."""
    field = Field.from_scene(pad_channels(scene))
    explicit = isinstance(scene.decoder, Decoder)
    config = replace(
        TrainConfig(),
        learning_rate=LEARNING_RATE,
        decoder_learning_rate=DECODER_LEARNING_RATE,
        appearance_learning_rate=0.0,
        view_dependent=not explicit or bool(scene.decoder.w2.any()),
        distortion=0.0,
        channel_dropout=0.0,
        scale_dropout=0.0,
        coarse_until=0.0,
        regularise_every=steps + 1,
        motion_every=steps + 1,
    )
    cells = scene.occupancy.shape[1:]
    optimiser = (
        FusedOptimiser(field, config, cells, scene.mapping)
        if explicit
        else TorchOptimiser(field, config, cells, scene.mapping, fused=True)
    )
    theta, M = field.theta.detach().numpy(), field.layout.channels
    kept = [
        slice(start, start + rows * columns * M)
        for s, name, start, rows, columns in field.layout.planes()
        if (s, name) in settled
    ]
    before = [theta[some].copy() for some in kept]
    probe = ValidationRays.through_occupied(scene, RAYS * steps, seed=100 + seed)
    for number in range(steps if len(probe.times) >= steps else 0):
        rays = [a[number::steps] for a in probe.rays]
        colours = torch.from_numpy(teacher.rgb(*rays))
        optimiser.step(
            number + 1,
            1.0,
            1 - number / steps,
            teacher.batch(*rays),
            colours,
            scene.aabb,
            scene.occupancy,
            scene.step,
            scene.extent,
        )
        for some, values in zip(kept, before, strict=True):
            theta[some] = values
        progress.advance()
    scales = tuple({name: plane if (s, name) in settled else field.plane(s, name).detach().numpy()[..., : plane.shape[2]].copy()
                    for name, plane in scale.items()} for s, scale in enumerate(scene.scales))  # fmt: skip
    return replace(scene, scales=scales, decoder=unpad_decoder(scene, field.export_decoder()))
