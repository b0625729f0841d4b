"""Cameras of kpexport to glTF and USD, and back."""

import contextlib
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_kpexport import save

import kpc
from kpc.format.common.errors import MediaError
from kpc.format.scene.cameras import View, load_views, save_views
from kpc.format.scene.metadata import Metadata
from kpc.player.app.camera_paths import CameraPath
from kpc.player.viewpoints import fit_camera
from kpc.tools.cli import kpexport
from kpc.tools.exchange.gltf import GltfReader
from scenes import look_at, tiny_scene

TOLERANCE = 1e-6
EYES = [(2.4, 1.0, 2.2), (-1.8, 1.4, 2.6), (0.3, -0.7, -3.1)]
FORMATS = ["path.gltf", "path.usda", "path.usdc"]


def views(has_path: bool, centre: tuple[float, float] = (24.0, 18.0)) -> list[View]:
    cameras = [replace(look_at(eye, (0.1, 0.0, 0.2), 48, 36, 55.0), cx=centre[0], cy=centre[1]) for eye in EYES]
    cameras = [replace(camera, fl_y=50.0) for camera in cameras]
    ats = [0.5, 1.5, 4.0] if has_path else [None] * 3
    return [View(c, 0.3 * n, f"eye{n}.png", at) for n, (c, at) in enumerate(zip(cameras, ats, strict=True))]


def exchange(tmp_path: Path, name: str, *options: str, back: tuple[str, ...] = ()) -> list[View]:
    """Write tmp_path/in.json in a format of another program, and read it back."""
    if not name.endswith(".gltf"):
        pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    assert kpexport.main([str(tmp_path / "in.json"), "-o", str(tmp_path / name), *options]) == 0
    assert kpexport.main([str(tmp_path / name), "-o", str(tmp_path / "out.json"), *back]) == 0
    return load_views(tmp_path / "out.json")


def assert_same(found: list[View], wanted: list[View]) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        a, b = one.camera, other.camera
        assert (a.width, a.height) == (b.width, b.height)
        assert np.abs(a.camera_to_world - b.camera_to_world).max() < TOLERANCE
        assert math.isclose(a.fl_x, b.fl_x, rel_tol=TOLERANCE) and math.isclose(a.fl_y, b.fl_y, rel_tol=TOLERANCE)
        assert max(abs(a.cx - b.cx) / a.width, abs(a.cy - b.cy) / a.height) < TOLERANCE
        assert abs(one.time - other.time) < TOLERANCE
        assert (one.at_s is None) == (other.at_s is None)
        assert abs((one.at_s or 0.0) - (other.at_s or 0.0)) < TOLERANCE


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("has_path", [False, True])
def test_views_and_keyframes_come_back(tmp_path: Path, name: str, has_path: bool) -> None:
    save_views(tmp_path / "in.json", views(has_path, centre=(25.5, 16.0)))
    assert_same(exchange(tmp_path, name, *(["--keyframes"] if has_path else [])), views(has_path, centre=(25.5, 16.0)))


@pytest.mark.parametrize("name", FORMATS)
def test_a_path_is_sampled_along_its_smooth_course(tmp_path: Path, name: str) -> None:
    save_views(tmp_path / "in.json", views(True))
    path = CameraPath.load(tmp_path / "in.json")
    instants = [0.5 + n / 8 for n in range(29)]
    wanted = [View(*path.at(at_s), "", at_s) for at_s in instants]
    assert_same(exchange(tmp_path, name, "--fps", "8"), wanted)


@pytest.mark.parametrize("name", FORMATS)
def test_the_scene_places_cameras_both_ways(tmp_path: Path, name: str) -> None:
    scene = replace(tiny_scene(4), metadata=Metadata({"up": [0, 0, 1], "metres_per_unit": 0.25}))
    file = str(save(scene, tmp_path / "scene.kpc"))
    save_views(tmp_path / "in.json", views(False))
    assert_same(exchange(tmp_path, name, "--scene", file, back=("--scene", file)), views(False))
    placed = exchange(tmp_path, name, "--scene", file)[0].camera.camera_to_world
    x, y, z = EYES[0]
    assert np.abs(placed[:3, 3] - 0.25 * np.array([x, z, -y])).max() < TOLERANCE


@pytest.mark.parametrize("name", FORMATS)
def test_cameras_of_a_scene_come_back_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    metadata = Metadata({"up": [0, 0, 1], "camera_names": ["left", "right café 2"]})
    scene = replace(tiny_scene(4), metadata=metadata)
    file, out = str(save(scene, tmp_path / "scene.kpc")), str(tmp_path / "out.json")
    assert kpexport.main([file, "-o", str(tmp_path / name)]) == 0
    assert "y is up, in units of the scene" in capsys.readouterr().err
    assert kpexport.main([str(tmp_path / name), "-o", out, "--scene", file, "--camera", "right café 2"]) == 0
    assert_same(load_views(out), [View(kpc.load(file).cameras[1], 0.0, "right café 2.png")])


@pytest.mark.parametrize("name", FORMATS[:2])
def test_another_size_keeps_the_vertical_field_of_view_and_the_shape_of_pixels(tmp_path: Path, name: str) -> None:
    before = views(False, centre=(25.5, 16.0))
    save_views(tmp_path / "in.json", before)
    wanted = [replace(view, camera=fit_camera(view.camera, 320, 90)) for view in before]
    assert_same(exchange(tmp_path, name, back=("--size", "320x90")), wanted)


def test_usd_cameras_that_are_renamed_have_their_new_names(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    save_views(tmp_path / "in.json", [replace(view, file=f"eye {n}.png") for n, view in enumerate(views(False))])
    assert [view.file for view in exchange(tmp_path, "a.usda")] == ["eye 0.png", "eye 1.png", "eye 2.png"]
    (tmp_path / "a.usda").write_text((tmp_path / "a.usda").read_text().replace("eye_1", "main"))
    assert kpexport.main([str(tmp_path / "a.usda"), "-o", str(tmp_path / "out.json")]) == 0
    assert [view.file for view in load_views(tmp_path / "out.json")] == ["eye 0.png", "main.png", "eye 2.png"]


def test_a_gltf_camera_is_valid_and_can_be_edited(tmp_path: Path) -> None:
    save_views(tmp_path / "in.json", views(True))
    out = tmp_path / "path.gltf"
    assert kpexport.main([str(tmp_path / "in.json"), "-o", str(out), "--fps", "4"]) == 0
    document = json.loads(out.read_text())
    reader = GltfReader(out)
    for number, accessor in enumerate(document["accessors"]):
        values = reader.floats(number, accessor["type"]).reshape(accessor["count"], -1)
        assert accessor["min"] == values.min(0).tolist() and accessor["max"] == values.max(0).tolist()
    ends = [view["byteOffset"] + view["byteLength"] for view in document["bufferViews"]]
    assert max(ends) == document["buffers"][0]["byteLength"]
    # as another program writes it: no extras, a parent that turns and scales, no animation
    del document["animations"]
    node = document["nodes"][0]
    del node["extras"]
    document["nodes"].append({"children": [0], "scale": [2, 2, 2], "rotation": [0, 0, 0, 1], "translation": [1, 0, 0]})
    out.write_text(json.dumps(document))
    assert kpexport.main([str(out), "-o", str(tmp_path / "out.json"), "--size", "480x360"]) == 0
    (view,) = load_views(tmp_path / "out.json")
    assert view.at_s is None and (view.camera.width, view.camera.height) == (480, 360)
    assert np.abs(view.camera.camera_to_world[:3, 3] - (2 * np.array(EYES[0]) + [1, 0, 0])).max() < TOLERANCE
    # its pixels may not have been square, which only extras say
    assert math.isclose(view.camera.fl_x, 500, rel_tol=TOLERANCE) and math.isclose(view.camera.fl_y, 500)


@pytest.mark.skipif(os.name != "posix", reason="names of files are Unicode")
def test_names_that_usd_cannot_have_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    save_views(tmp_path / "in.json", views(False))
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.usda")
    for words in (tmp_path / "in.json", odd), (odd, tmp_path / "out.json"):
        Path(words[0]).touch()
        assert kpexport.main([str(words[0]), "-o", str(words[1])]) == 1
        assert capsys.readouterr().err.endswith("USD files need names that are valid Unicode; choose another name\n")


def test_usd_of_other_programs_is_turned_and_scaled(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    (tmp_path / "z.usda").write_text(
        '#usda 1.0\n(\n    metersPerUnit = 0.01\n    upAxis = "Z"\n)\n'
        'def Camera "cam"\n{\n    float focalLength = 50\n    float horizontalAperture = 25\n'
        "    float verticalAperture = 12.5\n    double3 xformOp:translate = (100, 200, 300)\n"
        '    uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    )
    assert kpexport.main([str(tmp_path / "z.usda"), "-o", str(tmp_path / "out.json")]) == 0
    (view,) = load_views(tmp_path / "out.json")
    assert (view.camera.width, view.camera.height) == (1920, 960)
    assert math.isclose(view.camera.fl_x, 3840) and math.isclose(view.camera.fl_y, 3840)
    pose = view.camera.camera_to_world
    assert np.allclose(pose[:3, 3], [1, 3, -2]) and np.allclose(pose[:3, 2], [0, 1, 0])  # it looked down
    assert kpexport.main([str(tmp_path / "z.usda"), "-o", str(tmp_path / "out.json"), "--size", "320x90"]) == 0
    lens = load_views(tmp_path / "out.json")[0].camera
    assert (lens.width, lens.height) == (320, 90) and math.isclose(lens.fl_x, 360) and math.isclose(lens.fl_y, 360)


def test_a_camera_that_turns_with_what_holds_it_is_sampled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    (tmp_path / "turn.usda").write_text(
        '#usda 1.0\n(\n    metersPerUnit = 1\n    timeCodesPerSecond = 24\n    upAxis = "Y"\n)\n'
        'def Xform "rig"\n{\n    float xformOp:rotateY.timeSamples = { 24: 0, 72: 360, 96: 360 }\n'
        '    uniform token[] xformOpOrder = ["xformOp:rotateY"]\n    def Camera "cam"\n    {\n'
        '        double3 xformOp:translate = (0, 1, 4)\n        uniform token[] xformOpOrder = ["xformOp:translate"]\n'
        "    }\n}\n"
    )
    assert kpexport.main([str(tmp_path / "turn.usda"), "-o", str(tmp_path / "out.json")]) == 0
    found = load_views(tmp_path / "out.json")
    assert [view.at_s for view in found] == pytest.approx([1 + number / 24 for number in range(49)] + [4.0])
    assert [view.time for view in found] == pytest.approx([number / 72 for number in range(49)] + [1.0])
    angles = 2 * math.pi * np.arange(49) / 48
    eyes = np.stack([view.camera.camera_to_world[:3, 3] for view in found[:49]])
    assert np.abs(eyes - np.stack([4 * np.sin(angles), np.ones(49), 4 * np.cos(angles)], axis=1)).max() < 1e-5
    assert "sampled 24 times a second" in capsys.readouterr().err


def test_a_camera_that_jumps_stays_until_it_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_views(tmp_path / "in.json", views(True))
    out = tmp_path / "path.gltf"
    assert kpexport.main([str(tmp_path / "in.json"), "-o", str(out), "--keyframes"]) == 0
    document = json.loads(out.read_text())
    for sampler in document["animations"][0]["samplers"]:
        sampler["interpolation"] = "STEP"
    out.write_text(json.dumps(document))
    assert kpexport.main([str(out), "-o", str(tmp_path / "out.json")]) == 0
    found = load_views(tmp_path / "out.json")
    assert [view.at_s for view in found] == pytest.approx([0.5 + number / 24 for number in range(85)])
    nearest = [int(np.abs(np.array(EYES) - view.camera.camera_to_world[:3, 3]).max(1).argmin()) for view in found]
    assert nearest == [0] * 24 + [1] * 60 + [2]
    assert [found[number].time for number in (0, 12, 24, 54, 84)] == pytest.approx([0, 0.15, 0.3, 0.45, 0.6])
    assert "sampled 24 times a second" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda d: d["accessors"][0].update(count=10**6), "outside its buffer"),
        (lambda d: d["accessors"][0].update(bufferView=-1), "no entry"),
        (lambda d: d["buffers"][0].update(uri="../secret.bin"), "no plain file"),
        (lambda d: d["nodes"][0].update(children=[0]), "is its own"),
        (lambda d: d["cameras"][0]["perspective"].update(yfov=math.nan), "yfov"),
        (lambda d: d["cameras"][0]["perspective"].update(aspectRatio=0), "focal length"),
        (lambda d: d["animations"][0]["samplers"][0].update(interpolation="CUBICSPLINE"), "every frame"),
        (lambda d: d["animations"][0]["channels"][0]["target"].update(node=7), "no entry"),
        (lambda d: d.update(nodes={}), "not a list"),
        (lambda d: d.pop("asset"), "not glTF 2.0"),
    ],
)
def test_damaged_gltf_is_refused_in_one_line(
    tmp_path: Path, edit, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_views(tmp_path / "in.json", views(True))
    out = tmp_path / "path.gltf"
    kpexport.main([str(tmp_path / "in.json"), "-o", str(out), "--keyframes"])
    document = json.loads(out.read_text())
    edit(document)
    out.write_text(json.dumps(document))
    capsys.readouterr()
    assert kpexport.main([str(out), "-o", str(tmp_path / "out.json")]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(f"kpexport: {out}") and reason in error
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("no usd", "not USD"),
        ("#usda 1.0\n(\n    subLayers = [@other.usda@]\n)\n", "refers to other files"),
        ('#usda 1.0\ndef Camera "c"\n{\n    float focalLength = -1\n}\n', "must be positive"),
        ("#usda 1.0\n", "no perspective camera"),
    ],
)
def test_damaged_usd_is_refused_in_one_line(
    tmp_path: Path, text: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    (tmp_path / "in.usda").write_text(text)
    assert kpexport.main([str(tmp_path / "in.usda"), "-o", str(tmp_path / "out.json")]) == 1
    assert reason in capsys.readouterr().err.splitlines()[-1]


def test_usd_that_cannot_be_written_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed, which reads and writes USD")
    from kpc.tools.exchange import usd_cameras

    aside = tmp_path / "aside.usda"
    aside.mkdir()  # which no file replaces
    monkeypatch.setattr(usd_cameras, "atomic_write", lambda path: contextlib.nullcontext(aside))
    with pytest.raises(MediaError, match=r"out\.usda: cannot be written \(.+\)$"):
        usd_cameras.write_usd_cameras(tmp_path / "out.usda", [], 24.0)


OWN, SCENES, PATHS = "is not for a scene's own cameras", "is for scenes", "is for paths, and "


@pytest.mark.parametrize(
    ("source", "output", "words", "reason"),
    [
        ("s.kpc", "x.gltf", ["--time", "0"], OWN),
        ("s.kpc", "x.gltf", ["--from", "0"], OWN),
        ("s.kpc", "x.gltf", ["--step", "2"], OWN),
        ("s.kpc", "x.gltf", ["--backend", "gl"], OWN),
        ("s.kpc", "x.gltf", ["--quality", "reference"], OWN),
        ("in.json", "x.gltf", ["--step", "1"], SCENES),
        ("in.json", "x.gltf", ["--appearance", "a"], SCENES),
        ("x.glb", "out.json", ["--quality", "balanced"], SCENES),
        ("s.kpc", "x.glb", ["--mesh", "--quality", "balanced"], "is for points"),
        ("s.kpc", "x.glb", ["--mesh", "--backend", "reference"], "is for points"),
        ("in.json", "x.gltf", ["--keyframes"], PATHS),
        ("in.json", "x.gltf", ["--fps", "8"], "is for the smooth course of a path"),
    ],
)
def test_options_that_change_nothing_are_refused(
    tmp_path: Path, source: str, output: str, words: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_views(tmp_path / "in.json", views(False))
    assert kpexport.main([str(tmp_path / source), "-o", str(tmp_path / output), *words]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    option = next(word for word in reversed(words) if word.startswith("--"))
    assert said.startswith(f"kpexport: {option} {reason}") and said.endswith("; leave it out")
