"""Sequential fine-tuning: planes are coded group by group, and what is not yet coded is trained to compensate.

Pictures show the product of all planes, so that an error in one can be compensated by the others, at least in part. The
finest planes, which take most of the bytes, are coded first, those of what stands still and of what moves together.
Then all others and the decoder learn to reproduce the colours of the uncoded scene on random rays of its cameras; then
the next group is coded, and so on. The decoder learns on when all planes are coded. No filmed pictures are needed.

This is incremental network quantisation (Zhou et al., arXiv:1702.03044) applied to planes. Why it pays, and what it
gains: docs/design/rate-distortion.md, "Sequential fine-tuning".
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from kpc.encoder.evaluation.evaluate import SceneRenderer, pad_channels, unpad_decoder
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import layout_of_planes
from kpc.encoder.rdo.distortion import PlaneKey
from kpc.encoder.training.fused_optimiser import FusedOptimiser
from kpc.encoder.training.torch_optimiser import TorchOptimiser
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene, with_planes
from kpc.format.common.progress import Progress
from kpc.format.scene.scene import SPACE_PLANES, TIME_PLANES, Decoder, Scene

# Figures behind these constants: docs/design/rate-distortion.md, "Sequential fine-tuning".
RAYS = 1 << 12  # rays per step
SHARE = 0.2  # of the steps of training that one fine-tuning takes at most, so that short runs are not tuned for longer
LEARNING_RATE, DECODER_LEARNING_RATE = 7e-4, 2e-4  # initial; both fall linearly to 0
SPREAD = 0.2  # octaves by which the steps of the first planes are coarser, and those of the last finer

# Codes some planes of a scene and returns them as decoded.
CodePlanes = Callable[[Scene, Sequence[PlaneKey]], Mapping[PlaneKey, np.ndarray]]


def coding_order(scene: Scene, settled: Collection[PlaneKey] = ()) -> list[list[PlaneKey]]:
    """Return the groups of planes in coding order: each kind of space plane alone, finest scales first, then the time
    planes. Planes that are settled are left out.
    """
    finest_first = scales_by_resolution(scene)[::-1]
    groups = [[(s, name) for s in scales] for scales in finest_first for name in SPACE_PLANES]
    if scene.is_dynamic:
        groups += [[(s, name) for s in scales for name in TIME_PLANES] for scales in finest_first]
    remaining = ([key for key in group if key not in settled] for group in groups)
    return [group for group in remaining if group]


def scales_by_resolution(scene: Scene) -> list[list[int]]:
    """Return the scales that are coded together: one in which nothing changes, and the next, which holds what moves at
    that resolution; any other alone.
    """
    found: list[list[int]] = []
    for s in range(len(scene.scales)):
        if found and _stands_still(scene, found[-1][-1]) and not _stands_still(scene, s):
            found[-1].append(s)
        else:
            found.append([s])
    return found


def _stands_still(scene: Scene, s: int) -> bool:
    """Return whether the time planes of a scale are the identity; False in scenes that have none."""
    return scene.is_dynamic and all(_is_identity(scene, s, name) for name in TIME_PLANES)


def _is_identity(scene: Scene, s: int, name: str) -> bool:
    """Return whether a plane is a time plane that changes nothing."""
    return name in TIME_PLANES and bool((scene.scales[s][name] == 1).all())


def step_factors(scene: Scene) -> dict[PlaneKey, float]:
    """Return factors on the quantisation steps, from 2^SPREAD for the first group to 2^-SPREAD for the last.

    Later groups compensate some of the errors of earlier ones, which may therefore be coarser.
    """
    groups = coding_order(scene)
    return {
        plane: 2.0 ** (SPREAD * (1 - 2 * number / (len(groups) - 1)))
        for number, group in enumerate(groups)
        for plane in group
    }


def total_steps(scene: Scene, steps: int, settled: Collection[PlaneKey] = ()) -> int:
    """Return the steps of one fine-tuning with `steps` per group, and half as many for the decoder alone at the end."""
    return (len(coding_order(scene, settled)) - 1) * steps + steps // 2


def steps_per_group(trained: int, scene: Scene, most: int, settled: Collection[PlaneKey] = ()) -> int:
    """Return the steps per group after `trained` steps of training, at most `most`."""
    return min(most, int(SHARE * trained / (len(coding_order(scene, settled)) - 0.5)))


def quantise_sequentially(
    scene: Scene,
    teacher: Scene,
    quantise: Callable[[Scene, Sequence[PlaneKey]], QuantisedScene],
    steps: int,
    shown: bool = False,
    settled: Mapping[PlaneKey, QuantisedPlane] | None = None,
) -> QuantisedScene:
    """Quantise a scene group by group, with fine-tuning in between.

    Args:
        scene: to be quantised.
        teacher: the scene whose colours are to be reproduced.
        quantise: quantises a scene, of which only the given planes matter.
        steps: of training after each group.
        shown: whether to show progress.
        settled: planes that are quantised already.
    """
    quantised = dict(settled or {})

    def code_planes(candidate: Scene, group: Sequence[PlaneKey]) -> dict[PlaneKey, np.ndarray]:
        chosen = quantise(candidate, group)
        found = {(s, name): chosen.scales[s][name] for s, name in group}
        quantised.update(found)
        return {key: plane.dequantise() for key, plane in found.items()}

    known = {key: plane.dequantise() for key, plane in quantised.items()}
    rest = quantise(code_sequentially(scene, teacher, code_planes, steps, shown, known), ())
    return replace(
        rest, scales=tuple({name: quantised[s, name] for name in scale} for s, scale in enumerate(scene.scales))
    )


def code_sequentially(
    scene: Scene,
    teacher: Scene,
    code_planes: CodePlanes,
    steps: int,
    shown: bool = False,
    known: Mapping[PlaneKey, np.ndarray] | None = None,
) -> Scene:
    """Return a scene of decoded planes, coded group by group with fine-tuning in between, by any plane codec.

    Args:
        scene: to be coded.
        teacher: the scene whose colours are to be reproduced.
        code_planes: the codec.
        steps: of training after each group; half as many after the last.
        shown: whether to show progress.
        known: planes that are coded already, as decoded.
    """
    settled = set(known or {})
    renderer, groups, scene = SceneRenderer(teacher), coding_order(scene, settled), with_planes(scene, known or {})
    with Progress("fine-tuning", total=total_steps(scene, steps, settled), unit="steps", shown=shown) as progress:
        for number, group in enumerate(groups):
            decoded = code_planes(scene, group)
            settled |= decoded.keys()
            scene = with_planes(scene, decoded)
            group_steps = steps if number < len(groups) - 1 else steps // 2
            scene = _finetune(scene, renderer, settled, group_steps, number, progress)
    return scene


def _finetune(
    scene: Scene, teacher: SceneRenderer, settled: Collection[PlaneKey], steps: int, seed: int, progress: Progress
) -> Scene:
    """Train all planes that are not settled, and the decoder, to reproduce the teacher's colours."""
    field, optimiser = _field_and_optimiser(scene, steps)
    planes = [(s, name) for s, name, *_ in field.layout.planes()]
    field.freeze((s, name) for s, name in planes if (s, name) in settled or _is_identity(scene, s, name))
    drawn = ValidationRays.through_occupied(scene, RAYS * steps, seed=100 + seed)
    for number in range(steps if len(drawn.times) >= steps else 0):
        rays = [a[number::steps] for a in drawn.rays]
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
        field.restore_fixed()
        progress.advance()
    scales = tuple(
        {
            name: field.whole_plane(s, name)[..., : plane.shape[2]]
            if (s, name) not in settled and field.layout.has(s, name)
            else plane
            for name, plane in scale.items()
        }
        for s, scale in enumerate(scene.scales)
    )
    return replace(scene, scales=scales, decoder=unpad_decoder(scene, field.export_decoder()))


def _field_and_optimiser(scene: Scene, steps: int) -> tuple[Field, FusedOptimiser | TorchOptimiser]:
    """Return the scene as a field, and an optimiser without any regularisation within `steps`."""
    padded = pad_channels(scene)
    field = Field.from_scene(padded, layout_of_planes(padded.scales))
    explicit = isinstance(scene.decoder, Decoder)
    config = replace(
        TrainConfig(),
        learning_rate=LEARNING_RATE,
        line_rate=0.0,
        decoder_learning_rate=DECODER_LEARNING_RATE,
        appearance_learning_rate=0.0,
        view_dependent=not explicit or bool(scene.decoder.w2.any()),
        distortion=0.0,
        full_weight=0.0,
        channel_dropout=0.0,
        scale_dropout=0.0,
        coarse_until=0.0,
        regularise_every=steps + 1,
        motion_every=steps + 1,
    )
    cells = scene.occupancy.shape[1:]
    if explicit:
        return field, FusedOptimiser(field, config, cells, scene.mapping)
    return field, TorchOptimiser(field, config, cells, scene.mapping, fused=True)
