"""Encode a long clip in groups: each as a scene, one after the other, and all of them as one file.

Finished groups are kept in the work folder, with what was measured of them, so that an interrupted encode can be
resumed.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.cli.encode_scene import encode_scene
from kpc.encoder.cli.grouped import (
    LATER_STEPS,
    STILL_SHARE,
    options_of_group,
    plan_sharing,
    plane_bytes,
    spans_of,
)
from kpc.encoder.cli.metadata import clip_metadata, hash_dataset
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.prepare import Layers, Setting, find_layers, prepare_setting, trim_with_progress
from kpc.encoder.cli.report import log
from kpc.encoder.cli.sound import sound_of_span
from kpc.encoder.cli.transcode import combine_figures
from kpc.encoder.cli.work_folder import clear_work_folder
from kpc.encoder.rdo.codec_model import load_checkpoint
from kpc.encoder.training.importance import has_static_cameras
from kpc.encoder.training.refinement import with_corrections
from kpc.format.common import cli
from kpc.format.common.errors import TrainingError
from kpc.format.common.text import option_name
from kpc.format.container import groups, scene_io
from kpc.format.container.metadata_options import TEXTS
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip
from kpc.format.scene.space import Contraction

# Figures that are reported for each group.
GROUP_FIGURES = ("size_bytes", "test_psnr", "steps", "train_s", "coding_s", "peak_memory_bytes")
# Options by which a finished group may differ from those that follow, as a checkpoint from its continuation
# (`kpc.encoder.training.continuation`).
LENGTH = ("--steps", "--time-budget")
DEFAULT = "the default"  # value of an option that is not given, in words
# Figures that are summed over all groups.
SUMMED_FIGURES = ("test_pictures", "held_out_pictures", "steps", "train_s", "coding_s")


def encode_groups(options: Options) -> dict[str, Any]:
    """Encode all groups of a clip, or the one that `options.only` names; return what was measured."""
    started = time.monotonic()
    setting = prepare_setting(options)
    setting = replace(setting, dataset_sha256=hash_dataset(setting.dataset))
    work, spans = options.work_dir, plan_groups(options, setting.dataset.clip)
    numbers = range(len(spans)) if options.only is None else [options.only]
    first = group_path(work, numbers[0])
    if options.resume and first.with_suffix(".json").exists():
        setting = replace(setting, aabb=scene_io.SceneReader(first).head.aabb, is_final=True)
    elif not setting.is_final:
        setting = _trim_for_groups(setting, options, spans)
    config = options.config(setting.dataset)
    layers = find_layers(options, config, setting.dataset, setting.aabb, setting.mapping)
    setting = replace(setting, layers=layers)
    if layers.area is not None and len(numbers) > 1:
        sharing = plan_sharing(config, setting.dataset, setting.aabb, setting.mapping, layers.area)
        setting = replace(setting, sharing=sharing)
        log("what stands still is trained and coded with the first group, and shared by all")
    found: list[dict[str, Any]] = []
    shared = 0
    for number in numbers:
        span, path = spans[number], group_path(work, number)
        log(f"group {number} of {len(spans)}: frames {span.start} to {span.last}")
        group_options = replace(
            options_of_group(options, number, spans, 0.0 if setting.sharing is None else STILL_SHARE, shared),
            output=path,
            work=path.with_suffix(""),
            keep_checkpoint=options.keep_checkpoint or path.with_suffix(".kpck"),
        )
        begun = time.monotonic()
        if options.resume and path.with_suffix(".json").exists():
            found.append(_read_finished(path, group_options))
        else:
            before = None if number == numbers[0] else group_path(work, number - 1).with_suffix(".kpck")
            found.append(_encode_group(group_options, setting_of_span(setting, span), before))
        started -= found[-1]["encode_s"] - (time.monotonic() - begun)  # of runs that were interrupted
        if number == numbers[0] and found[0]["refine"] != "none" and has_static_cameras(setting.dataset):
            corrected = with_corrections(setting.dataset, found[0]["corrections"])
            setting = replace(setting, dataset=corrected, refined=found[0]["refine"])
        if number == numbers[0] and setting.sharing is not None:
            sizes = plane_bytes(path)
            shared = sum(sizes[key] for key in setting.sharing.planes)
            setting = replace(setting, sharing=setting.sharing.after(scene_io.read(path)))
    parts = [groups.GroupInput.of(group_path(work, number), spans[number].start) for number in numbers]
    for one in found[1:]:
        one["size_bytes"] -= shared
    figures = _combine(found, [spans[number] for number in numbers], 0, options)
    size = _join(parts, clip_metadata([part.metadata for part in parts], figures, options), options)
    if not options.keep:
        clear_work_folder(work, options.cache)
    return _combine(found, [spans[number] for number in numbers], size, options) | {
        "encode_s": time.monotonic() - started
    }


def plan_groups(options: Options, clip: Clip) -> tuple[groups.Span, ...]:
    """Split a clip into groups of at most `options.group_s`; log where one holds all of it.

    Raises:
        UsageError: groups are too short, or there is none of the number `options.only`.
    """
    spans = spans_of(options, clip)
    if len(spans) == 1:
        log(f"--group {options.group_s:g}s: the clip lasts {clip.total_s:.3g} s, so it is a single group")
    return spans


def group_path(work: Path, number: int) -> Path:
    """Return the path of a finished group in the work folder."""
    return work / f"group-{number:04d}.kpc"


def setting_of_span(setting: Setting, span: groups.Span) -> Setting:
    """Return the setting for the frames of one group."""
    dataset, clip = setting.dataset.frame_range(span.start, span.last), setting.dataset.clip
    layers = setting.layers
    if layers is not None and layers.area is not None:
        frames = max(clip.frame_count - 1, 1)
        layers = Layers(layers.area.between(span.start / frames, span.last / frames))
    return replace(setting, dataset=dataset, layers=layers, sound=sound_of_span(setting.sound, span, clip.fps))


def _trim_for_groups(setting: Setting, options: Options, spans: Sequence[groups.Span]) -> Setting:
    """Trim the box that all groups share, on no more frames than one group has."""
    dataset = setting.dataset.subsample_frames(max(span.count for span in spans))
    budget_s = options_of_group(options, 0, spans).time_budget_s
    assert not isinstance(setting.mapping, Contraction)
    aabb, _ = trim_with_progress(dataset, options.config(dataset), setting.aabb, budget_s, setting.mapping)
    return replace(setting, aabb=aabb, is_final=True)


def _encode_group(options: Options, setting: Setting, before: Path | None) -> dict[str, Any]:
    """Encode a group, starting from the checkpoint of the one before, and write what was measured beside its file.

    A group counts as finished when that file exists.
    """
    if before is None:
        found = encode_scene(options, setting)
    else:
        log(f"it starts where the one before ended, and takes {LATER_STEPS:.0%} of its steps")
        shorter = replace(options, steps=math.ceil(LATER_STEPS * options.config(setting.dataset).steps))
        found = encode_scene(shorter, replace(setting, before=load_checkpoint(before).scene))
    with cli.atomic_write(options.output.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps({"options": _fingerprint(options), "found": found}))
    if before is not None:
        before.unlink()
    return found


def _read_finished(path: Path, options: Options) -> dict[str, Any]:
    """Return what was measured of a finished group; log it if it was trained for another length.

    Raises:
        TrainingError: it was encoded with other options, or its figures cannot be read.
    """
    try:
        kept = json.loads(path.with_suffix(".json").read_text())
        before, now = kept["options"], _fingerprint(options)
        changed = [name for name in now if before[name] != now[name]]
        fixed = [
            f"{name} was {_shown(name, before[name])}, is {_shown(name, now[name])}"
            for name in changed
            if name not in LENGTH
        ]
        if fixed:
            raise TrainingError(
                f"{path}: is finished, with other settings ({', '.join(fixed)}), and all groups of a clip have the "
                "same; give those, or drop --resume to encode all of them anew"
            )
        found: dict[str, Any] = kept["found"]
        if missing := {*GROUP_FIGURES, *SUMMED_FIGURES, "test_psnr_moving", "refine"} - found.keys():
            raise KeyError(*missing)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"{path}: its figures cannot be read; delete it to have the group encoded anew") from error
    length = f", and stays as long as it was trained ({_length(before)} before, {_length(now)} now)" if changed else ""
    log(f"{path}: is finished already{length}")
    return found


def _shown(name: str, value: str) -> str:
    """Return a value of a fingerprint as the command line takes it."""
    return f"{float(value):g}s" if name == "--group" and value != DEFAULT else value


def _length(fingerprint: Mapping[str, str]) -> str:
    """Return how long a group was trained, as options of kpenc; of a time budget, it names the group's share."""
    steps, budget_s = (fingerprint[name] for name in LENGTH)
    return f"--steps {steps}" if budget_s == DEFAULT else f"--time-budget {float(budget_s):.3g}s of this group"


def _fingerprint(options: Options) -> dict[str, str]:
    """Return all options that the result depends on, by their names on the command line, as text."""
    without = ("resume", "keep", "preview", "trade", "cache", "members")
    given = {name: value for name, value in vars(options).items() if name not in without}
    given |= {name: options.members.get(name) for name in TEXTS}
    names = {option_name(name): DEFAULT if value is None else str(value) for name, value in given.items()}
    return names | {"the target": "{} {:g}".format(*options.trade.bound)}


def _join(parts: Sequence[groups.GroupInput], metadata: Metadata, options: Options) -> int:
    try:
        return groups.write(parts, options.output, metadata)
    except OSError as error:
        kept = f"or give another -o with --work {options.work_dir} --resume to keep what is done"
        raise TrainingError(f"{options.output}: {error.strerror}; make room there, {kept}") from error


def _combine(
    found: Sequence[dict[str, Any]], spans: Sequence[groups.Span], size: int, options: Options
) -> dict[str, Any]:
    """Combine the figures of all groups: sums, means over frames or pictures, and those of each group."""

    def mean(name: str, weights: Sequence[float]) -> float | None:
        known = [(one[name], weight) for one, weight in zip(found, weights, strict=True) if one[name] is not None]
        values, shares = [value for value, _ in known], [weight for _, weight in known]
        return float(np.average(values, weights=shares)) if sum(shares) else None

    pictures = [one["test_pictures"] for one in found]
    return (
        found[0]
        | combine_figures(found, spans, size, options.trade)
        | {
            "file": str(options.output),
            "test_psnr": mean("test_psnr", pictures),
            "test_ssim": mean("test_ssim", pictures),
            "test_psnr_moving": mean("test_psnr_moving", pictures),
            "test_psnr_still": mean("test_psnr_still", pictures),
            "coding_loss_db": mean("coding_loss_db", [span.count for span in spans]),
            **{key: sum(one[key] for one in found) for key in SUMMED_FIGURES},
            "rays_per_s": mean("rays_per_s", [one["train_s"] for one in found]),
            "peak_memory_bytes": found[-1]["peak_memory_bytes"],
            "groups": [
                {"frames": [span.start, span.last]} | {key: one[key] for key in GROUP_FIGURES}
                for one, span in zip(found, spans, strict=True)
            ],
        }
    )
