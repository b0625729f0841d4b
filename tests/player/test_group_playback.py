"""Playback of clips in groups: which group is shown, what is fetched ahead and released, and that no call blocks."""

import threading
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gl
import kpc
from kpc.encoder.coding import scene_writer
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import BudgetError
from kpc.format.container import groups
from kpc.format.container.container import Reader
from kpc.format.container.groups import GroupInput, Groups
from kpc.format.container.sources import open_source
from kpc.format.scene.scene import Clip, Scene
from kpc.player.gl.renderer import Renderer
from kpc.player.sharing.file_server import serving
from kpc.player.streaming.group_playback import GroupPlayback
from kpc.player.streaming.prefetch import Playhead
from scenes import tiny_scene

TIMEOUT_S = 10.0
RATE = 0.2  # fraction of the clip per second


def coded(scene: Scene) -> bytes:
    return scene_writer.encode(quantise_scene(scene, [dict.fromkeys(scale, 0.02) for scale in scene.scales]))


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 0 to 10, 8 to 18 and 19 to 29 at 2 fps; the groups differ in scales and in what they move."""
    path = tmp_path_factory.mktemp("clip") / "long.kpc"
    scenes = [tiny_scene(0, scales=1), tiny_scene(1), tiny_scene(2, dynamic=False, scales=1)]
    scenes = [
        replace(scene, clip=Clip(11, 2.0), cameras=scene.cameras if k == 0 else ()) for k, scene in enumerate(scenes)
    ]
    groups.write([GroupInput.of(coded(scene), start) for scene, start in zip(scenes, (0, 8, 19), strict=True)], path)
    return path


@pytest.fixture
def opened() -> Iterator[Callable[..., GroupPlayback]]:
    """Return a function that opens clips for the shared context; they are closed after the test."""
    playbacks: list[GroupPlayback] = []

    def open_clip(source: object, **options: int) -> GroupPlayback:
        playback = GroupPlayback(open_source(source), **options)  # type: ignore[arg-type]
        playback.draw_with(lambda scene: Renderer(gl.context(), scene))
        playbacks.append(playback)
        return playback

    yield open_clip
    for playback in playbacks:
        playback.close()


def wait_for(playback: GroupPlayback, head: Playhead, done: Callable[[], bool]) -> float:
    """Call `set_playhead` and `upload` until a condition holds; return the seconds of the slowest turn."""
    longest, until = 0.0, clock.monotonic() + TIMEOUT_S
    while not done():
        assert clock.monotonic() < until, "timeout"
        started = clock.monotonic()
        playback.set_playhead(head)
        playback.upload()
        longest = max(longest, clock.monotonic() - started)
        clock.sleep(0.002)
    return longest


def settled(playback: GroupPlayback, time: float, number: int) -> None:
    wait_for(
        playback, Playhead(time), lambda: playback.number == number and playback.can_show(time) and playback.is_settled
    )


def assert_shows(playback: GroupPlayback, path: object, time: float) -> None:
    """Assert that the picture at a time of the clip is that of the loaded clip."""
    whole = kpc.load(path)  # type: ignore[arg-type]
    camera = kpc.load(path).cameras[0].resized(16, 12)  # type: ignore[arg-type]
    drawn = playback.renderer.render(camera, playback.time_in(time)).rgb
    if (other_group := playback.blended_with(time)) is not None:
        other, time_in_it, share = other_group
        drawn = (1 - share) * drawn + share * other.render(camera, time_in_it).rgb
    assert np.abs(drawn - kpc.render(whole, camera, time).rgb).max() < 2 / 255


def test_each_group_is_shown_at_its_time(clip, opened):
    playback = opened(clip)
    assert playback.clip == Clip(30, 2.0) and len(playback.groups) == 3
    for frame, number in ((0, 0), (8, 0), (10, 1), (17, 1), (20, 2), (29, 2), (3, 0)):
        settled(playback, frame / 29, number)
        assert_shows(playback, clip, frame / 29)
        assert playback.time_of(playback.time_in(frame / 29)) == pytest.approx(frame / 29)


def test_the_next_group_is_ready_before_it_is_shown(clip, opened):
    playback, head = opened(clip), Playhead(0.1, RATE)
    wait_for(
        playback,
        head,
        lambda: (
            playback.next_group is not None and playback.next_group.is_warm and playback.next_group.stream.is_settled
        ),
    )
    assert playback.number == 0 and playback.next_group.number == 1
    assert playback.can_show(8 / 29, RATE)
    playback.set_playhead(Playhead(9.1 / 29, RATE))
    assert playback.number == 1 and playback.can_show(9.1 / 29, RATE)  # in the same turn
    assert_shows(playback, clip, 9.1 / 29)
    version = playback.version
    wait_for(playback, Playhead(0.6, RATE), lambda: playback.next_group is not None and playback.next_group.number == 2)
    assert playback.version >= version


def test_two_groups_are_blended_within_their_common_frames(clip, opened):
    """Whether the playhead reaches these frames by playing or by a jump."""
    playback = opened(clip)
    for frame, number in ((8.5, 0), (9.5, 1), (8.5, 0), (25, 2), (9.25, 1), (12, 1), (9.75, 1)):
        time = frame / 29
        settled(playback, time, number)
        assert (playback.blended_with(time) is not None) == (8 < frame < 10)
        if playback.blended_with(time) is not None:
            assert playback.next_group.number == 1 - number and playback.version_at(time) == (
                playback.version,
                playback.next_group.stream.version,
            )
        assert_shows(playback, clip, time)


def blocked(playback: GroupPlayback, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Block the opening of further groups until the event is set."""
    gate, open_group = threading.Event(), playback.groups.open
    monkeypatch.setattr(
        playback.groups, "open", lambda *args, **options: gate.wait(TIMEOUT_S) and open_group(*args, **options)
    )
    return gate


def test_playback_waits_for_a_group_that_has_not_arrived(clip, opened, monkeypatch):
    playback = opened(clip)
    gate = blocked(playback, monkeypatch)
    settled(playback, 0.0, 0)
    playback.set_playhead(Playhead(8.5 / 29))
    assert playback.number == 0 and playback.blended_with(8.5 / 29) is None
    assert (
        not playback.can_show(8.5 / 29)
        and playback.can_show(8 / 29)
        and not playback.is_settled
        and "loading" in playback.message
    )
    gate.set()
    settled(playback, 8.5 / 29, 0)


def test_the_first_group_follows_the_last_when_looping(clip, opened):
    playback = opened(clip)
    settled(playback, 0.99, 2)
    wait_for(
        playback,
        Playhead(0.99, RATE, loop=True),
        lambda: playback.next_group is not None and playback.next_group.number == 0,
    )
    playback.set_playhead(Playhead(0.99, RATE, loop=False))
    assert playback.next_group is None


def test_at_most_two_groups_are_held_and_all_threads_end(clip, opened):
    before = threading.active_count()
    playback = opened(clip)
    for time in (0.0, 0.5, 0.99, 0.0, 0.5):
        settled(playback, time, Groups(clip).timeline.at(time)[0])
        assert threading.active_count() <= before + 3  # two fetch, one opens
    playback.close()
    wait_until = clock.monotonic() + TIMEOUT_S
    while threading.active_count() > before:
        assert clock.monotonic() < wait_until
        clock.sleep(0.01)


def test_a_jump_to_a_missing_group_does_not_block(clip, opened, monkeypatch):
    playback = opened(clip)
    gate = blocked(playback, monkeypatch)
    settled(playback, 0.0, 0)
    playback.set_playhead(Playhead(0.99))
    assert not playback.can_show(0.99) and not playback.is_settled and playback.number == 0
    assert playback.time_in(0.99) == 1.0  # the group before stays, with its last picture
    gate.set()
    settled(playback, 0.99, 2)


def test_each_group_may_take_half_of_the_memory(clip, opened):
    single = Groups(clip).source_of(1)
    needed = GroupPlayback(open_source(single.read_at(0, single.size)))
    most = needed.stream.fixed_bytes
    needed.close()
    with pytest.raises(BudgetError):
        opened(clip, memory=most // 2)
    opened(clip, memory=8 * most)


def test_a_file_without_groups_is_a_single_group(opened):
    data = coded(tiny_scene(3))
    playback = opened(data)
    settled(playback, 0.7, 0)
    assert playback.next_group is None and playback.time_in(0.7) == 0.7
    assert_shows(playback, data, 0.7)


def test_groups_are_fetched_over_http(clip, opened):
    with serving(clip.parent) as url:
        playback = opened(f"{url}/long.kpc")
        settled(playback, 0.0, 0)
        assert_shows(playback, clip, 0.0)
        for frame, number in ((20, 2), (12, 1), (0, 0)):
            settled(playback, frame / 29, number)
            assert_shows(playback, clip, frame / 29)
        playback.close()


def test_a_damaged_group_is_reported_and_the_others_play(clip, opened, tmp_path):
    data = bytearray(clip.read_bytes())
    data[Reader(clip).index[1].offset + 8] ^= 1  # its header
    (tmp_path / "damaged.kpc").write_bytes(data)
    playback = opened(tmp_path / "damaged.kpc")
    wait_for(playback, Playhead(0.5), lambda: playback.message is not None and "group 1" in playback.message)
    wait_for(playback, Playhead(0.5), lambda: playback.is_settled)
    assert playback.number == 0
    assert_shows(playback, clip, 0.1)
