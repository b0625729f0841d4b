"""The sound of an encode: the clearest track of a dataset's videos, the one that is named, or that of a file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from kpc.encoder.cli.options import Options
from kpc.encoder.cli.report import log
from kpc.encoder.coding.opus import encode_sound
from kpc.encoder.datasets import Dataset
from kpc.encoder.datasets.capture import printable
from kpc.encoder.datasets.sound_tracks import MEASURED_S, Clarity, clarity, clearest, has_sound, read_samples
from kpc.format.common.errors import UsageError
from kpc.format.common.text import agreeing
from kpc.format.container.clip_sound import sample_at
from kpc.format.container.groups import Span
from kpc.format.scene.sound import Sound


def find_sound(options: Options, dataset: Dataset) -> tuple[Sound | None, str]:
    """Return the coded sound of the clip, and the name of the file that it is from; without any, what --audio says.

    None for a static scene, for --audio none, and where no video has a sound.

    Raises:
        UsageError: there is no track of the name that --audio gives.
        MediaError: a file cannot be read.
    """
    wanted = options.audio
    if wanted == "none" or (wanted == "auto" and dataset.video_start_s is None):
        return None, wanted
    files = {name: film.file for name, film in dataset.films.items()}
    check_sound(options, files, is_dynamic=dataset.is_dynamic)
    if not dataset.is_dynamic:
        return None, wanted
    if wanted == "auto":
        path, why = _clearest(dataset, files)
    else:
        path, why = _named(wanted, files), "as given"
    if path is None:
        log(f"sound: none ({why})")
        return None, wanted
    samples = _samples(dataset, path)
    if samples is None:
        raise UsageError(f"--audio {wanted}: {path} has no sound in the {dataset.clip.total_s:.4g} s of the clip")
    sound = encode_sound(samples, options.audio_bitrate)
    size = sum(map(len, sound.packets))
    kind = "mono" if sound.channels == 1 else "stereo"
    log(
        f"sound: {printable(path.name)}, {kind}, {sound.duration_s:.4g} s, {size / sound.duration_s:,.0f} bytes a "
        f"second ({why})"
    )
    return sound, path.name


def check_sound(options: Options, videos: Mapping[str, Path], *, is_dynamic: bool = True) -> None:
    """Refuse a name of --audio that is neither that of a video nor of a sound file, before pictures are decoded.

    Args:
        options: of the encode.
        videos: of the clip, by their names; none of images.
        is_dynamic: whether anything is heard.

    Raises:
        UsageError: as for `find_sound`.
    """
    wanted = options.audio
    if wanted in ("auto", "none"):
        return
    if not is_dynamic:
        raise UsageError(f"--audio {wanted}: the scene is static, so nothing can be heard; drop it")
    path = _named(wanted, videos)
    if not has_sound(path):
        what = f"{path} has no sound track" if path in videos.values() else "no sound file, nor a video with one"
        raise UsageError(f"--audio {wanted}: {what}")


def sound_of_span(sound: Sound | None, span: Span, fps: float) -> Sound | None:
    """Return the sound of some frames of a clip (spec/kpc-format.md, "Groups")."""
    if sound is None:
        return None
    return sound.part(sample_at(span.start, fps), sample_at(span.count, fps))


def _samples(dataset: Dataset, path: Path, most_s: float = float("inf")) -> np.ndarray | None:
    offset_s, rate = next((film.clock for film in dataset.films.values() if film.file == path), (0.0, 1.0))
    start_s = ((dataset.video_start_s or 0.0) - offset_s) / rate
    return read_samples(path, start_s, min(dataset.clip.total_s, most_s))


def _clearest(dataset: Dataset, files: dict[str, Path]) -> tuple[Path | None, str]:
    """Return the video with the clearest track, and why."""
    found: dict[str, Clarity] = {}
    for name, path in files.items():
        samples = _samples(dataset, path, MEASURED_S)
        if samples is not None:
            found[name] = clarity(samples)
    best = clearest(found)
    if best is None:
        silent = agreeing(len(found), "the only track is silent", f"the tracks of all {len(found)} videos are silent")
        return None, silent if found else "no video has a sound track"
    one = found[best]
    level = f"{one.range_db:.0f} dB above its noise floor{', clipped' if one.is_clipped else ''}"
    among = f"the clearest of {len(found)} tracks, " if len(found) > 1 else "the only track, " if len(files) > 1 else ""
    return files[best], f"{among}{level}; --audio overrides"


def _named(wanted: str, files: Mapping[str, Path]) -> Path:
    for name, path in files.items():
        if wanted in (name, path.name, path.stem):
            return path
    path = Path(wanted)
    if path.is_file():
        return path
    known = ", ".join(printable(path.stem) for path in list(files.values())[:4])
    cameras = f"one of {known}{' ...' if len(files) > 4 else ''}, or " if files else ""
    raise UsageError(f"--audio {wanted}: neither a camera nor a file; give {cameras}a sound file, auto or none")
