"""Videos are aligned by presentation time over their common span, and each picture keeps its own time."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import datasets as make
from datasets import fails, load
from kpc.encoder.datasets import Dataset, timeline
from kpc.encoder.datasets.video import VideoInfo
from kpc.format.common.errors import DatasetError
from kpc.format.common.films import write_video
from kpc.format.scene.scene import Clip
from videos import copy, ffmpeg

ROOT = Path("rig")

CODING = ("-c:v", "libx264", "-crf", 1, "-pix_fmt", "yuv444p", "-video_track_timescale", 90000)


def video(times: np.ndarray, tick_s: float = 1e-6, fps: float | None = None) -> VideoInfo:
    """Return the properties of a video with these times in seconds; `fps` is what its container declares."""
    average = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 25.0
    return VideoInfo(64, 32, times, tick_s, fps or average, "yuv420p", "bt709", False, False, 1.0, False, True, ())


def even(count: int, fps: float, start: float = 0.0) -> VideoInfo:
    """Return a video of constant rate."""
    return video(start + np.arange(count) / fps)


def align(*videos: VideoInfo) -> timeline.Timeline:
    return timeline.align(ROOT, {f"cam{k}.mp4": found for k, found in enumerate(videos)})


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the only line that was printed, or an empty text."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) <= 1, lines
    return lines[0] if lines else ""


@pytest.mark.parametrize("fps", [12.0, 12.5, 24000 / 1001, 30000 / 1001, 31.3, 120.0])
@pytest.mark.parametrize("tick_s", [1 / 90000, 1e-3, 1 / 600])
def test_constant_rate_is_not_affected_by_rounding(
    fps: float, tick_s: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """The times and the clip are exactly those of numbered frames, also where a container rounds to milliseconds."""
    count = 1500
    rounded = np.rint(np.arange(count) / fps / tick_s) * tick_s
    found = align(even(count, fps), video(rounded, tick_s, fps))
    assert found.clip.frame_count == count and found.clip.fps == pytest.approx(fps, rel=1e-12)
    assert found.frames == (range(count), range(count)) and not said(capsys)
    for times in found.times:
        np.testing.assert_array_equal(times, np.arange(count) / (count - 1))


def test_the_rate_is_measured_where_the_container_declares_another(capsys: pytest.CaptureFixture[str]) -> None:
    """Gaps lower the average that containers declare."""
    kept = np.delete(np.arange(100), slice(40, 60))
    assert align(video(kept / 30.0)).clip == Clip(100, 30.0)
    assert timeline.frame_rate(video(np.rint(kept * 1e3 * 1001 / 60000) / 1e3, 1e-3)) == 60000 / 1001


def test_frames_missing_at_different_times(capsys: pytest.CaptureFixture[str]) -> None:
    kept = [np.delete(np.arange(30), slice(n, n + 5)) for n in (4, 20)]
    found = align(*(video(k / 12) for k in kept))
    assert found.clip == Clip(30, 12.0) and found.frames == (range(25), range(25))
    for times, numbers in zip(found.times, kept, strict=True):
        np.testing.assert_array_equal(times, numbers / 29)
    line = said(capsys)
    assert "lack frames at different times" in line and "0.25 s" in line and "50 of 50" in line


def test_late_starts_and_early_ends(capsys: pytest.CaptureFixture[str]) -> None:
    found = align(even(30, 10), even(30, 10, 0.7), even(20, 10, 0.4))
    assert found.clip == Clip(17, 10.0)
    assert found.frames == (range(7, 24), range(17), range(3, 20))
    for times in found.times:
        np.testing.assert_array_equal(times, np.arange(17) / 16)
    line = said(capsys)
    assert "start up to 0.7 s apart (cam1.mp4 last)" in line and "51 of 80" in line
    assert "10 before it and 19 after it are left out" in line


def test_fewer_frames_in_one_video(capsys: pytest.CaptureFixture[str]) -> None:
    assert align(even(30, 10), even(20, 10)).frames == (range(20), range(20))
    assert "videos have 20 (cam1.mp4) to 30 frames; the 40 of 50 in their common span are used" in said(capsys)


@pytest.mark.parametrize("slow, fast", [(25.0, 50.0), (30000 / 1001, 30.0), (24.0, 60.0)])
def test_different_rates(slow: float, fast: float, capsys: pytest.CaptureFixture[str]) -> None:
    found = align(even(round(10 * slow) + 1, slow), even(round(10 * fast) + 1, fast))
    assert found.clip.fps == fast and found.clip.duration_s == pytest.approx(10, abs=0.1)
    span = max((len(times) - 1) / fps for times, fps in zip(found.times, (slow, fast), strict=True))
    for times, fps in zip(found.times, (slow, fast), strict=True):
        np.testing.assert_allclose(times * span, np.arange(len(times)) / fps, atol=1.01e-2 / fast)
    line = said(capsys)
    assert f"run at {slow:.5g} (cam0.mp4) to {fast:.5g} fps (cam1.mp4)" in line


def test_offsets_within_half_a_frame_lose_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    found = align(even(20, 10), even(20, 10, 0.03), even(20, 10, 0.047))
    assert [len(frames) for frames in found.frames] == [20, 20, 20] and not said(capsys)
    assert found.clip == Clip(20, 10.0)
    offsets = [times[0] * 1.947 for times in found.times]  # the clip spans 19.47 frames
    np.testing.assert_allclose(offsets, [0, 0.03, 0.047], atol=1e-9)


def test_an_offset_of_half_a_frame_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    align(even(12, 10), even(12, 10, 0.05))
    assert "videos have 12 frames, half a frame apart; the 22 of 24 in their common span are used" in said(capsys)


def test_uneven_times_are_kept() -> None:
    n = np.arange(40)
    times = n / 30 + 0.01 * np.sin(1.7 * n)
    found = align(video(times), video(times))
    np.testing.assert_allclose(found.times[0], (times - times[0]) / np.ptp(times), atol=1e-2 / 39)
    assert found.clip.frame_count == round(np.ptp(times) * found.clip.fps) + 1
    assert found.clip.fps == pytest.approx(30, rel=0.05)


def test_single_frames_are_a_static_scene() -> None:
    found = align(even(1, 25), even(1, 25))
    assert found.clip.frame_count == 1 and [times.tolist() for times in found.times] == [[0.0], [0.0]]


@pytest.mark.parametrize("other", [even(10, 10, 5.0), video(np.array([0.0, 3.0, 6.0]))])
def test_no_time_in_common(other: VideoInfo) -> None:
    with pytest.raises(DatasetError, match=r"rig: videos have no time in common: cam.\.mp4 ends at .*; cut them"):
        align(even(10, 10, 1.0), other)


Change = Callable[[int, Path, Path], object]  # makes from the video of a camera, by its number, another


def changed(folder: Path, change: Change, frames: int = 12, suffix: str = ".mp4") -> Dataset:
    """Load a rig whose videos were changed."""
    rig = make.write_n3dv(folder / "original", frames=frames)
    (folder / "set").mkdir()
    shutil.copy(folder / "original" / "poses_bounds.npy", folder / "set")
    for number in range(len(rig)):
        change(number, folder / "original" / f"cam{number:02d}.mp4", folder / "set" / f"cam{number:02d}{suffix}")
    return load(folder / "set")


def largest_error(dataset: Dataset, moment: Callable[[float], float] = float) -> float:
    """Return the largest mean error of a picture from what its camera sees at its time."""
    return max(
        float(np.abs(dataset.pixels.picture(n).astype(float) - make.picture(dataset.camera(n), moment(time))).mean())
        for n, time in enumerate(dataset.pictures.time.tolist())
    )


def test_a_rig_cut_without_encoding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = changed(tmp_path, lambda number, source, path: copy(source, path, before=("-ss", 0.3)))
    assert (len(dataset.pictures), dataset.clip) == (3 * 9, Clip(9, make.FPS)) and not said(capsys)
    assert largest_error(dataset, lambda time: (3 + 8 * time) / 11) < 2


def test_a_rig_with_uneven_times(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pictures are as of their numbers, while their times are uneven."""
    timing = ("-vf", "settb=1/90000,setpts=N*11250+3000*sin(N*1.7)", "-fps_mode", "passthrough")
    uneven = (*timing, "-enc_time_base", "1/90000", *CODING)
    dataset = changed(tmp_path, lambda number, source, path: ffmpeg("-i", source, *uneven, path))
    n = np.arange(12)
    ticks = n * 11250 + np.trunc(3000 * np.sin(n * 1.7))
    expected = (ticks - ticks[0]) / np.ptp(ticks)
    np.testing.assert_allclose(dataset.pictures.time[:12], expected, atol=2e-2 / 11)
    assert len(dataset.pictures) == 36 and not said(capsys) and not dataset.is_monocular
    assert largest_error(dataset, lambda time: int(np.abs(expected - time).argmin()) / 11) < 2


def test_a_rig_that_drops_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def drop(number: int, source: Path, path: Path) -> None:
        first = 3 if number % 2 else 7
        kept = f"select='not(between(n,{first},{first + 2}))'"
        ffmpeg("-i", source, "-vf", kept, "-fps_mode", "vfr", *CODING, path)

    dataset = changed(tmp_path, drop)
    assert (len(dataset.pictures), dataset.clip) == (3 * 9, Clip(12, make.FPS))
    assert largest_error(dataset) < 2
    assert "lack frames at different times" in said(capsys)
    assert len(dataset.frame_range(0, 5).pictures) + len(dataset.frame_range(6, 11).pictures) == 3 * 9
    dataset.subsample_frames(6)


def test_an_interlaced_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = ("-vf", "tinterlace=interleave_top,setfield=tff", "-c:v", "prores_ks", "-flags", "+ilme+ildct")
    dataset = changed(tmp_path, lambda _, source, path: ffmpeg("-i", source, *fields, path), suffix=".mov")
    assert (len(dataset.pictures), dataset.clip.frame_count) == (18, 6)
    assert "cam00.mov, cam01.mov, cam02.mov: interlaced; deinterlaced" in said(capsys)
    assert largest_error(dataset, lambda time: 10 * time / 11) < 8  # a frame holds a field of the next picture, too


def test_a_rig_of_many_kinds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Containers round times differently; a rotation tag, sound, 10 bits and full range do not matter."""
    make.write_n3dv(tmp_path / "set", cameras=6, frames=6)
    ten_bits = ("-c:v", "libx265", "-x265-params", "log-level=none:lossless=1", "-pix_fmt", "yuv444p10le")
    full_range = ("-vf", "scale=out_color_matrix=bt601:out_range=full", "-pix_fmt", "yuvj444p")
    kinds = {
        "cam00 \u2013 gr\u00f6\u00dfe.MP4": ten_bits,
        "cam01.webm": ("-c:v", "libvpx-vp9", "-lossless", 1, "-pix_fmt", "yuv444p"),
        "cam02.mkv": ("-c:v", "ffv1"),
        "cam03.avi": (*full_range, "-c:v", "mjpeg", "-q:v", 1),
        "cam04.mov": ("-f", "lavfi", "-i", "sine=d=1", "-map", 1, "-map", 0, "-c:v", "copy"),
    }
    for name, options in kinds.items():
        source = tmp_path / "set" / f"{name[:5]}.mp4"
        ffmpeg("-i", source, *options, tmp_path / "set" / name)
        source.unlink()
    turned = tmp_path / "set" / "turned.mp4"
    ffmpeg("-i", tmp_path / "set" / "cam05.mp4", "-vf", "transpose=clock", "-c:v", "libx264", "-qp", 0, turned)
    copy(turned, tmp_path / "set" / "cam05.mp4", before=("-display_rotation", 90))
    turned.unlink()
    dataset = load(tmp_path / "set")
    assert (len(dataset.pictures), dataset.clip) == (36, Clip(6, make.FPS)) and not said(capsys)
    np.testing.assert_array_equal(dataset.pictures.time, np.tile(np.arange(6) / 5, 6).astype(np.float32))
    assert largest_error(dataset) < 3


def test_rates_that_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = make.write_n3dv(tmp_path / "set", frames=5)
    frames = (make.picture(rig[1], n / 8) for n in range(9))
    write_video(tmp_path / "set" / "cam01.mp4", frames, 16, crf=1, pix_fmt="yuv444p")
    dataset = load(tmp_path / "set")
    assert (len(dataset.pictures), dataset.clip) == (19, Clip(9, 16.0))
    assert largest_error(dataset) < 2 and "run at 8 (cam00.mp4) to 16 fps (cam01.mp4)" in said(capsys)
    assert not dataset.is_monocular and "monocular" not in dataset.describe()


def test_timecodes_that_differ_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def coded(_: int, source: Path, path: Path) -> None:
        copy(source, path, "-timecode", "01:00:00:05" if path.stem == "cam01" else "01:00:00:00")

    dataset = changed(tmp_path, coded, frames=6, suffix=".mov")
    assert len(dataset.pictures) == 18
    assert "begin at different timecodes" in said(capsys)


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    """Calibrated for what is shown, the stored pixels have another focal length across; else it is refused."""
    narrow = ("-vf", "scale=24:24,setsar=4/3", *CODING)
    dataset = changed(tmp_path, lambda _, source, path: ffmpeg("-i", source, *narrow, path), frames=2)
    rig = make.ring(3)
    np.testing.assert_allclose(dataset.pictures.intrinsics[0], [rig[0].fl_x * 0.75, rig[0].fl_y, 12, 12])
    stored = [make.look_at((3.0, 0.5 * k, 1.0), width=24) for k in range(3)]
    np.save(tmp_path / "set" / "poses_bounds.npy", make.poses_bounds(stored))
    fails(tmp_path / "set", "cam00.mp4", "not square", "scale it to 32x24")


def test_the_cache_depends_on_the_frames_that_are_used(tmp_path: Path) -> None:
    rig = make.write_n3dv(tmp_path / "set", frames=6)
    load(tmp_path / "set")
    (tmp_path / "set" / "cam02.mp4").unlink()
    write_video(tmp_path / "set" / "cam02.mp4", [make.picture(rig[2], n / 5) for n in range(4)], make.FPS, crf=1)
    dataset = load(tmp_path / "set")
    assert len(dataset.pictures) == 12 and largest_error(dataset, lambda time: 3 * time / 5) < 4
