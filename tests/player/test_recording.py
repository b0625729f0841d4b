"""Videos that are being written: their frames, and that no call blocks."""

import contextlib
import time as clock
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kpc.encoder.datasets.video import read_video
from kpc.format.scene.rig import Rig
from kpc.player.app import recording
from kpc.player.app.filming import Filming
from kpc.player.app.path_follower import PathFollower
from kpc.player.app.recording import Recording, frames_due
from scenes import tiny_scene


def wait_for(video: Recording, seconds: float = 20.0) -> None:
    until = clock.monotonic() + seconds
    while not video.is_over and clock.monotonic() < until:
        clock.sleep(0.01)
    assert video.is_over


def frame(level: int, height: int = 30) -> np.ndarray:
    return np.full((height, 40, 3), level, np.uint8)


def test_frames_come_out_in_order(tmp_path: Path) -> None:
    video = Recording(tmp_path / "a.mp4", 10, (40, 30))
    for level in (20, 120, 220):
        assert video.take(frame(level))
    video.end()
    assert not video.take(frame(0)) and video.taken == 3 and video.duration_s == pytest.approx(0.3)
    wait_for(video)
    assert video.failure is None
    assert [round(float(f.mean()), -1) for f in read_video(tmp_path / "a.mp4")] == [20, 120, 220]


def test_a_full_queue_refuses_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "QUEUE_BYTES", 1)

    def slow(path: Path, frames: object, fps: float) -> None:
        for _ in frames:
            clock.sleep(0.2)

    monkeypatch.setattr(recording, "write_video", slow)
    video = Recording(tmp_path / "a.mp4", 10, (40, 30))
    started = clock.monotonic()
    taken = [video.take(frame(n)) for n in range(20)]
    assert clock.monotonic() - started < 0.1 and taken[:2] == [True, True] and sum(taken) <= 3
    assert not video.has_room and video.taken == sum(taken)
    video.close(5.0)
    assert video.is_over


def test_an_abandoned_video_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = Recording(tmp_path / "a.mp4", 10, (40, 30))
    video.take(frame(9))
    monkeypatch.setattr(video, "end", lambda: None)  # as if frames waited still
    video.close(0.2)
    assert video.is_over and "given up" in str(video.failure) and list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    video = Recording(tmp_path / "nowhere" / "a.mp4", 10, (40, 30))
    video.take(frame(9))
    video.end()
    wait_for(video)
    assert "nowhere" in str(video.failure)


def test_a_video_without_frames_is_reported(tmp_path: Path) -> None:
    video = Recording(tmp_path / "a.mp4", 10, (40, 30))
    video.end()
    wait_for(video)
    assert "no frames" in str(video.failure)


def test_the_camera_stays_where_a_film_of_its_path_fails(tmp_path: Path) -> None:
    """Before the first frame, which may take seconds, the window can show how to stop."""
    scene, follower, notices = tiny_scene(3), PathFollower(), []
    for time in (0.0, 1.0):
        follower.append(scene.cameras[0], time, playing=False)
    state = SimpleNamespace(
        follower=follower,
        playback=SimpleNamespace(playing=True, time=0.0),
        rig=Rig.of(scene),
        stream=SimpleNamespace(is_settled=True),
        notify_error=notices.append,
        reporting_errors=lambda folder: contextlib.nullcontext(),
    )
    view = SimpleNamespace(canvas=SimpleNamespace(size=(40, 30)), draw_still=lambda: None, pixels=lambda: frame(9))
    files = SimpleNamespace(folder=tmp_path, next_path=lambda suffix: tmp_path / "nowhere" / f"a{suffix}")
    filming = Filming(state, view, files)
    filming.start_or_stop(along_path=True)
    video = filming.recording
    for taken in (0, 0, 1):
        filming.update(0.0)
        assert video.taken == taken and follower.is_active
    wait_for(video)
    filming.update(0.0)
    assert not follower.is_active and filming.recording is None and "nowhere" in notices[0]


@pytest.mark.parametrize("frame_s", [1 / 200, 1 / 60, 1 / 30, 1 / 7])
def test_a_recording_has_the_right_duration(frame_s: float) -> None:
    taken = 0
    for elapsed in np.arange(0, 4, frame_s):
        due = frames_due(float(elapsed), 30, taken)
        assert due <= 30 * frame_s + 2
        taken += due
        assert abs(taken / 30 - elapsed) <= 1 / 30 + 1e-9
