"""Playback of scenes while they arrive, from memory and over good and bad connections to a local server."""

import gc
import threading
import time as clock
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import IO, ClassVar

import moderngl
import numpy as np
import pytest

import gl
import kpc
from kpc.format.common.errors import BudgetError
from kpc.format.container import http, http_client
from kpc.format.container.container import Reader
from kpc.format.container.sources import open_source
from kpc.format.scene.scene import Scene
from kpc.player.cpu.corner_grid import CornerGrid
from kpc.player.gl.renderer import Renderer
from kpc.player.quality import Quality
from kpc.player.sharing.file_server import Handler, Link, serving
from kpc.player.streaming import stream as module
from kpc.player.streaming.prefetch import Playhead
from kpc.player.streaming.stream import Stream
from partial_scenes import coded
from scenes import VARIANTS, tiny_scene

TIMEOUT_S = 20.0
SIZE = (48, 36)


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(http, "FIRST_BYTES", 4096)


@pytest.fixture
def watched() -> Iterator[Callable[..., Stream]]:
    """Return a function that opens streams; they are closed after the test."""
    opened: list[Stream] = []

    def open_stream(source: object, **options: object) -> Stream:
        opened.append(Stream(open_source(source), **options))  # type: ignore[arg-type]
        return opened[-1]

    yield open_stream
    for stream in opened:
        stream.close()
        stream._thread.join(TIMEOUT_S)
        assert not stream._thread.is_alive()


def until(condition: Callable[[], object], stream: Stream, renderer: Renderer) -> None:
    """Call `upload` as frames would, until a condition holds."""
    end = clock.monotonic() + TIMEOUT_S
    while not condition():
        assert clock.monotonic() < end, stream.message
        stream.upload(renderer)
        clock.sleep(0.001)


def picture(renderer: Renderer, scene: Scene, time: float) -> np.ndarray:
    return renderer.render(scene.cameras[0].resized(*SIZE), time).rgb


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12)))


@pytest.mark.parametrize("folded", [False, True])
@pytest.mark.parametrize("space", [*VARIANTS, "baked"])
def test_a_scene_that_has_arrived_gives_the_same_picture_as_one_that_was_loaded(
    space: str, folded: bool, watched: Callable[..., Stream], tmp_path: Path
) -> None:
    scene, quality = (
        VARIANTS["displaced" if space == "baked" else space](tiny_scene(4, channels=16, time=10)),
        Quality(folded=folded),
    )
    if space == "baked":
        scene = replace(scene, decoder=replace(scene.decoder, w2=0 * scene.decoder.w2))
        quality = Quality(folded=folded, grid_termination=1 / 16)
        assert CornerGrid.serves(scene)
    data = coded(scene)
    (tmp_path / "scene.kpc").write_bytes(data)
    whole = kpc.load(data)
    wanted = Renderer(gl.context(), whole, quality)
    with serving(tmp_path) as url:
        for source in (str(tmp_path / "scene.kpc"), f"{url}/scene.kpc"):
            stream = watched(source)
            renderer = Renderer(gl.context(), stream.scene, quality)
            picture(renderer, whole, 0.3)  # with what has arrived
            until(lambda stream=stream: stream.is_settled, stream, renderer)
            assert stream.loaded_fraction == 1 and stream.can_show(0.3) and stream.message is None
            assert stream.fixed_bytes > renderer.memory_bytes - renderer.picture_bytes
            for time in (0.0, 0.3, 1.0):
                assert np.array_equal(picture(renderer, whole, time), picture(wanted, whole, time))


def test_a_static_scene_streams_too(watched: Callable[..., Stream]) -> None:
    data = coded(tiny_scene(6, dynamic=False))
    stream, whole = watched(data), kpc.load(data)
    renderer = Renderer(gl.context(), stream.scene)
    until(lambda: stream.is_settled, stream, renderer)
    assert np.array_equal(picture(renderer, whole, 0.0), picture(Renderer(gl.context(), whole), whole, 0.0))


def test_a_coarse_picture_arrives_early_and_is_refined(watched: Callable[..., Stream], tmp_path: Path) -> None:
    data = coded(tiny_scene(4, time=10, scales=3, resolution=(96, 80, 64)))
    (tmp_path / "scene.kpc").write_bytes(data)
    whole, found = kpc.load(data), []
    with serving(tmp_path, link=Link(rate=20_000)) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        for scales in (1, 2, 3):
            until(lambda scales=scales: stream.complete_scales >= scales and stream.can_show(0.0), stream, renderer)
            found.append((stream.complete_scales, stream.source.received_bytes, picture(renderer, whole, 0.0)))  # type: ignore[attr-defined]
        until(lambda: stream.is_settled, stream, renderer)
    wanted = picture(Renderer(gl.context(), whole), whole, 0.0)
    quality = [psnr(rgb, wanted) for *_, rgb in found]
    assert [scales for scales, *_ in found] == [1, 2, 3]
    assert found[0][1] < 0.4 * len(data) and quality[0] < quality[-1] == psnr(wanted, wanted)


def test_a_finer_scale_is_shown_once_its_time_planes_are_there(
    watched: Callable[..., Stream], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Playback never stops for a scale that is finer than what could be shown before."""
    monkeypatch.setattr(module, "RUN_BYTES", 1024)  # so that space planes come before time planes, not with them
    (tmp_path / "scene.kpc").write_bytes(coded(tiny_scene(4, time=40, scales=3, resolution=(48, 40, 32)), 4))
    with serving(tmp_path, link=Link(rate=30_000)) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        until(lambda: stream.can_show(0.0), stream, renderer)
        began, scales = clock.monotonic(), []
        while not stream.is_settled and clock.monotonic() < began + TIMEOUT_S:
            time = (clock.monotonic() - began) / 20 % 1.0
            stream.set_playhead(Playhead(time, 1 / 20))
            stream.upload(renderer)
            if stream.complete_scales not in scales:
                assert stream.can_show(time, 1 / 20)
                scales.append(stream.complete_scales)
            clock.sleep(0.001)
    assert scales == [1, 2, 3]


def long_scene() -> bytes:
    return coded(tiny_scene(4, time=120), 4)


def test_a_long_clip_plays_in_little_memory(watched: Callable[..., Stream], tmp_path: Path) -> None:
    """Segments behind the playhead are dropped, those ahead are fetched, and every picture is right."""
    data = long_scene()
    (tmp_path / "scene.kpc").write_bytes(data)
    whole = kpc.load(data)
    wanted = Renderer(gl.context(), whole)
    with serving(tmp_path) as url:
        unlimited = watched(f"{url}/scene.kpc")
        fixed, all_of_it = unlimited.fixed_bytes, int(unlimited.parts.sizes[unlimited.parts.moves].sum())
        room = all_of_it // 5
        stream = watched(f"{url}/scene.kpc", memory=fixed + room)
        renderer = Renderer(gl.context(), stream.scene)
        until(lambda: stream.complete_scales == 2, stream, renderer)
        until(lambda: stream.memory_bytes > room / 3, stream, renderer)  # ahead of a playhead that stands still
        for turn in range(2):
            for time in np.linspace(0, 1, 60):
                stream.set_playhead(Playhead(float(time), 0.1))
                until(lambda time=time: stream.can_show(float(time)), stream, renderer)
                segments = sum(
                    p.nbytes for s in stream.scene.scales for n in ("xt", "yt", "zt") for p in s[n]._segments.values()
                )
                assert segments <= stream.memory_bytes <= room
                if int(60 * time) % 7 == turn:
                    assert np.array_equal(picture(renderer, whole, float(time)), picture(wanted, whole, float(time)))
        assert not stream._loaded.all()
        assert stream.source.received_bytes > 1.2 * len(data)  # type: ignore[attr-defined]  # dropped, and fetched again the second time


def test_too_little_memory_is_reported_before_a_plane_is_fetched() -> None:
    data = long_scene()
    with pytest.raises(BudgetError, match=r"playing takes more than --memory 3MB; give --memory \d+MB") as refusal:
        Stream(open_source(data), memory=3_000_000)
    needed = int(str(refusal.value).rsplit(" ", 1)[1].removesuffix("MB")) * 1_000_000
    Stream(open_source(data), memory=needed).close()
    with pytest.raises(BudgetError, match="than --memory 6MB; give --memory") as refusal:  # of two groups, one
        Stream(open_source(data), memory=3_000_000, share=0.5)
    with pytest.raises(BudgetError, match="than --memory 30KB; give --memory 1") as far_too_little:
        Stream(open_source(data), memory=15_000, share=0.5)
    assert str(far_too_little.value).rsplit(" ", 1)[1] == str(refusal.value).rsplit(" ", 1)[1]
    assert 2 * needed - 10**6 <= int(str(refusal.value).rsplit(" ", 1)[1].removesuffix("MB")) * 10**6 <= 2 * needed
    assert "fetching" not in [thread.name for thread in threading.enumerate()]


class RecordingHandler(Handler):
    """Records the first byte of every range that is requested."""

    asked: ClassVar[list[int]] = []

    def do_GET(self) -> None:
        self.asked.append(int(self.headers["Range"].removeprefix("bytes=").split("-")[0]))
        super().do_GET()


def test_segments_after_a_jump_are_fetched_before_those_in_between(
    watched: Callable[..., Stream], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "RUN_BYTES", 2048)
    data = long_scene()
    (tmp_path / "scene.kpc").write_bytes(data)
    RecordingHandler.asked.clear()
    with serving(tmp_path, link=Link(rate=40_000, delay_s=0.002), handler=RecordingHandler) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        until(lambda: stream.complete_scales == 2 and stream.can_show(0.0), stream, renderer)
        before = len(RecordingHandler.asked)
        stream.set_playhead(Playhead(0.9))
        assert not stream.can_show(0.9)
        until(lambda: stream.can_show(0.9), stream, renderer)
        assert stream.loaded_fraction < 0.9
        late = [e.offset for e in Reader(data).index if e.kind == "PLNE" and 104 <= e.row_start <= 108]
        since = RecordingHandler.asked[before:]
        assert any(offset in late for offset in since[:3])  # the request that was under way may finish first


def test_a_jump_does_not_wait_for_the_end_of_a_large_chunk(watched: Callable[..., Stream], tmp_path: Path) -> None:
    scene = tiny_scene(4, time=120, resolution=(160, 160, 160), scales=3)
    rng = np.random.default_rng(0)
    noise = {name: rng.normal(0, 0.2, plane.shape).astype(np.float32) for name, plane in scene.scales[2].items()}
    finest = {
        name: plane + (noise[name] if name in ("xy", "xz", "yz") else 0) for name, plane in scene.scales[2].items()
    }
    data = coded(replace(scene, scales=(*scene.scales[:2], finest)), 4)
    (tmp_path / "scene.kpc").write_bytes(data)
    largest = max(e.stored_length for e in Reader(data).index)
    assert largest > 100_000
    with serving(tmp_path, link=Link(rate=100_000)) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        until(
            lambda: stream.complete_scales == 2 and stream.can_show(0.0) and stream._fetching is not None,
            stream,
            renderer,
        )
        received = stream.received
        stream.set_playhead(Playhead(0.7))
        until(lambda: stream.can_show(0.7), stream, renderer)
        assert stream.complete_scales == 2 and stream.received - received < largest / 2
        until(lambda: stream.is_settled, stream, renderer)
        whole = kpc.load(data)
        assert np.array_equal(picture(renderer, whole, 0.5), picture(Renderer(gl.context(), whole), whole, 0.5))
        assert stream.received < 1.05 * len(data)  # what arrived before the jump is not fetched again


def test_a_stalled_player_continues(watched: Callable[..., Stream], tmp_path: Path) -> None:
    (tmp_path / "scene.kpc").write_bytes(long_scene())
    release = threading.Event()

    class Halting(Handler):
        """Sends the first picture, then nothing until `release` is set."""

        def send(self, file: IO[bytes], count: int) -> None:
            if file.tell() > 30_000:
                release.wait(TIMEOUT_S)
            super().send(file, count)

    with serving(tmp_path, handler=Halting) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        assert (stream.message or "").startswith("loading")
        until(lambda: stream.can_show(0.0), stream, renderer)
        assert stream.message is None
        time = 0.0
        while stream.can_show(time):
            stream.set_playhead(Playhead(time, 0.1))
            time += 0.01
            assert time < 1
        assert (stream.message or "").startswith("loading")
        release.set()
        until(lambda: stream.can_show(time, 0.1), stream, renderer)
        assert stream.message is None


def test_the_window_does_not_wait_for_a_server_that_does_not_answer(
    watched: Callable[..., Stream], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_client, "READ_TIMEOUT_S", 0.3)
    (tmp_path / "scene.kpc").write_bytes(long_scene())
    release, silent = threading.Event(), threading.Event()

    class Dying(Handler):
        def send(self, file: IO[bytes], count: int) -> None:
            if file.tell() >= 4096 and not release.is_set():
                silent.set()
                release.wait(TIMEOUT_S)
                self.close_connection = True
            else:
                super().send(file, count)

    with serving(tmp_path, handler=Dying) as url:
        opened: list[Stream] = []
        thread = threading.Thread(target=lambda: opened.append(watched(f"{url}/scene.kpc")))
        thread.start()  # the constructor waits for everything but planes
        silent.wait(TIMEOUT_S)
        release.set()
        thread.join(TIMEOUT_S)
        stream = opened[0]
        renderer = Renderer(gl.context(), stream.scene)
        until(lambda: stream.can_show(0.0), stream, renderer)
        release.clear()
        slowest = 0.0
        for frame in range(200):
            started = clock.monotonic()
            stream.set_playhead(Playhead(frame / 200, 0.1))
            stream.upload(renderer)
            stream.can_show(frame / 200)
            _ = stream.message, stream.loaded_fraction, stream.bytes_per_s
            slowest = max(slowest, clock.monotonic() - started)
        release.set()
    assert slowest < 0.25  # a request would have taken longer


def test_the_rate_shown_on_a_slow_line_does_not_fall_to_nothing_between_lumps(
    watched: Callable[..., Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream, now = watched(coded(tiny_scene(6, dynamic=False))), 0.0
    monkeypatch.setattr("kpc.player.streaming.stream.clock", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(Stream, "received", property(lambda self: 30_000 * int(now / 3)))  # 10 KB/s, every 3 s
    stream._history.clear()
    rates = []
    for frame in range(300):
        now = frame / 10
        rates.append(stream.bytes_per_s)
    assert 5_000 <= min(rates[100:]) <= max(rates) <= 15_000
    now = 60.0  # not asked for meanwhile
    assert stream.bytes_per_s == pytest.approx(10_000, rel=0.1)


def test_a_broken_connection_is_reported_and_resumed(watched: Callable[..., Stream], tmp_path: Path) -> None:
    data = long_scene()
    (tmp_path / "scene.kpc").write_bytes(data)
    whole = kpc.load(data)

    class Breaking(Handler):
        def send(self, file: IO[bytes], count: int) -> None:
            super().send(file, min(count, 3000))
            self.close_connection = self.close_connection or count > 3000

    with serving(tmp_path, handler=Breaking) as url:
        stream, messages = watched(f"{url}/scene.kpc"), []
        renderer = Renderer(gl.context(), stream.scene)

        def settled() -> bool:
            messages.append(stream.message)
            return stream.is_settled

        until(settled, stream, renderer)
        assert any("trying again" in (message or "") for message in messages)
        stream.can_show(0.5)
        assert stream.message is None
        assert np.array_equal(picture(renderer, whole, 0.5), picture(Renderer(gl.context(), whole), whole, 0.5))


def test_a_server_without_ranges_is_played_while_it_arrives(
    watched: Callable[..., Stream], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = coded(tiny_scene(4, time=10, scales=3, resolution=(96, 80, 64)))
    (tmp_path / "scene.kpc").write_bytes(data)
    whole = kpc.load(data)

    class Whole(Handler):
        def do_GET(self) -> None:
            del self.headers["Range"]
            super().do_GET()

    with serving(tmp_path, handler=Whole, link=Link(rate=100_000)) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        until(lambda: stream.complete_scales >= 1 and stream.can_show(0.0), stream, renderer)
        assert stream.source.received_bytes < 0.7 * len(data)  # type: ignore[attr-defined]
        until(lambda: stream.is_settled, stream, renderer)
        assert np.array_equal(picture(renderer, whole, 0.5), picture(Renderer(gl.context(), whole), whole, 0.5))
        assert stream.source.received_bytes == len(data)  # type: ignore[attr-defined]
    assert "not support range requests" in capsys.readouterr().err


def test_a_file_that_changes_is_reported_and_what_has_arrived_plays(
    watched: Callable[..., Stream], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "RUN_BYTES", 4096)
    data = long_scene()
    path = tmp_path / "scene.kpc"
    path.write_bytes(data)

    class Swapping(Handler):
        def do_GET(self) -> None:
            if int(self.headers["Range"].removeprefix("bytes=").split("-")[0]) > 10_000:
                path.write_bytes(data[::-1])
            super().do_GET()

    with serving(tmp_path, handler=Swapping) as url:
        stream = watched(f"{url}/scene.kpc")
        renderer = Renderer(gl.context(), stream.scene)
        until(lambda: stream.failure is not None, stream, renderer)
        until(lambda: not stream._finished, stream, renderer)
        assert "changed on the server" in (stream.failure or "") and stream.is_settled
        assert (stream.message or "").startswith("loading stopped: ")
        stream.upload(renderer)
        assert picture(renderer, stream.scene, 0.0).std() > 0.01 or stream.complete_scales == 0


def flipping(times: int, at: int) -> type[Handler]:
    class Flipping(Handler):
        """Damages one byte, `times` times."""

        left = times

        def send(self, file: IO[bytes], count: int) -> None:
            start = file.tell()
            body = bytearray(file.read(count))
            if start <= at < start + count and type(self).left:
                type(self).left -= 1
                body[at - start] ^= 1
            self.wfile.write(body)

    return Flipping


def test_a_damaged_chunk_is_fetched_twice_at_most(watched: Callable[..., Stream], tmp_path: Path) -> None:
    (tmp_path / "scene.kpc").write_bytes(long_scene())
    of_a_plane = Reader(long_scene()).index[-1].offset
    for times, words in ((1, None), (2, "is damaged")):
        with serving(tmp_path, handler=flipping(times, of_a_plane)) as url:
            stream = watched(f"{url}/scene.kpc")
            renderer = Renderer(gl.context(), stream.scene)
            until(lambda stream=stream: stream.is_settled, stream, renderer)
            assert (stream.failure is None) if words is None else words in (stream.failure or "")


def test_a_damaged_local_file_is_reported(watched: Callable[..., Stream]) -> None:
    data = bytearray(long_scene())
    data[-10] ^= 1
    stream = watched(bytes(data))
    renderer = Renderer(gl.context(), stream.scene)
    until(lambda: stream.is_settled, stream, renderer)
    assert "is damaged" in (stream.failure or "")


def test_unexpected_errors_of_the_thread_are_raised(
    watched: Callable[..., Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "dequantise_symbols", lambda *arguments: 1 / 0)
    stream = watched(long_scene())
    renderer = Renderer(gl.context(), stream.scene)
    with pytest.raises(ZeroDivisionError):
        until(lambda: False, stream, renderer)


def test_closing_does_not_wait_for_a_slow_connection(tmp_path: Path) -> None:
    (tmp_path / "scene.kpc").write_bytes(long_scene())
    with serving(tmp_path, link=Link(rate=20_000)) as url:
        stream = Stream(open_source(f"{url}/scene.kpc"))
        started = clock.monotonic()
        stream.close()
        assert clock.monotonic() - started < 1.5
        stream._thread.join(TIMEOUT_S)
        assert not stream._thread.is_alive()


def test_a_large_plane_is_uploaded_over_several_frames(watched: Callable[..., Stream]) -> None:
    data = coded(tiny_scene(4, time=10, scales=2, resolution=(96, 80, 64)))
    stream, whole = watched(data), kpc.load(data)
    renderer, written = Renderer(gl.context(), stream.scene), []
    put = renderer.put

    def noted(scale: int, plane: str, texels: np.ndarray, first: int = 0) -> None:
        written.append(texels.nbytes)
        put(scale, plane, texels, first)

    renderer.put = noted  # type: ignore[method-assign]
    end = clock.monotonic() + TIMEOUT_S
    while not stream.is_settled and clock.monotonic() < end:
        written.clear()
        stream.upload(renderer, max_bytes=20_000)
        assert sum(written) <= 20_000 + 96 * 2 * 16
    assert np.array_equal(picture(renderer, whole, 0.5), picture(Renderer(gl.context(), whole), whole, 0.5))


# Methods of a moderngl context that allocate something on the card.
MAKERS = (
    *("texture", "texture3d", "texture_array", "buffer", "framebuffer", "simple_framebuffer"),
    *("renderbuffer", "vertex_array", "simple_vertex_array", "program", "sampler", "query"),
)


@pytest.mark.parametrize("folded", [False, True])
def test_playback_allocates_nothing_on_the_card_and_no_memory(
    folded: bool, watched: Callable[..., Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also while segments are fetched and dropped."""
    data = long_scene()
    unlimited = watched(data)
    room = int(unlimited.parts.sizes[unlimited.parts.moves].sum()) // 4
    stream = watched(data, memory=unlimited.fixed_bytes + room)
    ctx = gl.context()
    renderer, screen = Renderer(ctx, stream.scene, Quality(folded=folded)), ctx.simple_framebuffer(SIZE, 4)
    camera = stream.scene.cameras[0].resized(*SIZE)
    until(lambda: stream.complete_scales == 2, stream, renderer)
    made: list[str] = []

    def play(turns: int) -> None:
        for time in np.tile(np.linspace(0, 1, 40), turns):
            stream.set_playhead(Playhead(float(time), 0.1))
            until(lambda time=time: stream.can_show(float(time)), stream, renderer)
            renderer.show(screen, camera, float(time))

    play(2)
    for name in MAKERS:
        monkeypatch.setattr(moderngl.Context, name, lambda *a, name=name, **k: made.append(name))
    tracemalloc.start()
    try:
        play(1)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        play(4)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        for each in (
            unlimited,
            stream,
        ):  # no kernel may allocate meanwhile: CPython's issue 128679, a crash before 3.14
            each.close()
            each._thread.join(TIMEOUT_S)
        tracemalloc.stop()
    assert not made
    assert grown < room + 100_000  # segments; keeping a row of texels per frame would take 1.6 MB
