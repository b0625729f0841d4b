"""Videos with all colour tags decode to their original colours; damaged files raise MediaError."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from kpc.format.common import films, media
from kpc.format.common.errors import MediaError
from kpc.format.common.films import ffmpeg_binary, write_video
from kpc.format.common.images import read_image
from kpc.format.common.media import read_video, video_info

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"

# Kr and Kb of ITU-R BT.601 and BT.709.
LUMA = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}

# Side of a patch of uniform colour, pixels.
PATCH = 16


def patches(rng: np.random.Generator) -> np.ndarray:
    """Return 8 x 4 patches of uniform colour, uint8 (64, 128, 3), which chroma subsampling keeps away from edges."""
    colours = rng.integers(0, 256, (4, 8, 3), dtype=np.uint8)
    colours[0, :5] = [(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 0), (0, 0, 255)]
    return colours.repeat(PATCH, 0).repeat(PATCH, 1)


def centres(frame: np.ndarray) -> np.ndarray:
    """Return the colours at the centres of the patches."""
    return frame[PATCH // 2 :: PATCH, PATCH // 2 :: PATCH].astype(float)


def yuv(rgb: np.ndarray, matrix: str, full: bool, bits: int, subsampled: bool) -> bytes:
    """Return planar Y'CbCr of one frame by the equations of the recommendations."""
    kr, kb = LUMA[matrix]
    r, g, b = np.moveaxis(rgb / 255.0, -1, 0)
    y = kr * r + (1 - kr - kb) * g + kb * b
    cb, cr = (b - y) / (2 * (1 - kb)), (r - y) / (2 * (1 - kr))
    top, half = 2**bits - 1, 2 ** (bits - 1)
    luma = y * top if full else (16 + 219 * y) * 2 ** (bits - 8)
    chroma = [half + c * (top if full else 224 * 2 ** (bits - 8)) for c in (cb, cr)]
    if subsampled:
        chroma = [c[::2, ::2] for c in chroma]
    dtype = np.dtype("<u2") if bits > 8 else np.dtype("u1")
    return b"".join(np.clip(np.rint(p), 0, top).astype(dtype).tobytes() for p in (luma, *chroma))


def encode(
    path: Path, raw: bytes, pix_fmt: str, *, matrix: str | None, full: bool | None, codec: str = "ffv1", frames: int = 1
) -> None:
    """Write a lossless video of raw planes with the given tags, without conversion."""
    tags = [f"colorspace={'smpte170m' if matrix == 'bt601' else matrix}"] if matrix else []
    tags += [f"range={'pc' if full else 'tv'}"] if full is not None else []
    command = [
        ffmpeg_binary(),
        *"-v error -y -f rawvideo -pix_fmt".split(),
        pix_fmt,
        *"-s 128x64 -r 10 -i pipe:".split(),
    ]
    command += ["-vf", "setparams=" + ":".join(tags)] if tags else []
    command += ["-color_range", "pc" if full else "tv"] if full is not None else []
    command += ["-c:v", codec, *(["-qp", "0"] if codec == "libx264" else []), str(path)]
    subprocess.run(command, input=raw * frames, check=True, capture_output=True)


def tolerance(matrix: str, full: bool, bits: int) -> float:
    """Return the largest error of a decoded channel, in 8-bit levels.

    It is half a step of each of Y, Cb and Cr through the inverse matrix to the channel with the largest coefficients,
    half a level for rounding the result, and one level for the fixed-point arithmetic of swscale.
    """
    kr, kb = LUMA[matrix]
    steps_per_level = 2 ** (bits - 8)
    luma, chroma = (1.0, 1.0) if full else (255 / 219, 255 / 224)
    green = 2 * (kb * (1 - kb) + kr * (1 - kr)) / (1 - kr - kb)
    return 0.5 / steps_per_level * (luma + chroma * max(2 * (1 - kb), 2 * (1 - kr), green)) + 1.5


@pytest.mark.parametrize("matrix", ["bt601", "bt709"])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv444p", "yuv420p10le", "yuv444p10le"])
def test_tags_are_honoured(tmp_path: Path, matrix: str, full: bool, pix_fmt: str) -> None:
    rgb = patches(np.random.default_rng(1))
    bits = 10 if "10" in pix_fmt else 8
    path = tmp_path / "tagged.mkv"
    encode(path, yuv(rgb, matrix, full, bits, "420" in pix_fmt), pix_fmt, matrix=matrix, full=full)
    info = video_info(path)
    assert (info.matrix, info.full_range, info.pix_fmt, info.width, info.height) == (matrix, full, pix_fmt, 128, 64)
    (frame,) = read_video(path)
    assert np.abs(centres(frame) - centres(rgb)).max() <= tolerance(matrix, full, bits)


@pytest.mark.parametrize("matrix, full", [("bt601", True), ("bt709", False), ("bt601", False), ("bt709", True)])
def test_tags_of_h264_are_honoured(tmp_path: Path, matrix: str, full: bool) -> None:
    rgb = patches(np.random.default_rng(2))
    raw = yuv(rgb, matrix, full, 8, True)
    encode(tmp_path / "x.mp4", raw, "yuv420p", matrix=matrix, full=full, codec="libx264", frames=3)
    frames = list(read_video(tmp_path / "x.mp4"))
    assert len(frames) == 3
    for frame in frames:
        assert np.abs(centres(frame) - centres(rgb)).max() <= tolerance(matrix, full, 8)


def test_untagged_small_video_is_limited_bt601(tmp_path: Path) -> None:
    rgb = patches(np.random.default_rng(3))
    encode(tmp_path / "x.mkv", yuv(rgb, "bt601", False, 8, False), "yuv444p", matrix=None, full=None)
    info = video_info(tmp_path / "x.mkv")
    assert (info.matrix, info.full_range) == ("bt601", False)
    (frame,) = read_video(tmp_path / "x.mkv")
    assert np.abs(centres(frame) - centres(rgb)).max() <= tolerance("bt601", False, 8)


@pytest.mark.parametrize(
    "pix_fmt, tags, height, matrix",
    [
        ("yuv420p", "progressive", 719, "bt601"),
        ("yuv420p", "progressive", 720, "bt709"),
        ("yuv420p", "", 1080, "bt709"),
        ("yuv420p", "tv, smpte170m/unknown/unknown, progressive", 1080, "bt601"),
        ("yuv420p", "tv, bt709, progressive", 100, "bt709"),
        ("yuvj420p", "pc, bt470bg/unknown/unknown", 1080, "bt601"),
        ("yuv420p10le", "tv, bt2020nc/bt2020/bt709", 100, "bt2020"),
        ("gbrp", "pc, gbr/unknown/unknown", 100, "rgb"),
        ("rgb24", "", 100, "rgb"),
    ],
)
def test_matrix_from_the_log_of_ffmpeg(pix_fmt: str, tags: str, height: int, matrix: str) -> None:
    assert media._matrix(pix_fmt, tags, height) == matrix


def test_hdr_is_refused(tmp_path: Path) -> None:
    raw = yuv(patches(np.random.default_rng(3)), "bt709", False, 10, True)
    options = (
        "-v error -f rawvideo -pix_fmt yuv420p10le -s 128x64 -i pipe: -c:v ffv1 "
        "-vf setparams=color_trc=smpte2084:colorspace=bt2020nc:color_primaries=bt2020"
    )
    command = [ffmpeg_binary(), *options.split(), str(tmp_path / "x.mkv")]
    subprocess.run(command, input=raw, check=True, capture_output=True)
    with pytest.raises(MediaError, match="HDR"):
        video_info(tmp_path / "x.mkv")


def test_display_rotation_is_applied(tmp_path: Path) -> None:
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[:, :16] = 255
    write_video(tmp_path / "x.mp4", [rgb] * 2, 10, crf=1)
    rotate = [ffmpeg_binary(), *"-v error -display_rotation 90 -i".split(), str(tmp_path / "x.mp4")]
    rotate += ["-c", "copy", str(tmp_path / "y.mp4")]
    if subprocess.run(rotate, check=False, capture_output=True).returncode != 0:
        pytest.skip("this ffmpeg cannot write a rotation")
    info = video_info(tmp_path / "y.mp4")
    assert (info.width, info.height) == (32, 64)
    frame = next(read_video(tmp_path / "y.mp4"))
    assert {frame[:12].mean() > 200, frame[-12:].mean() > 200} == {True, False}


def test_rgb_video_is_exact(tmp_path: Path) -> None:
    rgb = patches(np.random.default_rng(4))
    encode(tmp_path / "x.mkv", rgb.tobytes(), "rgb24", matrix=None, full=None)
    (frame,) = read_video(tmp_path / "x.mkv")
    np.testing.assert_array_equal(frame, rgb)


@pytest.mark.parametrize(
    "rest, fps",
    [
        (", 29.97 fps, 30 tbr", 30000 / 1001),
        (", 23.98 fps", 24000 / 1001),
        (", 25 fps", 25),
        (", 12.5 fps", 12.5),
        (", 15 tbr", 15),
    ],
)
def test_frame_rate(rest: str, fps: float) -> None:
    assert media._fps(rest) == pytest.approx(fps, rel=1e-12)


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
    assert np.abs(np.array(means) - greys).max() <= tolerance("bt709", False, 8)
    assert len(list(read_video(tmp_path / "x.mp4", limit=4))) == 4


def test_odd_sizes_are_padded_for_subsampled_chroma(tmp_path: Path) -> None:
    frame = np.full((15, 21, 3), 90, np.uint8)
    write_video(tmp_path / "even.mp4", [frame], 10)
    write_video(tmp_path / "odd.mp4", [frame], 10, pix_fmt="yuv444p")
    even, odd = video_info(tmp_path / "even.mp4"), video_info(tmp_path / "odd.mp4")
    assert (even.width, even.height) == (22, 16)
    assert (odd.width, odd.height) == (21, 15)


def test_damaged_videos_are_media_errors(tmp_path: Path) -> None:
    good = tmp_path / "good.mp4"
    rng = np.random.default_rng(0)
    write_video(good, [rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for _ in range(12)], 10)
    data = good.read_bytes()
    for name, damaged in {
        "empty.mp4": b"",
        "text.mp4": b"no video at all\n" * 50,
        "head.mp4": data[:200],
        "cut.mp4": data[: len(data) * 6 // 10],
        "hole.mp4": data[: len(data) // 2] + bytes(8000) + data[len(data) // 2 + 8000 :],
    }.items():
        path = tmp_path / name
        path.write_bytes(damaged)
        with pytest.raises(MediaError, match=name) as caught:
            list(read_video(path))
        assert "\n" not in str(caught.value)


def test_missing_videos_and_pipes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MediaError, match="no such file"):
        video_info(tmp_path / "none.mp4")
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(MediaError, match="not a regular file"):
        video_info(tmp_path / "pipe.mp4")


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


def test_no_ffmpeg_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> str:
        raise RuntimeError("none")

    monkeypatch.setattr(films.shutil, "which", lambda name: None)
    monkeypatch.setattr(films.imageio_ffmpeg, "get_ffmpeg_exe", none)
    ffmpeg_binary.cache_clear()
    with pytest.raises(MediaError, match="install ffmpeg"):
        ffmpeg_binary()
    ffmpeg_binary.cache_clear()


@pytest.mark.skipif(not (DATA / "room").is_dir(), reason="shared/data is not here")
@pytest.mark.parametrize("name, psnr_db", [("room", 39.28), ("liam", 42.39)])
def test_real_videos_decode_with_the_psnr_of_their_readme(name: str, psnr_db: float) -> None:
    errors = []
    for k, frame in enumerate(read_video(DATA / name / "cam00.mp4")):
        truth = DATA / name / "gt" / f"cam00_f{k:03d}.png"
        if truth.exists():
            errors.append(np.mean((frame.astype(float) - read_image(truth)[..., :3]) ** 2))
    assert len(errors) >= 5
    assert 10 * np.log10(255**2 / np.mean(errors)) == pytest.approx(psnr_db, abs=0.01)
