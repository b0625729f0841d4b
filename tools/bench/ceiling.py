"""kpbench ceiling: how good frames of a clip are that are trained alone, each as a still scene of the same cameras.

What moves is no harder for them than what stands still, so they show what a model of the clip could reach where it
moves. Their pixels are split by the motion of the clip, and measured as `kpbench quality` measures the clip.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from kpc.encoder.cli.encode_groups import setting_of_span
from kpc.encoder.cli.encode_scene import encode_scene
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.prepare import Setting, prepare_setting
from kpc.format.common.errors import DatasetError
from kpc.format.container.groups import Groups, Span
from kpc.tools.bench import quality
from kpc.tools.bench.group_joins import Shown, shown_frames


@dataclass(frozen=True)
class Job:
    """What to measure.

    Attributes:
        options: of kpenc, for each frame; their files lie beside `output`, which is not written.
        frames: how many frames of the clip, spread over it.
    """

    options: Options
    frames: int


def measure(job: Job) -> dict[str, Any]:
    """Train frames of a clip alone, and compare their coded files with its held-out pictures.

    Returns:
        As `kpc.tools.bench.quality.measure`; frames have no flicker.

    Raises:
        DatasetError: the scene does not move, or shows each instant from one camera only.
        KpcError: the dataset cannot be used, or it holds out no picture.
    """
    setting = prepare_setting(job.options)
    dataset = setting.dataset
    if not dataset.is_dynamic:
        raise DatasetError(f"{dataset.path}: does not move, so it has no frames to train alone")
    if dataset.is_monocular:
        raise DatasetError(f"{dataset.path}: shows each instant from one camera; a frame alone needs several")
    if not dataset.pictures.is_test.any():
        raise DatasetError(f"{dataset.path}: holds out no picture to compare with; give --holdout NAME")
    chosen = frames_between(dataset.clip.frame_count, job.frames)
    shown = (one for frame in chosen for one in _encoded_alone(frame, setting, job.options))
    frames = [asdict(frame) for frame in quality.measured_frames(shown, dataset)]
    return {"frames": frames, "means": quality.means(frames)}


def frames_between(count: int, wanted: int) -> list[int]:
    """Return the numbers of frames that part a clip evenly; neither its first nor its last where there are others."""
    return sorted(set(np.linspace(0, count - 1, wanted + 2).round().astype(int)[1:-1].tolist()))


def _encoded_alone(frame: int, setting: Setting, options: Options) -> Iterator[Shown]:
    """Train a frame as a still scene; yield its held-out pictures."""
    alone = setting_of_span(replace(setting, sound=None), Span(frame, 1))
    output = options.output.with_name(f"{options.output.stem}-{frame:04d}.kpc")
    encode_scene(replace(options, output=output, work=output.with_suffix(".work"), keep=False), alone)
    for shown in shown_frames(Groups(output), alone.dataset):
        yield replace(shown, frame=frame)
