import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import gl
import kpc
from kpc.encoder.coding.scene_writer import write
from kpc.encoder.datasets.video import read_video
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import DisplayError
from kpc.format.common.images import read_image
from kpc.format.scene.cameras import load_views
from kpc.format.scene.metadata import Metadata, camera_document
from kpc.player.app.camera_paths import CameraPath
from kpc.player.cpu import reference
from kpc.player.gl import offscreen
from kpc.tools.cli.depth_images import NO_SURFACE
from kpc.tools.rendering import pictures
from scenes import tiny_scene, with_appearances, with_contraction


def cameras_json(path: Path, files: list[str]) -> Path:
    scene = tiny_scene(4)
    frames = [
        {
            "file": name,
            "time": n / max(len(files) - 1, 1),
            "transform_matrix": scene.cameras[n % 2].camera_to_world.tolist(),
        }
        for n, name in enumerate(files)
    ]
    path.write_text(json.dumps({"w": 48, "h": 36, "fl_x": 55, "fl_y": 55, "cx": 24, "cy": 18, "frames": frames}))
    return path


@pytest.mark.parametrize("backend", ["gl", "reference"])
def test_pictures_from_a_camera_file(run, scene_file: Path, tmp_path: Path, backend: str) -> None:
    if backend == "gl":
        gl.context()
    listed = cameras_json(tmp_path / "cameras.json", ["a/one.png", "two.jpg"])
    out = tmp_path / "new" / "out"
    code, printed, _ = run(scene_file, "--cameras", listed, "-o", out, "--backend", backend)
    assert code == 0 and printed.startswith(f"{out}: 2 pictures, 48x36")
    assert sorted(p.name for p in out.glob("*.png")) == ["one.png", "two.png"]
    scene = kpc.load(scene_file)
    for n, name in enumerate(("one.png", "two.png")):
        wanted = reference.render(scene, tiny_scene(4).cameras[n], float(n)).rgb
        assert np.mean(np.abs(read_image(out / name) / 255 - wanted).max(axis=2) < 1.5 / 255) > 0.999


def test_without_a_camera_the_scene_shows_its_opening_view(run, tmp_path: Path) -> None:
    scene, path = tiny_scene(4), tmp_path / "scene.kpc"
    camera = replace(scene.cameras[1], width=20, height=15)
    names = ["left", "right"]
    members = {"opening": {"camera": camera_document(camera), "time": 0.25}, "camera_names": names}
    scene = replace(scene, metadata=Metadata(members))
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    assert run(path, "--time", 0, "--backend", "reference", "-o", tmp_path / "a.png")[0] == 0
    wanted = reference.render(kpc.load(path), camera, 0.0).rgb
    np.testing.assert_allclose(read_image(tmp_path / "a.png") / 255, wanted, atol=1.5 / 255)
    still = (path, "--time", 0, "--size", "8x6", "--backend", "reference", "-o")
    assert run(*still, tmp_path / "b.png", "--camera", "right")[0] == 0
    assert run(*still, tmp_path / "c.png", "--camera", 1)[0] == 0
    assert (tmp_path / "b.png").read_bytes() == (tmp_path / "c.png").read_bytes()
    code, _, err = run(*still, tmp_path / "d.png", "--camera", "up")
    assert code == 2 and "--camera up: neither a file nor a camera of the scene, which has left, right" in err


def test_cameras_too_far_away_for_float32_are_refused(run, scene_file: Path, tmp_path: Path) -> None:
    listed = cameras_json(tmp_path / "cameras.json", ["one.png"])
    document = json.loads(listed.read_text())
    for row, move in zip(document["frames"][0]["transform_matrix"], (0, 1e4, 0, 0), strict=True):
        row[3] += move
    listed.write_text(json.dumps(document))
    code, _, err = run(scene_file, "--cameras", listed, "-o", tmp_path / "out", "--backend", "reference")
    assert code == 2 and "a camera is 4,546 times the longest edge" in err and len(err.splitlines()) == 1


def test_names_from_a_camera_file_stay_in_the_directory(run, scene_file: Path, tmp_path: Path) -> None:
    names = [
        "../../escape.png",
        "/etc/passwd",
        "..\\..\\win.png",
        "",
        "..",
        ".hidden",
        "x.png",
        "y/x.png",
        "nul\0l\n.png",
        "n" * 400,
    ]
    listed = cameras_json(tmp_path / "cameras.json", names)
    out = tmp_path / "out"
    code, _, _ = run(scene_file, "--cameras", listed, "-o", out, "--backend", "reference", "--size", "8x6")
    assert code == 0
    found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} - {
        "cameras.json",
        "out/kprender.json",
    }
    assert len(found) == len(names) and all(name.startswith("out/") and name.count("/") == 1 for name in found)
    assert {"out/escape.png", "out/passwd.png", "out/win.png", "out/x.png"} <= found


def test_a_name_with_a_slash_or_without_suffix_is_a_folder(run, scene_file: Path, tmp_path: Path) -> None:
    (tmp_path / "take.3").mkdir()
    for number, name in enumerate(("plain", "slash.png/", "film.mp4/", "take.3")):
        words = ["--orbit", 2, "--size", "8x6", "--backend", "reference", *["--format", "jpg"] * (number % 2)]
        assert run(scene_file, *words, "-o", f"{tmp_path}/{name}")[0] == 0
        suffix = ("png", "jpg")[number % 2]
        assert sorted(p.name for p in (tmp_path / name).glob("0*")) == [f"0000.{suffix}", f"0001.{suffix}"]


@pytest.mark.parametrize(
    ("name", "beginning"), [("x.JPG", b"\xff\xd8"), ("x.jpeg", b"\xff\xd8"), ("x.mkv", b"\x1a\x45\xdf\xa3")]
)
def test_files_are_what_their_names_say(run, scene_file: Path, tmp_path: Path, name: str, beginning: bytes) -> None:
    words = ["--time", 0.4, "--size", "16x12", "--backend", "reference"]
    assert run(scene_file, *words, "-o", tmp_path / name)[0] == 0
    assert (tmp_path / name).read_bytes().startswith(beginning)


def test_one_picture_of_another_name_is_spoken_of_as_one(run, scene_file: Path, tmp_path: Path) -> None:
    listed = cameras_json(tmp_path / "cameras.json", ["a.png", ".b.png"])
    words = ["--cameras", listed, "--size", "8x6", "--backend", "reference", "-o", tmp_path / "out"]
    code, _, notes = run(scene_file, *words)
    assert (
        code == 0
        and "1 picture gets another name, for its own is taken or no plain file name: '.b.png' becomes b.png\n" in notes
    )


def test_no_picture_has_the_name_of_the_depth_of_another(run, scene_file: Path, tmp_path: Path) -> None:
    for number, names in enumerate((["a.png", "a_depth.png"], ["a_depth.png", "a.png"])):
        listed, out = cameras_json(tmp_path / "cameras.json", names), tmp_path / str(number)
        words = ["--cameras", listed, "--depth", "--size", "8x6", "--backend", "reference", "-o", out]
        code, _, notes = run(scene_file, *words)
        stems = {names[0][:-4], f"{names[1][:-4]}_0001"}
        assert code == 0 and f"'{names[1]}' becomes {names[1][:-4]}_0001.png" in notes
        assert {path.stem for path in out.glob("*.png")} == stems | {f"{stem}_depth" for stem in stems}
        depths = {path.stem for path in out.glob("*.png") if b"depth_unit" in path.read_bytes()}
        assert depths == {f"{stem}_depth" for stem in stems}


def test_names_keep_their_spaces(run, scene_file: Path, tmp_path: Path) -> None:
    listed = cameras_json(tmp_path / "cameras.json", ["left cam/take 1.png", " take 2 .png"])
    words = ["--cameras", listed, "--size", "8x6", "--backend", "reference", "-o", tmp_path / "out"]
    code, _, notes = run(scene_file, *words)
    assert code == 0 and "1 picture gets" in notes  # a space in front would hardly be seen
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {"take 1.png", "take 2 .png"}


def test_names_and_poses_of_nerfstudio(run, scene_file: Path, tmp_path: Path) -> None:
    """Frames keep the names of `file_path`, also one without a suffix; none keeps a name that is there twice."""
    listed = cameras_json(tmp_path / "transforms.json", ["images/0007.png", "./train/r_0.5", "b/0007.png"])
    document = json.loads(listed.read_text())
    for frame in document["frames"]:
        frame["file_path"] = frame.pop("file")
        del frame["time"]
    listed.write_text(json.dumps(document))
    words = ["--cameras", listed, "--size", "8x6", "--backend", "reference", "-o", tmp_path / "out"]
    code, _, notes = run(scene_file, *words)
    assert code == 0 and "2 pictures get other names" in notes and "beginning of the clip" in notes
    assert "beginning" not in run(scene_file, *words, "--time", 0)[2]
    assert sorted(p.name for p in (tmp_path / "out").glob("*.png")) == ["b_0007.png", "images_0007.png", "r_0.5.png"]


@pytest.mark.parametrize(("fps", "at_s"), [(12, (0.0, 1.0, 2.0)), (1.5, (0.0, 2 / 3, 4 / 3))])
def test_the_camera_path_of_nerfstudio(run, scene_file: Path, tmp_path: Path, fps: float, at_s: tuple[float]) -> None:
    """Three poses are keyframes over `seconds`, or the frames of a film if `fps` says so."""
    cameras = [*tiny_scene(4).cameras, tiny_scene(4).cameras[0]]
    fov = float(np.degrees(2 * np.arctan(18 / 55)))
    poses = [{"camera_to_world": c.camera_to_world.ravel().tolist(), "fov": fov, "aspect": 4 / 3} for c in cameras]
    shared = {"camera_type": "perspective", "render_height": 36, "render_width": 48, "fps": fps, "seconds": 2.0}
    file = tmp_path / "camera_path.json"
    file.write_text(json.dumps({**shared, "camera_path": poses}))
    views = load_views(file)
    assert [view.at_s for view in views] == pytest.approx(at_s)
    assert [view.time for view in views] == [0.0, 0.5, 1.0]
    for view, camera in zip(views, cameras, strict=True):
        np.testing.assert_array_equal(view.camera.camera_to_world, camera.camera_to_world)
        intrinsics = [view.camera.fl_x, view.camera.fl_y, view.camera.cx, view.camera.cy]
        assert intrinsics == pytest.approx([55, 55, 24, 18])
    words = ["--size", "8x6", "--backend", "reference"]
    code, printed, _ = run(scene_file, "--path", file, *words, "--fps", 3, "-o", tmp_path / "path.mp4")
    assert code == 0 and f"{round(3 * at_s[-1]) + 1} frames" in printed
    code, printed, _ = run(scene_file, "--cameras", file, *words, "-o", tmp_path / "views")
    assert code == 0 and len(list((tmp_path / "views").glob("*.png"))) == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera_type": "fisheye"}, "no pinhole"),
        ({"camera_type": "equirectangular"}, "no pinhole"),
        ({"render_width": None}, "w is missing"),
        ({"camera_path": [{"camera_to_world": [1, 0, 0], "fov": 50}]}, "not 4x4 numbers"),
        ({"camera_path": [{"camera_to_world": np.eye(4).tolist(), "fov": 180}]}, "outside (0, 180)"),
        ({"camera_path": [{"camera_to_world": np.eye(4).tolist()}]}, "fov is missing"),
        ({"camera_path": []}, "no frames"),
        ({"camera_path": {}}, "list of frames"),
    ],
)
def test_camera_paths_that_are_none(run, scene_file: Path, tmp_path: Path, change: dict, words: str) -> None:
    shared = {"render_height": 36, "render_width": 48, "seconds": 2.0}
    poses = [{"camera_to_world": np.eye(4).tolist(), "fov": 50}]
    file = tmp_path / "camera_path.json"
    file.write_text(json.dumps({**shared, "camera_path": poses, **change}))
    for option in ("--cameras", "--path"):
        code, _, complaint = run(scene_file, option, file, "--backend", "reference", "-o", tmp_path / "out")
        assert code == 1 and words in complaint and complaint.count("\n") == 1 and not (tmp_path / "out").exists()


def test_exr_holds_linear_colour_and_depth(run, scene_file: Path, tmp_path: Path) -> None:
    code, _, _ = run(scene_file, "--time", 0.4, "--backend", "reference", "-o", tmp_path / "x.exr")
    assert code == 0
    scene = kpc.load(scene_file)
    wanted = reference.render(scene, scene.cameras[0], 0.4)
    with OpenEXR.File(str(tmp_path / "x.exr"), separate_channels=True) as exr:
        found = {name: np.array(channel.pixels) for name, channel in exr.channels().items()}
    assert set(found) == set("RGBAZ") and np.array_equal(found["Z"], wanted.depth)
    assert np.allclose(found["A"], wanted.opacity, atol=1e-6) and found["Z"].dtype == np.float32
    assert (found["R"] <= found["A"] + 1e-6).all()  # colours are multiplied by alpha
    straight = read_image(tmp_path / "x.exr") / 255
    over = straight[..., :3] * straight[..., 3:] + scene.background * (1 - straight[..., 3:])
    assert np.abs(over - wanted.rgb).max() < 2 / 255
    words = ["--time", 0.4, "--backend", "reference", "--background", "#336699"]
    assert run(scene_file, *words, "-o", tmp_path / "y.exr")[0] == 0
    opaque = read_image(tmp_path / "y.exr") / 255
    expected = wanted.rgb + (1 - wanted.opacity[..., None]) * (np.array([0.2, 0.4, 0.6]) - scene.background)
    assert np.abs(opaque[..., :3] - expected).max() < 1 / 255 and (opaque[..., 3] == 1).all()


def test_depth_beside_a_png(run, scene_file: Path, tmp_path: Path) -> None:
    code, _, _ = run(scene_file, "--time", 0.4, "--backend", "reference", "--depth", "-o", tmp_path / "x.png")
    assert code == 0
    scene = kpc.load(scene_file)
    wanted = reference.render(scene, scene.cameras[0], 0.4).depth
    with Image.open(tmp_path / "x_depth.png") as image:
        unit, levels = float(image.text["depth_unit"]), np.asarray(image)
    assert np.array_equal(levels == NO_SURFACE, np.isinf(wanted))
    hit = np.isfinite(wanted)
    assert np.abs(levels[hit] * unit - wanted[hit]).max() <= unit / 2 * 1.01


def test_depth_in_contracted_space_is_clipped(run, tmp_path: Path) -> None:
    path, camera = tmp_path / "around.kpc", tmp_path / "c.json"
    scene = with_contraction(tiny_scene(4))
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales], skip_unseen=False), path)
    pose = scene.cameras[0].camera_to_world.copy()
    pose[:3, 3] = [0.1, 0.05, 1.4]  # in free space, with the wall far behind
    camera.write_text(
        json.dumps(
            {
                "w": 40,
                "h": 30,
                "fl_x": 12,
                "fl_y": 12,
                "cx": 20,
                "cy": 15,
                "frames": [{"file": "a.png", "time": 0.4, "transform_matrix": pose.tolist()}],
            }
        )
    )
    assert run(path, "--cameras", camera, "--backend", "reference", "--depth", "-o", tmp_path)[0] == 0
    scene = kpc.load(path)
    wanted = reference.render(scene, load_views(camera)[0].camera, 0.4).depth
    with Image.open(tmp_path / "a_depth.png") as image:
        unit, levels = float(image.text["depth_unit"]), np.asarray(image)
    hit = np.isfinite(wanted)
    limit = pictures.CONTRACTED_DEPTH_RANGE * scene.mapping.uniform_distance
    assert wanted[hit].max() > 2 * scene.mapping.uniform_distance and unit == pytest.approx(limit / 65534)
    np.testing.assert_allclose(levels[hit] * unit, np.minimum(wanted, limit)[hit], atol=0.51 * unit)
    assert (levels[~hit] == NO_SURFACE).all()
    assert run(path, "--cameras", camera, "--backend", "reference", "--depth", "-o", tmp_path / "a.mp4")[0] == 0
    (frame,) = read_video(tmp_path / "a.mp4")
    grey = 255 * (1 - scene.mapping.parameter(wanted) / (2 * scene.mapping.uniform_distance))
    assert np.abs(frame[..., 1].astype(float) - grey).mean() < 6 and grey.std() > 10


@pytest.mark.parametrize("depth", [False, True])
def test_an_orbit_becomes_a_video(run, scene_file: Path, tmp_path: Path, depth: bool) -> None:
    out = tmp_path / "orbit.mp4"
    code, printed, _ = run(
        scene_file, "--orbit", 7, "--size", "64x48", "--backend", "reference", "-o", out, *["--depth"] * depth
    )
    assert code == 0 and "7 frames at 10 fps" in printed
    frames = list(read_video(out))
    assert len(frames) == 7 and frames[0].shape == (48, 64, 3)
    assert np.abs(frames[0].astype(int) - frames[3]).mean() > 1  # the camera moves


def test_a_path_becomes_a_video_and_its_keyframes_pictures(run, scene_file: Path, tmp_path: Path) -> None:
    path = CameraPath()
    for time, camera in zip((0.0, 0.4, 0.9), (*tiny_scene(4).cameras, tiny_scene(4).cameras[0]), strict=True):
        path = path.with_keyframe(camera, time, 0.5)
    path.save(tmp_path / "path.json")
    code, printed, _ = run(
        scene_file, "--path", tmp_path / "path.json", "--backend", "reference", "-o", tmp_path / "a.mp4", "--fps", 6
    )
    assert code == 0 and "7 frames at 6 fps, 48x36" in printed
    frames = list(read_video(tmp_path / "a.mp4"))
    code, printed, _ = run(
        scene_file, "--cameras", tmp_path / "path.json", "--backend", "reference", "-o", tmp_path / "keys"
    )
    assert code == 0 and "3 pictures" in printed
    for number, frame in enumerate((frames[0], frames[3], frames[6])):
        key = read_image(tmp_path / "keys" / f"{number:04d}.png")
        assert np.abs(frame.astype(float) - key).mean() < 6  # up to the losses of H.264
    assert np.abs(frames[0].astype(int) - frames[3]).mean() > 6


def test_the_clip_from_the_first_camera(run, scene_file: Path, tmp_path: Path) -> None:
    code, printed, _ = run(scene_file, "--backend", "reference", "-o", tmp_path / "clip.mp4", "--fps", 5)
    assert code == 0 and "6 frames at 5 fps" in printed  # 1.1 s


def test_quality_levels(run, scene_file: Path, tmp_path: Path) -> None:
    gl.context()
    pictures = {}
    for name in ("reference", "finer", "fastest"):
        path = tmp_path / f"{name}.png"
        assert run(scene_file, "--time", 0.4, "-o", path, "--quality", name)[0] == 0
        pictures[name] = read_image(path).astype(int)
    off = [np.abs(pictures[name] - pictures["reference"]).mean() for name in ("finer", "fastest")]
    assert off[0] < 0.5 < off[1]
    assert run(scene_file, "--time", 0.4, "-o", tmp_path / "x.png", "--quality", "best")[0] == 2


def test_diagnosed_parts(run, scene_file: Path, tmp_path: Path) -> None:
    pictures = {}
    for part in ("", "static", "dynamic"):
        path = tmp_path / f"x{part}.png"
        words = ["--diagnose", part] if part else []
        assert run(scene_file, "--time", 0.4, "--backend", "reference", "-o", path, *words)[0] == 0
        pictures[part] = read_image(path).astype(int)
    difference = np.abs(pictures[""] - pictures["static"])
    assert difference.max() > 5
    assert np.abs(difference - pictures["dynamic"]).max() <= 1


def test_the_dynamic_map_is_the_same_from_both_backends(run, scene_file: Path, tmp_path: Path) -> None:
    gl.context()
    pictures = []
    for backend in ("gl", "reference"):
        path = tmp_path / f"{backend}.png"
        assert run(scene_file, "--time", 0.4, "--dynamic-map", "--backend", backend, "-o", path)[0] == 0
        pictures.append(read_image(path).astype(int))
    assert np.abs(pictures[0] - pictures[1]).mean() < 2
    red, green, blue = np.moveaxis(pictures[1], -1, 0)
    assert (red - blue).max() > 60 and (red >= green - 1).all() and (green >= blue - 1).all()
    assert ((red == green) & (green == blue)).mean() > 0.2
    assert run(scene_file, "--time", 0, "--dynamic-map", "--diagnose", "static", "-o", path)[0] == 2


@pytest.fixture(scope="module")
def varied_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("appearances") / "varied.kpc"
    scene = with_appearances(tiny_scene(4), ("dawn.jpg", "5:00 pm", "a/b.jpg", "x:y:0.5", "n.jpg", "n.png"))
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), path)
    return path


@pytest.mark.parametrize("backend", ["gl", "reference"])
@pytest.mark.parametrize(
    "text, one, other, share",
    [
        ("dawn.jpg", 0, 0, 0),
        ("x:y:0.5", 3, 3, 0),
        ("dawn", 0, 0, 0),
        ("dawn.jpg:5:00 pm:0.3", 0, 1, 0.3),
        ("5:00 pm:a/b.jpg:1", 1, 2, 1.0),
        ("x:y:0.5:dawn:0.75", 3, 0, 0.75),
    ],
)
def test_appearances_by_name_and_interpolated(
    run, varied_file: Path, tmp_path: Path, backend: str, text: str, one: int, other: int, share: float
) -> None:
    if backend == "gl":
        gl.context()
    code, _, _ = run(varied_file, "--time", 0.4, "--appearance", text, "--backend", backend, "-o", tmp_path / "x.png")
    assert code == 0
    scene = kpc.load(varied_file)
    codes = [appearance.code for appearance in scene.appearances]
    wanted, average = (
        kpc.render(scene, scene.cameras[0], 0.4, appearance).rgb
        for appearance in ((1 - share) * codes[one] + share * codes[other], None)
    )
    assert np.abs(read_image(tmp_path / "x.png") / 255 - wanted).max() < 1.5 / 255
    assert np.abs(wanted - average).max() > 5 / 255


@pytest.mark.parametrize(
    "text, words",
    [
        ("dusk.jpg", "'dusk.jpg'"),
        ("", "''"),
        ("n", "'n'"),
        ("dawn.jpg:dusk.jpg", "'dawn.jpg:dusk.jpg'"),
        ("dawn.jpg:dusk.jpg:0.5", "'dusk.jpg'"),
        ("dawn.jpg:a/b.jpg:1.5", "not a share"),
        ("dawn.jpg:a/b.jpg:x", "not a share"),
    ],
)
def test_unknown_appearances_are_refused(
    run, varied_file: Path, scene_file: Path, tmp_path: Path, text: str, words: str
) -> None:
    arguments = ("--appearance", text, "--time", 0, "--backend", "reference", "-o", tmp_path / "x.png")
    code, _, complaint = run(varied_file, *arguments)
    assert code == 2 and words in complaint and complaint.count("\n") == 1
    code, _, complaint = run(scene_file, *arguments)
    assert code == 2 and ("no appearances" in complaint or words == "not a share") and not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["{missing}", "-o", "{dir}"], 1, "missing.kpc"),
        (["{text}", "-o", "{dir}"], 1, "text.kpc"),
        (["{scene}", "--cameras", "{missing}", "-o", "{dir}"], 1, "missing.kpc"),
        (["{scene}", "--cameras", "{text}", "-o", "{dir}"], 1, "not JSON"),
        (["{scene}", "--cameras", "{empty}", "-o", "{dir}"], 1, "frames"),
        (["{scene}", "--cameras", "{nan}", "-o", "{dir}"], 1, "NaN"),
        (["{scene}", "--path", "{missing}", "-o", "{dir}"], 1, "missing.kpc"),
        (["{scene}", "--path", "{nan}", "-o", "{dir}"], 1, "NaN"),
        (["{scene}", "--path", "{long}", "-o", "{dir}"], 2, "more than 100,000 pictures"),
        (["{scene}", "--path", "x", "--orbit", "2", "-o", "{dir}"], 2, "not allowed"),
        (["{scene}", "--orbit", "2", "-o", "{text}/inside"], 2, "text.kpc: is a file"),
        (["{scene}", "--orbit", "2", "-o", "{dir}/no/such/a.mp4"], 2, "no/such: no such folder"),
        (["{scene}", "--orbit", "2", "-o", "{dir}/a.png"], 2, "2 pictures do not go into one file"),
        (["{scene}", "--orbit", "0", "-o", "{dir}"], 2, "--orbit"),
        (["{scene}", "--orbit", "x", "-o", "{dir}"], 2, "--orbit"),
        (["{scene}", "--time", "1.5", "-o", "{dir}"], 2, "--time"),
        (["{scene}", "--size", "0x5", "-o", "{dir}"], 2, "--size"),
        (["{scene}", "--size", "640", "-o", "{dir}"], 2, "--size"),
        (["{scene}", "--fps", "-1", "-o", "{dir}"], 2, "--fps"),
        (["{scene}", "--orbit", "2", "--cameras", "x", "-o", "{dir}"], 2, "not allowed"),
        (["{scene}"], 2, "--output"),
        *(
            (["{scene}", "--time", "0", "-o", f"{{dir}}/x{suffix}"], 2, f"{suffix} is not written")
            for suffix in (".gif", ".webp", ".tiff", ".avi", ".MXF", ".v2")
        ),
        (["{scene}", "--time", "0", "-o", "-"], 2, "is no file"),
        *((["{scene}", "--time", "0", "-o", name], 2, "is no name") for name in ("{dir}/.png", "{dir}/x.")),
        (["{scene}", "--time", "0", "-o", "{folder}"], 2, "film.mp4: is a folder"),
        (["{scene}", "--time", "0", "--format", "exr", "-o", "{dir}/x.png"], 2, "contradicts .png"),
        (["{scene}", "--time", "0", "--format", "png", "-o", "{dir}/x.mp4"], 2, "contradicts .mp4"),
    ],
)
def test_bad_input_is_one_line(
    run, scene_file: Path, tmp_path: Path, arguments: list[str], code: int, words: str
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "film.mp4").mkdir()
    (tmp_path / "text.kpc").write_text("not a scene")
    (tmp_path / "empty.json").write_text("{}")
    pose = np.eye(4).tolist()
    pose[0][3] = float("nan")
    (tmp_path / "nan.json").write_text(json.dumps({"w": 4, "h": 4, "fl_x": 4, "frames": [{"transform_matrix": pose}]}))
    frames = [{"transform_matrix": np.eye(4).tolist(), "at": at} for at in (0, 80_000)]
    (tmp_path / "long.json").write_text(json.dumps({"w": 4, "h": 4, "fl_x": 4, "frames": frames}))
    names = {
        "long": tmp_path / "long.json",
        "scene": scene_file,
        "missing": tmp_path / "missing.kpc",
        "text": tmp_path / "text.kpc",
        "dir": out,
        "folder": tmp_path / "film.mp4",
        "empty": tmp_path / "empty.json",
        "nan": tmp_path / "nan.json",
    }
    got, printed, complaint = run(*[a.format(**names) for a in arguments], "--backend", "reference")
    assert got == code and printed == "" and words in complaint
    assert "Traceback" not in complaint
    last = [line for line in complaint.splitlines() if line.startswith("kprender:")]
    assert len(last) >= 1 and words in last[-1]
    assert list(out.iterdir()) == []


def test_a_directory_that_cannot_be_written(
    run, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path / "x.png"))

    monkeypatch.setattr("kpc.format.common.cli.tempfile.mkstemp", refuse)
    code, _, complaint = run(scene_file, "--time", 0, "-o", tmp_path / "x.png", "--backend", "reference")
    said = f"{tmp_path / 'x.png'}: cannot be written (Permission denied); give another name"
    assert code == 1 and complaint.splitlines()[-1] == f"kprender: {said}"


def test_without_opengl_the_reference_backend_is_offered(run, scene_file: Path, tmp_path: Path, monkeypatch) -> None:
    def refuse() -> None:
        raise DisplayError(f"no OpenGL 3.3 to be had: {offscreen.REMEDY}")

    monkeypatch.setattr(offscreen, "open_context", refuse)
    code, _, complaint = run(scene_file, "--time", 0, "-o", tmp_path / "x.png")
    assert code == 1 and "--backend reference" in complaint and "libegl1" in complaint and complaint.count("\n") == 1


def test_the_reference_backend_needs_no_opengl_module(scene_file: Path, tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules.update(moderngl=None, glfw=None, slimgui=None, torch=None); "
        "from kpc.tools.cli.kprender import main; sys.exit(main())"
    )
    arguments = [str(scene_file), "--time", "0", "-o", str(tmp_path / "x.png"), "--backend", "reference"]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, env=dict(os.environ), check=False
    )
    assert done.returncode == 0, done.stderr
    assert read_image(tmp_path / "x.png").shape == (36, 48, 3)
