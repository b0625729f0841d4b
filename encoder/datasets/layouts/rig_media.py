"""The videos or images of a calibrated rig, found by the names of its cameras.

Calibrations name cameras, but not their files. A camera's own are, in the first folder that has any,

* a video `NAME.mp4`, or a folder `NAME/` that holds one;
* a folder `NAME/` of images, one an instant, or a single image `NAME.png`.

Names may differ by what precedes a number and by its zeros: camera 1 is also `cam01`, `port_1` and `hd_1`. Of a longer
name of a file, a part that begins with `cam`, or one that is as long as a serial number, names the camera.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpc.encoder.datasets.capture import (
    HOLD_OUT_EVERY,
    Capture,
    CapturedView,
    first_names,
    holdout_flags,
    image_view,
    natural_key,
    printable,
    video_view,
    with_image_suffix,
)
from kpc.encoder.datasets.layouts.calibration import RigCamera
from kpc.encoder.datasets.left_out import media_in
from kpc.format.common.errors import DatasetError
from kpc.format.common.media_files import is_hidden, is_video
from kpc.format.common.text import agreeing, counted, notice

# What precedes the number of a camera in names of files.
_PREFIX = re.compile(r"(camera|cam|port|view|hd|vga|kinect|video)[-_ ]*", re.IGNORECASE)

# A principal point that is farther from the middle of a picture, as a share of its sides, is doubted.
FAR_OFF = 0.25

# Parts of names with at least so many characters are serial numbers.
_SERIAL = 4


@dataclass(frozen=True)
class Media:
    """What one camera filmed.

    Attributes:
        path: the video, the image, or the folder of images.
        names: by which it may be meant.
        images: in natural order; empty for a video.
    """

    path: Path
    names: tuple[str, ...]
    images: tuple[Path, ...] = ()


def read_rig(
    root: Path,
    layout: str,
    file: Path,
    cameras: Sequence[RigCamera],
    folders: Sequence[str],
    holdout: str | None,
    foregrounds: Sequence[str] = (),
) -> Capture:
    """Read the videos or images of a rig. Test pictures are those of the first camera, or of stills every eighth.

    Args:
        root: the dataset's folder.
        layout: its name.
        file: the calibration, for messages.
        cameras: as the calibration has them.
        folders: in which media are looked for, relative to the root, in this order.
        holdout: as for `holdout_flags`, or a camera's name.
        foregrounds: folders of masks that are 0 where the images show no foreground; the first that exists is read.

    Raises:
        DatasetError: the calibration is invalid, no camera has media, or it is unknown which belong to which.
        MediaError: a file cannot be read.
    """
    masks = next((root / folder for folder in foregrounds if (root / folder).is_dir()), None)
    media, found = _media(root, file, [camera.name for camera in cameras], folders, foregrounds if masks else ())
    used = sorted((c for c in cameras if c.name in media), key=lambda c: natural_key(c.name))
    missing = [camera.name for camera in cameras if camera.name not in media]
    if missing:
        notice(
            f"{file}: {len(missing)} of {counted(len(cameras), 'camera')} "
            f"{agreeing(len(missing), 'has no video or images and is', 'have no video or images and are')} left out: "
            f"{first_names(missing)}"
        )
    paths = [media[camera.name].path for camera in used]
    times = _times(root, [media[camera.name] for camera in used])
    is_still = not any(len(some) > 1 for some in times) and all(media[c.name].images for c in used)
    default = [k % HOLD_OUT_EVERY == 0 if is_still else k == 0 for k in range(len(used))]
    if holdout in media:
        holdout = str(media[holdout].path.relative_to(root))
    tests = holdout_flags(root, [str(path.relative_to(root)) for path in paths], holdout, default)
    views: list[CapturedView] = []
    for camera, some, is_test in zip(used, times, tests, strict=True):
        own = _views(camera, media[camera.name], some, is_test)
        views += own if masks is None else [_with_foreground(masks, view) for view in own]
    _report_centres(file, views)
    if masks is not None:
        without = [view.file.name for view in views if view.foreground is None]
        share = f"{len(without)} of {counted(len(views), 'picture')} {agreeing(len(without), 'has', 'have')}"
        lack = f"; {share} none: {first_names(without)}" if without else ""
        notice(f"{masks}: masks of the foreground; what they leave out is transparent{lack}")
    return Capture(layout, tuple(views), None, tuple(found))


def _media(
    root: Path, file: Path, names: Sequence[str], folders: Sequence[str], foregrounds: Sequence[str]
) -> tuple[dict[str, Media], list[Path]]:
    """Return the media of each camera, of one kind and from one folder, and all media there.

    Of folders and kinds that are there for equally many cameras the first is taken, images before videos where there
    are masks of foregrounds, which only images have.
    """
    prefers_images = bool(foregrounds)
    found: list[tuple[str, bool, dict[str, Media], list[Media]]] = []
    others, problem = [], None
    for folder in dict.fromkeys(folders):
        if not (root / folder).is_dir():
            continue
        entries = _entries(root / folder, {*folders, *foregrounds} if folder == "." else set())
        for is_film in (False, True) if prefers_images else (True, False):
            some = [entry for entry in entries if bool(entry.images) != is_film]
            try:
                matched = _matched(file, names, some)
            except DatasetError as error:
                matched, problem = {}, problem or error
            if matched:
                found.append((folder, is_film, matched, some))
            elif some and folder != ".":
                others.append(_described(is_film, folder))
    if not found:
        searched = " or ".join("the folder itself" if folder == "." else f"{folder}/" for folder in folders)
        raise problem or DatasetError(
            f"{file}: none of its {counted(len(names), 'camera')} ({first_names(names)}) has a video or images in "
            f"{searched}; name videos, or folders of images, after the cameras"
        )
    found.sort(key=lambda kind: (-len(kind[2]), kind[1] == prefers_images))  # stable: of equals the first
    folder, is_film, chosen, entries = found[0]
    others += [_described(film, name) for name, film, _, _ in found[1:]]
    if folder == ".":  # which may hold anything
        kept = {entry.path for entry in chosen.values()}
        strange = [
            entry.path.parent if entry.path.is_file() else entry.path for entry in entries if entry.path not in kept
        ]
        others += [path.name for path in dict.fromkeys(strange) if path != root]
        entries = list(chosen.values())
    if others:
        notice(f"{root}: {_described(is_film, folder)} are read; left out: {first_names(others)}")
    files = [image for entry in entries for image in (entry.images or (entry.path,))]
    return chosen, [*files, *(item for item in media_in(root / folder) if is_video(item) == is_film)]


def _described(is_film: bool, folder: str) -> str:
    return f"{'videos' if is_film else 'images'} in {'the folder itself' if folder == '.' else folder}"


def _entries(folder: Path, others: set[str]) -> list[Media]:
    """Return what may belong to a camera each: videos and images in a folder and in its folders but `others`."""
    entries = []
    for item in sorted(folder.iterdir(), key=lambda item: natural_key(item.name)):
        if is_hidden(item) or item.name in others:
            continue
        if item.is_dir():
            inside = sorted(media_in(item), key=lambda file: natural_key(file.name))
            films = [file for file in inside if is_video(file)]
            entries += [Media(f, (f.stem, item.name) if len(films) == 1 else (f.stem,)) for f in films]
            if images := tuple(file for file in inside if not is_video(file)):
                entries.append(Media(item, (item.name,), images))
    for file in sorted(media_in(folder), key=lambda file: natural_key(file.name)):
        entries.append(Media(file, (file.stem,), () if is_video(file) else (file,)))
    return entries


def _matched(file: Path, names: Sequence[str], entries: Sequence[Media]) -> dict[str, Media]:
    """Return the entry of each camera that has one: first those of the same name, then those that are alike.

    Raises:
        DatasetError: two entries are those of one camera, or the reverse.
    """
    likenesses: tuple[Callable[[str, str], bool], ...] = (
        lambda name, own: own == name,
        lambda name, own: _canonical(own) == _canonical(name),
        lambda name, own: any(_canonical(p) == _canonical(name) for p in _parts(own) if _PREFIX.match(p)),
        lambda name, own: len(name) >= _SERIAL and name in _parts(own),
    )
    matched: dict[str, Media] = {}
    owner: dict[Path, str] = {}
    for like in likenesses:
        left = [entry for entry in entries if entry.path not in owner]
        pairs = [(name, entry) for name in names if name not in matched for entry in left]
        for name, entry in pairs:
            if not any(like(name, own) for own in entry.names):
                continue
            if matched.setdefault(name, entry) is not entry:
                both = f"{matched[name].path.name} and {entry.path.name}"
                raise DatasetError(f"{file}: camera {printable(name)} may have filmed {printable(both)}; remove one")
            if owner.setdefault(entry.path, name) != name:
                both = f"{owner[entry.path]} and {name}"
                raise DatasetError(
                    f"{file}: cameras {printable(both)} may both have filmed {printable(entry.path.name)}; rename it"
                )
    return matched


def _canonical(name: str) -> str:
    """Return a name without what precedes its number, and a number without zeros in front."""
    bare = _PREFIX.sub("", name, count=1) if _PREFIX.match(name) else name
    return (bare.lstrip("0") or "0" if bare.isdecimal() else bare).casefold()


def _parts(name: str) -> list[str]:
    return re.split(r"[-_. ]+", name)


def _times(root: Path, media: Sequence[Media]) -> list[list[float | None]]:
    """Return the time of each image of each camera in [0, 1], or None of stills; a video has none.

    Images of the same number belong to one instant, if the last number in their names counts images up without large
    gaps; else they do by their order, of which there must then be as many for each camera.

    Raises:
        DatasetError: neither is the case.
    """
    counts = [len(item.images) for item in media]
    if max(counts) <= 1:
        return [[None] * max(count, 1) for count in counts]
    frames = [_frame_numbers(item.images) for item in media]
    if any(some is None for some in frames):
        if len(set(counts)) > 1:
            fewest, most = (media[counts.index(n)].path.name for n in (min(counts), max(counts)))
            raise DatasetError(
                f"{root}: {printable(fewest)} has {counted(min(counts), 'image')}, {printable(most)} {max(counts)}, "
                "and their names do not number the instants; name the images by their instants, such as 000000.jpg"
            )
        notice(
            f"{root}: the names of images do not number the instants, so that their order does: the first of each "
            "camera, the second of each, and so on"
        )
        frames = [list(range(count)) for count in counts]
    numbers = [number for some in frames if some is not None for number in some]
    first, last = min(numbers), max(numbers)
    return [[(number - first) / max(last - first, 1) for number in some or ()] for some in frames]


def _frame_numbers(images: Sequence[Path]) -> list[int] | None:
    """Return the last number in each name; None if they do not rise by about equal steps."""
    found = [re.findall(r"[0-9]+", image.stem[-64:]) for image in images]
    if not all(found):
        return None
    numbers = [int(some[-1][-15:]) for some in found]
    steps = np.diff(numbers)
    if len(steps) and (steps.min() <= 0 or numbers[-1] - numbers[0] > 2 * len(steps) * np.median(steps)):
        return None
    return numbers


def _views(camera: RigCamera, media: Media, times: Sequence[float | None], is_test: bool) -> list[CapturedView]:
    """Return the views of a camera: that of its video, or of each of its images."""
    where, lens, pose = camera.where, camera.lens, camera.camera_to_world
    if not media.images:
        return [replace(video_view(media.path, where, lens, pose, is_test), camera=camera.name)]
    return [
        replace(image_view(image, where, lens, pose, time=time, is_test=is_test), camera=camera.name)
        for image, time in zip(media.images, times, strict=True)
    ]


def _report_centres(file: Path, views: Sequence[CapturedView]) -> None:
    """Say in one line if a principal point is far from the middle, as that of a calibration for other pictures is."""
    for view in views:
        cx, cy = view.intrinsics[2] / view.width, view.intrinsics[3] / view.height
        if max(abs(cx - 0.5), abs(cy - 0.5)) > FAR_OFF:
            notice(
                f"{file}: the principal point of {printable(view.camera or '')} lies at {cx:.0%} of the width and "
                f"{cy:.0%} of the height of its pictures; if it was calibrated at another size, say so there"
            )
            return


def _with_foreground(masks: Path, view: CapturedView) -> CapturedView:
    """Return a view with the mask of its foreground, `masks/NAME/000000.png` or `masks/NAME.png`, if there is one."""
    if view.video is not None:
        return view
    image = view.file
    bare = masks / (Path(image.parent.name) / image.stem if view.time is not None else image.stem)
    mask = with_image_suffix(bare) or with_image_suffix(masks / image.parent.name / image.stem)
    return view if mask is None else replace(view, foreground=mask, has_alpha=True)
