"""Cameras of bare videos: what a folder is taken for, structure from motion, the document and reading it back."""

import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import textured_room
from kpc.encoder.datasets import load_dataset
from kpc.encoder.evaluation.camera_page import write_camera_page
from kpc.encoder.poses.footage import find_footage, left_out
from kpc.format.common.errors import DatasetError
from textured_room import FOCAL, FPS, SIZE, aligned, rig, write_films, write_pictures
from videos import film

pytest.importorskip("pycolmap", reason="needs pycolmap, of the extra poses")
pytest.importorskip("scipy", reason="needs scipy, of the extra poses")

from kpc.encoder.cli import kpposes, read_dataset
from kpc.encoder.cli.options import parse
from kpc.encoder.poses import find
from kpc.encoder.poses.clocks import UNKNOWN
from kpc.encoder.poses.epipolar_lines import LINES
from kpc.encoder.poses.orientation import looked_at, up_direction
from kpc.encoder.poses.structure import Structure

LATE = (0, 7, 0, 3, 12)  # frames
CAMERAS = rig(5, LATE)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of five films that begin at different times, and nothing else."""
    folder = tmp_path_factory.mktemp("bare") / "room"
    write_films(folder, CAMERAS, 70)
    return folder


@pytest.fixture(scope="module")
def document(room: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What `kpposes` writes about it, and nothing else: COLMAP's log does not stay."""
    file, temporary = room.parent / "transforms.json", tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(temporary))
        patch.setattr(tempfile, "tempdir", None)
        assert kpposes.main([str(room), "-o", str(file), "--distance", "cam00,cam04=1.5"]) == 0
    assert not list(temporary.iterdir())
    return json.loads(file.read_text())


def test_all_cameras_of_a_still_rig_are_placed(document):
    frames = document["frames"]
    assert [frame["file_path"] for frame in frames] == [f"{camera.name}.mp4" for camera in CAMERAS]
    poses = np.array([frame["transform_matrix"] for frame in frames])
    centres, angle = aligned(poses, np.stack([camera.pose for camera in CAMERAS]))
    assert centres < 0.01 and angle < 0.2
    assert frames[0]["fl_x"] == pytest.approx(FOCAL, rel=0.03)
    assert [frames[0]["w"], frames[0]["h"]] == list(SIZE)


def test_videos_are_brought_in_step_by_what_moves(document):
    offsets = np.array([frame.get("time_offset", 0.0) for frame in document["frames"]])
    assert offsets - offsets[0] == pytest.approx(np.array(LATE) / FPS, abs=0.2 / FPS)


def test_a_page_shows_the_cameras(room, document):
    page = (room.parent / "cameras.html").read_text()
    assert "still rig: 5 of 5 placed" in page
    assert page.count('<polyline class="curve"') == page.count("<img") == 5
    assert page.count('<polyline class="check"') == page.count('<circle class="check"') == 5 * LINES
    assert page.count("<td>motion</td>") == 5


def test_the_world_is_upright_and_in_metres(document):
    poses = np.array([frame["transform_matrix"] for frame in document["frames"]])
    assert np.linalg.norm(poses[0, :3, 3] - poses[4, :3, 3]) == pytest.approx(1.5, rel=1e-6)
    assert np.abs(poses[:, 2, 0]).max() < 0.02  # no camera is rolled
    assert document["unit"] == "metre"
    near, far = (np.array([frame[key] for frame in document["frames"]]) for key in ("near", "far"))
    assert (0 < near).all() and (near < far).all()


def test_the_document_is_read_back_with_its_clocks(room, document, tmp_path):
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(document))
    dataset = load_dataset(room, tmp_path / "cache", progress=False, transforms=file)
    assert dataset.clip.fps == FPS
    assert dataset.clip.frame_count == 70 - max(LATE)
    assert not dataset.pictures.is_test.any()
    assert dataset.clocks["cam04.mp4"][0] == document["frames"][4]["time_offset"]
    held_out = load_dataset(room, tmp_path / "cache", progress=False, transforms=file, holdout="cam02")
    assert {held_out.pictures.file[k] for k in np.flatnonzero(held_out.pictures.is_test)} == {"cam02.mp4"}


@pytest.mark.parametrize(
    "change, said",
    [
        ({"time_rate": 3.0}, r"time_rate 3 is not from 0\.5 to 2;"),
        ({"w": None}, "needs w and h"),
        ({"near": 5.0, "far": 1.0}, "near"),
    ],
)
def test_a_document_that_makes_no_sense_is_refused(room, document, tmp_path, change, said):
    document = json.loads(json.dumps(document))
    frame = document["frames"][1] | change
    document["frames"][1] = {key: value for key, value in frame.items() if value is not None}
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(document))
    with pytest.raises(DatasetError, match=said):
        load_dataset(room, tmp_path / "cache", progress=False, transforms=file)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder of the numbered pictures of a camera that is carried along an arc, and its poses (N, 4, 4)."""
    folder = tmp_path_factory.mktemp("walk") / "pictures"
    places = rig(5)
    write_pictures(folder, places)
    return folder, np.stack([place.pose for place in places])


@pytest.mark.parametrize("kind", ["photographs", "moving camera"])
def test_a_carried_camera_is_placed(walk, kind, tmp_path, capsys):
    folder, poses = walk
    file = tmp_path / "transforms.json"
    options = ["--rig", "moving"] if kind == "moving camera" else []
    assert kpposes.main([str(folder), "-o", str(file), *options]) == 0
    said, document = capsys.readouterr().err, json.loads(file.read_text())
    assert "warning" not in said
    assert document["kind"] == kind
    assert ("--rig moving for the frames of a clip" in said) == (kind == "photographs")
    frames = document["frames"]
    assert [frame["file_path"] for frame in frames] == [f"cam{number:02d}.png" for number in range(5)]
    centres, angle = aligned(np.array([frame["transform_matrix"] for frame in frames]), poses)
    assert centres < 0.01 and angle < 0.2
    assert all(("far" in frame) == (kind == "moving camera") for frame in frames)
    times = [frame.get("time") for frame in frames]
    assert times == (pytest.approx(np.linspace(0, 1, 5)) if kind == "moving camera" else [None] * 5)


def test_patterns_that_repeat_themselves_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(textured_room, "PERIOD", 200)
    monkeypatch.setattr(textured_room, "_texture", textured_room._texture.__wrapped__)
    write_pictures(tmp_path / "pictures", rig(8)[2:])
    assert kpposes.main([str(tmp_path / "pictures")]) == 0
    assert "contradict where these were placed: patterns that repeat themselves" in capsys.readouterr().err


def test_it_is_said_if_no_clock_is_found(tmp_path, monkeypatch, capsys):
    nothing = Structure({}, np.zeros((0, 3)), np.zeros((0, 4)), {})
    monkeypatch.setattr(find, "reconstruct", lambda *_: nothing)
    for name in ("a", "b", "c"):
        film(tmp_path / f"{name}.mp4")
    assert kpposes.main([str(tmp_path), "--rig", "still", "--sync", "audio"]) == 1
    said = "warning: no clocks could be found by sound, and all are left as they are; drop --sync audio, film a clap"
    assert capsys.readouterr().err.count(said) == 1
    assert kpposes.main([str(tmp_path), "--rig", "still", "--sync", "none"]) == 1
    assert "clocks" not in capsys.readouterr().err
    footage, unknown, known = find_footage(tmp_path), [UNKNOWN] * 3, replace(UNKNOWN, method="motion")
    for sync, way in (("auto", "sound or what moves"), ("motion", "what moves")):
        find._warn_if_none_found(tmp_path, footage, unknown, sync)
        assert f"warning: no clocks could be found by {way}, and all are left as" in capsys.readouterr().err
    find._warn_if_none_found(tmp_path, footage, [UNKNOWN, known, known], "auto")
    find._warn_if_none_found(tmp_path, [replace(one, video=None) for one in footage], unknown, "auto")
    assert not capsys.readouterr().err


def test_videos_without_a_time_in_common_are_named(tmp_path, capsys):
    for name in ("a", "b", "c"):
        film(tmp_path / f"{name}.mp4")  # 1.2 s
    footage = find_footage(tmp_path)
    for late, count in ((1.0, 0), (100.0, 1)):
        clocks = [UNKNOWN, replace(UNKNOWN, offset_s=late, method="given"), UNKNOWN]
        find._warn_if_nothing_in_common(tmp_path, list(zip(footage, clocks, strict=True)))
        said = capsys.readouterr().err
        assert said.count("no time in common, and kpenc will refuse them: a ends at 1.1 s, b starts at 100 s;") == count
    find._warn_if_nothing_in_common(tmp_path, [(replace(one, video=None), UNKNOWN) for one in footage])


def test_two_cameras_are_too_few(tmp_path, capsys):
    for name in ("a", "b"):
        film(tmp_path / f"{name}.mp4")
    assert kpposes.main([str(tmp_path), "--rig", "still"]) == 1
    assert "2 cameras that stand still: depth needs 3 or more" in capsys.readouterr().err


def test_what_cannot_be_matched_is_named(tmp_path, capsys):
    for name in ("a", "b", "c"):
        film(tmp_path / f"{name}.mp4")  # patches of colour without texture
    assert kpposes.main([str(tmp_path), "--rig", "still"]) == 1
    said = capsys.readouterr().err
    assert "0 of 3 cameras could be placed, too few: a (matches none)" in said
    assert not (tmp_path / "transforms.json").exists()


@pytest.mark.parametrize(
    "options, said",
    [
        (["--distance", "a,cam99=1"], "--distance: cam99 is not there; there are a, b, c"),
        (["--sync", "nosuch.json"], "nosuch.json: no such file"),
        (["--sync", "offsets.json"], "cam99; there are a, b, c"),
    ],
)
def test_cameras_that_are_not_there_are_refused_before_videos_are_read(tmp_path, monkeypatch, capsys, options, said):
    for name in ("a", "b", "c"):
        film(tmp_path / f"{name}.mp4")
    (tmp_path / "offsets.json").write_text('{"cam99": 1}')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("kpc.encoder.poses.find.survey", lambda _: pytest.fail("a video was read"))
    assert kpposes.main([".", *options]) == 1 and said in capsys.readouterr().err


def test_footage_that_is_not_there_is_named(tmp_path, capsys):
    for options in ([], ["-o", str(tmp_path / "x.json")]):
        assert kpposes.main([str(tmp_path / "nosuch"), *options]) == 2
        assert "nosuch: no such folder; give a folder of videos" in capsys.readouterr().err


def test_it_is_said_if_kpenc_reads_other_poses(walk, tmp_path, capsys):
    folder = tmp_path / "set"
    shutil.copytree(walk[0], folder)
    (folder / "poses_bounds.npy").touch()
    assert kpposes.main([str(folder)]) == 0
    assert "kpenc reads the folder in the layout of LLFF, and not this file" in capsys.readouterr().err


def test_only_a_document_of_kpposes_is_replaced(tmp_path, capsys):
    film(tmp_path / "a.mp4")
    (tmp_path / "transforms.json").write_text('{"frames": []}')  # poses that were given
    for output, complaint in (("a.mp4", "does not end in .json"), ("transforms.json", "and stays")):
        before = (tmp_path / output).read_bytes()
        try:
            code = kpposes.main([str(tmp_path), "-o", str(tmp_path / output)])
        except SystemExit as ended:
            code = ended.code
        assert code == 2 and complaint in capsys.readouterr().err and (tmp_path / output).read_bytes() == before
    (tmp_path / "transforms.json").write_text('{"made_by": "kpposes"}')
    (tmp_path / "cameras.html").write_text("<title>My cameras</title>")
    assert kpposes.main([str(tmp_path)]) == 2 and "cameras.html: is no page of KPC and stays" in capsys.readouterr().err
    write_camera_page(tmp_path / "cameras.html", "found before", [], [])
    assert kpposes.main([str(tmp_path), "--rig", "still"]) == 1
    said = capsys.readouterr().err
    assert "depth needs 3 or more" in said and f"replaces {tmp_path / 'transforms.json'}, with any edits" in said


def test_cameras_are_found_anew_if_what_they_depend_on_changes(tmp_path, monkeypatch, capsys):
    (tmp_path / "set").mkdir()
    for name in ("a", "b", "c"):
        film(tmp_path / "set" / f"{name}.mp4")
    offsets = tmp_path / "offsets.json"
    offsets.write_text('{"a": 1}')

    def said(*options: str) -> str:
        words = [str(tmp_path / "set"), "-o", str(tmp_path / "x.kpc"), *options]
        with pytest.raises(DatasetError, match="stopped here"):
            read_dataset.read_dataset(parse(words)[0])
        return capsys.readouterr().err

    def stop(*_: object, **__: object) -> None:
        raise DatasetError("stopped here")

    monkeypatch.setattr("kpc.encoder.poses.find.find_poses", lambda *_: None)
    monkeypatch.setattr("kpc.encoder.poses.document.write_document", lambda _, __, file: file.write_text("{}"))
    monkeypatch.setattr("kpc.encoder.cli.kpposes.report", lambda _: "")
    monkeypatch.setattr("kpc.encoder.poses.page.write_page", lambda *_: None)
    monkeypatch.setattr(read_dataset, "load_dataset", stop)
    sync = ("--sync", str(offsets))
    assert "has no poses; finding the cameras" in said(*sync)
    assert "cameras: those found before" in said(*sync)
    offsets.write_text('{"a": 2}')
    assert "--sync changed since the cameras were found; finding" in said(*sync)
    assert "--distance changed" in said(*sync, "--distance", "a,b=2")
    film(tmp_path / "set" / "d.mp4")
    assert "the footage changed" in said(*sync, "--distance", "a,b=2")


def test_cameras_are_named_by_their_folders(tmp_path):
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        film(tmp_path / name / "GOPR0001.MP4")
    assert [footage.name for footage in find_footage(tmp_path)] == ["left", "right"]


@pytest.mark.parametrize("holdout", ["bb", "c/000003", "bb/000001"])
def test_what_is_held_out_is_looked_up_before_cameras_are_found(tmp_path, monkeypatch, holdout):
    (tmp_path / "set").mkdir()
    for name in ("a", "b", "c"):
        film(tmp_path / "set" / f"{name}.mp4", count=3)
    monkeypatch.setattr("kpc.encoder.poses.find.find_poses", lambda *_: pytest.fail("cameras are looked for"))
    options = parse([str(tmp_path / "set"), "-o", str(tmp_path / "x.kpc"), "--holdout", holdout])[0]
    with pytest.raises(DatasetError, match=f"no file or folder is named '{holdout}'; give --holdout one of a, b, c"):
        read_dataset.read_dataset(options)


def test_of_a_mixture_it_is_said_what_is_left_out(tmp_path, capsys):
    for name in ("a.mp4", "b.mp4"):
        film(tmp_path / name)
    (tmp_path / "transforms.images-2").mkdir()
    (tmp_path / "photos").mkdir()
    (tmp_path / "masks").mkdir()
    (tmp_path / "transforms.json").write_text('{"made_by": "kpposes"}')
    for name in ("c.png", "photos/d.png", "transforms.images-2/e.png", "dynamic_mask_c.png", "masks/c.png"):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / name)
    assert kpposes.main([str(tmp_path), "-o", str(tmp_path / "x.json"), "--rig", "still"]) == 1
    said = "2 files beside the videos belong to no camera and are left out: c.png, photos/d.png\n"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("name", "unused"), [("masks", []), ("Mask", [f"Mask/{n}.png" for n in range(6)])])
def test_masks_are_no_footage(tmp_path, name, unused):
    for folder in ("images", name):
        (tmp_path / folder).mkdir()
        for number in range(6):
            Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / folder / f"{number}.png")
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "images" / "dynamic_mask_0.png")
    footage = find_footage(tmp_path)
    assert [one.files[0].parent.name for one in footage] == ["images"] * 6 and left_out(tmp_path, footage) == unused


def test_folders_of_frames_may_have_any_name(tmp_path):
    for folder in ("left.images", "right"):
        (tmp_path / folder).mkdir()
        for number in range(6):
            Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / folder / f"{number}.png")
    assert [one.name for one in find_footage(tmp_path)] == ["left.images", "right"]


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="holds no videos"):
        find_footage(tmp_path)


def test_up_is_across_the_cameras_horizons_and_the_origin_where_they_look():
    poses = np.stack([camera.pose for camera in CAMERAS])
    assert up_direction(poses) == pytest.approx([0, 0, 1], abs=1e-9)
    assert looked_at(poses) == pytest.approx([0, 0, 0.6], abs=1e-9)
