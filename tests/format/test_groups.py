"""Clips in groups: which group is shown when, which files can be joined, and that one group is held at a time."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import kpc
from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import BudgetError, FormatError, UsageError
from kpc.format.common.images import read_image
from kpc.format.container import groups, scene_io
from kpc.format.container.container import Reader
from kpc.format.container.groups import GroupedScene, GroupInput, Groups, Span, Timeline
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip, Scene
from kpc.player.cpu import reference
from kpc.player.sharing.file_server import Handler, serving
from kpc.player.viewpoints import fit_camera, orbit
from kpc.tools.cli import kpinfo, kpjoin, kprender
from kpc.tools.rendering.clean_plate import CleanPlates, matte, motion_colours
from scenes import tiny_scene, with_appearances


def coded(scene: Scene) -> bytes:
    return scene_writer.encode(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]))


@pytest.fixture(scope="module")
def scenes() -> list[bytes]:
    """Three scenes of 11 frames, the last without cameras and static."""
    last = replace(tiny_scene(2, dynamic=False, scales=1), clip=Clip(11, 10.0), cameras=())
    return [coded(tiny_scene(0, scales=1)), coded(tiny_scene(1)), coded(last)]


@pytest.fixture(scope="module")
def clip(scenes: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 0 to 10, 8 to 18 and 19 to 29."""
    path = tmp_path_factory.mktemp("groups") / "long.kpc"
    size = groups.write([GroupInput.of(scene, start) for scene, start in zip(scenes, (0, 8, 19), strict=True)], path)
    assert size == path.stat().st_size
    return path


def test_a_group_takes_over_in_the_middle_of_the_shared_frames():
    timeline = Timeline((Span(100, 11), Span(106, 15), Span(121, 1)), 25.0)
    assert timeline.clip == Clip(22, 25.0)
    frames = np.arange(100, 121.01, 0.5)
    shown = [timeline.at((frame - 100) / 21) for frame in frames]
    assert [number for number, _ in shown] == [0 if frame < 108 else 1 if frame < 120.5 else 2 for frame in frames]
    for frame, (number, time) in zip(frames, shown, strict=True):
        span = timeline.spans[number]
        assert time == pytest.approx(min((frame - span.start) / max(span.count - 1, 1), 1) if span.count > 1 else 0)
    assert [timeline.display_span(number) for number in range(3)] == [(0, 8 / 21), (8 / 21, 20.5 / 21), (20.5 / 21, 1)]
    assert timeline.local_time(0, 1.0) == 1 and timeline.local_time(1, 0.0) == 0 and timeline.local_time(2, 0.3) == 0


def test_two_groups_are_blended_between_shared_frames():
    timeline = Timeline((Span(100, 11), Span(106, 15), Span(121, 1)), 25.0)
    for frame in np.arange(100, 121.01, 0.25):
        parts = {number: (time, share) for number, time, share in timeline.blend_at((frame - 100) / 21)}
        assert sum(share for _, share in parts.values()) == pytest.approx(1)
        assert list(parts) == ([0, 1] if 106 < frame < 110 else [timeline.at((frame - 100) / 21)[0]])
        for number, (time, share) in parts.items():
            assert time == timeline.local_time(number, (frame - 100) / 21)
            assert share == pytest.approx(1 if len(parts) == 1 else abs(frame - (110, 106)[number]) / 4)


def test_a_clip_passes_from_group_to_group_without_a_jump(clip):
    """In the middle of the shared frames, where a hard switch would jump, pictures differ as little as their times."""
    long, camera = kpc.load(clip), kpc.load(clip).cameras[0].resized(8, 6)
    before, middle, after = (kpc.render(long, camera, frame / 29) for frame in (8.99, 9.0, 9.01))
    (first, t, _), (second, u, share) = long.blend_at(9.0 / 29)
    one, other = reference.render(first, camera, t), reference.render(second, camera, u)
    assert share == pytest.approx(0.5) and np.abs(one.rgb - other.rgb).max() > 0.1
    assert np.abs(middle.rgb - (one.rgb + other.rgb) / 2).max() < 1e-6 and np.array_equal(
        middle.samples, one.samples + other.samples
    )
    assert np.abs(middle.opacity - (one.opacity + other.opacity) / 2).max() < 1e-6
    assert np.abs(before.rgb - after.rgb).max() < 0.02


def test_a_clip_renders_as_its_groups_do(clip, scenes):
    long = kpc.load(clip)
    assert isinstance(long, GroupedScene) and long.clip == Clip(30, 10.0)
    camera = long.cameras[0].resized(12, 9)
    for frame, number in ((0, 0), (8, 0), (10, 1), (18, 1), (18.4, 1), (18.6, 2), (29, 2)):
        start = (0, 8, 19)[number]
        alone = kpc.load(scenes[number])
        expected = kpc.render(alone, camera, min(max((frame - start) / 10, 0), 1))
        assert np.allclose(kpc.render(long, camera, frame / 29).rgb, expected.rgb, atol=1e-6), frame
    assert long.at(1.0)[0].cameras == long.cameras  # although the last group has none


def test_the_motion_map_and_kpinfo_describe_the_group_shown(clip, scenes, tmp_path, capsys):
    picture = tmp_path / "map.png"
    small = ["--size", "24x18", "--backend", "reference", "-o", str(picture)]
    for number, time, own in ((1, 13 / 29, 0.5), (2, 1.0, 1.0)):
        assert kprender.main([str(clip), "--dynamic-map", "--time", str(time), *small]) == 0
        capsys.readouterr()
        assert kpinfo.main([str(clip), "--group", str(number), "--json"]) == 0
        shares = json.loads(capsys.readouterr().out)["files"][0]["groups"][number]["scene"]["static"]
        alone, camera = kpc.load(scenes[number]), fit_camera(kpc.load(clip).cameras[0], 24, 18)
        plate = CleanPlates(reference.render).of(alone, camera)
        shown = reference.render(alone, camera, own)
        expected = motion_colours(shown, matte(shown, plate)).rgb
        assert np.abs(read_image(picture) - 255 * np.clip(expected, 0, 1)).max() <= 1
        assert (shares == {"identity_share": 1, "constant_share": 1, "motionless_share": 1}) == (number == 2)


def test_a_scene_counts_as_a_clip_of_one_group(scenes):
    groups = Groups(scenes[1])
    assert groups.is_single and len(groups) == 1 and groups.clip == Clip(11, 10.0)
    assert scene_io.read(groups.open(0)).parameter_count == scene_io.read(scenes[1]).parameter_count
    scene = kpc.load(scenes[1])
    assert isinstance(scene, Scene) and scene.at(0.3) == (scene, 0.3)


def test_one_group_is_held_or_two_while_they_are_blended(clip):
    long = kpc.load(clip)
    first, _ = long.at(0.0)
    assert long.at(0.2)[0] is first
    second, _ = long.at(0.5)
    assert second is not first and long.at(0.4)[0] is second and long.at(0.0)[0] is not first
    assert [len(long.blend_at(time)) for time in (0.0, 9 / 29, 0.5)] == [1, 2, 1]
    blended = [scene for scene, *_ in long.blend_at(9 / 29)]
    assert long.blend_at(9.5 / 29)[0][0] is blended[0] and long.at(0.5)[0] is blended[1] and len(long._held) == 1


def test_the_memory_budget_applies_to_a_single_group(clip, scenes):
    needed = [5 * Reader(scene).header.value_count for scene in scenes]
    assert needed[1] == max(needed) and Reader(clip).header.value_count == max(needed) // 5
    long = kpc.load(clip, memory_budget=needed[1] - 1)
    long.at(0.0)
    with pytest.raises(BudgetError, match="group 1"):
        long.at(0.5)


def test_reading_a_single_scene_refuses_a_clip_in_groups(clip):
    with pytest.raises(FormatError, match="a clip in groups"):
        scene_io.read(clip)


def test_a_truncated_file_has_the_groups_before_the_cut(clip):
    data = clip.read_bytes()
    cut = data[: Reader(clip).index[1].offset + 2000]
    with pytest.raises(FormatError, match="cut off"):
        Groups(cut)
    partial = Groups(cut, allow_partial=True)
    assert [partial.available(number) for number in range(3)] == [True, False, False]
    assert scene_io.read(partial.open(0)).clip.frame_count == 11
    assert partial.open(1).head.clip.frame_count == 11  # its head is complete
    with pytest.raises(FormatError, match=r"cut off at .* group 2 is not there"):
        partial.open(2)


def test_groups_are_read_from_a_server_one_by_one(clip):
    with serving(clip.parent) as url:
        remote = Groups(f"{url}/long.kpc")
        for number in (2, 0, 1):
            assert (
                scene_io.read(remote.open(number)).parameter_count
                == scene_io.read(Groups(clip).open(number)).parameter_count
            )
        source = remote.source_of(1)
        assert source.read_at(0, 4) == b"\x89KPC" and source.received_bytes < clip.stat().st_size
        source.close()
        assert kpc.load(f"{url}/long.kpc").at(1.0)[0].parameter_count == kpc.load(clip).at(1.0)[0].parameter_count


class WithoutRanges(Handler):
    """A server without ranges."""

    def send_head(self):
        del self.headers["Range"]
        return super().send_head()


def test_a_server_without_ranges_sends_the_file_once(clip, capfd):
    with serving(clip.parent, handler=WithoutRanges) as url:
        remote = Groups(f"{url}/long.kpc")
        assert [scene_io.read(remote.open(number)).clip.frame_count for number in range(3)] == [11, 11, 11]
        assert remote.source_of(1).read_at(0, 4) == b"\x89KPC"


def test_joined_groups_are_sorted(scenes, tmp_path, capsys):
    for number, start in enumerate((40, 48, 59)):
        groups.write([GroupInput.of(scenes[number], start)], tmp_path / f"{number}.kpc")
    assert (
        kpjoin.main([*(str(tmp_path / f"{number}.kpc") for number in (2, 0, 1)), "-o", str(tmp_path / "long.kpc")]) == 0
    )
    assert "3 groups, 30 frames at 10 fps, 3.00 s" in capsys.readouterr().out
    joined = Groups(tmp_path / "long.kpc")
    assert joined.timeline.spans == (Span(40, 11), Span(48, 11), Span(59, 11))
    assert [joined.source_of(number).read_at(0, 1 << 20) for number in range(3)] == scenes


def test_scenes_follow_the_file_before_them(clip, scenes, tmp_path):
    (tmp_path / "last.kpc").write_bytes(scenes[0])
    assert kpjoin.main([str(clip), str(tmp_path / "last.kpc"), "-o", str(tmp_path / "both.kpc")]) == 0
    both = Groups(tmp_path / "both.kpc").timeline.spans
    assert both[2:] == (Span(19, 11), Span(30, 11))
    assert kpjoin.main([str(tmp_path / "both.kpc"), str(clip), "-o", str(tmp_path / "all.kpc")]) == 0
    again = Groups(tmp_path / "all.kpc").timeline.spans
    assert again == (*both, *(Span(41 + one.start, one.count) for one in both[:3]))


def test_files_that_do_not_make_up_a_clip_are_refused(clip, scenes, tmp_path, capsys):
    for name, scene, start in (("early", 0, 0), ("middle", 1, 9), ("late", 1, 12), ("copy", 2, 12), ("later", 2, 23)):
        groups.write([GroupInput.of(scenes[scene], start)], tmp_path / f"{name}.kpc")
    (tmp_path / "alone.kpc").write_bytes(scenes[0])
    for name, digit, start in (("early", "a", 0), ("again", "a", 0), ("other", "b", 11)):
        of_dataset = Metadata({"provenance": {"dataset_sha256": 64 * digit}})
        groups.write([GroupInput.of(scenes[0], start)], tmp_path / f"{name}.kpc", of_dataset)
    slower = tmp_path / "slower.kpc"
    slower.write_bytes(coded(replace(tiny_scene(3, scales=1), clip=Clip(11, 12.5))))
    output = tmp_path / "out.kpc"
    for names, code, complaint in (
        (["early", "late"], 2, "frame 11 is missing between "),
        (["late", "early", "later"], 2, "frame 11 is missing between "),
        (["early", "early", "middle"], 2, "early.kpc: is given twice; give it once"),
        (["late", "late"], 2, "late.kpc, group 0: is given twice; give it once"),
        (["late", "copy"], 2, "holds frames 12 to 22, as "),
        (["middle", "later"], 2, "frames 20 to 22 are missing between "),
        (["early", "again", "late"], 2, "again.kpc: begins with frame 0, as "),
        (["early", "alone", "late"], 2, "alone.kpc: is a clip of its own, and "),
        (["early", "other"], 2, "early.kpc: is of another dataset than "),
        (["early"], 2, "give two or more"),
        (["early", "slower"], 2, "runs at 12.5 fps"),
        (["early", "none"], 1, "No such file"),
    ):
        assert kpjoin.main([*(str(tmp_path / f"{name}.kpc") for name in names), "-o", str(output)]) == code
        assert complaint in capsys.readouterr().err and not output.exists()
    damaged = bytearray(scenes[0])
    damaged[-3] ^= 1
    with pytest.raises(FormatError, match="is damaged"):
        groups.write([GroupInput.of(bytes(damaged), 0)], output)
    assert not output.exists()
    before = clip.read_bytes()
    assert kpjoin.main([str(clip), str(slower), "-o", str(clip)]) == 2 and clip.read_bytes() == before
    with pytest.raises(UsageError, match="leave no frame out"):
        groups.write([GroupInput.of(slower, 5), GroupInput.of(scenes[1], 4)], output)


def test_kpinfo_lists_the_groups(clip, capsys):
    assert kpinfo.main([str(clip), "--verify"]) == 0
    page = capsys.readouterr().out
    assert "30 frames at 10 fps, 3.00 s, in 3 groups" in page and "verified" in page
    named = clip.with_name("named.kpc")
    groups.write(groups.group_inputs([clip]), named, Metadata({"camera_names": ["left", "right"]}))
    assert kpinfo.main([str(named)]) == 0 and "names       left, right\n" in capsys.readouterr().out
    assert kpinfo.main([str(clip), "--json"]) == 0
    (info,) = json.loads(capsys.readouterr().out)["files"]
    assert [group["frames"] for group in info["groups"]] == [[0, 10], [8, 18], [19, 29]]
    assert [group["shown_s"] for group in info["groups"]] == [[0, 0.9], [0.9, 1.85], [1.85, 3.0]]
    assert kpinfo.main([str(clip), "--group", "1"]) == 0
    assert "group 1     frames 8-18, shown from 0.90 to 1.85 s" in capsys.readouterr().out
    assert kpinfo.main([str(clip), "--group", "3"]) == 2
    assert "there is no group 3: it has 3 groups, numbered from 0" in capsys.readouterr().err


def test_kpinfo_finds_a_damaged_group(clip, tmp_path, capsys):
    data = bytearray(clip.read_bytes())
    data[-5] ^= 1
    (tmp_path / "damaged.kpc").write_bytes(data)
    assert kpinfo.main([str(tmp_path / "damaged.kpc"), "--verify", "--json"]) == 1
    captured = capsys.readouterr()
    (info,) = json.loads(captured.out)["files"]
    assert "group 2" in captured.err and "group 2" in info["error"] and not info["verified"]
    assert [chunk["group"] for chunk in info["damaged_chunks"]] == [2] and len(info["groups"]) == 3


@pytest.mark.parametrize("backend", ["reference", "gl"])
def test_kprender_renders_across_groups(clip, backend, tmp_path):
    options = [str(clip), "--orbit", "4", "--size", "16x12", "--backend", backend, "-o", str(tmp_path / "pictures")]
    assert kprender.main(options) == 0
    long = kpc.load(clip)
    for number, camera in enumerate(orbit(long.at(0.0)[0], 4)):
        expected = np.rint(np.clip(kpc.render(long, fit_camera(camera, 16, 12), number / 3).rgb, 0, 1) * 255)
        picture = np.asarray(Image.open(tmp_path / "pictures" / f"{number:04d}.png"), float)
        assert np.abs(picture - expected).max() <= 1, number


def test_an_appearance_must_exist_in_every_group_rendered(tmp_path):
    one = with_appearances(tiny_scene(0, scales=1))
    other = with_appearances(tiny_scene(1, scales=1), names=("noon.jpg",))
    groups.write([GroupInput.of(coded(one), 0), GroupInput.of(coded(other), 11)], tmp_path / "varied.kpc")
    options = [str(tmp_path / "varied.kpc"), "--size", "8x6", "--backend", "reference", "-o"]
    assert kprender.main([*options, str(tmp_path / "noon"), "--appearance", "noon.jpg", "--orbit", "2"]) == 0
    assert kprender.main([*options, str(tmp_path / "dawn"), "--appearance", "dawn.jpg", "--orbit", "2"]) == 2
