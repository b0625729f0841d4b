"""Sound tracks of videos and sound files: which is the clearest, and the samples of a span of time.

Times count as those of pictures do (`kpc.encoder.datasets.video`), so that a sample belongs to the frame that is shown
while it is heard.
"""

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.audio.frame import AudioFrame
from av.audio.resampler import AudioResampler
from av.container import InputContainer

from kpc.encoder.datasets.containers import open_container
from kpc.encoder.datasets.time_stamps import MATROSKA, MP4
from kpc.format.common.errors import MediaError
from kpc.format.scene.sound import SAMPLE_RATE

# A step of the time stamps between frames from which on the samples are put anew, seconds; smaller ones are rounding.
GAP_S = 0.02

# How clear a track is is measured on at most this much of it, in windows of so many samples (50 ms).
MEASURED_S, WINDOW = 60.0, 2400
# The levels of signal and noise floor, as shares of the windows that are below.
SIGNAL, FLOOR = 0.95, 0.1
# Levels in dB of full scale: a track whose signal is below the first is silent, and windows below the second are not
# noise, but samples that a recorder left out.
SILENT_DB, NOTHING_DB = -60.0, -110.0
# A track is clipped if more than this share of its samples is as large as can be.
CLIPPED_SHARE, CLIPPED = 1e-3, 0.999


@dataclass(frozen=True)
class Clarity:
    """How clear a track is.

    Attributes:
        signal_db, floor_db: level of loud and of quiet windows, dB of full scale.
        is_clipped: whether it is overloaded.
    """

    signal_db: float
    floor_db: float
    is_clipped: bool

    @property
    def is_silent(self) -> bool:
        return self.signal_db < SILENT_DB

    @property
    def range_db(self) -> float:
        """Signal above the noise floor."""
        return self.signal_db - self.floor_db

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """A key by which clearer tracks are greater."""
        return not self.is_silent, not self.is_clipped, self.range_db


def clarity(samples: np.ndarray) -> Clarity:
    """Measure how clear a track is.

    Args:
        samples: (N, channels) float32, full scale 1.
    """
    mixed = samples[: int(MEASURED_S * SAMPLE_RATE)].mean(1)
    windows = mixed[: len(mixed) // WINDOW * WINDOW].reshape(-1, WINDOW) if len(mixed) >= WINDOW else mixed[None]
    levels = 20 * np.log10(np.maximum(np.sqrt((windows.astype(np.float64) ** 2).mean(1)), 1e-9))
    levels = levels[levels > NOTHING_DB]
    if not len(levels):
        return Clarity(-math.inf, -math.inf, False)
    signal, floor = np.quantile(levels, (SIGNAL, FLOOR))
    return Clarity(float(signal), float(floor), bool((np.abs(samples) >= CLIPPED).mean() > CLIPPED_SHARE))


def clearest(tracks: Mapping[str, Clarity]) -> str | None:
    """Return the name of the clearest track that is not silent; None if there is none."""
    heard = {name: found for name, found in tracks.items() if not found.is_silent}
    return max(heard, key=lambda name: heard[name].rank, default=None)


def read_samples(path: str | os.PathLike[str], start_s: float, duration_s: float) -> np.ndarray | None:
    """Return the sound of a file between two times, at SAMPLE_RATE.

    Args:
        path: a video or sound file.
        start_s: when to begin, on the file's own time line.
        duration_s: how long.

    Returns:
        (N, 1 or 2) float32, full scale 1: one channel if the file has one, else two. N ends with the track. None if
        the file has no sound in that span.

    Raises:
        MediaError: the file cannot be read.
    """
    try:
        with open_container(path) as container:
            if not container.streams.audio:
                return None
            return _read(container, start_s, round(duration_s * SAMPLE_RATE))
    except (av.FFmpegError, ValueError) as error:
        raise MediaError(f"{path}: its sound cannot be read ({error}); convert it or give --audio none") from error


def _read(container: InputContainer, start_s: float, count: int) -> np.ndarray | None:
    stream = container.streams.audio[0]
    channels = 1 if stream.codec_context.channels == 1 else 2
    samples, end = np.zeros((count, channels), np.float32), 0
    for position, block in _blocks(container, start_s, count, channels):
        first, last = max(position, 0), min(position + len(block), count)
        if first < last:
            samples[first:last] = block[first - position : last - position]
            end = max(end, last)
    return samples[:end] if end else None


def _blocks(container: InputContainer, start_s: float, count: int, channels: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield decoded blocks, each with the position of its first sample in the span; (n, channels) float32."""
    origin_s = 0.0 if container.format.name in (MP4, MATROSKA) else (container.start_time or 0) / av.time_base
    resampler: AudioResampler | None = None
    position, expected_s = 0, -math.inf
    frames = container.decode(container.streams.audio[0])
    while True:
        try:
            frame = next(frames, None)
        except av.FFmpegError:  # a packet that does not decode is heard as silence
            continue
        if frame is None:
            break
        at_s = expected_s if frame.pts is None or frame.time is None else frame.time - origin_s
        at_s = 0.0 if at_s == -math.inf else at_s
        if (at_s - start_s) * SAMPLE_RATE >= count:
            break
        if resampler is None or abs(at_s - expected_s) > GAP_S:
            for block in _resampled(resampler, None):
                yield position, block
                position += len(block)
            resampler = AudioResampler("flt", "mono" if channels == 1 else "stereo", SAMPLE_RATE)
            position = round((at_s - start_s) * SAMPLE_RATE)
        expected_s = at_s + frame.samples / frame.sample_rate
        frame.pts = None
        for block in _resampled(resampler, frame):
            yield position, block
            position += len(block)
    for block in _resampled(resampler, None):
        yield position, block
        position += len(block)


def _resampled(resampler: AudioResampler | None, frame: AudioFrame | None) -> Iterator[np.ndarray]:
    """Push a frame, or None at the end, and yield what comes out, (n, channels)."""
    for out in resampler.resample(frame) if resampler is not None else ():
        channels = len(out.layout.channels)
        yield out.to_ndarray().reshape(-1, channels)


def has_sound(path: Path) -> bool:
    """Return whether a file can be read and has a sound track."""
    try:
        with open_container(path) as container:
            return bool(container.streams.audio)
    except av.FFmpegError:
        return False
