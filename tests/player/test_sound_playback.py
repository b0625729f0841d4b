"""The sound of the player: samples of a clip, and a clip that follows the clock of a device."""

import threading
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.opus import encode_sound
from kpc.format.common.errors import FormatError, MediaError
from kpc.format.container.groups import Groups
from kpc.format.container.sources import open_source
from kpc.format.scene.scene import Clip
from kpc.format.scene.sound import SAMPLE_RATE
from kpc.player.app.controls import Playback
from kpc.player.sharing.file_server import Handler, serving
from kpc.player.sound import device
from kpc.player.sound.clip_samples import MISSING, ClipSamples
from kpc.player.sound.playback import AHEAD_S, APART_S, SoundPlayback
from sounds import decoded, scene_with_sound, sweep, write_clip_with_sound

pytest.importorskip("soundfile")

FRAME_S, PERIOD = 1 / 60, 480  # of the window, and frames that the device pulls at once
CLIP = Clip(301, 30.0)  # ten seconds


class Ramp:
    """Samples that are their own position."""

    notice = None

    def read(self, first: int, count: int) -> np.ndarray:
        return np.repeat(np.arange(first, first + count, dtype=np.float32)[:, None], 2, axis=1)

    def close(self) -> None:
        pass


class Bench:
    """A player's loop with a device, both of which run on a simulated clock.

    Args:
        rate: of the device's clock, 1 if it is right.
        latency_s: of the device.
    """

    def __init__(self, rate: float = 1.0, latency_s: float = 0.06, samples: object = None) -> None:
        self.time_s, self.rate, self.latency_s, self.pulled = 0.0, rate, latency_s, 0
        self.played: list[tuple[float, np.ndarray]] = []
        self.playback, self.stalls = Playback(CLIP), False
        self.sound = SoundPlayback(
            samples or Ramp(), CLIP.duration_s, open_device=self._open, now=lambda: self.time_s, starts_thread=False
        )

    def _open(self, pull: device.Pull) -> "Bench":
        self.pull = pull
        return self

    def close(self) -> None:
        self.pulled = -1

    def frame(self) -> None:
        """Show a frame, and let the device pull what it needs meanwhile."""
        self.time_s += FRAME_S
        while hasattr(self, "pull") and 0 <= self.pulled <= self.time_s * self.rate * SAMPLE_RATE:
            self.played.append((self.time_s, self.pull(PERIOD)))
            self.pulled += PERIOD
        clip_s = self.playback.clip.duration_s
        plays = self.playback.playing and self.playback.speed == 1 and not self.stalls
        later = self.playback.after(self.sound.advance(FRAME_S, self.playback.time * clip_s) if plays else FRAME_S)
        if not self.stalls:
            self.playback = later
        self.sound.follow(self.playback.time * clip_s, plays=plays, loops=self.playback.loop)
        while self.sound.fill():
            pass

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / FRAME_S)):
            self.frame()

    @property
    def apart_s(self) -> float:
        """How far the clip is from what is heard now."""
        _, samples = self.played[-1]
        end = (samples[-1, 0] + 1) / SAMPLE_RATE - self.latency_s
        pulled_s = (self.pulled / (self.rate * SAMPLE_RATE)) - self.time_s  # of it, what is not due yet
        length = self.playback.clip.duration_s
        return float((self.playback.time * length - (end - pulled_s) + length / 2) % length - length / 2)


@pytest.mark.parametrize("rate", [1.001, 0.999])
def test_the_clip_stays_with_a_device_whose_clock_is_off_for_ten_minutes(rate):
    bench = Bench(rate)
    bench.run(3.0)
    worst = 0.0
    for _ in range(600):
        bench.run(1.0)
        worst = max(worst, abs(bench.apart_s))
    assert worst < 0.04, worst
    heard_s = bench.pulled / SAMPLE_RATE
    assert abs(heard_s - bench.time_s) > 0.5  # what a clip that followed its own clock would be off by


def test_a_seek_a_pause_and_a_loop_keep_the_sound_with_the_clip():
    bench = Bench()
    for position in (0.7, 0.1, 0.95):  # the last comes round the end of the clip
        bench.playback.seek(position)
        bench.run(2.0)
        assert abs(bench.apart_s) < 0.03
    bench.playback.toggle()
    bench.frame()
    count = len(bench.played)
    bench.run(0.5)
    assert len(bench.played) > count and not any(samples.any() for _, samples in bench.played[count:])
    bench.playback.toggle()
    bench.run(1.0)
    assert abs(bench.apart_s) < 0.03


def test_a_loop_has_no_gap():
    bench = Bench()
    bench.run(12.0)
    heard = np.concatenate([samples[:, 0] for _, samples in bench.played])
    heard = heard[np.argmax(heard > 0) :]
    steps = np.diff(heard)
    assert np.isin(steps, (1, 1 - CLIP.duration_s * SAMPLE_RATE)).all() and (steps < 0).sum() == 1


def test_another_speed_and_a_clip_that_waits_are_silent():
    bench = Bench()
    bench.run(1.0)
    bench.playback.speed = 2.0
    bench.frame()
    count = len(bench.played)
    bench.run(0.5)
    assert not any(samples.any() for _, samples in bench.played[count:])
    bench.playback.speed, bench.stalls = 1.0, True
    time = bench.playback.time
    bench.run(1.0)
    assert bench.playback.time == time and not any(samples.any() for _, samples in bench.played[count:])
    bench.stalls = False
    bench.run(1.0)
    assert abs(bench.apart_s) < 0.03 and bench.played[-1][1].any()


def test_a_clip_that_ends_is_silent_afterwards():
    bench = Bench()
    bench.playback.loop = False
    bench.playback.seek(0.95)
    bench.run(2.0)
    assert not bench.playback.playing and not bench.played[-1][1].any()


def test_the_volume_is_that_of_what_is_heard():
    bench = Bench()
    bench.sound.set_volume(0.5)
    bench.run(1.0)
    assert bench.played[-1][1][0, 0] == pytest.approx(0.25 * round(4 * bench.played[-1][1][0, 0]))
    bench.sound.set_volume(0.0)
    bench.frame()
    assert not bench.played[-1][1].any()


def test_no_device_is_said_once_and_the_clip_plays_on():
    def refuse(pull: device.Pull) -> device.Device:
        raise MediaError(device.NO_DEVICE)

    bench = Bench()
    bench.sound = SoundPlayback(Ramp(), CLIP.duration_s, open_device=refuse)
    bench.run(1.0)
    assert bench.playback.time == pytest.approx(1.0 / CLIP.duration_s)
    assert bench.sound.notice == device.NO_DEVICE
    bench.sound.notice = None
    bench.run(0.1)
    assert bench.sound.notice is None


def test_a_file_that_cannot_be_read_ends_the_sound_but_not_the_clip():
    failed = threading.Event()

    class Broken(Ramp):
        def read(self, first: int, count: int) -> np.ndarray:
            failed.set()
            raise FormatError("chunk 7 (soun) is damaged")

    bench = Bench()
    bench.sound = SoundPlayback(Broken(), CLIP.duration_s, open_device=bench._open)
    bench.sound.follow(0.0, plays=True, loops=True)
    assert failed.wait(60)
    bench.sound._thread.join(60)
    assert bench.sound.notice == "chunk 7 (soun) is damaged"
    assert bench.sound.advance(0.1, 0.0) == 0.1
    bench.sound.close()


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[bytes, str, np.ndarray]:
    """Return a scene of 4 s with sound, a clip in two groups of it, and the samples of the scene."""
    sound = encode_sound(sweep(5.0)[:, None])
    path = tmp_path_factory.mktemp("clip") / "clip.kpc"
    write_clip_with_sound(path, sound)
    return scene_with_sound(sound, 0, 40), str(path), decoded(sound)[:, 0]


def test_samples_of_a_file_are_those_of_a_decoder_that_never_stopped(files):
    for file in files[:2]:
        samples = ClipSamples(Groups(file, in_parts=True))
        found = np.concatenate([samples.read(first, 24_000) for first in range(0, 4 * SAMPLE_RATE, 24_000)])
        assert np.abs(found[:, 0] - files[2][: len(found)]).max() < 0.005 and (found[:, 0] == found[:, 1]).all()
        for first in (0, 17, 100_000, 95_999, 150_001):  # after a seek
            error = np.abs(samples.read(first, 3000)[:, 0] - files[2][first : first + 3000])
            assert error.max() < 0.005, (file, first)
        assert not samples.read(4 * SAMPLE_RATE + 10, 100).any()


def test_sound_that_was_cut_off_with_its_group_is_missed_once(files):
    whole = Path(files[1]).read_bytes()
    samples = ClipSamples(Groups(whole[: len(whole) - 40], allow_partial=True, in_parts=True))
    bench = Bench(samples=samples)
    bench.sound.follow(0.0, plays=True, loops=True)
    assert bench.sound.fill() and bench.sound.notice is None
    assert bench.sound.fill() and bench.sound.fill() and bench.sound.notice == MISSING
    bench.sound.notice = None
    bench.run(2.0)  # so that the rest is asked for, too
    assert bench.sound.notice is None


@pytest.mark.parametrize("has_ranges", [True, False])
def test_samples_come_from_a_server_beside_the_planes(files, has_ranges):
    class Server(Handler):
        def send_head(self) -> object:
            if not has_ranges:
                del self.headers["Range"]
            return super().send_head()

    folder = Path(files[1]).parent
    (folder / "scene.kpc").write_bytes(files[0])
    with serving(folder, handler=Server) as url:
        for name in ("scene.kpc", "clip.kpc"):
            source = open_source(f"{url}/{name}")
            samples = ClipSamples(Groups(source, in_parts=True))
            assert np.abs(samples.read(100_000, 4000)[:, 0] - files[2][100_000:104_000]).max() < 0.005
            samples.close()
            source.close()


def test_the_system_has_a_device_or_says_that_it_has_none():
    pytest.importorskip("miniaudio")
    pulled = threading.Event()

    def pull(count: int) -> np.ndarray:
        pulled.set()
        return np.zeros((count, 2), np.float32)

    try:
        opened = device.SystemDevice(pull)
    except MediaError as error:
        assert str(error) == device.NO_DEVICE
    else:
        assert pulled.wait(60)
        opened.close()


def test_little_is_decoded_ahead():
    bench = Bench()
    bench.run(0.2)
    assert AHEAD_S * SAMPLE_RATE <= bench.sound._queue.waiting + 2 * PERIOD + SAMPLE_RATE * APART_S
    assert bench.sound._queue.waiting <= (AHEAD_S + 1) * SAMPLE_RATE
