"""Read the dataset of an encode; of footage without poses, find the cameras and clocks first."""

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kpc.encoder.cli.grouped import options_of_group, spans_of
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.sound import check_sound, sound_of_span
from kpc.encoder.cli.work_folder import POSES
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.datasets.capture import holdout_flags
from kpc.encoder.datasets.loading import has_layout, layouts_of
from kpc.encoder.poses.footage import Footage, find_footage, videos_by_name
from kpc.encoder.poses.survey import frame_count
from kpc.encoder.poses.takes import frame_names
from kpc.format.common.errors import UsageError
from kpc.format.common.media_files import is_hidden, is_image, is_video
from kpc.format.common.text import notice
from kpc.format.scene.scene import Clip
from kpc.format.scene.sound import Sound

# The file beside found cameras that says what they were found from.
ASKED = "asked.json"
# The page that shows them.
PAGE = "cameras.html"


def read_dataset(options: Options) -> Dataset:
    """Decode the dataset that the options name.

    Cameras that were found are kept in the work folder, and not looked for again unless the footage or the
    options about it changed.

    Raises:
        DatasetError, MediaError: the dataset cannot be used, or its cameras cannot be found.
        UsageError: options about cameras are given, and so are the cameras; or the clip has no such groups or sound.
        TrainingError: the target size is too small for any scene.
    """
    _refuse_early(options)
    root, transforms = options.source, None
    if not has_layout(root) and _has_footage(root):
        file = options.work_dir / POSES / "transforms.json"
        changed = _what_changed(options, file)
        if changed is None:
            notice(f"cameras: those found before, {file}")
        else:
            _check_footage(options, find_footage(root))
            _find_poses(options, file, changed)
        # The frames of moving cameras lie in a folder beside the document.
        is_own = any(one.is_dir() for one in file.parent.iterdir())
        root, transforms = (file.parent if is_own else root), file

    def check(clip: Clip, videos: Mapping[str, Path]) -> None:
        check_target_size(options, clip)
        check_sound(options, videos, is_dynamic=clip.frame_count > 1)

    return load_dataset(
        root,
        options.cache_dir,
        holdout=options.holdout,
        downscale=options.downscale or 1,
        most_across=options.most_across,
        transforms=transforms,
        footage=None if transforms is None else options.source,
        check_clip=check,
    )


def check_folder(options: Options) -> None:
    """Refuse a folder that holds nothing to encode, or options that do not apply to it.

    Raises:
        DatasetError: it has neither a layout nor footage, or two videos have one name.
        UsageError, TrainingError: as for `read_dataset`.
    """
    if not _has_footage(options.source):
        layouts_of(options.source)
    elif not has_layout(options.source):
        videos_by_name(options.source)
    _refuse_early(options)


def check_target_size(options: Options, clip: Clip, sound: Sound | None = None) -> None:
    """Refuse a target size of which a group gets less than its header, index and sound take.

    Raises:
        UsageError: as for `spans_of`.
        TrainingError: the size is too small.
    """
    spans = spans_of(options, clip)
    if options.group_s is None:
        options.trade.check_size(sound)
        return
    for number in range(len(spans)) if options.only is None else [options.only]:
        options_of_group(options, number, spans).trade.check_size(sound_of_span(sound, spans[number], clip.fps))


def _refuse_early(options: Options) -> None:
    """Refuse options about footage without poses, of which a folder with poses would use none, and a target size that
    is too small for any scene.
    """
    options.trade.check_size(None)
    if (given := options.wishes.options_given()) and has_layout(options.source):
        raise UsageError(
            f"{', '.join(given)}: {options.source} has poses, so none are looked for; drop what is not used here, or "
            "give it to kpposes"
        )


def _has_footage(root: Path) -> bool:
    """Return whether a folder, or one of its folders, holds a video or an image."""
    if not root.is_dir():
        return False
    folders = [root, *(folder for folder in root.iterdir() if folder.is_dir() and not is_hidden(folder))]
    return any(is_video(file) or is_image(file) for folder in folders for file in folder.iterdir())


def _what_changed(options: Options, file: Path) -> str | None:
    """Return why cameras that were found before cannot be used again; None if they can."""
    try:
        before = json.loads((file.parent / ASKED).read_text())
    except (OSError, ValueError):
        before = None
    if not isinstance(before, dict) or not file.exists():
        return "has no poses"
    different = [name for name, value in _asked(options).items() if before.get(name) != value]
    return f"{different[0]} changed since the cameras were found" if different else None


def _asked(options: Options) -> dict[str, Any]:
    """Return what found cameras depend on: the files, and what the user says about them."""
    wishes = options.wishes
    given = wishes.sync.read_text(errors="replace") if isinstance(wishes.sync, Path) and wishes.sync.is_file() else ""
    files = [file for one in find_footage(options.source) for file in one.files]
    return {
        "--rig": wishes.rig,
        "--sync": [str(wishes.sync), given],
        "--distance": wishes.distance and list(wishes.distance),
        "--lens": wishes.lens,
        "the footage": [[str(file), file.stat().st_size, file.stat().st_mtime] for file in files],
    }


def _check_footage(options: Options, footage: tuple[Footage, ...]) -> None:
    """Refuse sound or held-out cameras that footage lacks, as far as is known before its cameras are found.

    Raises:
        UsageError, DatasetError: as for `check_sound` and `holdout_flags`.
    """
    root = options.source
    files = {file.relative_to(root).as_posix(): file for one in footage for file in one.files}
    names = list(files)
    if footage[0].video is not None:
        check_sound(options, files)
        for one in footage if options.wishes.rig != "still" else ():
            frames = frame_names(one.name if len(footage) > 1 else "", range(frame_count(one)))
            names += [f"{frame}.png" for frame in frames]
    holdout_flags(root, names, options.holdout, ())


def _find_poses(options: Options, file: Path, why: str) -> None:
    from kpc.encoder.cli.kpposes import report  # needs packages that other encodes do not
    from kpc.encoder.poses.document import write_document
    from kpc.encoder.poses.find import find_poses
    from kpc.encoder.poses.page import write_page

    notice(f"{options.source}: {why}; finding the cameras")
    found = find_poses(options.source, options.wishes)
    shutil.rmtree(file.parent, ignore_errors=True)
    file.parent.mkdir(parents=True)
    write_document(found, options.source, file)
    write_page(found, f"Cameras of {options.source.resolve().name}", file.parent / PAGE)
    (file.parent / ASKED).write_text(json.dumps(_asked(options)))
    print(report(found), file=sys.stderr)
