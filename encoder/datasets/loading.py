"""Loading of datasets: recognise the layout, check it, and decode its pictures, masks and times."""

import hashlib
import math
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from kpc.encoder.datasets.cache_lock import exclusive
from kpc.encoder.datasets.capture import Capture, CapturedView, Film, MaskFile, first_names, report_orientations
from kpc.encoder.datasets.dataset import Dataset, Pictures
from kpc.encoder.datasets.decoded_pictures import cached_pixels
from kpc.encoder.datasets.layouts import (
    anipose,
    blender,
    caliscope,
    colmap,
    easymocap,
    llff,
    nerfies,
    nerfstudio,
    opencv,
    panoptic,
    qualisys,
)
from kpc.encoder.datasets.left_out import count_left_out
from kpc.encoder.datasets.masks import find_masks, load_masks
from kpc.encoder.datasets.timeline import align, in_step
from kpc.encoder.datasets.video import VideoInfo
from kpc.format.common.errors import DatasetError, MediaError
from kpc.format.common.text import notice, one_line, valid_unicode
from kpc.format.scene.camera_checks import NUMBER_LIMIT
from kpc.format.scene.scene import Clip

# The first layout that recognises a folder reads it: formats to which a COLMAP model is exported precede COLMAP's own.
LAYOUTS = (
    *(llff, blender, nerfstudio, nerfies, easymocap, panoptic, caliscope, anipose, qualisys),
    *(colmap, opencv),
)

# Frame rate of images with times whose dataset does not give one, frames per second.
ASSUMED_FPS = 30.0

# Cameras whose positions differ by no more than this share of their coordinates are one, since poses are rounded; so
# are those that differ by no more than the narrowest box of a .kpc file, 1 / NUMBER_LIMIT.
STILL = 1e-6
# The least side in pixels that --downscale may leave: less is a slip of the keyboard.
MIN_SIDE = 4


def load_dataset(
    path: str | os.PathLike[str],
    cache_dir: str | os.PathLike[str],
    *,
    holdout: str | None = None,
    downscale: int = 1,
    most_across: int | None = None,
    progress: bool = True,
    transforms: Path | None = None,
    footage: Path | None = None,
    check_clip: Callable[[Clip, Mapping[str, Path]], object] = lambda *_: None,
) -> Dataset:
    """Read a dataset: recognise its layout by its content, decode its pictures and masks, and read its cameras.

    Decoded pictures are cached on disk and reused.

    Args:
        path: the dataset's folder.
        cache_dir: made if it does not exist; holds pixels-*, a file or a folder for each dataset and downscale. Other
            processes may use it at the same time.
        holdout: the file to hold out for testing, "none", or None for the layout's default.
        downscale: every block of downscale^2 pixels is averaged to one; the remainder on the right and below is
            cropped. A block is usable if all its pixels are.
        most_across: instead of `downscale`, the most pixels along the longer side of a picture.
        progress: whether to report progress on stderr.
        transforms: a document of `kpposes` for the folder, if it lies elsewhere.
        footage: the folder of the videos from which its images were taken, if it is another.
        check_clip: called with the clip and its videos by name before pictures are decoded; what it raises ends the
            reading.

    Raises:
        DatasetError: the folder does not exist, has no known layout, is inconsistent, its masks leave nothing to train
            on, or the cache's disk is full.
        MediaError: a video, image or mask cannot be read.
    """
    root = Path(path)
    try:
        if transforms is None:
            capture = _recognise(root, holdout)
        else:
            capture = nerfstudio.read(root, holdout, transforms, footage)
        if most_across is not None:
            downscale = _fitting_downscale(root, capture.views, most_across)
        _check(root, capture, downscale)
        report_orientations(root, capture.views)
        masks = find_masks(root, capture.views)
        left_out = count_left_out(root, capture, [mask.path for mask in masks if mask])
        dataset = _load(root, capture, masks, Path(cache_dir), downscale, progress, check_clip)
        return replace(dataset, left_out=left_out)
    except PermissionError as error:
        file = Path(error.filename or root)
        if file.is_relative_to(cache_dir):
            remedy = "no permission to write there; name another folder with --cache"
        else:
            remedy = "no permission to read it; change its permissions or run as its owner"
        raise DatasetError(f"{file}: {remedy}") from error
    except (DatasetError, MediaError) as error:
        if str(error).isprintable():
            raise
        raise type(error)(one_line(str(error))) from error  # the names of files may hold anything


def _recognise(root: Path, holdout: str | None) -> Capture:
    """Read the folder as the first layout that recognises it."""
    layouts = layouts_of(root)
    capture = layouts[0].read(root, holdout)
    if len(layouts) > 1:
        others = ", ".join(layout.NAME for layout in layouts[1:])
        notice(f"{root}: read as {capture.layout}; what is there in the layout of {others} is not")
    return capture


def layouts_of(root: Path) -> list[ModuleType]:
    """Return the layouts that recognise a folder, at least one.

    Raises:
        DatasetError: none does, or there is no folder.
    """
    if not root.is_dir():
        problem = "not a directory" if root.exists() else "no such directory"
        raise DatasetError(f"{root}: {problem}; give a folder of posed videos or images")
    if not any(root.iterdir()):
        raise DatasetError(f"{root}: empty directory; give a folder of posed videos or images")
    layouts = [layout for layout in LAYOUTS if layout.recognise(root)]
    if layouts:
        return layouts
    raise DatasetError(
        f"{root}: no dataset layout recognised; it needs one of: poses_bounds.npy (N3DV, LLFF), transforms_train.json "
        "(Blender, D-NeRF), transforms.json (nerfstudio, instant-ngp), dataset.json (Nerfies), intri.yml and extri.yml "
        "(EasyMocap), calibration_*.json (Panoptic Studio), camera_array.toml (Caliscope), calibration.toml (Anipose), "
        "*.qca.txt (Qualisys), sparse/0 with cameras and images (COLMAP), K R t in YAML or JSON (OpenCV)"
    )


def has_layout(root: Path) -> bool:
    """Return whether a folder is read by a layout."""
    return root.is_dir() and any(layout.recognise(root) for layout in LAYOUTS)


def _check(root: Path, capture: Capture, downscale: int) -> None:
    """Refuse captures that cannot be trained on."""
    train = [view for view in capture.views if not view.is_test]
    if not train:
        raise DatasetError(
            f"{root}: every picture is held out, none is left to train on; give --holdout none or add cameras"
        )
    centres = np.stack([view.camera_to_world[:3, 3] for view in train])
    if np.ptp(centres, axis=0).max() <= max(STILL * np.abs(centres).max(), 1 / NUMBER_LIMIT):
        raise DatasetError(
            f"{root}: a single camera that does not move ({train[0].file.name}): depth cannot be reconstructed from "
            "one viewpoint; add cameras"
        )
    for view in capture.views:
        least = 1 if downscale == 1 else MIN_SIDE
        if downscale < 1 or min(view.width, view.height) // downscale < least:
            raise DatasetError(
                f"{view.file}: {view.width}x{view.height} cannot be downscaled by {downscale}; lower --downscale"
            )


def _fitting_downscale(root: Path, views: Sequence[CapturedView], most_across: int) -> int:
    """Return the least factor that makes no picture longer than `most_across` pixels; print it."""
    longest = max(max(view.width, view.height) for view in views)
    factor = -(-longest // most_across)
    notice(f"{root}: {longest} pixels across: --downscale {factor} (auto: {most_across} at most for the preset)")
    return factor


def _load(
    root: Path,
    capture: Capture,
    mask_files: list[MaskFile | None],
    cache_dir: Path,
    downscale: int,
    progress: bool,
    check_clip: Callable[[Clip, Mapping[str, Path]], object],
) -> Dataset:
    views = capture.views
    frames, times, clip, video_start_s = _times(root, capture)
    films = {view.file.relative_to(root).as_posix(): Film(view.file, view.clock) for view in views if view.video}
    films |= capture.films
    check_clip(clip, {name: film.file for name, film in films.items()})
    view_of = np.repeat(np.arange(len(views)), [len(some) for some in frames])  # the view of each picture
    used = [(some.start, some.stop) for some in frames]
    key = hashlib.sha256(os.fsencode(f"{root.resolve()} {downscale} {used}")).hexdigest()[:12]
    path = cache_dir / f"pixels-{key}"
    with exclusive(path.with_suffix(".lock")):
        cache = cached_pixels(root, views, frames, path, downscale, progress)
        masks = load_masks(root, views, mask_files, cache_dir / f"pixels-{key}-masks.bin", downscale, progress)
    intrinsics = np.array([v.intrinsics for v in views])[view_of] / downscale
    distortion = np.array([v.distortion for v in views])[view_of]
    is_fisheye = np.array([v.is_fisheye for v in views])[view_of]
    poses = np.stack([v.camera_to_world for v in views])[view_of]
    files = tuple(valid_unicode(views[v].file.relative_to(root).as_posix()) for v in view_of)
    camera, first = _distinct(
        np.concatenate([poses.reshape(-1, 16), intrinsics, distortion, is_fisheye[:, None]], axis=1)
    )
    pictures = Pictures(
        file=files,
        camera=camera,
        time=times.astype(np.float32),
        is_test=np.array([v.is_test for v in views])[view_of],
        offset=np.array([t.offset for t in cache.tiles], np.int64),
        width=np.array([t.width for t in cache.tiles], np.int32),
        height=np.array([t.height for t in cache.tiles], np.int32),
        intrinsics=intrinsics,
        distortion=distortion,
        is_fisheye=is_fisheye,
        camera_to_world=poses,
        near=np.array([v.near for v in views], np.float32)[view_of],
        far=np.array([v.far for v in views], np.float32)[view_of],
    )
    names = _camera_names([views[view_of[p]].camera for p in first], [Path(files[p]).stem for p in first])
    if masks is not None and not masks.counts[~pictures.is_test].any():
        raise DatasetError(
            f"{root}: its masks ignore every pixel to train on (0 means ignored); invert the masks or remove them"
        )
    is_dynamic = clip.frame_count > 1
    return Dataset(
        capture.layout,
        root,
        pictures,
        cache,
        clip,
        is_dynamic,
        cache.channels == 4,
        names,
        masks,
        video_start_s=video_start_s,
        downscale=downscale,
        clocks={view.file.relative_to(root).as_posix(): view.clock for view in views if view.video},
        poses_found=capture.poses_found,
        films=films,
    )


def _times(root: Path, capture: Capture) -> tuple[tuple[range, ...], np.ndarray, Clip, float | None]:
    """Return the frames of each view that are used, the time of each of these pictures in [0, 1], the clip, and when it
    begins in the seconds of the videos; None for images.

    Videos are aligned by `timeline.align`. The time of an image is the dataset's if all are within [0, 1], else shifted
    and scaled to [0, 1]; the frame count of their clip is the dataset's, or follows from the median step between times
    of training images.
    """
    videos = {_name(root, capture, view): in_step(view.video, view.clock) for view in capture.views if view.video}
    if videos:
        _report_notes(root, videos)
        timeline = align(root, videos)
        return timeline.frames, np.concatenate(timeline.times), timeline.clip, timeline.start_s
    still = (range(1),) * len(capture.views)
    given = [view.time for view in capture.views]
    if all(time is None for time in given):
        return still, np.zeros(len(given)), Clip(1, ASSUMED_FPS), None
    if any(time is None or not math.isfinite(time) for time in given):
        number = next(k for k, time in enumerate(given) if time is None or not math.isfinite(time))
        name = capture.views[number].file.name
        raise DatasetError(
            f"{root}: {name} has no valid time while other images have one; give every image a time, or none"
        )
    times = np.array(given, np.float64)
    low, high = times.min(), times.max()
    if low < 0 or high > 1:
        notice(f"{root}: times run from {low:g} to {high:g}; scaled to [0, 1]")
        times = (times - low) / (high - low) if high > low else np.zeros_like(times)
    clip = Clip(capture.frame_count or 1, float(capture.fps or ASSUMED_FPS))
    if capture.frame_count is not None:
        return still, times, clip, capture.start_s
    steps = np.diff(np.unique(np.round(times[[not view.is_test for view in capture.views]], 6)))
    count = min(1 + round(1 / float(np.median(steps))), len(times)) if len(steps) else 1
    return still, times, replace(clip, frame_count=count), None


def _camera_names(given: Sequence[str | None], stems: Sequence[str]) -> tuple[str, ...]:
    """Return the names of cameras: those that are given, or, where several have the same or none, those of files."""
    counts = Counter(given)
    return tuple(
        valid_unicode(name if name and counts[name] == 1 else stem) for name, stem in zip(given, stems, strict=True)
    )


def _name(root: Path, capture: Capture, view: CapturedView) -> str:
    """Return the name of a view's file, with its folders if another has the same."""
    is_own = sum(other.file.name == view.file.name for other in capture.views) == 1
    return view.file.name if is_own else view.file.relative_to(root).as_posix()


def _report_notes(root: Path, videos: dict[str, VideoInfo]) -> None:
    """Print one line for each thing that a user should know about how videos are read."""
    for note in dict.fromkeys(note for video in videos.values() for note in video.notes):
        names = [name for name, video in videos.items() if note in video.notes]
        notice(f"{root}: {first_names(names)}: {note}")
    timecodes = {video.timecode: name for name, video in videos.items() if video.timecode}
    if len(timecodes) > 1:
        shown = [f"{name} at {timecode}" for timecode, name in sorted(timecodes.items())]
        notice(
            f"{root}: videos begin at different timecodes ({first_names(shown)}), but are aligned by their times of "
            "presentation; if the timecodes are right, cut the videos to begin at the same one"
        )


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number distinct rows in order of first appearance: (P,) int32 numbers, and the first row of each number."""
    _, first, inverse = np.unique(np.round(rows, 9), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[inverse.ravel()].astype(np.int32), first[order]
