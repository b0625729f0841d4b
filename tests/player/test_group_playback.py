"""Clips in groups that play: which group shows, what is fetched ahead and let go, and that nobody waits."""

import threading
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import gl
import numpy as np
import pytest
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import BudgetError
from kpc.format.container import groups, scene_io
from kpc.format.container.container import Reader, open_source
from kpc.format.container.groups import GroupInput, Groups
from kpc.format.scene.scene import Clip, Scene
from kpc.player.gl.renderer import Renderer
from kpc.player.streaming.group_playback import GroupPlayback
from kpc.player.streaming.prefetch import Playhead
from kpc.tools.cli.serve import serving
from scenes import tiny_scene

import kpc

SOON_S = 10.0
RATE = 0.2
"""Of the clip in a second."""


def coded(scene: Scene) -> bytes:
    return scene_io.encode(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]))


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 0 to 10, 8 to 18 and 19 to 29 at 2 fps; the groups differ in scales and in what they move."""
    path = tmp_path_factory.mktemp("reel") / "long.kpc"
    scenes = [tiny_scene(0, scales=1), tiny_scene(1), tiny_scene(2, dynamic=False, scales=1)]
    scenes = [
        replace(scene, clip=Clip(11, 2.0), cameras=scene.cameras if k == 0 else ()) for k, scene in enumerate(scenes)
    ]
    groups.write([GroupInput.of(coded(scene), start) for scene, start in zip(scenes, (0, 8, 19), strict=True)], path)
    return path


@pytest.fixture
def opened() -> Iterator[Callable[..., GroupPlayback]]:
    """Opens reels that draw on the shared context, and closes them in the end."""
    reels: list[GroupPlayback] = []

    def open_reel(source: object, **options: int) -> GroupPlayback:
        reel = GroupPlayback(open_source(source), **options)  # type: ignore[arg-type]
        reel.draw_with(lambda scene: Renderer(gl.context(), scene))
        reels.append(reel)
        return reel

    yield open_reel
    for reel in reels:
        reel.close()


def wait_for(reel: GroupPlayback, head: Playhead, done: Callable[[], bool]) -> float:
    """Turn after turn of a window until something is so; the longest that one took, seconds."""
    longest, until = 0.0, clock.monotonic() + SOON_S
    while not done():
        assert clock.monotonic() < until, "never"
        started = clock.monotonic()
        reel.set_playhead(head)
        reel.upload()
        longest = max(longest, clock.monotonic() - started)
        clock.sleep(0.002)
    return longest


def settled(reel: GroupPlayback, time: float, number: int) -> None:
    wait_for(reel, Playhead(time), lambda: reel.number == number and reel.can_show(time) and reel.is_settled)


def assert_shows(reel: GroupPlayback, path: object, time: float) -> None:
    """The picture at a time of the clip is that of the whole."""
    whole = kpc.load(path)  # type: ignore[arg-type]
    camera = kpc.load(path).cameras[0].resized(16, 12)  # type: ignore[arg-type]
    drawn = reel.renderer.render(camera, reel.time_in(time)).rgb
    if (beside := reel.blended_with(time)) is not None:
        other, time_in_it, share = beside
        drawn = (1 - share) * drawn + share * other.render(camera, time_in_it).rgb
    assert np.abs(drawn - kpc.render(whole, camera, time).rgb).max() < 2 / 255


def test_each_group_shows_in_its_time(clip, opened):
    reel = opened(clip)
    assert reel.clip == Clip(30, 2.0) and len(reel.groups) == 3
    for frame, number in ((0, 0), (8, 0), (10, 1), (17, 1), (20, 2), (29, 2), (3, 0)):
        settled(reel, frame / 29, number)
        assert_shows(reel, clip, frame / 29)
        assert reel.time_of(reel.time_in(frame / 29)) == pytest.approx(frame / 29)


def test_the_next_group_is_there_before_it_shows(clip, opened):
    reel, head = opened(clip), Playhead(0.1, RATE)
    wait_for(
        reel,
        head,
        lambda: reel.next_group is not None and reel.next_group.is_warm and reel.next_group.stream.is_settled,
    )
    assert reel.number == 0 and reel.next_group.number == 1
    assert reel.can_show(8 / 29, RATE)
    reel.set_playhead(Playhead(9.1 / 29, RATE))
    assert reel.number == 1 and reel.can_show(9.1 / 29, RATE)  # in the same turn
    assert_shows(reel, clip, 9.1 / 29)
    version = reel.version
    wait_for(reel, Playhead(0.6, RATE), lambda: reel.next_group is not None and reel.next_group.number == 2)
    assert reel.version >= version


def test_two_groups_are_mixed_amid_the_frames_that_they_share(clip, opened):
    """Whether they come to it one after the other or at once; both are held until it is over."""
    reel = opened(clip)
    for frame, number in ((8.5, 0), (9.5, 1), (8.5, 0), (25, 2), (9.25, 1), (12, 1), (9.75, 1)):
        time = frame / 29
        settled(reel, time, number)
        assert (reel.blended_with(time) is not None) == (8 < frame < 10)
        if reel.blended_with(time) is not None:
            assert reel.next_group.number == 1 - number and reel.version_at(time) == (
                reel.version,
                reel.next_group.stream.version,
            )
        assert_shows(reel, clip, time)


def held_up(reel: GroupPlayback, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Let no further group be opened until this is set."""
    gate, open_group = threading.Event(), reel.groups.open
    monkeypatch.setattr(
        reel.groups, "open", lambda *args, **options: gate.wait(SOON_S) and open_group(*args, **options)
    )
    return gate


def test_a_clip_does_not_go_on_into_frames_of_a_group_that_is_not_there(clip, opened, monkeypatch):
    reel = opened(clip)
    gate = held_up(reel, monkeypatch)
    settled(reel, 0.0, 0)
    reel.set_playhead(Playhead(8.5 / 29))
    assert reel.number == 0 and reel.blended_with(8.5 / 29) is None
    assert not reel.can_show(8.5 / 29) and reel.can_show(8 / 29) and not reel.is_settled and "loading" in reel.message
    gate.set()
    settled(reel, 8.5 / 29, 0)


def test_after_the_last_comes_the_first_where_it_loops(clip, opened):
    reel = opened(clip)
    settled(reel, 0.99, 2)
    wait_for(reel, Playhead(0.99, RATE, loop=True), lambda: reel.next_group is not None and reel.next_group.number == 0)
    reel.set_playhead(Playhead(0.99, RATE, loop=False))
    assert reel.next_group is None


def test_two_groups_are_held_at_most_and_their_threads_end(clip, opened):
    before = threading.active_count()
    reel = opened(clip)
    for time in (0.0, 0.5, 0.99, 0.0, 0.5):
        settled(reel, time, Groups(clip).timeline.at(time)[0])
        assert threading.active_count() <= before + 3  # two fetch, one opens
    reel.close()
    wait_until = clock.monotonic() + SOON_S
    while threading.active_count() > before:
        assert clock.monotonic() < wait_until
        clock.sleep(0.01)


def test_what_is_not_there_is_waited_for_without_blocking(clip, opened, monkeypatch):
    reel = opened(clip)
    gate = held_up(reel, monkeypatch)
    settled(reel, 0.0, 0)
    reel.set_playhead(Playhead(0.99))
    assert not reel.can_show(0.99) and not reel.is_settled and reel.number == 0
    assert reel.time_in(0.99) == 1.0  # the group before stays, with its last picture
    gate.set()
    settled(reel, 0.99, 2)


def test_the_memory_is_halved_between_two_groups(clip, opened):
    single = Groups(clip).source_of(1)
    needed = GroupPlayback(open_source(single.read_at(0, single.size)))
    most = needed.stream.fixed_bytes
    needed.close()
    with pytest.raises(BudgetError):
        opened(clip, memory=most // 2)
    opened(clip, memory=8 * most)


def test_a_scene_is_a_reel_of_one(opened):
    data = coded(tiny_scene(3))
    reel = opened(data)
    settled(reel, 0.7, 0)
    assert reel.next_group is None and reel.time_in(0.7) == 0.7
    assert_shows(reel, data, 0.7)


def test_groups_come_over_http_and_only_as_they_are_wanted(clip, opened):
    with serving(clip.parent) as url:
        reel = opened(f"{url}/long.kpc")
        settled(reel, 0.0, 0)
        assert_shows(reel, clip, 0.0)
        for frame, number in ((20, 2), (12, 1), (0, 0)):
            settled(reel, frame / 29, number)
            assert_shows(reel, clip, frame / 29)
        reel.close()


def test_a_group_that_is_damaged_is_told_and_the_others_play_on(clip, opened, tmp_path):
    data = bytearray(clip.read_bytes())
    data[Reader(clip).index[1].offset + 8] ^= 1  # its header
    (tmp_path / "damaged.kpc").write_bytes(data)
    reel = opened(tmp_path / "damaged.kpc")
    wait_for(reel, Playhead(0.5), lambda: reel.message is not None and "group 1" in reel.message)
    wait_for(reel, Playhead(0.5), lambda: reel.is_settled)
    assert reel.number == 0
    assert_shows(reel, clip, 0.1)
