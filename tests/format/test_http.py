"""HttpSource against real servers on this machine, well-behaved and faulty."""

import gc
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, ClassVar

import numpy as np
import pytest

import kpc
from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import BudgetError, FormatError, InterruptedRead, NetworkError, UnreachableError
from kpc.format.container import http, http_client
from kpc.format.container.http import FIRST_BYTES, HttpSource
from kpc.format.container.http_address import is_url
from kpc.format.container.scene_io import SceneReader
from kpc.format.container.sources import RemoteSource, Source
from kpc.player.sharing.file_server import Handler, Link, serving
from scenes import tiny_scene

DATA = np.random.default_rng(0).integers(0, 256, 400_000, np.uint8).tobytes()


class RecordingHandler(Handler):
    """Records the ranges that are requested."""

    ranges: ClassVar[list[str | None]] = []

    def do_GET(self) -> None:
        self.ranges.append(self.headers.get("Range"))
        super().do_GET()


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Retry without long pauses; afterwards collect garbage, so that a connection left open raises a warning.

    What earlier tests left is not looked through, which would take seconds.
    """
    monkeypatch.setattr(http, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(http_client, "CONNECT_TIMEOUT_S", 2.0)
    monkeypatch.setattr(http_client, "READ_TIMEOUT_S", 2.0)
    RecordingHandler.ranges.clear()
    gc.freeze()
    yield
    gc.collect()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "data.bin").write_bytes(DATA)
    (tmp_path / "short.bin").write_bytes(DATA[:100])
    (tmp_path / "empty.bin").write_bytes(b"")
    return tmp_path


@pytest.fixture
def url(folder: Path) -> Iterator[str]:
    with serving(folder, handler=RecordingHandler) as address:
        yield f"{address}/data.bin"


def test_only_the_ranges_needed_are_requested(url: str) -> None:
    source = HttpSource(url)
    assert isinstance(source, Source) and isinstance(source, RemoteSource)
    assert source.size == len(DATA) and source.name == url and source.has_ranges
    assert source.read_at(0, 64) == DATA[:64] and source.read_at(64, 1000) == DATA[64:1064]
    assert RecordingHandler.ranges == [f"bytes=0-{FIRST_BYTES - 1}"]
    assert source.read_at(300_000, 5000) == DATA[300_000:305_000]
    assert source.read_at(len(DATA) - 10, 100) == DATA[-10:]
    assert source.read_at(len(DATA), 5) == source.read_at(10**9, 5) == source.read_at(5, 0) == b""
    assert RecordingHandler.ranges[1:] == ["bytes=300000-304999", "bytes=399990-399999"]
    assert source.received_bytes <= FIRST_BYTES + 5010
    source.close()


def test_announced_reads_share_one_request(url: str) -> None:
    source = HttpSource(url)
    source.will_read(100_000, 50_000)
    for start in range(100_000, 150_000, 7000):
        length = min(7000, 150_000 - start)
        assert source.read_at(start, length) == DATA[start : start + length]
    source.will_read(150_000, 10_000)
    assert source.read_at(155_000, 5000) == DATA[155_000:160_000]
    assert RecordingHandler.ranges == [f"bytes=0-{FIRST_BYTES - 1}", "bytes=100000-149999", "bytes=150000-159999"]
    source.close()


def test_a_whole_file_takes_two_requests_and_no_byte_twice(url: str) -> None:
    source = HttpSource(url)
    source.will_read(0, source.size)
    assert source.read_at(0, source.size) == DATA and source.received_bytes == len(DATA)
    assert RecordingHandler.ranges == [f"bytes=0-{FIRST_BYTES - 1}", f"bytes={FIRST_BYTES}-399999"]
    source.close()


def test_memory_of_a_long_response_is_released(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "KEPT_BYTES", 50_000)
    source = HttpSource(url)
    source.will_read(0, source.size)
    for start in range(0, len(DATA), 10_000):
        assert source.read_at(start, 10_000) == DATA[start : start + 10_000]
        assert len(source._download.data) <= 50_000 + 10_000 + FIRST_BYTES
    assert len(RecordingHandler.ranges) == 2
    source.close()


def test_small_and_empty_files(url: str) -> None:
    source = HttpSource(url.replace("data", "short"))
    assert source.size == 100 and source.read_at(0, 1000) == DATA[:100]
    source.close()
    with pytest.raises(NetworkError, match="is empty"):
        HttpSource(url.replace("data", "empty"))


def test_a_server_without_ranges_sends_the_whole_file_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class WithoutRanges(RecordingHandler):
        def do_GET(self) -> None:
            del self.headers["Range"]
            super().do_GET()

    with serving(folder, handler=WithoutRanges) as address:
        source = HttpSource(f"{address}/data.bin")
        assert not source.has_ranges and "not support range requests, so the whole file" in capsys.readouterr().err
        assert source.read_at(0, 64) == DATA[:64] and source.received_bytes < 200_000  # the rest is still arriving
        assert source.read_at(399_000, 1000) == DATA[399_000:] and source.read_at(10, 10) == DATA[10:20]
        assert len(RecordingHandler.ranges) == 1 and source.received_bytes == len(DATA)
        source.close()
        other = source.clone()
        assert other.read_at(300_000, 10) == DATA[300_000:300_010] and other.read_at(5, 10) == DATA[5:15]
        assert len(RecordingHandler.ranges) == 2
        other.close()
        with pytest.raises(BudgetError, match="not support range requests, and the whole file of 400,000 bytes"):
            HttpSource(f"{address}/data.bin", limit=399_999)


def test_a_whole_file_without_a_length_is_read_to_its_end(folder: Path) -> None:
    class WithoutLength(RecordingHandler):
        def answer(self, file: IO[bytes], stat: object) -> None:
            self.wfile.write(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n")
            self.close_connection = True
            self.send(file, len(DATA))

    with serving(folder, handler=WithoutLength) as address:
        source = HttpSource(f"{address}/data.bin")
        assert source.size == len(DATA) and source.read_at(200_000, 10) == DATA[200_000:200_010]
        source.close()
        with pytest.raises(BudgetError, match="sends more than the budget of 100,000"):
            HttpSource(f"{address}/data.bin", limit=100_000)


def breaking_off(every: int, ranges: bool = True) -> type[RecordingHandler]:
    """Return a handler whose connections end after `every` bytes of a body."""

    class BreakingOff(RecordingHandler):
        def send(self, file: IO[bytes], count: int) -> None:
            super().send(file, min(count, every))
            self.close_connection = True

        def do_GET(self) -> None:
            if not ranges:
                del self.headers["Range"]
            super().do_GET()

    return BreakingOff


def test_a_broken_connection_is_resumed_behind_the_last_byte(folder: Path) -> None:
    messages: list[str | None] = []
    with serving(folder, handler=breaking_off(30_000)) as address:
        source = HttpSource(f"{address}/data.bin", report=messages.append)
        assert source.read_at(100_000, 100_000) == DATA[100_000:200_000]
        assert RecordingHandler.ranges[1:] == [f"bytes={start}-199999" for start in range(100_000, 200_000, 30_000)]
        failures = [text for text in messages if text and ("breaks off" in text or "fails" in text)]
        assert messages.count(None) == 3 == len(failures)
        source.close()


def test_without_ranges_a_download_restarts_and_gives_up_when_nothing_new_arrives(folder: Path) -> None:
    class Recovering(breaking_off(90_000, ranges=False)):  # type: ignore[misc]
        def send(self, file: IO[bytes], count: int) -> None:
            if len(self.ranges) > 2:
                Handler.send(self, file, count)
            else:
                super().send(file, count)

    with serving(folder, handler=Recovering) as address:
        source = HttpSource(f"{address}/data.bin", report=lambda message: None)
        assert source.read_at(390_000, 10_000) == DATA[390_000:] and len(RecordingHandler.ranges) == 3
        source.close()
    with serving(folder, handler=breaking_off(90_000, ranges=False)) as address:
        source = HttpSource(f"{address}/data.bin", report=lambda message: None)
        assert source.read_at(0, 90_000) == DATA[:90_000]
        with pytest.raises(UnreachableError, match=r"breaks off|fails"):
            source.read_at(390_000, 10_000)
        source.close()


def test_requests_to_a_busy_server_are_repeated(folder: Path) -> None:
    class Busy(RecordingHandler):
        def do_GET(self) -> None:
            if len(self.ranges) in (0, 1, 3):
                self.ranges.append(None)
                self.send_error(503)
            else:
                super().do_GET()

    with serving(folder, handler=Busy) as address:
        source = HttpSource(f"{address}/data.bin", report=lambda message: None)
        assert source.read_at(100_000, 10) == DATA[100_000:100_010] and len(RecordingHandler.ranges) == 5
        source.close()


def test_an_unreachable_server_is_reported_after_a_few_attempts(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(folder) as address:
        pass
    with pytest.raises(UnreachableError, match=r"/data.bin: the connection fails \(Connection refused\)"):
        HttpSource(f"{address}/data.bin")
    assert capsys.readouterr().err.count("trying again in") == http.MAX_ATTEMPTS - 1


def test_a_silent_server_times_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_client, "READ_TIMEOUT_S", 0.1)
    release = threading.Event()

    class Silent(RecordingHandler):
        def send(self, file: IO[bytes], count: int) -> None:
            super().send(file, min(count, max(1000 - file.tell(), 0)))
            release.wait(5)

    with serving(folder, handler=Silent) as address:
        source = HttpSource(f"{address}/data.bin", attempts=2, report=lambda message: None)
        assert source.read_at(0, 1000) == DATA[:1000]
        with pytest.raises(UnreachableError, match="in time"):
            source.read_at(0, 5000)
        release.set()
        source.close()


def test_a_very_slow_response_is_given_up(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "GRACE_S", 0.3)
    monkeypatch.setattr(http, "MIN_BYTES_PER_S", 1e6)
    with serving(folder, link=Link(rate=50_000)) as address:
        source = HttpSource(f"{address}/data.bin", attempts=2, report=lambda message: None)
        with pytest.raises(UnreachableError, match="too slow"):
            source.read_at(0, 60_000)
        source.close()


def header_changed(name: str, change: Callable[[str, int], str | None]) -> type[RecordingHandler]:
    """Return a handler with one header changed; `change` gets its value and the number of earlier requests."""

    class Changed(RecordingHandler):
        def send_header(self, key: str, value: str) -> None:
            value = change(value, len(self.ranges) - 1) if key == name else value
            if value is not None:
                super().send_header(key, value)

    return Changed


@pytest.mark.parametrize(
    ("handler", "words"),
    [
        (
            header_changed("Content-Range", lambda value, n: value if n == 0 else value.replace("/4", "/5")),
            "changed on the server",
        ),
        (
            header_changed("Content-Range", lambda value, n: value if n == 0 else "bytes 0-9/400000"),
            "not the bytes from 100000 on",
        ),
        (header_changed("Content-Range", lambda value, n: value if n == 0 else None), "does not say which bytes"),
        (
            header_changed("Content-Range", lambda value, n: value if n == 0 else "bytes 100000-99/400000"),
            "sends 'bytes 100000-99",
        ),
    ],
    ids=["size", "other bytes", "missing", "malformed"],
)
def test_an_inconsistent_response_is_refused(folder: Path, handler: type[RecordingHandler], words: str) -> None:
    with serving(folder, handler=handler) as address:
        source = HttpSource(f"{address}/data.bin")
        assert source.read_at(0, 1000) == DATA[:1000]
        with pytest.raises(NetworkError, match=words):
            source.read_at(100_000, 10)
        source.close()


@pytest.mark.parametrize("new", [DATA[::-1], DATA[:90_000]], ids=["other content", "shorter"])
def test_a_file_that_changes_while_it_is_read_is_detected(url: str, folder: Path, new: bytes) -> None:
    source = HttpSource(url)
    (folder / "data.bin").write_bytes(new)
    with pytest.raises(NetworkError, match="changed on the server while it was read"):
        source.read_at(100_000, 10)
    source.close()


def test_a_response_shorter_than_requested_is_completed(folder: Path) -> None:
    class ShortResponses(RecordingHandler):
        def do_GET(self) -> None:
            first, last = self.headers["Range"].removeprefix("bytes=").split("-")
            self.headers.replace_header("Range", f"bytes={first}-{min(int(last), int(first) + 9999)}")
            super().do_GET()

    with serving(folder, handler=ShortResponses) as address:
        source = HttpSource(f"{address}/data.bin", attempts=1)
        assert source.read_at(0, 50_000) == DATA[:50_000] and source.read_at(395_000, 5000) == DATA[-5000:]
        source.close()


def encoding(name: str) -> type[RecordingHandler]:
    """Return a handler that says that what it sends is encoded."""

    class Encoding(RecordingHandler):
        def send_header(self, key: str, value: str) -> None:
            super().send_header(key, value)
            if key == "ETag":
                super().send_header("Content-Encoding", name)

    return Encoding


def test_a_compressed_response_is_refused(folder: Path) -> None:
    with (
        serving(folder, handler=encoding("gzip")) as address,
        pytest.raises(NetworkError, match=r"compressed \(gzip\)"),
    ):
        HttpSource(f"{address}/data.bin")


@pytest.mark.parametrize("name", ["", "Identity"])
def test_a_response_that_says_that_it_is_not_compressed(folder: Path, name: str) -> None:
    with serving(folder, handler=encoding(name)) as address:
        source = HttpSource(f"{address}/data.bin")
        assert source.read_at(0, 9) == DATA[:9]
        source.close()


def redirecting(target: Callable[[str], str]) -> type[RecordingHandler]:
    class Redirecting(RecordingHandler):
        def do_GET(self) -> None:
            if self.path.startswith("/to/"):
                self.ranges.append(None)
                self.send_response(302)
                self.send_header("Location", target(self.path))
                self.send_header("Content-Length", "0")
                self.end_headers()
            else:
                super().do_GET()

    return Redirecting


def test_redirections_are_followed_up_to_a_limit(folder: Path) -> None:
    with serving(folder, handler=redirecting(lambda path: path.removeprefix("/to"))) as address:
        source = HttpSource(f"{address}/to/to/data.bin")
        assert source.read_at(100_000, 10) == DATA[100_000:100_010] and len(RecordingHandler.ranges) == 4
        source.close()
    with (
        serving(folder, handler=redirecting(lambda path: path)) as address,
        pytest.raises(NetworkError, match="more than 5 redir"),
    ):
        HttpSource(f"{address}/to/data.bin")
    for target in ("file:///etc/passwd", "http://[", "https://", "ftp://127.0.0.1/data.bin"):
        with (
            serving(folder, handler=redirecting(lambda path, target=target: target)) as address,
            pytest.raises(NetworkError, match="no http or https address"),
        ):
            HttpSource(f"{address}/to/data.bin")


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("http://", "no http or https"),
        ("http://[::1", "not a valid address"),
        ("http://a:b/c?d", "^http://a:b/c: not a valid address"),
        ("http://a b/c", "connection|address"),
    ],
)
def test_malformed_addresses_are_refused(address: str, words: str) -> None:
    with pytest.raises(NetworkError, match=words):
        HttpSource(address, attempts=1)


def test_secrets_in_an_address_are_not_printed(url: str) -> None:
    with pytest.raises(NetworkError) as error:
        HttpSource(url.replace("http://", "http://me:password@").replace("data.bin", "nothing.bin?key=token"))
    assert "nothing.bin" in str(error.value) and not any(
        word in str(error.value) for word in ("password", "token", "me:")
    )


def test_control_characters_from_a_server_are_replaced(folder: Path) -> None:
    class Rude(RecordingHandler):
        def do_GET(self) -> None:
            self.wfile.write(b"HTTP/1.1 404 \x1b[31mgone\r\nContent-Length: 0\r\n\r\n")

    with serving(folder, handler=Rude) as address, pytest.raises(NetworkError, match=r"404 \?\[31mgone"):
        HttpSource(f"{address}/data.bin")


def test_an_interrupted_read_continues_later_where_it_stopped(folder: Path) -> None:
    with serving(folder, link=Link(rate=200_000), handler=RecordingHandler) as address:
        source = HttpSource(f"{address}/data.bin")
        source.interrupt()
        with pytest.raises(InterruptedRead):
            source.read_at(100_000, 100_000)
        assert source.read_at(300_000, 10) == DATA[300_000:300_010]
        assert source.read_at(100_000, 100_000) == DATA[100_000:200_000]
        first, again = (
            int(RecordingHandler.ranges[1][6:].split("-")[0]),
            int(RecordingHandler.ranges[3][6:].split("-")[0]),
        )  # type: ignore[index]
        assert first == 100_000 < again < 200_000 and len(RecordingHandler.ranges) == 4
        source.close()


def test_closing_ends_the_read_of_another_thread(folder: Path) -> None:
    with serving(folder, link=Link(rate=20_000)) as address:
        source, errors = HttpSource(f"{address}/data.bin"), []

        def read() -> None:
            try:
                source.read_at(0, 60_000)
            except NetworkError as error:
                errors.append(error)

        thread = threading.Thread(target=read)
        thread.start()
        source.close()
        thread.join(1.5)
        assert not thread.is_alive() and "closed" in str(errors[0])


def test_urls_are_distinguished_from_paths() -> None:
    assert is_url("http://a/b.kpc") and is_url("HTTPS://a") and not is_url("a/http://b") and not is_url("scene.kpc")
    assert not is_url("ftp://a/b")


@pytest.fixture
def scene_url(folder: Path) -> Iterator[str]:
    scene = tiny_scene(4)
    write(
        quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]),
        folder / "scene.kpc",
        segment_rows=2,
    )
    (folder / "cut.kpc").write_bytes((folder / "scene.kpc").read_bytes()[:-1])
    with serving(folder, handler=RecordingHandler) as address:
        yield f"{address}/scene.kpc"


def test_a_scene_from_a_url_equals_the_one_in_the_file(scene_url: str, folder: Path) -> None:
    local, remote = kpc.load(folder / "scene.kpc"), kpc.load(scene_url)
    for a, b in zip(local.scales, remote.scales, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a)
    with pytest.raises(FormatError, match="cut off"):
        kpc.load(scene_url.replace("scene", "cut"))
    with pytest.raises(FormatError, match=r"not a \.kpc file"):
        kpc.load(scene_url.replace("scene.kpc", "data.bin"))


def test_header_and_index_take_one_request(scene_url: str) -> None:
    reader = SceneReader(scene_url)
    assert RecordingHandler.ranges == [f"bytes=0-{FIRST_BYTES - 1}"] and len(reader.index) > 10
    assert isinstance(reader.source, HttpSource)
    reader.source.close()


def test_kpinfo_and_kprender_read_urls(scene_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from kpc.tools.cli import kpinfo, kprender

    assert kpinfo.main([scene_url, "--verify"]) == 0
    assert scene_url in capsys.readouterr().out
    out = tmp_path / "still.png"
    small = ["--backend", "reference", "--time", "0", "--size", "16x12", "-o", str(out)]
    assert kprender.main([scene_url, *small]) == 0 and out.is_file()
    assert kprender.main([scene_url.replace("scene", "nothing"), "-o", str(out)]) == 1
    *_, message = capsys.readouterr().err.splitlines()
    assert message.startswith("kprender: http://127.0.0.1") and "404" in message
