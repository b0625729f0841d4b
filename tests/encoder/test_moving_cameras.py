"""Several cameras that move: where and when their pictures were taken, what is said of them, and what is refused."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("scipy", reason="needs scipy, of the extra poses")

from kpc.encoder.cli import kpposes
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.sound import find_sound
from kpc.encoder.datasets import load_dataset
from kpc.encoder.datasets.layouts import nerfstudio
from kpc.encoder.poses import find, structure
from kpc.encoder.poses.clocks import UNKNOWN, Clock
from kpc.encoder.poses.footage import Footage, find_footage
from kpc.encoder.poses.structure import Pairing, PlacedView, Structure
from kpc.encoder.poses.takes import Take, Track, pairing_of, take_of
from kpc.encoder.poses.wishes import Wishes
from kpc.format.common.errors import DatasetError
from kpc.format.scene.sound import SAMPLE_RATE
from sounds import add_track, decoded, offset_of
from textured_room import RigCamera, aligned, pose_at, write_walk
from videos import film

FRAMES, FPS, LATE_S = 14, 10.0, 0.225
FOCALS = {"left": 240.0, "right": 300.0}
# The frames that lie in the time that both filmed, to within half a frame.
USED = {"left": range(2, 14), "right": range(12)}
START_S, SPAN_S = 0.2, 1.125  # of that time, by the clock of the left one


def places(name: str) -> list[RigCamera]:
    """Return where a camera is at each of its frames: both walk on an arc, one against the other."""
    azimuths = np.linspace(-24, 8, FRAMES) * (1 if name == "left" else -1)
    height = {"left": 1.2, "right": 1.5}[name]
    return [
        RigCamera(name, pose_at(azimuth, height + 0.15 * np.sin(azimuth / 5)), focal=FOCALS[name])
        for azimuth in azimuths
    ]


def noises(seconds: float) -> np.ndarray:
    """Return short noises at random times, (N,) float32: what both cameras hear."""
    rng = np.random.default_rng(3)
    samples = 0.003 * rng.standard_normal(round(seconds * SAMPLE_RATE))
    for start in rng.integers(0, len(samples) - 3000, 12):
        samples[start : start + 3000] += 0.3 * rng.standard_normal(3000) * np.exp(-np.arange(3000) / 500)
    return samples.astype(np.float32)


HEARD = noises(2.0)


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the films of two cameras of different lenses, one of which begins a little later; with sound."""
    folder = tmp_path_factory.mktemp("walks") / "films"
    for name, start_s in (("left", 0.0), ("right", LATE_S)):
        write_walk(folder / f"{name}.mp4", places(name), FPS, start_s)
        first = round(start_s * SAMPLE_RATE)
        add_track(folder / f"{name}.mp4", HEARD[first : first + round(FRAMES / FPS * SAMPLE_RATE)])
    return folder


@pytest.fixture(scope="module")
def file(walks: Path) -> Path:
    """The document that `kpposes` writes about them, in a folder of its own."""
    pytest.importorskip("pycolmap", reason="needs pycolmap, of the extra poses")
    file = walks.parent / "found" / "transforms.json"
    file.parent.mkdir()
    assert kpposes.main([str(walks), "-o", str(file), "--require-all", "--distance", "left/000002,right/000000=3"]) == 0
    return file


def frames_of(file: Path) -> list[tuple[str, int, dict]]:
    """Return the name of the camera, the number, and the entry of each frame of a document."""
    frames = json.loads(file.read_text())["frames"]
    paths = [Path(frame["file_path"]) for frame in frames]
    return [(path.parent.name, int(path.stem), frame) for path, frame in zip(paths, frames, strict=True)]


def test_the_pictures_of_both_are_placed_with_lenses_of_their_own(file):
    frames = frames_of(file)
    assert [(name, number) for name, number, _ in frames] == [(name, n) for name in USED for n in USED[name]]
    true = np.stack([places(name)[number].pose for name, number, _ in frames])
    found = np.array([frame["transform_matrix"] for *_, frame in frames])
    centres, angle = aligned(found, true)
    assert centres < 0.01 and angle < 0.2
    for name, _, frame in frames:
        assert frame["fl_x"] == pytest.approx(FOCALS[name], rel=0.02)
    ends = found[[0, len(USED["left"])], :3, 3]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(3.0, rel=1e-6)


def test_each_picture_keeps_its_own_time_by_the_sound(file):
    document = json.loads(file.read_text())
    assert (document["kind"], document["fps"], document["frame_count"]) == ("moving cameras", FPS, 12)
    for name, number, frame in frames_of(file):
        time_s = number / FPS + (LATE_S if name == "right" else 0.0)
        assert frame["time"] == pytest.approx((time_s - START_S) / SPAN_S, abs=0.002 / SPAN_S)


def test_a_dataset_of_images_with_the_sound_of_the_videos_is_read_back(walks, file, tmp_path):
    dataset = load_dataset(file.parent, tmp_path, progress=False, transforms=file, footage=walks)
    assert (dataset.clip.frame_count, dataset.clip.fps) == (12, FPS)
    assert dataset.poses_found and not dataset.is_monocular
    assert dataset.pictures.is_test.tolist() == [number % 8 == 0 for number in range(24)]
    assert [dataset.camera_names[c] for c in dataset.pictures.camera[[0, 23]]] == ["left/000002", "right/000011"]
    other = load_dataset(file.parent, tmp_path, progress=False, transforms=file, footage=walks, holdout="right")
    assert other.pictures.is_test.tolist() == [name == "right" for name, *_ in frames_of(file)]
    expected = HEARD[round(START_S * SAMPLE_RATE) :]
    for name in FOCALS:
        sound, found = find_sound(Options(Path("in"), Path("out.kpc"), audio=name), dataset)
        assert found == f"{name}.mp4"
        samples = decoded(sound)[:, 0]
        assert abs(offset_of(samples, expected[: len(samples)])) < 0.001 * SAMPLE_RATE


def test_documents_in_one_folder_have_frames_and_pages_of_their_own(films, placed, tmp_path):
    for name in ("one", "two"):
        assert kpposes.main([str(films), "-o", str(tmp_path / f"{name}.json"), "--rig", "moving"]) == 0
        paths = [frame["file_path"] for frame in json.loads((tmp_path / f"{name}.json").read_text())["frames"]]
        assert paths == [f"{name}.images/a/{number:06d}.png" for number in range(12)]
        assert all((tmp_path / path).is_file() for path in paths)
        assert (tmp_path / f"{name}.cameras.html").is_file()


def test_frames_of_an_earlier_document_stay(films, placed, tmp_path, monkeypatch, capsys):
    def run() -> set[str]:
        assert kpposes.main([str(films), "-o", str(tmp_path / "one.json"), "--rig", "moving"]) == 0
        paths = [frame["file_path"] for frame in json.loads((tmp_path / "one.json").read_text())["frames"]]
        assert all((tmp_path / path).is_file() for path in paths)
        return {path.partition("/")[0] for path in paths}

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    (tmp_path / "one.images").mkdir()
    assert run() == {"one.images-2"} and f"{tmp_path / 'one.images'}: stays" in capsys.readouterr().err
    (tmp_path / "one.json").rename(tmp_path / "transforms.json")
    assert run() == {"one.images-3"}
    before = (tmp_path / "one.json").read_bytes()
    monkeypatch.setattr("kpc.encoder.poses.document.write_image", interrupt)
    assert kpposes.main([str(films), "-o", str(tmp_path / "one.json"), "--rig", "moving"]) == 130
    assert (tmp_path / "one.json").read_bytes() == before and not (tmp_path / "one.images-4").exists()
    assert sorted(folder.name for folder in tmp_path.glob("*.images*")) == [f"one.images{n}" for n in ("", "-2", "-3")]


@pytest.mark.parametrize(
    ("name", "said"), [("out/A.json", "kpenc reads these cameras once the file is"), ("out/transforms.json", "")]
)
def test_it_is_said_where_a_document_is_read(films, placed, tmp_path, capsys, name, said):
    (tmp_path / "out").mkdir()
    assert kpposes.main([str(films), "-o", str(tmp_path / name), "--rig", "moving"]) == 0
    found = f"{said} {tmp_path / 'out' / 'transforms.json'}" in capsys.readouterr().err
    assert found == bool(said)


@pytest.mark.parametrize("holdout, count", [("left", 12), ("left/000003", 1), ("000003", 2), ("right/000003.png", 1)])
def test_a_camera_or_a_picture_is_held_out_by_its_name(file, tmp_path, holdout, count):
    held_out = nerfstudio.read(file.parent, holdout, file).views
    assert sum(view.is_test for view in held_out) == count


def test_edits_without_effect_and_other_footage_are_named(walks, file, tmp_path, capsys):
    root = tmp_path / "found"
    shutil.copytree(file.parent, root)
    document = json.loads((root / "transforms.json").read_text())
    sizes = {video["file_path"]: video["bytes"] for video in document["videos"]}
    assert sizes == {f"{name}.mp4": (walks / f"{name}.mp4").stat().st_size for name in FOCALS}
    nerfstudio.read(root, None, footage=walks)
    assert "warning" not in capsys.readouterr().err
    document["videos"][0]["bytes"] += 1
    document["frames"][3]["time_offset"] = 0.3
    (root / "transforms.json").write_text(json.dumps(document))
    nerfstudio.read(root, None, footage=walks)
    said = capsys.readouterr().err
    assert "warning: left.mp4 changed since kpposes found the cameras" in said
    assert "warning: time_offset and time_rate of 000005.png have no effect" in said


def test_the_page_shows_the_paths_and_a_picture_of_each(file):
    page = (file.parent / "cameras.html").read_text()
    assert "moving cameras: 24 of 24 placed" in page and page.count("<img") == 2
    assert "left: placed 12 of 12, clock s" in page and page.count("<td>right/0000") == 12


@pytest.fixture
def films(tmp_path) -> Path:
    """A folder of two films without sound, of 10 and 15 frames a second."""
    folder = tmp_path / "films"
    folder.mkdir()
    film(folder / "a.mp4")
    film(folder / "b.mp4", count=18, fps=15.0)
    return folder


@pytest.fixture
def placed(monkeypatch) -> list[dict]:
    """Place the first twelve views in place of COLMAP; return what is asked for, which is filled in later."""
    asked = []

    def reconstruct(pictures, names, cameras, features, pairing, lenses, kind) -> Structure:
        asked.append({"names": names, "cameras": cameras, "pairing": pairing, "lenses": lenses})
        shown = [picture.view for picture in pictures]
        assert shown == list(range(len(names)))
        views = {}
        for number in range(12):
            pose = np.eye(4)
            pose[0, 3] = number
            views[number] = PlacedView(pose, (60.0, 60.0, 32.0, 16.0), (0.0,) * 4, 200, 0.2)
        return Structure(views, np.zeros((0, 3)), np.zeros((0, 4)), {}, tuple(range(len(views), len(names))))

    monkeypatch.setattr(find, "reconstruct", reconstruct)
    return asked


MOVING = Wishes(rig="moving")


def test_unknown_clocks_and_a_camera_that_was_not_placed_are_named_once(films, placed, capsys):
    found = find.find_poses(films, MOVING)
    assert found.kind == "moving cameras"
    said = capsys.readouterr().err
    assert "taken for 2 cameras that move (as --rig says)" in said
    assert said.count("warning: the clocks of a, b could not be found by sound") == 1
    assert "12 of 29 pictures could be placed; left out: all 17 pictures of b\n" in said
    assert "warning: all 17 pictures of b fit each other but not the rest" in said
    assert "videos run at 10 (a) to 15 fps (b)" in said
    asked = placed[0]
    assert asked["names"][:2] == ("a/000000", "a/000001") and asked["cameras"] == [0] * 12 + [1] * 17
    assert asked["lenses"] == ([0] * 29, asked["cameras"])  # both pictures have one size
    assert asked["pairing"].by_camera and asked["pairing"].besides == ()


def test_what_is_known_of_clocks_is_not_warned_of(films, placed, tmp_path, capsys):
    find.find_poses(films, replace(MOVING, sync="none"))
    offsets = tmp_path / "offsets.json"
    offsets.write_text('{"a": 0, "b": 0.4}')
    found = find.find_poses(films, replace(MOVING, sync=offsets))
    assert "could not be found" not in capsys.readouterr().err
    assert placed[0]["pairing"].besides[:2] == ((0, 12), (3, 16))  # those of each third frame of a, nearest in time
    assert found.take.start_s == pytest.approx(0.4)
    assert [track.frames for track in found.take.tracks] == [range(4, 12), range(11)]
    assert found.take.tracks[1].times[:3] * 10.5 == pytest.approx([0, 1, 2])


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"sync": "motion"}, "--sync motion: what moves in pictures says nothing of clocks while cameras move; film a"),
        ({"distance": ("a", "b", 1.0)}, "--distance: a, b are not there; there are a/000000, a/000001"),
        ({"distance": ("a/000000", "b/000000", 1.0)}, "--distance a/000000,b/000000: both must be cameras that were"),
        ({"require_all": True}, "left out: all 17 pictures of b; film with more overlap"),
    ],
)
def test_what_makes_no_sense_is_refused(films, placed, wishes, said):
    with pytest.raises(DatasetError, match=said):
        find.find_poses(films, replace(MOVING, **wishes))


def test_a_film_of_one_frame_is_refused(films):
    film(films / "c.mp4", count=1)
    with pytest.raises(DatasetError, match=r"c\.mp4 has one frame, beside cameras that move; remove it"):
        find.find_poses(films, MOVING)


def test_colmap_is_missed_before_the_footage_is_looked_at(films, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr(find, "survey", lambda *_: pytest.fail("the footage is looked at"))
    with pytest.raises(DatasetError, match=r'^finding cameras needs COLMAP; pip install "kpc\[poses\]"$'):
        find.find_poses(films, Wishes())


def test_films_of_one_frame_are_no_photographs(tmp_path):
    for name in ("a", "b", "c"):
        film(tmp_path / f"{name}.mp4", count=1)
    with pytest.raises(DatasetError, match="its videos have one frame each; give whole videos, or photographs"):
        find.find_poses(tmp_path, Wishes())


def test_films_without_time_in_common_are_refused(films, tmp_path):
    offsets = tmp_path / "offsets.json"
    offsets.write_text('{"a": 0, "b": 9}')
    with pytest.raises(DatasetError, match=r"videos have no time in common: a ends at 1\.1 s, b starts at 9 s"):
        find.find_poses(films, replace(MOVING, sync=offsets))


def test_a_camera_that_stands_still_among_others_is_one_view(films, placed, monkeypatch, capsys):
    seen = find.survey(find_footage(films)[0])
    shares = {"a": 0.9, "b": 0.1}
    monkeypatch.setattr(find, "survey", lambda one: replace(seen, still_share=shares[one.name]))
    found = find.find_poses(films, Wishes())
    assert (
        "taken for 1 camera that moves and 1 that stands still, a (10% to 90% of a picture's texture"
        in capsys.readouterr().err
    )
    assert found.view_names[:3] == ("a", "b/000000", "b/000001")
    track = found.take.tracks[0]
    assert track.frames == range(12) and {track.view_of(frame) for frame in track.frames} == {0}


def test_frames_are_matched_within_a_camera_and_at_one_instant():
    times = np.linspace(0, 1, 5)
    tracks = (Track("a", range(5), times, 0, False), Track("b", range(2, 7), times + 0.1, 5, False))
    take = Take((*tracks, Track("c", range(5), times, 10, True)), 5, 10.0, 0.0)
    assert take.names == (*(f"a/00000{n}" for n in range(5)), *(f"b/00000{n}" for n in range(2, 7)), "c")
    assert pairing_of(take, [True, True, True]).besides == ((0, 5), (3, 8))
    assert pairing_of(take, [True, False, True]).besides == ()
    pictures = [{"view": view, "instant": 0} for view in range(11)]
    pairing = Pairing((1, 2), 2, 3, by_camera=True, besides=((0, 5),))
    pairs = structure._pairs(pictures, pairing, take.cameras)
    assert (0, 5) in pairs and (3, 5) not in pairs and (4, 5) not in pairs
    assert (0, 1) in pairs and (5, 7) in pairs and len(pairs) == 7 + 7 + 1
    assert structure._compared(pictures, pairing, take.cameras) == [0, 3, 5, 8, 10]


def test_folders_of_frames_are_in_step(tmp_path):
    names = [Path(f"{number}.png") for number in range(9)]
    footage = [Footage(name, tuple(names[:count]), None) for name, count in (("a", 9), ("b", 7))]
    take = take_of(tmp_path, footage, [UNKNOWN, Clock(1.0, 1.0, "given", np.nan)], [False, False])
    assert [track.frames for track in take.tracks] == [range(1, 8), range(7)]
    assert (take.frame_count, take.fps, take.start_s) == (7, None, None)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"frame_count": 0}, "frame_count 0 is no whole number from 1 to"),
        ({"frame_count": 1e9}, "frame_count 1e\\+09 is no whole number from 1 to"),
        ({"frame_count": 7.5}, "frame_count 7.5 is no whole"),
        ({"videos": "a.mp4"}, "videos is not a list"),
        ({"videos": [{}]}, "video 0: lacks file_path"),
        ({"videos": [{"file_path": "../a.mp4"}]}, "leads out of"),
        ({"videos": [{"file_path": "a.mp4", "time_rate": 9}], "start_s": 0}, "video 0: time_rate 9 is not from"),
        ({"videos": [{"file_path": "a.mp4"}], "start_s": "x"}, "start_s"),
    ],
)
def test_a_document_that_makes_no_sense_is_refused(films, keys, said):
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(films / "0.png")
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 8, "time": 0}
    (films / "transforms.json").write_text(json.dumps({"frames": [frame]} | keys))
    with pytest.raises(DatasetError, match=said):
        nerfstudio.read(films, None)
