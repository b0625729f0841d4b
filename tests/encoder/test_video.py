"""Videos decode to their original colours, the right way up; what would be shown wrong is refused in one line."""

import os
from pathlib import Path

import numpy as np
import pytest

import videos as make
from kpc.encoder.datasets.video import read_video, video_info
from kpc.format.common.errors import MediaError
from kpc.format.common.films import write_video
from kpc.format.common.images import read_image
from videos import PATCH, colour_tolerance, copy, ffmpeg, film, patches, psnr

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"

# Filters that make a frame from the fields of two.
TOP_FIRST = ("-vf", "tinterlace=interleave_top,setfield=tff")
BOTTOM_FIRST = ("-vf", "tinterlace=interleave_bottom,setfield=bff")


def colours() -> np.ndarray:
    """Return 4 x 8 patches of uniform colour, uint8 (64, 128, 3), with black, white and the primaries."""
    found = np.random.default_rng(1).integers(0, 256, (4, 8, 3), dtype=np.uint8)
    found[0, :5] = [(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 0), (0, 0, 255)]
    return found.repeat(PATCH, 0).repeat(PATCH, 1)


def centres(frame: np.ndarray) -> np.ndarray:
    """Return the colours at the centres of the patches."""
    return frame[PATCH // 2 :: PATCH, PATCH // 2 :: PATCH].astype(float)


def encode(
    path: Path, raw: bytes, pix_fmt: str, *, matrix: str | None, full: bool | None, codec: str = "ffv1", frames: int = 1
) -> None:
    """Write a lossless video of raw planes with the given tags, without conversion."""
    tags = [f"colorspace={'smpte170m' if matrix == 'bt601' else matrix}"] if matrix else []
    tags += [f"range={'pc' if full else 'tv'}"] if full is not None else []
    filters = ["-vf", "setparams=" + ":".join(tags)] if tags else []
    filters += ["-color_range", "pc" if full else "tv"] if full is not None else []
    lossless = ["-qp", "0"] if codec == "libx264" else []
    source = ["-f", "rawvideo", "-pix_fmt", pix_fmt, "-s", "128x64", "-r", "10", "-i", "pipe:"]
    ffmpeg(*source, *filters, "-c:v", codec, *lossless, path, frames=raw * frames)


def refused(path: Path, *words: str) -> None:
    """Assert that reading raises a one-line error that names the file and contains all these words."""
    with pytest.raises(MediaError) as caught:
        list(read_video(path))
    message = str(caught.value)
    assert "\n" not in message and message.startswith(f"{path}: ")
    assert all(word in message for word in words), message


@pytest.mark.parametrize("matrix", ["bt601", "bt709"])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv444p", "yuv420p10le", "yuv444p12le"])
def test_tags_are_honoured(tmp_path: Path, matrix: str, full: bool, pix_fmt: str) -> None:
    rgb = colours()
    bits = int(pix_fmt[7:9]) if pix_fmt.endswith("le") else 8
    path = tmp_path / "tagged.mkv"
    encode(path, make.yuv(rgb, matrix, full, bits, "420" in pix_fmt), pix_fmt, matrix=matrix, full=full)
    info = video_info(path)
    assert (info.matrix, info.full_range, info.pix_fmt, info.width, info.height) == (matrix, full, pix_fmt, 128, 64)
    (frame,) = read_video(path)
    assert np.abs(centres(frame) - centres(rgb)).max() <= colour_tolerance(matrix, full, bits)


@pytest.mark.parametrize("matrix, full", [("bt601", True), ("bt709", False)])
def test_tags_of_h264_are_honoured(tmp_path: Path, matrix: str, full: bool) -> None:
    rgb = colours()
    raw = make.yuv(rgb, matrix, full, 8, True)
    encode(tmp_path / "x.mp4", raw, "yuv420p", matrix=matrix, full=full, codec="libx264", frames=3)
    frames = list(read_video(tmp_path / "x.mp4"))
    assert len(frames) == 3
    for frame in frames:
        assert np.abs(centres(frame) - centres(rgb)).max() <= colour_tolerance(matrix, full, 8)


def test_untagged_small_video_is_limited_bt601(tmp_path: Path) -> None:
    rgb = colours()
    encode(tmp_path / "x.mkv", make.yuv(rgb, "bt601", False, 8, False), "yuv444p", matrix=None, full=None)
    info = video_info(tmp_path / "x.mkv")
    assert (info.matrix, info.full_range) == ("bt601", False)
    (frame,) = read_video(tmp_path / "x.mkv")
    assert np.abs(centres(frame) - centres(rgb)).max() <= colour_tolerance("bt601", False, 8)


@pytest.mark.parametrize("height, matrix", [(718, "bt601"), (720, "bt709")])
def test_untagged_matrix_by_size(tmp_path: Path, height: int, matrix: str) -> None:
    ffmpeg(
        "-f",
        "lavfi",
        "-i",
        f"color=s=16x{height}:d=0.1:r=10",
        "-c:v",
        "ffv1",
        "-pix_fmt",
        "yuv420p",
        tmp_path / "x.mkv",
    )
    assert video_info(tmp_path / "x.mkv").matrix == matrix


def test_full_range_jpeg_formats(tmp_path: Path) -> None:
    film(tmp_path / "x.avi", "-c:v", "mjpeg", "-q:v", 1, "-pix_fmt", "yuvj420p")
    info = video_info(tmp_path / "x.avi")
    assert (info.pix_fmt, info.full_range, info.matrix) == ("yuvj420p", True, "bt601")
    assert make.numbers(list(read_video(tmp_path / "x.avi", info))) == list(range(12))


@pytest.mark.parametrize("curve, words", [("smpte2084", "HDR video (PQ)"), ("arib-std-b67", "HDR video (HLG)")])
def test_hdr_is_refused(tmp_path: Path, curve: str, words: str) -> None:
    film(tmp_path / "x.mkv", "-c:v", "ffv1", "-pix_fmt", "yuv420p10le", "-vf", f"setparams=color_trc={curve}")
    refused(tmp_path / "x.mkv", words, "tone-map")


@pytest.mark.parametrize("curve, words", [(8, "linear light"), (9, "logarithmic")])
def test_curves_far_from_that_of_television_are_refused(tmp_path: Path, curve: int, words: str) -> None:
    film(tmp_path / "a.mp4")
    copy(tmp_path / "a.mp4", tmp_path / "x.mp4", "-bsf:v", f"h264_metadata=transfer_characteristics={curve}")
    refused(tmp_path / "x.mp4", f"its transfer curve is {words}", "BT.709")


def test_wide_primaries_are_named(tmp_path: Path) -> None:
    film(tmp_path / "x.mp4", "-vf", "format=yuv444p,setparams=color_primaries=smpte432")
    assert video_info(tmp_path / "x.mp4").notes == ("colour primaries number 12 of H.273 are not converted",)


def test_two_views_in_one_picture_are_refused(tmp_path: Path) -> None:
    film(tmp_path / "x.mp4", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-x264-params", "frame-packing=3")
    refused(tmp_path / "x.mp4", "is stereoscopic", "split them into two videos")


@pytest.mark.parametrize(
    "projection, words", [(b"equi", "equirectangular"), (b"cbmp", "a cube map"), (b"mshp", None), (None, None)]
)
def test_projections_of_spherical_videos(tmp_path: Path, projection: bytes | None, words: str | None) -> None:
    """As in Google's Spherical Video V2: boxes within the description of an MP4's samples."""
    film(tmp_path / "flat.mp4")

    def box(kind: bytes, content: bytes) -> bytes:
        return (len(content) + 8).to_bytes(4, "big") + kind + content

    data = bytearray((tmp_path / "flat.mp4").read_bytes())
    if projection is not None:
        known = box(b"prhd", bytes(16)) + box(projection, bytes(20))
        added = box(b"sv3d", box(b"svhd", bytes(5)) + box(b"proj", known))
        entry = data.index(b"avc1", data.index(b"stsd")) - 4
        end = entry + int.from_bytes(data[entry : entry + 4], "big")
        data[end:end] = added
        for start in (
            entry,
            *(data.index(name) - 4 for name in (b"stsd", b"stbl", b"minf", b"mdia", b"trak", b"moov")),
        ):
            data[start : start + 4] = (int.from_bytes(data[start : start + 4], "big") + len(added)).to_bytes(4, "big")
    (tmp_path / "x.mp4").write_bytes(data)
    if words is None:
        assert video_info(tmp_path / "x.mp4").frame_count == 12
    else:
        refused(tmp_path / "x.mp4", f"its projection is {words}", "undistort")


def test_a_matrix_that_cannot_be_converted_is_refused(tmp_path: Path) -> None:
    film(tmp_path / "x.mkv", "-c:v", "ffv1", "-pix_fmt", "yuv444p", "-vf", "format=yuv444p,setparams=colorspace=ycgco")
    refused(tmp_path / "x.mkv", "colour matrix YCgCo")


@pytest.mark.parametrize("codec, pix_fmt", [("ffv1", "bgr0"), ("libx264rgb", "gbrp"), ("qtrle", "rgb24")])
def test_rgb_video_is_exact(tmp_path: Path, codec: str, pix_fmt: str) -> None:
    film(tmp_path / "x.mov", "-c:v", codec, *(["-qp", 0] if codec == "libx264rgb" else ["-pix_fmt", pix_fmt]), count=2)
    info = video_info(tmp_path / "x.mov")
    assert (info.pix_fmt, info.matrix) == (pix_fmt, "rgb")
    np.testing.assert_array_equal(list(read_video(tmp_path / "x.mov", info)), [patches(0), patches(1)])


@pytest.mark.parametrize("codec, pix_fmt", [("ffv1", "bgra"), ("prores_ks", "yuva444p10le")])
def test_alpha_is_read(tmp_path: Path, codec: str, pix_fmt: str) -> None:
    half = "format=rgba,geq=r='r(X,Y)':g='g(X,Y)':b='b(X,Y)':a='if(lt(X,32),255,64)'"
    film(tmp_path / "x.mov", "-c:v", codec, "-vf", half, "-pix_fmt", pix_fmt, "-strict", -2, count=2)
    info = video_info(tmp_path / "x.mov")
    first, _ = read_video(tmp_path / "x.mov", info)
    assert info.has_alpha and first.shape == (32, 64, 4)
    assert psnr(first[..., :3], patches(0)) > 35
    assert np.abs(first[..., 3].astype(int) - np.where(np.arange(64) < 32, 255, 64)).max() <= 1


def test_alpha_that_is_not_decoded_is_refused(tmp_path: Path) -> None:
    film(tmp_path / "x.webm", "-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p", "-vf", "format=yuva420p", count=2)
    refused(tmp_path / "x.webm", "alpha channel")


@pytest.mark.parametrize("turn", [90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
def test_display_rotation_is_applied(tmp_path: Path, turn: int, mirror: bool) -> None:
    """The encoded picture is turned back, so that the rotation tag makes it upright again."""
    restore = {90: "transpose=clock", 180: "hflip,vflip", 270: "transpose=cclock"}[turn]
    film(tmp_path / "x.mp4", "-vf", "hflip," * mirror + restore, count=2)
    tag = ("-display_rotation", turn, *(["-display_hflip"] if mirror else []))
    copy(tmp_path / "x.mp4", tmp_path / "y.mp4", before=tag)
    info = video_info(tmp_path / "y.mp4")
    assert (info.width, info.height) == (64, 32)
    if turn != 180 and mirror:
        pytest.skip("ffmpeg mirrors before it turns, and so needs another tag than this test's")
    assert make.numbers(list(read_video(tmp_path / "y.mp4", info)), 2) == [0, 1]


def test_slanting_rotation_is_refused(tmp_path: Path) -> None:
    copy(film(tmp_path / "x.mp4"), tmp_path / "y.mp4", before=("-display_rotation", 45))
    refused(tmp_path / "y.mp4", "no quarter turn", "45")


@pytest.mark.parametrize(
    "name, options",
    [
        ("x.mov", ("-vf", "tinterlace=interleave_top,setfield=tff", "-c:v", "prores_ks", "-flags", "+ilme+ildct")),
        (
            "x.ts",
            (
                "-vf",
                "tinterlace=interleave_top,setfield=tff",
                "-c:v",
                "mpeg2video",
                "-pix_fmt",
                "yuv422p",
                "-flags",
                "+ilme+ildct",
                "-q:v",
                1,
            ),
        ),
        ("x.mp4", ("-vf", "tinterlace=interleave_bottom", "-c:v", "libx264", "-x264-params", "bff=1", "-crf", 1)),
        (
            "y.mov",
            ("-vf", "tinterlace=interleave_bottom", "-c:v", "rawvideo", "-pix_fmt", "uyvy422", "-field_order", "bb"),
        ),
    ],
)
def test_interlaced_video_is_deinterlaced(tmp_path: Path, name: str, options: tuple[object, ...]) -> None:
    """Frame n is made from the fields of pictures 2n and 2n + 1. Deinterlaced, it shows the former and no combing."""
    path = film(tmp_path / name, *options)
    info = video_info(path)
    frames = list(read_video(path, info))
    assert info.interlaced and "deinterlaced" in info.notes[0] and len(frames) == info.frame_count == 6
    rows = slice(PATCH // 4, PATCH - PATCH // 4)  # away from the edges of patches
    for number, frame in enumerate(frames):
        assert np.abs(np.diff(frame[rows].astype(int), axis=0)).max() <= 12  # combing differs by up to 200
        assert psnr(frame[rows], patches(2 * number)[rows]) > 25


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    info = video_info(film(tmp_path / "x.mp4", "-vf", "setsar=4/3"))
    assert info.pixel_aspect == pytest.approx(4 / 3) and (info.width, info.height) == (64, 32)
    copy(tmp_path / "x.mp4", tmp_path / "y.mp4", before=("-display_rotation", 90))
    assert video_info(tmp_path / "y.mp4").pixel_aspect == pytest.approx(3 / 4)


def test_the_film_is_chosen_among_streams(tmp_path: Path) -> None:
    """A cover picture, sound and a second film are other streams than the one that is read."""
    path = film(tmp_path / "x.mp4")
    write_video(tmp_path / "other.mp4", [np.full((16, 16, 3), 90, np.uint8)] * 3, 10)
    ffmpeg("-i", path, "-frames:v", 1, tmp_path / "cover.png")
    cover = ("-i", tmp_path / "cover.png", "-i", path, "-map", 0, "-map", 1, "-c", "copy")
    ffmpeg(*cover, "-disposition:v:0", "attached_pic", tmp_path / "cover.mp4")
    sound = ("-f", "lavfi", "-i", "sine=d=1.5", "-i", path, "-map", 0, "-map", 1)
    ffmpeg(*sound, "-c:v", "copy", tmp_path / "sound.mov")
    ffmpeg("-i", path, "-i", tmp_path / "other.mp4", "-map", 0, "-map", 1, "-c", "copy", tmp_path / "two.mkv")
    for name in ("cover.mp4", "sound.mov", "two.mkv"):
        info = video_info(tmp_path / name)
        assert make.numbers(list(read_video(tmp_path / name, info))) == list(range(12))
        assert info.notes == (("2 video streams; the first is used",) if name == "two.mkv" else ())


def test_files_without_a_film(tmp_path: Path) -> None:
    ffmpeg("-f", "lavfi", "-i", "sine=d=0.2", tmp_path / "sound.mp4")
    refused(tmp_path / "sound.mp4", "no video, only audio")
    for name, content in {"empty.mp4": b"", "text.mp4": b"no video at all\n" * 50}.items():
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, "not a video that can be read")
    (tmp_path / "list.mp4").write_text(f"#EXTM3U\n#EXTINF:1,\n{film(tmp_path / 'x.ts')}\n#EXT-X-ENDLIST\n")
    refused(tmp_path / "list.mp4", "not a video that can be read")  # it must not lead to other files


def test_missing_videos_and_pipes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MediaError, match="no such file"):
        video_info(tmp_path / "none.mp4")
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(MediaError, match="not a regular file"):
        video_info(tmp_path / "pipe.mp4")


@pytest.mark.parametrize("name", ["good.mp4", "good.mkv", "good.avi"])
def test_videos_that_are_cut_off_say_how_many_frames_decode(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(0)
    write_video(tmp_path / "x.mp4", [rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for _ in range(12)], 10)
    data = copy(tmp_path / "x.mp4", tmp_path / name, "-movflags", "+faststart").read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) * 6 // 10])
    refused(tmp_path / name, "frames decode", "12" if name != "good.avi" else "of its")


def test_damage_inside_a_video(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "x.mp4"
    write_video(path, [rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for _ in range(12)], 10)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(8000) + data[len(data) // 2 + 8000 :])
    refused(path, "of its 12 frames decode")


def test_a_stream_that_changes_its_size_is_refused(tmp_path: Path) -> None:
    a = film(tmp_path / "a.ts", "-bf", 0)
    film(tmp_path / "b.ts", "-bf", 0, "-vf", "scale=32:16", "-output_ts_offset", 1.2)
    (tmp_path / "both.ts").write_bytes(a.read_bytes() + (tmp_path / "b.ts").read_bytes())
    refused(tmp_path / "both.ts", "frame 12 is 32x16, the first 64x32")


def test_a_stream_that_becomes_interlaced(tmp_path: Path) -> None:
    a = film(tmp_path / "a.ts", "-bf", 0)
    film(tmp_path / "b.ts", "-bf", 0, "-x264-params", "tff=1", "-output_ts_offset", 1.2)
    (tmp_path / "both.ts").write_bytes(a.read_bytes() + (tmp_path / "b.ts").read_bytes())
    info = video_info(tmp_path / "both.ts")
    frames = list(read_video(tmp_path / "both.ts", info))
    assert not info.interlaced and make.numbers(frames) == [*range(12), *range(12)]
    assert all(psnr(frame, patches(number)) > 40 for number, frame in enumerate(frames[:12]))  # as they are


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


def test_frames_are_chosen_by_number(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4")
    assert make.numbers(list(read_video(path, first=3, stop=7))) == [3, 4, 5, 6]
    assert video_info(path).frame_count == 12
