"""kpedit changes what it is asked to, and nothing else."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import groups
from kpc.format.container.container import Reader
from kpc.format.container.scene_io import read
from kpc.format.scene.cameras import View, save_views
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.rig import Rig
from kpc.tools.cli import kpedit, kpinfo
from scenes import tiny_scene


def small_scene(**options):
    return tiny_scene(scales=1, channels=2, resolution=(6, 5, 4), time=3, **options)


def save(scene, path: Path) -> Path:
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.05) for scale in scene.scales]), path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Hold `scene.kpc`, a small scene of five cameras, and `clip.kpc`, a clip of two groups of it."""
    folder = tmp_path_factory.mktemp("kpedit")
    scene = small_scene()
    rig = Rig.of(scene)
    cameras = tuple(rig.camera(azimuth, 0.5, 3.0) for azimuth in (0.0, -0.4, -0.2, 0.2, 0.4))
    save(replace(scene, cameras=cameras), folder / "scene.kpc")
    one = groups.GroupInput.of(folder / "scene.kpc", 0)
    groups.write([one, replace(one, span=groups.Span(11, 11))], folder / "clip.kpc")
    return folder


def edit(folder: Path, *options: str, scene: str = "scene.kpc", code: int = 0) -> Path:
    assert kpedit.main([str(folder / scene), "-o", str(folder / "out.kpc"), *options]) == code
    return folder / "out.kpc"


def stored(path: Path) -> list[tuple[str, bytes]]:
    """Return kind and stored bytes of all chunks but the metadata."""
    reader = Reader(path)
    return [(e.kind, reader.stored(n)) for n, e in enumerate(reader.index) if e.kind != "meta"]


def test_the_progress_of_a_clip_is_one_of_all_groups(folder, monkeypatch, capsys):
    for name in ("FIRST_LINE_S", "LINE_EVERY_S"):
        monkeypatch.setattr(f"kpc.format.common.progress.{name}", 0.0)
    edit(folder, "--speed", "2", scene="clip.kpc")
    edited = [line.split(" ")[1] for line in capsys.readouterr().err.splitlines()]
    assert set(edited) == {"0/2", "1/2", "2/2"} and edited == sorted(edited)
    assert kpinfo.main([str(folder / "clip.kpc"), "--verify"]) == 0
    checked = capsys.readouterr().err.splitlines()
    assert checked[0].startswith("checking: 0/2 groups") and checked[-1].startswith("checking: 2/2 groups")


@pytest.mark.parametrize("name", ["scene.kpc", "clip.kpc"])
def test_texts_are_set_and_removed_and_all_chunks_are_copied(folder, name, capsys):
    texts = ["--title", "Tänzer", "--description", r"a\\n\nb", "--date", "2026-11", "--author", " "]
    out = edit(folder, *texts, scene=name)
    expected = {"title": "Tänzer", "description": "a\\n\nb", "date": "2026-11"}
    assert groups.Groups(out).metadata().document == expected and stored(out) == stored(folder / name)
    assert kpinfo.main([str(out)]) == 0
    assert "title       Tänzer\n  description a\\n\n              b\n" in capsys.readouterr().out
    again = folder / "again.kpc"
    assert kpedit.main([str(out), "-o", str(again), "--title", "", "--up", "0,0,2", "--metres-per-unit", "0.5"]) == 0
    expected = {"description": "a\\n\nb", "date": "2026-11", "up": [0, 0, 2], "metres_per_unit": 0.5}
    assert groups.Groups(again).metadata().document == expected and stored(again) == stored(folder / name)


def test_provenance_comes_from_a_file_and_goes(folder, capsys):
    (folder / "made.json").write_text(json.dumps({"preset": "fast", "seed": 3}))
    out = edit(folder, "--provenance", str(folder / "made.json"), "--transparent")
    assert read(out).metadata.document == {"provenance": {"preset": "fast", "seed": 3}, "transparent": True}
    again = folder / "again.kpc"
    assert kpedit.main([str(out), "-o", str(again), "--provenance", str(folder / "made.json")]) == 2
    assert "holds its own (preset, seed)" in capsys.readouterr().err
    assert kpedit.main([str(out), "-o", str(again), "--no-provenance", "--no-transparent"]) == 0
    assert not read(again).metadata and again.read_bytes() == (folder / "scene.kpc").read_bytes()
    scaled = edit(folder, "--scale", "2").rename(folder / "scaled.kpc")
    assert kpedit.main([str(scaled), "-o", str(again), "--provenance", str(folder / "made.json")]) == 0
    assert set(read(again).metadata.provenance) == {"history", "preset", "seed"}
    (folder / "made.json").write_text('{"preset": "fast", "held_out": {"pictures": 3}, "coding_loss_db": 0.1}')
    measured = edit(folder, "--provenance", str(folder / "made.json"))
    assert kpedit.main([str(measured), "-o", str(again), "--box", "-0.4,-0.4,-0.4,0.4,0.4,0.4"]) == 0
    assert set(read(again).metadata.provenance) == {"history", "preset"}  # what was measured is of the whole


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--provenance", "made.json", "--no-provenance"], "not allowed with"),
        (["--transparent", "--no-transparent"], "not allowed with"),
        (["--scale", "1e9"], "--scale 1e+09: the scene would reach to"),
        (["--scale", "1e8", "--move", "1e9,0,0"], "--scale 1e+08: the scene would reach to"),
    ],
)
def test_contradictions_and_what_no_file_holds_are_refused(folder, capsys, words, message):
    try:
        code = kpedit.main([str(folder / "scene.kpc"), "-o", str(folder / "refused.kpc"), *words])
    except SystemExit as end:
        code = end.code
    assert code == 2 and message in capsys.readouterr().err and not (folder / "refused.kpc").exists()


def test_view_limits_are_found_and_set_and_taken_away(folder, capsys):
    found = read(edit(folder, "--view-limits", "auto")).metadata
    limits = found.view_limits
    assert limits.azimuth[0] <= 0 <= limits.azimuth[1] and limits.distance[0] < 3 <= limits.distance[1] * 1.001
    assert found.up == pytest.approx(Rig.of(read(folder / "scene.kpc").dequantise()).up, abs=1e-4)
    assert found.opening.camera.camera_to_world == pytest.approx(
        read(folder / "scene.kpc").cameras[0].camera_to_world, abs=1e-5
    )
    (folder / "out.kpc").rename(folder / "limited.kpc")
    changed = read(edit(folder, "--view-limits", "azimuth=-3:4.5,reach=0", scene="limited.kpc")).metadata
    assert changed.document["view_limits"] == {**found.document["view_limits"], "azimuth": [-3, 4.5], "reach": 0}
    assert "outside" not in capsys.readouterr().err
    edit(folder, "--view-limits", "distance=5:6,elevation=-5:5", scene="limited.kpc")
    assert "outside the limits of its elevation and distance" in capsys.readouterr().err
    none = read(edit(folder, "--view-limits", "none", scene="limited.kpc")).metadata
    assert none == found.with_members(view_limits=None)


def test_view_limits_are_found_again_about_another_up(folder, capsys):
    limited = edit(folder, "--view-limits", "auto").rename(folder / "limited.kpc")
    before = read(limited).metadata
    longer = ",".join(str(2 * number) for number in before.document["up"])
    same = read(edit(folder, f"--up={longer}", scene=limited.name)).metadata
    assert same.view_limits.elevation == before.view_limits.elevation and "view limits" not in capsys.readouterr().err
    tilted = Rig.of(read(limited).dequantise()).compass()[1] * 0.5 + before.up  # towards the side
    words = [f"--up={','.join(map(str, tilted))}"]
    after = read(edit(folder, *words, scene=limited.name)).metadata
    assert "and they are found again" in capsys.readouterr().err
    assert after.opening.camera.fl_x == before.opening.camera.fl_x and after.document["up"] == tilted.tolist()
    auto = read(edit(folder, *words, "--view-limits", "auto", scene=limited.name)).metadata
    assert auto.document["view_limits"] == after.document["view_limits"] != before.document["view_limits"]
    eye = read(limited).cameras[0].camera_to_world[:3, 3] - after.view_limits.focus
    height = np.degrees(np.arcsin(eye @ after.up / np.linalg.norm(eye)))
    low, high = after.document["view_limits"]["elevation"]
    assert low <= height <= high


def test_view_limits_that_cannot_be_found_again_are_left_out(folder, capsys):
    limits = {"focus": [0, 0, 0], "forward": [0, 1, 0], "azimuth": [-9, 9], "elevation": [0, 9], "distance": [1, 2]}
    members = {"up": [0, 0, 1], "view_limits": limits | {"reach": 1}}
    save(replace(small_scene(), metadata=Metadata(members)), folder / "two.kpc")
    assert "view_limits" not in read(edit(folder, "--up", "0,1,0", scene="two.kpc")).metadata.document
    assert "none are found about the new one" in capsys.readouterr().err


def test_a_saved_view_opens_the_scene(folder):
    camera = read(folder / "scene.kpc").cameras[2]
    save_views(folder / "view.json", [View(camera, 0.25, "a.png")])
    opening = read(edit(folder, "--open-at", str(folder / "view.json"))).metadata.opening
    assert opening.time == 0.25 and opening.camera.camera_to_world == pytest.approx(camera.camera_to_world, abs=1e-5)


def test_up_and_unit_hold_where_the_scene_is_put(folder):
    placed = edit(folder, "--turn", "x:-90", "--scale", "0.5", "--up", "0,1,0", "--metres-per-unit", "2")
    assert read(placed).metadata.document["up"] == pytest.approx([0, 1, 0])
    assert read(placed).metadata.document["metres_per_unit"] == pytest.approx(2)


@pytest.mark.parametrize(
    "options, code, words",
    [
        (["--title", "\x1b[2J"], 2, "argument --title: a text holds tabs or other control characters"),
        (["--date", "yesterday"], 2, "is no date like 2026"),
        (["--date", "2026-13"], 2, "is no date like 2026"),
        (["--up", "0,0,0"], 2, "is not a direction"),
        (["--view-limits", "azimuth=3"], 2, "is not like azimuth=-30:30"),
        (["--view-limits", "azimuth=30:-30"], 2, "least value is above the largest"),
        (["--view-limits", "azimuth=-300:300"], 2, "at most a full turn"),
        (["--view-limits", "elevation=-100:100"], 2, "'elevation=-100:100': write degrees from -90 to 90"),
        (["--view-limits", "distance=0:0"], 2, "'distance=0:0': write lengths above 0, up to 1.07e+09"),
        (["--view-limits", "reach=-1"], 2, "write a length from 0"),
        (["--turn", "x"], 2, "'x' is not a turn such as x:-90"),
        (["--up", "x"], 2, "'x' is not three numbers from -1e9 to 1e9 such as 0,0,1"),
        (["--move", "1,2"], 2, "such as 0,0,1"),
        (["--provenance", "broken.json"], 2, 'such as {"preset": "fast"}'),
        (["--provenance", "wrong.json"], 1, "seed is no integer"),
    ],
)
def test_wrong_options_are_refused_in_one_line(folder, options, code, words, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    Path("broken.json").write_text("{")
    Path("wrong.json").write_text('{"seed": "seven"}')
    try:
        assert kpedit.main(["scene.kpc", "-o", "no.kpc", *options]) == code
    except SystemExit as exit_:
        assert exit_.code == code
    assert words in capsys.readouterr().err.splitlines()[-1] and not Path("no.kpc").exists()


def test_the_input_is_not_overwritten_and_two_cameras_give_no_limits(folder, capsys):
    scene = str(folder / "scene.kpc")
    assert kpedit.main([scene, "-o", scene, "--title", "a"]) == 2
    save(small_scene(), folder / "two.kpc")
    edit(folder, "--view-limits", "auto", scene="two.kpc", code=2)
    assert "three cameras" in capsys.readouterr().err
    assert not read(scene).metadata


def test_a_direction_that_stays_is_written_as_before(folder, tmp_path):
    upright = tmp_path / "upright.kpc"
    save(replace(small_scene(), metadata=Metadata({"up": [0, 0, 1]})), upright)
    found = read(edit(folder, "--up", "0,0,2", "--title", "a", scene=str(upright))).metadata.document
    assert json.dumps(found["up"]) == "[0, 0, 1]" and found["title"] == "a"


def test_what_changes_nothing_is_said_or_refused(folder, tmp_path, capsys):
    turns = ["--turn", "x:90", "--turn", "x:-90", "--scale", "1", "--move", "0,0,0"]
    around = ["--box", "-9,-9,-9,9,9,9"]
    idle = [], around, ["--speed", "1", "--to", "1.1"], ["--fps", "10", *turns], ["--from", "0.01", "--to", "0.99"]
    for words in idle:
        copy = edit(folder, *words)
        assert "there is nothing to change" in capsys.readouterr().err
        assert copy.read_bytes() == (folder / "scene.kpc").read_bytes()
    save(replace(tiny_scene(dynamic=False), cameras=()), tmp_path / "still.kpc")
    for option in ("--fps", "--speed"):
        assert kpedit.main([str(tmp_path / "still.kpc"), "-o", str(tmp_path / "out.kpc"), option, "2"]) in (1, 2)
        assert "the scene is static" in capsys.readouterr().err
