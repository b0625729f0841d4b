"""The sound of a film: what is heard of the clip while it plays at its own speed."""

import wave
from pathlib import Path

import numpy as np

from kpc.format.common.errors import MediaError
from kpc.format.container.clip_sound import has_sound, parts_of
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.scene import Clip, Scene
from kpc.format.scene.sound import SAMPLE_RATE, Sound
from kpc.player.sound.opus import decode
from kpc.tools.rendering.shots import Shots

# Seconds by which the time of a frame may differ from that of a clip at its own speed: rounding of times.
TOLERANCE_S = 1e-3


def start_of(shots: Shots, clip: Clip) -> float | None:
    """Return when in the clip a film begins that plays it at its own speed, in seconds; None for any other film."""
    if shots.timeline.is_stopped:
        return None
    times = np.array([shots.time(number) for number in shots.numbers]) * clip.duration_s
    expected = np.minimum(times[0] + np.arange(len(times)) / shots.fps, clip.duration_s)
    return float(times[0]) if np.abs(times - expected).max() <= TOLERANCE_S else None


def write_sound(path: Path, loaded: Scene | GroupedScene, shots: Shots) -> str | None:
    """Write the sound of a film as WAV; return why it has none, if the scene has.

    Args:
        path: of the file, which exists afterwards if the film has sound.
        loaded: what is rendered.
        shots: the frames of the film.
    """
    if not (loaded.sound is not None if isinstance(loaded, Scene) else has_sound(loaded.groups)):
        return None
    start_s = start_of(shots, loaded.clip)
    if start_s is None:
        return "the film has no sound, since it does not play the clip at its own speed"
    first = round(start_s * SAMPLE_RATE)
    stop = first + round(len(shots) / shots.fps * SAMPLE_RATE)
    if isinstance(loaded, Scene):
        assert loaded.sound is not None
        parts: list[tuple[int, Sound | None]] = [(stop - first, loaded.sound.part(first, stop - first))]
    else:
        parts = list(parts_of(loaded.groups, first, stop))
    channels = max((sound.channels for _, sound in parts if sound is not None), default=0)
    if not channels:
        return None
    try:
        with wave.open(str(path), "wb") as written:
            written.setnchannels(channels)
            written.setsampwidth(2)
            written.setframerate(SAMPLE_RATE)
            for count, sound in parts:
                written.writeframes(_samples(count, sound, channels).tobytes())
    except MediaError as error:
        path.unlink(missing_ok=True)
        return f"the film has no sound: {error}"
    return None


def _samples(count: int, sound: Sound | None, channels: int) -> np.ndarray:
    """Return (count, channels) int16 of a sound, with silence after it."""
    found = np.zeros((count, channels), np.float32)
    if sound is not None:
        decoded = decode(sound)[:count]
        found[: len(decoded)] = decoded  # one channel is heard on both
    return np.rint(np.clip(found, -1, 1) * 32767).astype("<i2")
