"""Several scenes in one picture, and pictures of every camera that kpenc trains on."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gl
import kpc
from kpc.encoder.coding.scene_writer import write
from kpc.encoder.datasets.loading import load_dataset
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import read_image
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip, Scene
from kpc.player.cpu import reference
from kpc.player.cpu.reference import Rendering
from kpc.tools.rendering import pictures
from kpc.tools.rendering.composition import in_depth_order, played_clip, same_moment
from scenes import tiny_scene, with_appearances

SIZE = ("--size", "24x18", "--backend", "reference")
Run = Callable[..., tuple[int, str, str]]


def save(scene: Scene, path: Path) -> Path:
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    return path


def halves(scene: Scene, folder: Path) -> tuple[Path, Path]:
    """Write what a scene has on the left and on the right of a plane across its box, as two files of that box."""
    side = np.arange(scene.occupancy.shape[3]) < scene.occupancy.shape[3] // 2
    left, right = (replace(scene, occupancy=scene.occupancy & chosen) for chosen in (side, ~side))
    return save(left, folder / "left.kpc"), save(right, folder / "right.kpc")


def picture(rgb: float, depth: float, opacity: float) -> Rendering:
    """One pixel, of a colour that is not yet multiplied by its opacity."""
    one = np.ones((1, 1), np.float32)
    return Rendering(rgb * opacity * np.ones((1, 1, 3), np.float32), depth * one, opacity * one, one.astype(int))


def test_nearer_pictures_cover_farther_ones_whatever_their_order() -> None:
    near, middle, far = picture(0.8, 1.0, 0.5), picture(0.4, 2.0, 0.25), picture(0.2, 4.0, 1.0)
    for order in ([near, middle, far], [far, middle, near], [middle, far, near]):
        made = in_depth_order(order)
        np.testing.assert_allclose(made.rgb, 0.5 * 0.8 + 0.5 * 0.25 * 0.4 + 0.5 * 0.75 * 0.2, rtol=1e-6)
        np.testing.assert_allclose(made.opacity, 1.0)
        np.testing.assert_allclose(made.depth, 0.5 * 1 + 0.125 * 2 + 0.375 * 4, rtol=1e-6)
        assert made.samples.item() == 3
    empty = picture(0.0, np.inf, 0.0)
    assert np.isinf(in_depth_order([empty, empty]).depth).all()
    np.testing.assert_allclose(in_depth_order([empty, middle]).depth, 2.0)
    nowhere = picture(0.2, np.inf, 0.3)  # a surface that has no depth, as where groups are blended
    np.testing.assert_allclose(in_depth_order([picture(0.8, 2.0, 0.9), nowhere]).depth, 2.0)


@pytest.mark.parametrize("backend", ["gl", "reference"])
def test_two_halves_of_a_scene_make_the_scene(run: Run, tmp_path: Path, backend: str) -> None:
    """Rays cross the plane between the halves once, so drawing one before the other is exact but for steps there."""
    if backend == "gl":
        gl.context()
    scene = tiny_scene(4)
    whole = save(scene, tmp_path / "whole.kpc")
    left, right = halves(scene, tmp_path)
    shots = ("--time", 0.4, "--size", "48x36", "--backend", backend)
    for camera in (0, 1):
        assert run(whole, *shots, "--camera", camera, "-o", tmp_path / "whole.png")[0] == 0
        wanted = read_image(tmp_path / "whole.png").astype(int)
        for one, other in ((left, right), (right, left)):
            assert run(one, "--with", other, *shots, "--camera", camera, "-o", tmp_path / "both.png")[0] == 0
            error = np.abs(read_image(tmp_path / "both.png") - wanted)
            assert error.max() <= 8 and error.mean() < 0.1
            assert run(one, *shots, "--camera", camera, "-o", tmp_path / "one.png")[0] == 0
            assert np.abs(read_image(tmp_path / "one.png") - wanted).max() > 30


def test_a_scene_beside_nothing_stays_as_it_is(run: Run, scene_file: Path, tmp_path: Path) -> None:
    scene = tiny_scene(4)
    nothing = save(replace(scene, occupancy=np.zeros_like(scene.occupancy)), tmp_path / "nothing.kpc")
    for words in ((), ("--background", "transparent"), ("--background", "#204060")):
        for beside, name in (((), "alone.png"), (("--with", nothing), "with.png")):
            assert run(scene_file, *beside, *SIZE, "--time", 0.5, *words, "-o", tmp_path / name)[0] == 0
        alone, both = (read_image(tmp_path / name).astype(int) for name in ("alone.png", "with.png"))
        assert alone.shape == both.shape and np.abs(alone - both).max() <= 1


def test_clips_begin_together() -> None:
    short, long, still = Clip(11, 10.0), Clip(41, 20.0), Clip(1, 10.0)
    assert same_moment(0.5, short, long) == pytest.approx(0.25)
    assert same_moment(0.25, long, short) == pytest.approx(0.5)
    assert same_moment(0.75, long, short) == 1.0
    assert same_moment(0.5, short, still) == 0.0 and same_moment(0.0, still, short) == 0.0
    assert played_clip(short, [long, still]) is short and played_clip(still, [short, long]) is long
    assert played_clip(still, []) is still


def test_before_a_still_scene_another_one_moves(run: Run, scene_file: Path, tmp_path: Path) -> None:
    still = save(tiny_scene(6, dynamic=False), tmp_path / "still.kpc")
    assert run(still, "--with", scene_file, *SIZE, "--step", 5, "-o", tmp_path / "out")[0] == 0
    assert sorted(path.name for path in (tmp_path / "out").glob("*.png")) == ["0000.png", "0005.png", "0010.png"]
    first, last = (read_image(tmp_path / "out" / name).astype(int) for name in ("0000.png", "0010.png"))
    assert np.abs(first - last).max() > 10


def test_other_scenes_have_their_average_appearance(run: Run, tmp_path: Path) -> None:
    scene = with_appearances(tiny_scene(4), ("dawn.jpg", "dusk.jpg"))
    nothing = save(replace(scene, occupancy=np.zeros_like(scene.occupancy)), tmp_path / "nothing.kpc")
    whole = save(scene, tmp_path / "whole.kpc")
    for words in ((), ("--appearance", "dawn.jpg")):
        assert run(nothing, "--with", whole, *words, *SIZE, "--time", 0.5, "-o", tmp_path / "with.png")[0] == 0
        assert run(whole, *SIZE, "--time", 0.5, "-o", tmp_path / "average.png")[0] == 0
        assert np.abs(read_image(tmp_path / "with.png").astype(int) - read_image(tmp_path / "average.png")).max() <= 1


@pytest.mark.parametrize("names", [["0000", "0000"], ["a/cam", "b/cam"], [".", ".."], ["a:b", "a?b"], ["A", "a"]])
def test_names_of_cameras_are_those_of_files_whatever_is_rendered(run: Run, tmp_path: Path, names: list[str]) -> None:
    scene = replace(tiny_scene(4), metadata=Metadata({"camera_names": names}))
    file, kept = save(scene, tmp_path / "scene.kpc"), set()
    for number, words in enumerate((("--frames", "0-10", "--step", 5), ("--frames", "10"))):
        out = tmp_path / str(number)
        code, _, complaint = run(file, "--every-camera", *SIZE, *words, "-o", out)
        assert code == 0 and "other name" not in complaint
        frames = json.loads((out / "transforms.json").read_text())["frames"]
        kept |= {(frame["file_path"], frame["transform_matrix"][0][3]) for frame in frames}
    assert len(kept) == len({name for name, _ in kept}) == 6


def test_an_interrupted_run_leaves_no_document(
    run: Run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (scene_file, "--every-camera", "--frames", "0-2", "--backend", "reference", "-o", tmp_path / "out")
    assert run(*words, "--size", "16x12")[0] == 0
    monkeypatch.setattr(pictures, "write_picture", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    assert run(*words, "--size", "8x6")[0] != 0
    assert not (tmp_path / "out" / "transforms.json").exists()


def test_every_camera_makes_a_folder_that_trains(run: Run, tmp_path: Path) -> None:
    scene = replace(tiny_scene(4), metadata=Metadata({"camera_names": ["left", "right"]}))
    file, out = save(scene, tmp_path / "scene.kpc"), tmp_path / "out"
    words = ("--every-camera", "--background", "transparent", "--frames", "2-8", "--step", 2, "--backend", "reference")
    code, printed, _ = run(file, *words, "-o", out)
    assert code == 0 and printed.startswith(f"{out}: 8 pictures, 48x36")
    names = [f"{name}_{frame:04d}.png" for name in ("left", "right") for frame in (2, 4, 6, 8)]
    assert sorted(path.name for path in out.glob("*.png")) == sorted(names)
    wanted = reference.render(kpc.load(file), scene.cameras[1], 0.6)
    pixels = read_image(out / "right_0006.png") / 255
    np.testing.assert_allclose(pixels[..., 3], wanted.opacity, atol=1 / 255)
    over_sky = pixels[..., :3] * pixels[..., 3:] + (1 - pixels[..., 3:]) * scene.background
    np.testing.assert_allclose(over_sky, wanted.rgb, atol=3 / 255)

    assert load_dataset(out, tmp_path / "cache").pictures.is_test.sum() == 1
    dataset = load_dataset(out, tmp_path / "cache", holdout="none")
    assert dataset.has_alpha and dataset.clip == Clip(4, 5.0) and len(dataset.pictures) == 8
    assert dataset.left_out == 0 and dataset.camera_names == ("left", "right")
    for number, path in enumerate(dataset.pictures.file):
        name, frame = Path(path).stem.split("_")
        assert dataset.pictures.time[number] == pytest.approx((int(frame) - 2) / 6)
        found, true = dataset.camera(number), scene.cameras[("left", "right").index(name)]
        np.testing.assert_allclose(found.camera_to_world, true.camera_to_world, atol=1e-4)
        assert (found.width, found.height) == (48, 36) and found.fl_x == pytest.approx(55)


def test_every_camera_at_one_time_is_a_still_scene(run: Run, scene_file: Path, tmp_path: Path) -> None:
    assert run(scene_file, "--every-camera", "--time", 0.5, *SIZE, "-o", tmp_path / "out")[0] == 0
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert len(frames) == 2 and all("time" not in frame and frame["w"] == 24 for frame in frames)
    dataset = load_dataset(tmp_path / "out", tmp_path / "cache", holdout="none")
    assert not dataset.is_dynamic and not dataset.has_alpha


def test_every_camera_resumes(run: Run, scene_file: Path, tmp_path: Path) -> None:
    words = (scene_file, "--every-camera", *SIZE, "--frames", "0-2", "-o", tmp_path / "out")
    assert run(*words)[0] == 0
    (tmp_path / "out" / "1_0001.png").unlink()
    code, printed, _ = run(*words, "--resume")
    assert code == 0 and "6 pictures (5 were there)" in printed
    other = save(tiny_scene(5), tmp_path / "other.kpc")
    before = (tmp_path / "out" / "transforms.json").read_bytes()
    code, _, complaint = run(*words, "--resume", "--with", other)
    assert (tmp_path / "out" / "transforms.json").read_bytes() == before
    assert code == 2 and "another value of --with (not given, now other.kpc" in complaint
    both = (*words[:-1], tmp_path / "both", "--with", other, "--with")
    assert run(*both, other)[0] == 0
    assert run(*both, other.rename(tmp_path / "renamed.kpc"), "--resume")[0] != 0  # the first one is gone
    (tmp_path / "other.kpc").write_bytes((tmp_path / "renamed.kpc").read_bytes())
    assert "6 were there" in run(*both, tmp_path / "renamed.kpc", "--resume")[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--every-camera", "-o", "x.mp4"], "--every-camera: x.mp4 is no folder"),
        (["--every-camera", "-o", "x.png", "--time", 0], "--every-camera: x.png is no folder"),
        (["--every-camera", "--camera", 1, "-o", "x"], "not allowed with"),
        (["--every-camera", "--time", 0, "--step", 2, "-o", "x"], "--time stops the clip"),
        (["--with", "nowhere.kpc", "-o", "x"], "nowhere.kpc"),
        (["--with", "other.kpc", "--matte", "-o", "x"], "--with: --matte, --dynamic-map and --diagnose"),
        (["--with", "other.kpc", "--diagnose", "static", "-o", "x"], "--with: --matte, --dynamic-map and --diagnose"),
    ],
)
def test_what_does_not_go_together_is_refused(
    run: Run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    save(tiny_scene(5), tmp_path / "other.kpc")
    code, printed, complaint = run(scene_file, *SIZE, *words)
    assert code in (1, 2) and printed == "" and message in complaint
    assert [path.name for path in tmp_path.iterdir()] == ["other.kpc"]


@pytest.mark.parametrize("text", ['{"frames": []}', '{"made_by": "kpposes"}', "[1]", "no JSON", "[" * 100_000])
def test_a_document_of_other_pictures_stays(run: Run, scene_file: Path, tmp_path: Path, text: str) -> None:
    """A folder of pictures that a camera took is not made one of rendered ones by mistake."""
    (tmp_path / "transforms.json").write_text(text)
    code, _, complaint = run(scene_file, *SIZE, "--every-camera", "-o", tmp_path)
    assert code == 2 and "holds a transforms.json that kprender did not write" in complaint
    assert [path.name for path in tmp_path.iterdir()] == ["transforms.json"]
