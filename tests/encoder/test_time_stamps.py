"""The frames of a video are those that a player shows, at the times at which it shows them."""

from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.datasets.video import read_video, video_info
from kpc.format.common.errors import MediaError
from videos import B_FRAMES, copy, ffmpeg, film, numbers

# A phone's time stamps: each frame up to 0.3 frames early or late.
JITTER = ("-vf", "settb=1/90000,setpts=N*9000+2700*sin(N*1.7)+5000", "-enc_time_base", "1/90000")
PASS = ("-fps_mode", "passthrough")


def check(path: Path, shown: list[int], times: list[float], *notes: str, atol: float = 1e-4) -> None:
    """Assert which frames of `film` a video shows, when, and what is noted."""
    info = video_info(path)
    assert numbers(list(read_video(path, info))) == shown
    np.testing.assert_allclose(info.times, times, atol=atol)
    assert len(info.notes) == len(notes)
    assert all(words in note for words, note in zip(notes, info.notes, strict=True)), info.notes


def test_the_edit_list_of_a_cut_is_honoured(tmp_path: Path) -> None:
    """A cut between key frames hides frames from there on; the first that is shown comes when the cut says."""
    path = film(tmp_path / "x.mp4")
    for seconds, shown in ((0.35, range(4, 12)), (0.42, range(5, 12)), (0.5, range(5, 12))):
        copy(path, tmp_path / "cut.mp4", before=("-ss", seconds))
        check(tmp_path / "cut.mp4", list(shown), [n / 10 - seconds for n in shown])
    copy(path, tmp_path / "part.mp4", "-t", 0.4, before=("-ss", 0.35))
    info = video_info(tmp_path / "part.mp4")
    assert numbers(list(read_video(tmp_path / "part.mp4", info)))[:4] == [4, 5, 6, 7] and info.frame_count < 8


@pytest.mark.parametrize("name", ["x.mp4", "x.mkv"])
def test_frames_keep_uneven_times(tmp_path: Path, name: str) -> None:
    film(tmp_path / name, *JITTER, *PASS, *(["-video_track_timescale", 90000] if name == "x.mp4" else []))
    n = np.arange(12)
    check(tmp_path / name, list(n), list((n * 9000 + np.trunc(2700 * np.sin(n * 1.7)) + 5000) / 90000), atol=6e-4)


def test_gaps_and_late_starts_stay(tmp_path: Path) -> None:
    kept = [0, 1, 2, 3, 8, 9, 10, 11]
    film(tmp_path / "gap.mkv", "-vf", "select='not(between(n,4,7))'", "-fps_mode", "vfr")
    check(tmp_path / "gap.mkv", kept, [n / 10 for n in kept])
    path, everything = film(tmp_path / "x.mp4"), list(range(12))
    copy(path, tmp_path / "late.mp4", before=("-itsoffset", 0.5))
    check(tmp_path / "late.mp4", everything, [0.5 + n / 10 for n in everything])
    sound = ("-f", "lavfi", "-i", "sine=d=2", "-itsoffset", 0.5, "-i", path, "-map", 0, "-map", 1)
    ffmpeg(*sound, "-c:v", "copy", tmp_path / "late.mkv")
    check(tmp_path / "late.mkv", everything, [0.5 + n / 10 for n in everything], atol=2e-3)


@pytest.mark.parametrize("start", [0, 9000])
def test_clocks_of_transport_streams_start_anywhere(tmp_path: Path, start: int) -> None:
    """ffmpeg's own start at 1.4 s."""
    film(tmp_path / "x.ts", "-output_ts_offset", start)
    check(tmp_path / "x.ts", list(range(12)), [n / 10 for n in range(12)])


def test_times_below_zero_are_not_shown(tmp_path: Path) -> None:
    copy(film(tmp_path / "x.mp4"), tmp_path / "x.mkv", "-avoid_negative_ts", "disabled", before=("-ss", 0.35))
    check(tmp_path / "x.mkv", list(range(4, 12)), [n / 10 - 0.35 for n in range(4, 12)], "4 frames", atol=1e-3)


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_avi_has_no_presentation_times(tmp_path: Path, codec: str) -> None:
    film(tmp_path / "x.avi", "-c:v", codec, *B_FRAMES, "-q:v", 1, "-pix_fmt", "yuv420p")
    check(tmp_path / "x.avi", list(range(12)), [n / 10 for n in range(12)])


def test_bare_streams_have_no_times(tmp_path: Path) -> None:
    film(tmp_path / "x.h264")
    check(tmp_path / "x.h264", list(range(12)), [n / 25 for n in range(12)], "25 frames a second are assumed")


def test_hidden_frames_of_vp8_are_not_shown(tmp_path: Path) -> None:
    """Two passes make libvpx write alternate reference frames as packets of their own."""
    options = ("-c:v", "libvpx", "-auto-alt-ref", 1, "-lag-in-frames", 25, "-b:v", "9M", "-g", 60)
    log = ("-passlogfile", tmp_path / "log")
    repeat = ("-vf", "loop=3:12")
    film(tmp_path / "first.webm", *options, *log, *repeat, "-pass", 1)
    film(tmp_path / "x.webm", *options, *log, *repeat, "-pass", 2)
    check(tmp_path / "x.webm", [*range(12)] * 4, [n / 10 for n in range(48)])


def test_a_time_stamp_twice(tmp_path: Path) -> None:
    """The second of two frames with one time stamp is seen."""
    film(tmp_path / "x.mkv", "-c:v", "ffv1", "-vf", "settb=1/1000,setpts='if(eq(N,5),400,N*100)'", *PASS)
    shown = [n for n in range(12) if n != 4]
    check(tmp_path / "x.mkv", shown, [0.4 if n == 5 else n / 10 for n in shown], "1 frame has")


def test_a_recording_that_starts_between_key_frames(tmp_path: Path) -> None:
    data = film(tmp_path / "x.ts", "-g", 6, "-x264-params", "open-gop=1").read_bytes()
    (tmp_path / "x.ts").write_bytes(data[len(data) // 188 // 4 * 188 :])
    info = video_info(tmp_path / "x.ts")
    shown = numbers(list(read_video(tmp_path / "x.ts", info)))
    assert shown == list(range(shown[0], 12)) and shown[0] in (5, 6)
    assert len(info.notes) == 1 and "frames cannot be decoded without what came before" in info.notes[0]


def test_segments_of_a_stream_may_be_joined(tmp_path: Path) -> None:
    """Each segment begins to count its packets anew. Nothing is missing, though the demultiplexer marks packets."""
    options = ("-g", 4, "-bf", 0, "-f", "hls", "-hls_time", 0.4, "-hls_segment_filename", tmp_path / "s%d.ts")
    film(tmp_path / "x.m3u8", *options)
    (tmp_path / "x.ts").write_bytes(b"".join((tmp_path / f"s{k}.ts").read_bytes() for k in range(3)))
    check(tmp_path / "x.ts", list(range(12)), [n / 10 for n in range(12)])


def test_time_stamps_that_start_again_are_refused(tmp_path: Path) -> None:
    data = film(tmp_path / "x.ts").read_bytes()
    (tmp_path / "x.ts").write_bytes(data + data)
    with pytest.raises(MediaError, match=r"x\.ts: its time stamps go back by 1.1 s at frame 12.*split it"):
        video_info(tmp_path / "x.ts")


def test_time_stamps_that_jump_are_refused(tmp_path: Path) -> None:
    film(tmp_path / "x.mkv", "-vf", "setpts='PTS+gte(N,6)*100/TB'", *PASS)
    with pytest.raises(MediaError, match=r"x\.mkv: its time stamps jump by 100.1 s after frame 5; split"):
        video_info(tmp_path / "x.mkv")


def test_frames_at_other_times_than_their_packets_are_refused(tmp_path: Path) -> None:
    """A time stamp of decoding is none of presentation where frames are reordered."""
    copy(film(tmp_path / "x.mp4"), tmp_path / "x.mkv", "-bsf:v", "setts=pts=DTS:dts=DTS")
    with pytest.raises(MediaError, match=r"x\.mkv: frame 1 .*time stamps are wrong; encode it anew"):
        list(read_video(tmp_path / "x.mkv"))
