"""Films have the codec, bits, alpha and colour tags that are asked for, and all their frames."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from kpc.encoder.datasets.video import read_video, video_info
from kpc.format.common import films
from kpc.format.common.errors import MediaError, UsageError
from kpc.format.common.films import CODECS, DEFAULT_CODECS, FilmFormat, ffmpeg_binary, write_film, write_video
from videos import colour_tolerance

WIDTH, HEIGHT = 65, 65  # SVT-AV1 takes no less than 64
NAMES = {"h264": "h264", "hevc": "hevc", "prores": "prores", "vp9": "vp9", "av1": "av1"}
BT709, LIMITED = 1, 1


def pictures(bits: int, with_alpha: bool) -> list[np.ndarray]:
    """Three grey pictures of which the right half is transparent."""
    kind = np.uint8 if bits == 8 else np.uint16
    found = []
    for level in (0.2, 0.5, 0.8):
        picture = np.full((HEIGHT, WIDTH, 3 + with_alpha), level * np.iinfo(kind).max).astype(kind)
        if with_alpha:
            picture[..., 3] = np.where(np.arange(WIDTH) < WIDTH // 2, np.iinfo(kind).max, 0)
        found.append(picture)
    return found


@pytest.mark.parametrize(
    ("suffix", "codec", "bits", "alpha"),
    [
        *((DEFAULT, None, None, False) for DEFAULT in DEFAULT_CODECS),
        (".mov", None, None, True),
        (".webm", None, None, True),
        (".mp4", "hevc", 10, False),
        (".mp4", "av1", 10, False),
        (".mov", "h264", 10, False),
        (".mkv", "vp9", 10, False),
    ],
)
def test_films_are_what_was_asked_for(
    tmp_path: Path, suffix: str, codec: str | None, bits: int | None, alpha: bool
) -> None:
    film = FilmFormat.of(suffix, codec, bits=bits, alpha=alpha)
    assert film.bits == (bits or film.bits) and film.has_alpha == alpha
    path = tmp_path / f"x{suffix}"
    assert write_film(path, pictures(film.bits, alpha), 12.5, film) == 3
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert context.codec.canonical_name == (codec or DEFAULT_CODECS[suffix]) and stream.average_rate == 12.5
        assert (context.width, context.height) == film.padded(WIDTH, HEIGHT)
        tags = context.color_primaries, context.color_trc, context.colorspace, context.color_range
        assert tags == (BT709, BT709, BT709, LIMITED)
        if codec is None and suffix == ".webm" and alpha:  # FFmpeg's own decoder leaves the alpha out
            decoder = av.CodecContext.create("libvpx-vp9", "r")
            frames = [frame for packet in container.demux(stream) for frame in decoder.decode(packet)]
        else:
            frames = list(container.decode(stream))
    assert len(frames) == 3
    assert frames[0].format.components[0].bits >= film.bits
    for frame, level in zip(frames, (0.2, 0.5, 0.8), strict=True):
        rgba = frame.to_ndarray(format="rgba").astype(int)
        assert abs(int(rgba[20, 20, 1]) - 255 * level) <= 3
        assert rgba[20, 20, 3] == 255 and rgba[20, 50, 3] == (0 if alpha else 255)


@pytest.mark.parametrize(
    ("suffix", "codec", "bits"),
    [(".mp4", "h264", 8), (".mp4", "h264", 10), (".mp4", "hevc", 10), (".mov", "prores", 10), (".mkv", "vp9", 10)],
)
def test_black_grey_and_white_have_the_luma_of_limited_range(
    tmp_path: Path, suffix: str, codec: str, bits: int
) -> None:
    """Y' = (219 E' + 16) 2^(bits - 8), ITU-R BT.709, section 3: 16 to 235 of 8 bits, 64 to 940 of 10 bits."""
    path, shades = tmp_path / f"x{suffix}", (0.0, 0.5, 1.0)
    kind = np.uint8 if bits == 8 else np.uint16
    frames = [np.full((64, 64, 3), round(shade * np.iinfo(kind).max), kind) for shade in shades]
    write_film(path, frames, 25, FilmFormat.of(suffix, codec, bits=bits))
    with av.open(str(path)) as container:
        lumas = [np.frombuffer(frame.planes[0], kind)[0] for frame in container.decode(video=0)]
    wanted = [(219 * shade + 16) * 2 ** (bits - 8) for shade in shades]
    np.testing.assert_allclose(lumas, wanted, atol=1)


@pytest.mark.parametrize(
    ("suffix", "words", "message"),
    [
        (".mp4", {"codec": "prores"}, "it holds h264, hevc, av1; prores goes into .mov, .mkv"),
        (".webm", {"codec": "h264"}, "it holds vp9, av1"),
        (".mp4", {"alpha": True}, "films with alpha are prores (.mov, .mkv), vp9 (.webm, .mkv)"),
        (".webm", {"alpha": True, "bits": 10}, "vp9 with alpha has 8 bits, not 10"),
        (".mov", {"bits": 8}, "prores has 10 bits, not 8"),
        (".mov", {"crf": 10}, "its quality is fixed"),
        (".mp4", {"crf": 52}, "0 to 51; not 52"),
    ],
)
def test_films_that_do_not_exist_are_refused(suffix: str, words: dict, message: str) -> None:
    with pytest.raises(UsageError) as error:
        FilmFormat.of(suffix, **words)
    assert message in str(error.value)


def test_a_lower_rate_factor_makes_a_larger_file(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    for name, codec in CODECS.items():
        if codec.crf is None:
            continue
        sizes = []
        for crf in (codec.crf[0] + 10, codec.crf[1] - 5):
            path = tmp_path / f"{name}{crf}{codec.suffixes[0]}"
            write_film(path, [noise] * 2, 10, FilmFormat.of(path.suffix, name, crf=crf))
            sizes.append(path.stat().st_size)
        assert sizes[0] > 1.5 * sizes[1], name


def test_sizes_are_padded_only_as_chroma_needs() -> None:
    assert FilmFormat.of(".mp4").padded(33, 17) == (34, 18)
    assert FilmFormat.of(".mov").padded(33, 17) == (34, 17)
    assert FilmFormat.of(".mov", alpha=True).padded(33, 17) == (33, 17)


@pytest.mark.parametrize("fps", [7.0, 15.0, 29.97, 120.0])
def test_written_videos_have_the_same_frames(tmp_path: Path, fps: float) -> None:
    """Every frame has its own grey level, so a dropped or repeated frame would be noticed."""
    greys = np.arange(20, 240, 20)
    frames = [np.full((32, 48, 3), g, np.uint8) for g in greys]
    assert write_video(tmp_path / "x.mp4", frames, fps, crf=1) == len(frames)
    info = video_info(tmp_path / "x.mp4")
    assert (info.frame_count, info.matrix, info.full_range, info.pix_fmt) == (len(frames), "bt709", False, "yuv420p")
    assert info.fps == pytest.approx(fps, rel=1e-3)
    means = [frame.mean() for frame in read_video(tmp_path / "x.mp4")]
    assert np.abs(np.array(means) - greys).max() <= colour_tolerance("bt709", False, 8)
    assert len(list(read_video(tmp_path / "x.mp4", stop=4))) == 4


def test_odd_sizes_are_padded_for_subsampled_chroma(tmp_path: Path) -> None:
    frame = np.full((15, 21, 3), 90, np.uint8)
    write_video(tmp_path / "even.mp4", [frame], 10)
    write_video(tmp_path / "odd.mp4", [frame], 10, pix_fmt="yuv444p")
    even, odd = video_info(tmp_path / "even.mp4"), video_info(tmp_path / "odd.mp4")
    assert (even.width, even.height) == (22, 16)
    assert (odd.width, odd.height) == (21, 15)


def test_names_that_look_like_options_or_urls(tmp_path: Path) -> None:
    for name in ("-y.mp4", "a:b.mp4", "50%d done.mp4", "concat:x.mp4"):
        write_video(tmp_path / name, [np.zeros((16, 16, 3), np.uint8)] * 2, 10)
        assert video_info(tmp_path / name).frame_count == 2


def test_failed_writing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(MediaError, match="no frames"):
        write_video(tmp_path / "x.mp4", [], 10)
    with pytest.raises(MediaError, match="frame 1"):
        write_video(tmp_path / "x.mp4", [np.zeros((16, 16, 3), np.uint8), np.zeros((8, 16, 3), np.uint8)], 10)
    with pytest.raises(MediaError, match="cannot write"):
        write_video(tmp_path / "x.mp4", [np.zeros((16, 16, 3), np.uint8)] * 5, 10, pix_fmt="no_such_format")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="a shell script stands in for ffmpeg")
def test_a_full_disk_is_an_error_whatever_ffmpeg_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As ffmpeg 5.1 does, whose exit code is 0 if the end of a file cannot be written."""
    script = tmp_path / "ffmpeg"
    script.write_text(
        '#!/bin/sh\nfor word; do case "$word" in file:*) film="${word#file:}" ;; esac; done\ncat > "$film"\n'
        'echo "av_interleaved_write_frame(): No space left on device" >&2\n'
    )
    monkeypatch.setattr(films, "ffmpeg_binary", lambda: str(script))
    script.chmod(0o755)
    with pytest.raises(MediaError, match=r"x\.mp4: No space left on device; make room"):
        write_video(tmp_path / "x.mp4", [np.zeros((16, 16, 3), np.uint8)], 10)
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_ffmpeg_is_that_of_the_path_or_the_wheel(monkeypatch: pytest.MonkeyPatch) -> None:
    wheel = SimpleNamespace(get_ffmpeg_exe=lambda: "/wheel/ffmpeg")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", wheel)
    monkeypatch.setattr(films.shutil, "which", lambda name: f"/path/{name}")
    assert ffmpeg_binary.__wrapped__() == "/path/ffmpeg"
    monkeypatch.setattr(films.shutil, "which", lambda name: None)
    assert ffmpeg_binary.__wrapped__() == "/wheel/ffmpeg"


@pytest.mark.parametrize("is_there", [False, True])
def test_no_ffmpeg_anywhere(monkeypatch: pytest.MonkeyPatch, is_there: bool) -> None:
    """The wheel may be missing, or have no binary for this system."""

    def none() -> str:
        raise RuntimeError("none")

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", SimpleNamespace(get_ffmpeg_exe=none) if is_there else None)
    monkeypatch.setattr(films.shutil, "which", lambda name: None)
    with pytest.raises(MediaError, match=r'apt install ffmpeg\) or pip install "kpc\[film\]"') as refused:
        ffmpeg_binary.__wrapped__()
    assert "\n" not in str(refused.value)
