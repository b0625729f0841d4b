"""Edited scenes show what the originals show, from the corresponding camera at the corresponding time."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import UsageError
from kpc.format.container import groups
from kpc.format.container.container import Codec, Reader
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import TIME_PLANES, Clip
from kpc.player.cpu import reference
from kpc.tools.cli import kpedit, kpjoin
from kpc.tools.editing.cropping import cropped
from kpc.tools.editing.files import edited
from kpc.tools.editing.placing import Placement, axis_turn, placed
from kpc.tools.editing.timing import at_rate, at_speed, common_rows, trimmed
from kpc.tools.vectors.metadata_vectors import FULL
from scenes import VARIANTS, tiny_scene

VECTORS = Path(__file__).parents[2] / "spec" / "vectors" / "valid"
MOVED = Placement(np.eye(3), 2.5, np.array([3.0, -1.0, 0.5]))
QUARTERS = Placement(axis_turn("x", -90) @ axis_turn("z", 180) @ axis_turn("y", 90), 0.5, np.array([1.0, 2.0, -3.0]))
SKEW = Placement(axis_turn("z", 30) @ axis_turn("x", 20), 1.5, np.array([1.0, 2.0, -3.0]))


def quantised(variant="box", time=5, **changes):
    scene = VARIANTS[variant](tiny_scene(scales=2, channels=4, resolution=(12, 10, 8), time=time))
    scene = replace(scene, metadata=Metadata(FULL), **changes)
    return quantise_scene(scene, [dict.fromkeys(scale, 0.05) for scale in scene.scales])


def picture(scene, camera, time):
    seen = reference.render_rays(scene.dequantise(), *camera.resized(16, 12).rays(), time)
    return seen.rgb, seen.opacity, seen.depth


def symbols_of(scene):
    return [np.sort(plane.symbols, axis=None) for scale in scene.scales for plane in scale.values()]


# --- place


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("placement", [MOVED, QUARTERS, SKEW], ids=["moved", "quarters", "skew"])
def test_a_placed_scene_shows_the_same_to_a_camera_that_moves_along(variant, placement):
    before = quantised(variant)
    if placement is SKEW and variant != "ndc":
        with pytest.raises(UsageError, match="multiples of 90 degrees"):
            placed(before, placement)
        return
    after = placed(before, placement)
    for camera, time in zip(before.cameras, (0.0, 0.4), strict=True):
        rgb, opacity, depth = picture(before, camera, time)
        found = picture(after, placement.camera(camera), time)
        # float32 samples lie elsewhere by 1e-6; a ray may end a sample earlier, at 1/1024 of its light
        assert found[0] == pytest.approx(rgb, abs=2e-3) and found[1] == pytest.approx(opacity, abs=2e-3)
        seen = opacity > 0.5
        assert found[2][seen] == pytest.approx(placement.factor * depth[seen], rel=2e-3)
    for one, other in zip(sorted(symbols_of(before), key=len), sorted(symbols_of(after), key=len), strict=True):
        assert len(one) == len(other)
    assert np.array_equal(np.sort(np.concatenate(symbols_of(before))), np.sort(np.concatenate(symbols_of(after))))


def test_turning_back_gives_the_symbols_of_the_original():
    before = quantised("displaced")
    there = Placement(axis_turn("y", 90) @ axis_turn("x", 270), 1.0, np.zeros(3))
    after = placed(placed(before, there), Placement(there.turn.T, 1.0, np.zeros(3)))
    for one, other in zip(before.scales, after.scales, strict=True):
        for name in one:
            assert np.array_equal(one[name].symbols, other[name].symbols)
            assert np.array_equal(one[name].coded, other[name].coded)
    assert np.array_equal(before.motion.symbols, after.motion.symbols)
    assert np.array_equal(before.occupancy, after.occupancy) and np.array_equal(before.aabb, after.aabb)
    assert np.array_equal(before.decoder.w1, after.decoder.w1)


def test_what_the_file_says_of_itself_moves_along():
    before, after = quantised(), placed(quantised(), QUARTERS)
    limits, moved = before.metadata.view_limits, after.metadata.view_limits
    assert moved.focus == pytest.approx(QUARTERS.points(limits.focus), abs=1e-5)
    assert moved.forward == pytest.approx(QUARTERS.turn @ limits.forward, abs=1e-5)
    assert moved.up == pytest.approx(QUARTERS.turn @ limits.up, abs=1e-5)
    assert moved.distance == pytest.approx((0.25, 2.0)) and moved.azimuth == limits.azimuth
    eye = before.metadata.opening.camera.camera_to_world[:3, 3]
    assert after.metadata.opening.camera.camera_to_world[:3, 3] == pytest.approx(QUARTERS.points(eye), abs=1e-5)
    assert after.metadata.document["metres_per_unit"] == pytest.approx(0.02)


@pytest.mark.parametrize("variant", ["box", "contracted", "ndc", "displaced"])
def test_moving_and_scaling_copies_planes_decoder_and_occupancy(variant, tmp_path):
    write(quantised(variant), tmp_path / "in.kpc")
    reader = SceneReader(tmp_path / "in.kpc")
    after = Reader(edited(reader, lambda scene: placed(scene, MOVED)))
    kept = ("PLNE", "DECO", "HYBR", "OCCU", "MOVE", "appe")
    one, other = (
        [(e.kind, e.codec, r.stored(n)) for n, e in enumerate(r.index) if e.kind in kept] for r in (reader, after)
    )
    assert one == other and len(one) > 12


def test_a_box_smaller_than_a_file_holds_is_refused():
    with pytest.raises(UsageError, match=r"--scale 1e-10: an edge of the box would be"):
        placed(quantised(), Placement(np.eye(3), 1e-10, np.zeros(3)))


# --- time


def test_speed_and_frame_rate_change_the_clip_and_no_symbol(tmp_path):
    scene = quantised()  # 11 frames at 10 fps
    assert at_speed(scene, 2.0).clip.duration_s == pytest.approx(0.5)
    assert (at_rate(scene, 25.0).clip.frame_count, at_rate(scene, 25.0).clip.duration_s) == (26, 1.0)
    write(scene, tmp_path / "in.kpc")
    assert kpedit.main([str(tmp_path / "in.kpc"), "-o", str(tmp_path / "out.kpc"), "--speed", "2", "--fps", "40"]) == 0
    one, other = Reader(tmp_path / "in.kpc"), Reader(tmp_path / "out.kpc")
    assert [e.crc for e in one.index if e.kind not in ("SCNE", "meta")] == [
        e.crc for e in other.index if e.kind not in ("SCNE", "meta")
    ]
    clip = read(tmp_path / "out.kpc").clip
    assert (clip.frame_count, clip.fps) == (21, 40.0)


@pytest.mark.parametrize(
    ("fps", "words", "message"),
    [
        (10.0, ["--speed", "101"], "--speed 101: the clip would have 1010 frames per second"),
        (0.01, ["--speed", "0.01"], "--speed 0.01: the clip would have 0.0001"),
        (10.0, ["--fps", "0.4"], "the clip lasts 1 s, which would be a single frame"),
        (1e-6, ["--fps", "2"], "the clip lasts 1e+07 s, which would be more than 16,777,216 frames"),
        (5e-324, ["--from", "0.5s"], "the clip has no end in seconds"),
    ],
)
def test_no_edit_makes_a_clip_of_an_odd_rate_or_length(tmp_path, capsys, fps, words, message):
    write(replace(quantised(), clip=Clip(11, fps)), tmp_path / "in.kpc")
    assert kpedit.main([str(tmp_path / "in.kpc"), "-o", str(tmp_path / "out.kpc"), *words]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out.kpc").exists()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_part_shows_what_the_clip_shows_then(variant):
    before = quantised(variant, time=9)
    after, (since, until) = trimmed(before, 0.3, 0.6)
    assert (since, until) == (0.25, 0.625) and after.clip.duration_s == pytest.approx(until - since)
    assert all(len(after.scales[-1][name].symbols) == 4 for name in TIME_PLANES)
    for local in (0.0, 0.3, 0.777, 1.0):
        time = (since + local * (until - since)) / before.clip.duration_s
        expected = picture(before, before.cameras[0], time)
        found = picture(after, before.cameras[0], local)
        assert found[0] == pytest.approx(expected[0], abs=1e-4) and found[1] == pytest.approx(expected[1], abs=1e-4)
    for name, plane in after.scales[1].items():
        whole = before.scales[1][name]
        rows = slice(2, 6) if name in TIME_PLANES else slice(None)
        assert np.array_equal(plane.symbols, whole.symbols[rows] * plane.coded[..., None])


def test_a_part_of_whole_frames_keeps_the_frame_rate():
    """Exactly, since `kpjoin` joins clips of one rate; 31 frames in 1.03 s were at 30.000000000000007."""
    whole = replace(quantised(time=60), clip=Clip(60, 30.0))
    for start, end in (0.5, 1.5), (0.1, 0.7), (1.0, 1.9):
        assert trimmed(whole, start, end)[0].clip.fps == 30.0


def test_planes_that_never_change_do_not_keep_a_clip_from_being_cut():
    """As those of the scales that `kpenc --layers auto` gives to what stands still: two equal rows."""
    whole = quantised(time=9)
    still = {
        name: replace(plane, symbols=plane.symbols[[0, 0]], coded=plane.coded[[0, 0]]) if name in TIME_PLANES else plane
        for name, plane in whole.scales[0].items()
    }
    before = replace(whole, scales=(still, *whole.scales[1:]))
    after, (since, until) = trimmed(before, 0.3, 0.6)
    assert (since, until) == (0.25, 0.625)
    for local in (0.0, 0.777):
        time = (since + local * (until - since)) / before.clip.duration_s
        expected, found = picture(before, before.cameras[0], time), picture(after, before.cameras[0], local)
        assert found[0] == pytest.approx(expected[0], abs=1e-4)


def test_the_whole_clip_stays_as_it_is_and_what_cannot_be_cut_is_refused():
    scene = quantised(time=5)
    assert common_rows(scene) == 4
    for end in (1.1, 1.104, np.inf):  # with the last frame; as kpinfo shows it, rounded; not said
        assert trimmed(scene, 0.0, end) == (scene, (0.0, 1.0))
    assert trimmed(scene, 1.05, np.inf)[1] == (0.75, 1.0)  # within the last frame
    uneven = replace(scene, motion=quantised("displaced", time=4).motion)
    assert common_rows(uneven) == 1
    with pytest.raises(UsageError, match="no rows in common"):
        trimmed(uneven, 0.2, 0.5)
    for start, end, message in (
        (0.5, 0.5, "ends before it begins"),
        (0.6, 0.2, "ends before it begins"),
        (1.1, np.inf, "--from 1.1s: the clip lasts 1.10 s"),
        (0.0, 2.0, "--to 2s: the clip lasts 1.10 s"),
    ):
        with pytest.raises(UsageError, match=message):
            trimmed(scene, start, end)
    with pytest.raises(UsageError, match="static"):
        trimmed(quantised_static(), 0.0, 0.5)


def quantised_static():
    scene = tiny_scene(dynamic=False, scales=1, channels=2, resolution=(6, 5, 4))
    return quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.1)])


# --- boxes


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_cropped_scene_shows_the_cells_of_the_box_as_before(variant):
    before = quantised(variant)
    box = np.array([[-0.4, -0.8, -0.6], [0.6, 0.5, 0.4]])
    after = cropped(before, box)
    assert after.occupancy.sum() < before.occupancy.sum()
    alone = replace(before, occupancy=after.occupancy)  # nothing but cells taken away
    for time in (0.0, 0.6):
        expected, found = (picture(scene, before.cameras[0], time) for scene in (alone, after))
        assert found[0] == pytest.approx(expected[0], abs=1e-6) and found[1] == pytest.approx(expected[1], abs=1e-6)
    coded = [sum(int(p.coded.sum()) for s in scene.scales for p in s.values()) for scene in (before, after)]
    assert coded[1] < coded[0]
    for one, other in zip(before.scales, after.scales, strict=True):
        for name in one:
            assert np.array_equal(other[name].symbols, one[name].symbols * other[name].coded[..., None])
            assert not (other[name].coded & ~one[name].coded).any()


def test_a_box_that_is_empty_in_all_groups_is_refused(clip, capsys):
    for source in (clip, clip.with_name("one.kpc")):
        command = [str(source), "-o", str(clip.with_name("out.kpc")), "--box", "50,50,50,51,51,51"]
        assert kpedit.main(command) == 2
        assert "--box: there is nothing from [50.0, 50.0, 50.0] to [51.0, 51.0, 51.0]" in capsys.readouterr().err


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("name", ["predictive-time-empty", "time-empty", "transform-implied", "predictive-implied"])
def test_files_of_all_codecs_survive_a_turn(name, axis):
    """Time planes that store nothing, but change places with those of other sizes, too."""
    reader = SceneReader(VECTORS / f"{name}.kpc")
    expected = placed(read(reader), Placement(axis_turn(axis, 90), 1.0, np.zeros(3)))
    found = read(edited(reader, lambda scene: placed(scene, Placement(axis_turn(axis, 90), 1.0, np.zeros(3)))))
    assert symbols_equal(found, expected) and np.array_equal(found.occupancy, expected.occupancy)


@pytest.mark.parametrize("name", ["transform", "transform-implied", "predictive-implied", "trellis"])
def test_files_of_all_codecs_survive_a_crop(name):
    reader = SceneReader(VECTORS / f"{name}.kpc")
    before = read(reader)
    middle = before.aabb.mean(0)
    data = edited(reader, lambda scene: cropped(scene, np.stack([before.aabb[0], middle])))
    after = read(data)
    for one, other in zip(before.scales, after.scales, strict=True):
        for plane in one:
            assert np.array_equal(other[plane].symbols, one[plane].symbols * other[plane].coded[..., None])
    if name.startswith("transform"):  # the levels of its blocks are kept
        assert {e.codec for e in Reader(data).index if e.kind == "PLNE"} >= {Codec.TRANSFORM}


# --- files


def test_a_file_that_is_not_changed_comes_back_byte_for_byte(tmp_path):
    for name in ("metadata-zstd", "unknown-ancillary", "predictive-implied", "hybrid-moved"):
        reader = SceneReader(VECTORS / f"{name}.kpc")
        again = Reader(edited(reader, lambda scene: scene))
        assert sorted((e.kind, reader.stored(n)) for n, e in enumerate(reader.index)) == sorted(
            (e.kind, again.stored(n)) for n, e in enumerate(again.index)
        )


@pytest.fixture
def clip(tmp_path):
    write(quantised(), tmp_path / "one.kpc")
    parts = [groups.GroupInput.of(tmp_path / "one.kpc", start) for start in (0, 9, 18)]
    groups.write(parts, tmp_path / "clip.kpc")
    return tmp_path / "clip.kpc"  # 29 frames at 10 fps; two groups share two frames


def test_groups_are_placed_retimed_and_cut(clip, capsys):
    out = clip.with_name("out.kpc")
    command = ["--from", "1.2s", "--to", "2.5s", "--fps", "20", "--scale", "2", "--box", "-0.4,-0.8,-0.6,0.6,0.5,0.4"]
    assert kpedit.main([str(clip), "-o", str(out), *command]) == 0
    opened, whole = groups.Groups(out), groups.Groups(clip)
    assert [(s.start, s.count) for s in opened.timeline.spans] == [(0, 21), (18, 21)] and opened.clip.fps == 20
    assert " s of the clip (whole groups are kept), 39 frames at 20 fps, 1.95 s\n" in capsys.readouterr().out
    one = read(opened.open(0))
    assert one.aabb == pytest.approx(2 * read(whole.open(1)).aabb) and opened.metadata().view_limits.reach == 1.5
    assert "from 1.2, to 2.5, box" in opened.metadata().provenance["history"][-1]
    assert "held_out" not in opened.metadata().provenance


@pytest.mark.parametrize("words", [["--box", "-0.4,-0.8,-0.6,0.2,0.5,0.4"], ["--turn", "x:90"]])
def test_groups_share_after_an_edit_what_they_shared_before(words, tmp_path):
    """Each group reads other texels of the planes; those that none reads are left out."""
    scene = quantised()
    planes = [{name: replace(one, stores_map=True) for name, one in scale.items()} for scale in scene.scales]
    cells = np.indices(scene.occupancy.shape)[3] < scene.occupancy.shape[3] // 3
    for number, occupied in enumerate((scene.occupancy & cells, scene.occupancy & ~cells)):
        write(replace(scene, scales=tuple(planes), occupancy=occupied), tmp_path / f"{number}.kpc")
    parts = [groups.GroupInput.of(tmp_path / f"{number}.kpc", 11 * number) for number in range(2)]
    source, out = tmp_path / "clip.kpc", tmp_path / "out.kpc"
    groups.write(parts, source)
    assert kpedit.main([str(source), "-o", str(out), *words]) == 0
    opened, before = groups.Groups(out), groups.Groups(source)
    assert len(opened.reader.beside) == len(before.reader.beside) > 5
    size = [sum(clip.reader.index[number].stored_length for number in clip.reader.beside) for clip in (opened, before)]
    if words[0] == "--box":
        assert size[0] < size[1]
        box = np.reshape([float(number) for number in words[1].split(",")], (2, 3))
        for number in range(2):
            camera = scene.cameras[0]
            expected = picture(cropped(read(before.open(number)), box), camera, 0.4)
            assert picture(read(opened.open(number)), camera, 0.4)[0] == pytest.approx(expected[0], abs=1e-6)


def test_only_planes_that_are_coded_anew_are_said_to_be_larger(clip, capsys):
    """A part of a group may be larger by its planes; a part that is widened to all groups is none."""
    description = "".join(hashlib.sha512(text).hexdigest() for text in (b"a", b"b", b"c"))  # hardly compressed
    for source, is_coded_anew in ((clip, False), (VECTORS / "limits-rows.kpc", True)):
        out = clip.with_name("out.kpc")
        assert kpedit.main([str(source), "-o", str(out), "--from", "0.3s", "--description", description]) == 0
        said = capsys.readouterr().err
        assert ("predicted from less" in said and out.stat().st_size > source.stat().st_size) == is_coded_anew
        assert ("kept as a whole" in said) != is_coded_anew


def test_clips_of_different_rates_are_joined_when_told_to(tmp_path, capsys):
    write(quantised(), tmp_path / "slow.kpc")
    write(at_rate(quantised(), 30.0), tmp_path / "fast.kpc")
    command = [str(tmp_path / "slow.kpc"), str(tmp_path / "fast.kpc"), "-o", str(tmp_path / "both.kpc")]
    assert kpjoin.main(command) == 2 and "--fps" in capsys.readouterr().err
    assert kpjoin.main([*command, "--fps", "20"]) == 0
    joined = groups.Groups(tmp_path / "both.kpc")
    assert [(s.start, s.count) for s in joined.timeline.spans] == [(0, 21), (21, 21)] and joined.clip.fps == 20
    for number in range(2):
        assert symbols_equal(read(joined.open(number)), quantised())


@pytest.mark.parametrize("fps", [3.0, 24.0, 25.0, 60.0])
def test_groups_without_shared_frames_stay_without_a_gap_at_any_rate(fps, tmp_path, capsys):
    write(quantised(), tmp_path / "one.kpc")
    assert kpjoin.main([str(tmp_path / "one.kpc")] * 3 + ["-o", str(tmp_path / "three.kpc")]) == 0
    assert kpjoin.main([str(tmp_path / "three.kpc")] * 2 + ["--fps", str(fps), "-o", str(tmp_path / "six.kpc")]) == 0
    spans = groups.Groups(tmp_path / "six.kpc").timeline.spans
    assert [one.start for one in spans[1:]] == [one.last + 1 for one in spans[:-1]] and len(spans) == 6
    assert abs(spans[5].last - 65 * fps / 10) <= 1.5 + fps / 10  # each half as long as before, to half a frame
    command = [str(tmp_path / "three.kpc"), "-o", str(tmp_path / "short.kpc"), "--fps", "0.5"]
    assert kpedit.main(command) == 2 and "--fps 0.5: at this rate" in capsys.readouterr().err


def symbols_equal(one, other):
    return all(
        np.array_equal(a[name].symbols, b[name].symbols)
        for a, b in zip(one.scales, other.scales, strict=True)
        for name in a
    )
