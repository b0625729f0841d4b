"""Times, alpha, exposure and interruption of what kprender writes."""

import argparse
import itertools
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import kpc
from kpc.format.common.errors import MediaError, UsageError
from kpc.format.common.images import read_image
from kpc.format.container.clip_sound import LAST_SAMPLE, sample_at
from kpc.format.scene.scene import Clip
from kpc.player.app.camera_paths import CameraPath
from kpc.player.cpu import reference
from kpc.tools.cli import kprender
from kpc.tools.rendering import content, pictures, resuming
from kpc.tools.rendering.options import parser
from kpc.tools.rendering.resuming import RECORD
from kpc.tools.rendering.shots import rate_note, shots_of
from scenes import tiny_scene

SIZE = ("--size", "16x12", "--backend", "reference")
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def times(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The times of all pictures that are rendered, seconds."""
    seen: list[float] = []
    render = reference.render

    def record(scene: object, camera: object, time: float, **words: object) -> object:
        seen.append(time * 1.0)  # the clip lasts a second
        return render(scene, camera, time, **words)

    monkeypatch.setattr(reference, "render", record)
    return seen


@pytest.mark.parametrize(
    ("words", "numbers", "fps"),
    [
        ([], range(11), 10),
        (["--fps", 20], range(22), 20),
        (["--fps", 5], range(6), 5),
        (["--from", 0.3, "--to", 0.6], range(3, 6), 10),
        (["--from", 0.35], range(4, 11), 10),
        (["--fps", 20, "--from", 0.3, "--to", 0.5], range(6, 10), 20),
        (["--frames", "2-4"], range(2, 5), 10),
        (["--frames", "7"], range(7, 8), 10),
        (["--fps", 20, "--frames", "20-21"], range(20, 22), 20),
        (["--step", 3], range(0, 11, 3), 10),
        (["--orbit", 8, "--frames", "2-5"], range(2, 6), 10),
    ],
)
def test_time_is_continuous(
    run: Run, scene_file: Path, tmp_path: Path, times: list[float], words: list, numbers: range, fps: float
) -> None:
    """Frame n is at n / fps seconds and keeps its number as its name, whichever are rendered."""
    code, _, complaint = run(scene_file, *words, *SIZE, "-o", tmp_path / "out")
    assert code == 0, complaint
    assert sorted(p.stem for p in (tmp_path / "out").glob("*.png")) == [f"{number:04d}" for number in numbers]
    last = 7 if "--orbit" in words else fps
    assert times == pytest.approx([min(number / last, 1.0) for number in numbers])


@pytest.mark.parametrize(
    ("words", "frames", "rate"),
    [(["--fps", 20], 22, "20"), (["--step", 2], 6, "5"), (["--from", 0.5, "--fps", 30], 18, "30")],
)
def test_films_last_as_long_as_the_clip(
    run: Run, scene_file: Path, tmp_path: Path, words: list, frames: int, rate: str
) -> None:
    code, printed, _ = run(scene_file, *words, *SIZE, "-o", tmp_path / "x.mkv")
    assert code == 0 and f"{frames} frames at {rate} fps" in printed


@pytest.mark.parametrize(
    ("clip", "words", "rate", "note"),
    [
        (Clip(3, 0.4), [], 0.4, None),
        (Clip(3, 500.0), [], 240.0, "the clip's 500 fps are beyond 0.001 to 240; 240 fps are used"),
        (Clip(3, 500.0), ["--fps", "100"], 100.0, None),
        (Clip(1, 0.4), [], 1.0, None),
        (Clip(11, 1e300), [], 240.0, "the clip's 1e+300 fps are beyond 0.001 to 240; 240 fps are used"),
    ],
)
def test_a_clip_keeps_its_rate_or_a_line_says_so(clip: Clip, words: list[str], rate: float, note: str | None) -> None:
    options = parser().parse_args(["x.kpc", "-o", "x", *words])
    scene = replace(tiny_scene(4), clip=clip)
    shots = shots_of(scene, clip, options, is_film=True)
    assert shots.fps == rate and rate_note(clip, options) == note
    assert len(shots) >= 1 and 0 <= shots.time(shots.numbers[-1]) <= 1


def test_a_clip_that_hardly_moves_has_too_many_pictures() -> None:
    clip = Clip(1 << 24, 5e-324)  # the slowest that a file may have
    options = parser().parse_args(["x.kpc", "-o", "x"])
    with pytest.raises(UsageError, match="more than 100,000 pictures"):
        shots_of(replace(tiny_scene(4), clip=clip), clip, options, is_film=False)
    assert sample_at(clip.frame_count, clip.fps) == LAST_SAMPLE
    options = parser().parse_args(["x.kpc", "-o", "x", "--frames", "99998-100001"])
    assert len(shots_of(replace(tiny_scene(4), clip=clip), clip, options, is_film=False)) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--from", 2], "the last frame is at 1.00 s"),
        (["--to", "2s"], "the last frame ends at 1.10 s"),
        (["--from", 0.5, "--to", 0.4], "no frame lies"),
        (["--frames", "5-11"], "--frames 5-11: the last frame is 10"),
        (["--frames", "11"], "--frames 11: the last frame is 10"),
        (["--frames", "4-2"], "range of frames"),
        (["--frames", "4-6", "--from", 0.1], "--frames chooses frames"),
        (["--frames", "4-6", "--to", "0s"], "--frames chooses frames"),
        (["--diagnose", "both"], "'both' is neither static nor dynamic"),
        (["--time", 0.5, "--frames", "0-3"], "--time stops the clip"),
        (["--time", 0.5, "--from", 0.1, "--to", 0.3], "--time stops the clip"),
        (["--time", 0.5, "--fps", 60], "leave out --time or --fps"),
        (["--time", 0.5, "--step", 3], "leave out --time or --step"),
        (["--orbit", 4, "--fps", 60], "--fps: --orbit says how many pictures"),
        (["-o", ""], "the name is empty"),
        (["-o", "x.exr", "--depth", "--time", 0.5], "always hold the depth"),
        (["-o", "x.mp4", "--depth", "--matte"], "--depth: a film shows depth or --matte"),
        (["--step", 0], "--step"),
        (["--shutter", 1.5], "--shutter"),
        (["--quality", "fast"], "--quality fast: is of the gl backend"),
        (["--samples", 17], "--samples"),
        (["--background", "greenish"], "no colour"),
        (["--camera", 2], "cameras 0 to 1"),
        (["--crf", 10], "is for films"),
        (["--codec", "h264"], "is for films"),
        (["--background", "transparent", "--format", "jpg"], "no alpha"),
        (["--background", "transparent", "--dynamic-map"], "leave it out"),
        (["--background", "white", "--matte"], "leave it out"),
        (["-o", "x.exr", "--matte", "--time", 0], "channel A of --dynamic-only"),
        (["-o", "x.mp4", "--background", "transparent"], "films with alpha are prores (.mov, .mkv)"),
        (["-o", "x.mp4", "--codec", "vp9"], "it holds h264, hevc, av1"),
        (["-o", "x.mp4", "--resume"], "a film cannot be resumed"),
        (["-o", "x.png", "--time", 0, "--resume"], "a single picture cannot be resumed"),
        (["-o", "x.png", "--size", "9000x10", "--samples", 2, "--time", 0], "more than 16384"),
    ],
)
def test_what_cannot_be_rendered_is_a_usage_error(
    run: Run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, printed, complaint = run(scene_file, *SIZE, "-o", "out", *words)
    assert code == 2 and printed == "" and message in complaint and not list(tmp_path.iterdir())


def test_a_fixed_camera_needs_no_path(run: Run, scene_file: Path, tmp_path: Path) -> None:
    scene = kpc.load(scene_file)
    path = CameraPath().with_keyframe(scene.cameras[1], 0.0)
    path.save(tmp_path / "one.json")
    words = ["--frames", "4", "--backend", "reference"]
    assert run(scene_file, *words, "--camera", 1, "-o", tmp_path / "a")[0] == 0
    assert run(scene_file, *words, "--camera", tmp_path / "one.json", "-o", tmp_path / "b")[0] == 0
    wanted = reference.render(scene, scene.cameras[1], 0.4).rgb
    for folder in "ab":
        assert np.abs(read_image(tmp_path / folder / "0004.png") / 255 - wanted).max() < 1 / 255
    path.with_keyframe(scene.cameras[0], 0.5).save(tmp_path / "two.json")
    code, _, complaint = run(scene_file, *words, "--camera", tmp_path / "two.json", "-o", tmp_path / "c")
    assert code == 2 and "lists 2 views" in complaint


def test_png_holds_straight_alpha(run: Run, scene_file: Path, tmp_path: Path) -> None:
    words = ["--time", 0.4, "--backend", "reference", "--background", "transparent", "-o", tmp_path / "x.png"]
    assert run(scene_file, *words)[0] == 0
    scene, pixels = kpc.load(scene_file), read_image(tmp_path / "x.png") / 255
    wanted = reference.render(scene, scene.cameras[0], 0.4)
    assert np.abs(pixels[..., 3] - wanted.opacity).max() < 1 / 255
    over = pixels[..., :3] * pixels[..., 3:] + scene.background * (1 - pixels[..., 3:])
    assert np.abs(over - wanted.rgb).max() < 1.5 / 255


@pytest.mark.parametrize("is_transparent", [False, True])
def test_samples_and_instants_are_averaged_in_linear_light(is_transparent: bool) -> None:
    """A white, opaque sample beside a black or an empty one is half the light."""
    camera = tiny_scene(4).cameras[0].resized(2, 1)

    def render(camera: object, time: float) -> reference.Rendering:
        checks = np.indices((camera.height, camera.width)).sum(0) % 2 == 0
        white = checks if camera.width > 2 else np.full_like(checks, time < 0.5)
        rgb = np.repeat(white[..., None], 3, axis=2).astype(np.float32)
        opacity = white.astype(np.float32) if is_transparent else np.ones_like(rgb[..., 0])
        return reference.Rendering(rgb, np.where(white, 1, 5).astype(np.float32), opacity, np.ones(white.shape, int))

    half = 1.0 * 0.5 if is_transparent else 1.055 * 0.5 ** (1 / 2.4) - 0.055
    for instants, samples in (([(camera, 0.0)], 2), ([(camera, 0.0), (camera, 1.0)], 1)):
        picture = content.mean_picture(render, instants, samples, is_transparent)
        assert picture.rgb == pytest.approx(half, abs=1e-6) and picture.rgb.shape == (1, 2, 3)
        assert picture.opacity == pytest.approx(0.5 if is_transparent else 1.0)
        assert set(picture.depth.ravel()) <= {1.0, 5.0}  # no depth between two surfaces


def test_the_shutter_opens_around_the_frame(run: Run, scene_file: Path, tmp_path: Path, times: list[float]) -> None:
    words = ["--frames", "5", "--shutter", 0.5, *SIZE]
    assert run(scene_file, *words, "-o", tmp_path / "x.png")[0] == 0
    assert len(times) == 8 and np.mean(times) == pytest.approx(0.5)
    assert max(times) - min(times) == pytest.approx(0.05 * 7 / 8)


def test_the_camera_of_a_path_moves_while_the_shutter_is_open(scene_file: Path, tmp_path: Path) -> None:
    first, second = kpc.load(scene_file).cameras
    path = CameraPath().with_keyframe(first, 0.2).with_keyframe(second, 0.2, 1.0)
    path.save(tmp_path / "path.json")
    words = ["x.kpc", "--path", str(tmp_path / "path.json"), "--shutter", "1", "-o", "x"]
    scene = kpc.load(scene_file)
    shots = shots_of(scene, scene.clip, parser().parse_args(words), is_film=False)
    eyes = [camera.camera_to_world[:3, 3] for camera, _ in shots.instants(5)]
    assert len(shots) == 11 and [time for _, time in shots.instants(5)] == pytest.approx([0.2] * 8)
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    whole = np.linalg.norm(shots.camera(6).camera_to_world[:3, 3] - shots.camera(5).camera_to_world[:3, 3])
    assert (steps > 0).all() and steps.sum() == pytest.approx(whole * 7 / 8, rel=0.05)


def test_resuming_skips_whole_pictures(run: Run, scene_file: Path, tmp_path: Path, times: list[float]) -> None:
    out = tmp_path / "out"
    words = [scene_file, "--frames", "0-5", "--depth", *SIZE, "--resume", "-o", out]
    assert run(*words)[0] == 0 and len(times) == 6
    whole = (out / "0001.png").read_bytes()
    (out / "0001.png").write_bytes(whole[:-20])  # cut off while it was copied
    (out / "0002.png").unlink()
    (out / "0003_depth.png").unlink()
    (out / "0004.png").write_bytes((out / "0004_depth.png").read_bytes()[:0])
    times.clear()
    code, printed, _ = run(*words)
    assert code == 0 and "6 pictures (2 were there)" in printed
    assert times == pytest.approx([0.1, 0.2, 0.3, 0.4]) and (out / "0001.png").read_bytes() == whole


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--background", "white"], "--background"),
        (["--static-only"], "what is shown"),
        (["--samples", "2"], "--samples"),
        (["--camera", "0"], "--camera"),
        (["--size", "12x9"], "--size (16x12, now 12x9)"),  # whole pictures of a long run are not replaced
    ],
)
def test_resuming_with_other_options_is_refused(
    run: Run, scene_file: Path, tmp_path: Path, more: list[str], named: str
) -> None:
    words = [scene_file, *SIZE, "-o", tmp_path / "out"]
    assert run(*words, "--frames", "0-0")[0] == 0
    assert run(*words, "--frames", "0-1", "--resume")[0] == 0, "other frames are what --resume is for"
    code, _, printed = run(*words, "--frames", "0-2", "--resume", *more)
    assert code == 2 and f"another value of {named}" in printed
    assert not (tmp_path / "out" / "0002.png").exists()


def test_resuming_in_another_format_names_the_format(run: Run, scene_file: Path, tmp_path: Path) -> None:
    for before, now in (("exr", "png"), ("jpg", "exr")):  # whose backgrounds differ where none is given
        words = [scene_file, *SIZE, "--frames", "0-0", "-o", tmp_path / before]
        assert run(*words, "--format", before)[0] == 0
        code, _, printed = run(*words, "--format", now, "--resume")
        assert code == 2 and f"another value of --format ({before}, now {now})" in printed


def test_resuming_knows_a_scene_by_its_content_and_keeps_no_secret(run: Run, scene_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(scene_file, *SIZE, "--frames", "0-0", "-o", out)[0] == 0
    renamed = shutil.copy(scene_file, tmp_path / "renamed.kpc")
    assert run(renamed, *SIZE, "--frames", "0-1", "--resume", "-o", out)[0] == 0
    assert json.loads((out / RECORD).read_text())["part"] == "full"
    (out / RECORD).unlink()
    code, _, printed = run(renamed, *SIZE, "--frames", "0-1", "--resume", "-o", out)
    assert code == 2 and "what they show is not known" in printed
    described = resuming.described(argparse.Namespace(scene="https://user:password@host/a.kpc?token=secret"))
    assert described["scene"].startswith("https://host/a.kpc, address of SHA-256 ") and len(described["scene"]) < 70


def test_two_runs_share_a_folder_only_if_their_pictures_belong_together(
    run: Run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, write, found = tmp_path / "out", pictures.write_picture, []
    out.mkdir()
    (out / ".kprender-0123456789ab-killed.lock").touch()

    def write_beside_others(*arguments: Any) -> None:
        if not found:
            found.append(None)
            for words in ["--samples", 2], ["--samples", 2, "--frames", "0-0"], ["--frames", "1-1"]:
                found.append(run(scene_file, *SIZE, *words, "-o", out))
        write(*arguments)

    monkeypatch.setattr(pictures, "write_picture", write_beside_others)
    assert run(scene_file, *SIZE, "--frames", "0-0", "-o", out)[0] == 0
    for code, _, said in found[1:3]:
        assert code == 2 and "another kprender with other options is at work there" in said
    assert found[3][0] == 0 and {path.name for path in out.iterdir()} == {"0000.png", "0001.png", RECORD}
    assert run(scene_file, *SIZE, "--samples", 2, "--frames", "0-0", "-o", out)[0] == 0


def test_resuming_tells_black_from_transparent(run: Run, scene_file: Path, tmp_path: Path) -> None:
    words = [scene_file, *SIZE, "--frames", "0-0", "--resume", "-o", tmp_path / "out"]
    assert run(*words, "--background", "black")[0] == 0
    code, _, printed = run(*words, "--background", "transparent")
    assert code == 2 and "(#000000, now transparent)" in printed


def test_pictures_of_other_options_are_never_taken_for_finished(run: Run, scene_file: Path, tmp_path: Path) -> None:
    words = [scene_file, *SIZE, "-o", tmp_path / "out"]
    assert run(*words, "--frames", "0-1", "--background", "white")[0] == 0
    code, _, said = run(*words, "--frames", "1-1", "--background", "black")
    assert code == 0 and "other pictures stay there, such as 0000.png; 1 in all" in said
    code, _, printed = run(*words, "--frames", "0-1", "--background", "black", "--resume")
    assert code == 2 and "another value of --background (various, now" in printed
    assert run(*words, "--frames", "0-1", "--background", "black")[0] == 0
    assert run(*words, "--frames", "0-2", "--background", "black", "--resume")[0] == 0


def test_pictures_that_lay_in_a_folder_before_are_never_taken_for_finished(
    run: Run, scene_file: Path, tmp_path: Path
) -> None:
    out, words = tmp_path / "out", [scene_file, *SIZE, "-o", tmp_path / "out"]
    out.mkdir()
    for name in ("0001.png", "0003.png"):
        Image.new("RGB", (16, 12), "red").save(out / name)
    for frames in ("0-1", "0-0"):  # the second run remembers what the first one found
        assert run(*words, "--frames", frames)[0] == 0
    code, _, said = run(*words, "--frames", "0-3", "--resume")
    assert code == 2 and "0003.png was there before kprender" in said
    assert run(*words, "--frames", "0-2", "--resume")[0] == 0
    (out / "0003.png").unlink()
    code, printed, _ = run(*words, "--frames", "0-3", "--resume")
    assert code == 0 and "4 pictures (3 were there)" in printed


def test_what_a_run_replaces_is_deleted_before(
    run: Run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [scene_file, *SIZE, "--frames", "0-1", "-o", tmp_path / "out"]
    assert run(*words, "--background", "white")[0] == 0

    def interrupt(*arguments: object, **options: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr(reference, "render", interrupt)
    assert run(*words, "--background", "black")[0] == 130
    assert [path.name for path in (tmp_path / "out").iterdir()] == [RECORD]


def test_a_damaged_exr_is_rendered_anew_without_a_word_of_its_reader(
    scene_file: Path, tmp_path: Path, times: list[float], capfd: pytest.CaptureFixture[str]
) -> None:
    words = [str(word) for word in (scene_file, "--frames", "0-0", *SIZE, "--resume", "--format", "exr", "-o")]
    assert kprender.main([*words, str(tmp_path)]) == 0
    picture = tmp_path / "0000.exr"
    picture.write_bytes(picture.read_bytes()[:700])  # within its pixels
    capfd.readouterr()
    assert kprender.main([*words, str(tmp_path)]) == 0 and len(times) == 2
    assert capfd.readouterr().err == "kprender: reference renderer (numpy)\n"
    assert kprender.main([*words, f"{picture}/"]) == 2 and "is a file, not a folder" in capfd.readouterr().err


@pytest.mark.parametrize("name", ["out", "x.mkv", "x.webm"])
def test_ctrl_c_leaves_whole_frames_only(
    run: Run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    render, calls = reference.render, itertools.count()

    def interrupt(*arguments: object, **words: object) -> object:
        if next(calls) == 4:
            raise KeyboardInterrupt
        return render(*arguments, **words)

    monkeypatch.setattr(reference, "render", interrupt)
    code, _, complaint = run(scene_file, *SIZE, "-o", tmp_path / name)
    assert code == 130 and complaint.endswith("kprender: interrupted\n")
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file() and p.name != RECORD)
    assert left == ([f"out/{number:04d}.png" for number in range(4)] if name == "out" else [])
    for file in left:
        assert read_image(tmp_path / file).shape == (12, 16, 3)


def test_an_odd_size_is_padded_and_said(run: Run, scene_file: Path, tmp_path: Path) -> None:
    words = [scene_file, "--frames", "0-1", "--size", "33x17", "--backend", "reference"]
    code, printed, notes = run(*words, "-o", tmp_path / "x.mp4")
    assert code == 0 and "2 frames at 10 fps, 33x17 (padded to 34x18), in" in printed and "needs even sides" in notes
    code, printed, notes = run(*words, "-o", tmp_path / "x.mov", "--background", "transparent")
    assert code == 0 and "(padded" not in printed and "33x17" in printed


def test_an_exr_that_cannot_be_written_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import OpenEXR

    def fail(self: object, name: str) -> None:
        raise RuntimeError(f'Failed to write pixel data to image file "{name}". No space left on device.')

    monkeypatch.setattr(OpenEXR.File, "write", fail)
    seen = reference.Rendering(*(np.ones((2, 3, 3), np.float32), *np.ones((3, 2, 3), np.float32)))
    with pytest.raises(MediaError, match=r"a\.exr: cannot be written \(.*/a\.exr\". No space left on device\)$"):
        pictures.write_picture(tmp_path / "a.exr", seen, False, None)
    assert not list(tmp_path.iterdir())
