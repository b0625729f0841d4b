"""HttpSource against servers that answer range requests in ways of their own."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, ClassVar

import numpy as np
import pytest

import kpc
from kpc.format.common.errors import FormatError, NetworkError, UnreachableError
from kpc.format.container import http, http_client
from kpc.format.container.http import FIRST_BYTES, HttpSource
from kpc.format.container.scene_io import SceneReader
from kpc.player.sharing.file_server import Handler, serving

DATA = np.random.default_rng(0).integers(0, 256, 200_000, np.uint8).tobytes()


class Wilful(Handler):
    """Answers requests for bytes `first` to `last` as a subclass has it.

    Attributes:
        requests: the Range headers of all requests; "" where there was none.
    """

    requests: ClassVar[list[str]]

    def __init_subclass__(cls) -> None:
        cls.requests = []

    def answer(self, file: IO[bytes], stat: os.stat_result) -> None:
        wanted = self.headers.get("Range", "")
        self.requests.append(wanted)
        first, _, last = wanted.removeprefix("bytes=").partition("-")
        self.respond(file.read(), int(first or 0), int(last) if last else None)

    def respond(self, data: bytes, first: int, last: int | None) -> None:
        """Answer a request; `last` is None if it asks for all from `first` on."""
        raise NotImplementedError

    def reply(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(http_client, "READ_TIMEOUT_S", 5.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "long.bin").write_bytes(DATA)
    (tmp_path / "short.bin").write_bytes(DATA[:100])
    (tmp_path / "empty.bin").write_bytes(b"")
    return tmp_path


def strict(content_range: str | None) -> type[Wilful]:
    """Return a handler that refuses ranges that go beyond the end of the file, as some servers do."""

    class Strict(Wilful):
        def respond(self, data: bytes, first: int, last: int | None) -> None:
            if not self.requests[-1]:
                self.reply(200, data)
            elif last is None or last >= len(data):
                said = {} if content_range is None else {"Content_Range": content_range.format(len(data))}
                self.reply(416, **said)
            else:
                self.reply(206, data[first : last + 1], Content_Range=f"bytes {first}-{last}/{len(data)}")

    return Strict


@pytest.mark.parametrize(
    ("content_range", "requests"),
    [
        ("bytes */{}", [f"bytes=0-{FIRST_BYTES - 1}", "bytes=0-99"]),
        ("bytes */*", [f"bytes=0-{FIRST_BYTES - 1}", ""]),
        (None, [f"bytes=0-{FIRST_BYTES - 1}", ""]),
    ],
    ids=["size", "star", "none"],
)
def test_a_small_file_of_a_server_that_refuses_more_than_there_is(
    folder: Path, content_range: str | None, requests: list[str]
) -> None:
    handler = strict(content_range)
    with serving(folder, handler=handler) as address:
        source = HttpSource(f"{address}/short.bin")
        assert source.size == 100 and source.read_at(90, 100) == DATA[90:100]
        assert handler.requests == requests
        source.close()
        with pytest.raises(NetworkError, match="is empty"):
            HttpSource(f"{address}/empty.bin")


def test_a_server_that_refuses_every_range_and_the_whole_file_is_named(folder: Path) -> None:
    class Refusing(Wilful):
        def respond(self, data: bytes, first: int, last: int | None) -> None:
            self.reply(416, Content_Range=f"bytes */{len(data)}")

    with serving(folder, handler=Refusing) as address, pytest.raises(NetworkError, match="answers 416"):
        HttpSource(f"{address}/short.bin")
    assert len(Refusing.requests) == 3


def saying(words: Callable[[int, int, int], str], before: int = 0) -> type[Wilful]:
    """Return a handler whose responses begin up to `before` bytes early and whose Content-Range is
    `words(first, last, size)`, where `last` may be beyond the end.
    """

    class Saying(Wilful):
        def respond(self, data: bytes, first: int, last: int | None) -> None:
            first, last = max(first - before, 0), len(data) - 1 if last is None else last
            self.reply(206, data[first : last + 1], Content_Range=words(first, last, len(data)))

    return Saying


UNDERSTOOD = {
    "unknown size": saying(lambda first, last, size: f"bytes {first}-{min(last, size - 1)}/*"),
    "beyond the end": saying(lambda first, last, size: f"bytes {first}-{last}/{size}"),
    "both": saying(lambda first, last, size: f"bytes {first}-{min(last, size - 1)}/*", before=300),
    "begins early": saying(lambda first, last, size: f"bytes {first}-{min(last, size - 1)}/{size}", before=5000),
    "other spelling": saying(lambda first, last, size: f"Bytes={first}-{min(last, size - 1)}/{size}"),
}


@pytest.mark.parametrize("name", UNDERSTOOD)
def test_content_ranges_that_are_understood(folder: Path, name: str) -> None:
    with serving(folder, handler=UNDERSTOOD[name]) as address:
        source = HttpSource(f"{address}/long.bin", attempts=1)
        assert source.size == len(DATA) and source.has_ranges
        assert source.read_at(150_000, 1000) == DATA[150_000:151_000]
        assert source.read_at(len(DATA) - 10, 100) == DATA[-10:] and source.read_at(60_000, 10) == DATA[60_000:60_010]
        source.close()
        source = HttpSource(f"{address}/short.bin", attempts=1)
        assert source.size == 100 and source.read_at(50, 100) == DATA[50:100]
        source.close()


def test_a_range_larger_than_requested_is_clipped(folder: Path) -> None:
    class Generous(Wilful):
        def respond(self, data: bytes, first: int, last: int | None) -> None:
            first, last = first // 4096 * 4096, min(first + 70_000, len(data) - 1)
            self.reply(206, data[first : last + 1], Content_Range=f"bytes {first}-{last}/{len(data)}")

    with serving(folder, handler=Generous) as address:
        source = HttpSource(f"{address}/long.bin", attempts=1)
        for start in (100_001, 50_000, 199_000):
            assert source.read_at(start, 500) == DATA[start : start + 500]
        source.close()


REFUSED = {
    "size below the body": (saying(lambda first, last, size: f"bytes {first}-{last}/50"), "sends 'bytes 0-65535/50'"),
    "no size at all": (saying(lambda first, last, size: f"bytes 5-{last}/*"), "not say how long"),
    "no numbers": (saying(lambda first, last, size: "bytes first-last/all"), "not say which bytes"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_content_ranges_that_are_refused_by_name(folder: Path, name: str) -> None:
    handler, words = REFUSED[name]
    with serving(folder, handler=handler) as address, pytest.raises(NetworkError, match=words):
        HttpSource(f"{address}/long.bin", attempts=1)


def test_a_whole_file_in_answer_to_a_later_range_is_read_over_or_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OnceOnly(Wilful):
        def respond(self, data: bytes, first: int, last: int | None) -> None:
            if len(self.requests) == 1 and last is not None:
                self.reply(206, data[first : last + 1], Content_Range=f"bytes {first}-{last}/{len(data)}")
            else:
                self.reply(200, data)

    with serving(folder, handler=OnceOnly) as address:
        source = HttpSource(f"{address}/long.bin", attempts=1)
        assert source.read_at(150_000, 1000) == DATA[150_000:151_000]
        monkeypatch.setattr(http, "MAX_SKIPPED_BYTES", 1000)
        with pytest.raises(UnreachableError, match="much more of the file than was requested"):
            source.read_at(190_000, 10)
        source.close()


def nodes(**headers: Callable[[int], str | None]) -> type[Wilful]:
    """Return a handler of a server with several nodes: each header is a function of the number of the request."""

    class Nodes(Wilful):
        def respond(self, data: bytes, first: int, last: int | None) -> None:
            number = len(self.requests) - 1
            values = {name: value(number) for name, value in headers.items()}
            said = {name: value for name, value in values.items() if value is not None}
            wanted = self.headers.get("If-Range")
            if self.honours_if_range and wanted is not None and wanted not in said.values():
                self.reply(200, data, **said)
                return
            last = min(len(data) - 1 if last is None else last, len(data) - 1)
            self.reply(206, data[first : last + 1], Content_Range=f"bytes {first}-{last}/{len(data)}", **said)

        honours_if_range: ClassVar[bool] = True

    return Nodes


DATES = "Fri, 13 Nov 2026 10:00:00 GMT", "Sat, 14 Nov 2026 10:00:00 GMT"
NODES = {
    "ETag": nodes(ETag=lambda number: f'"node-{number}"'),
    "weak ETag": nodes(ETag=lambda number: f'W/"{number}"'),
    "weak ETag and date": nodes(ETag=lambda number: f'W/"{number}"', Last_Modified=lambda number: DATES[number % 2]),
    "ETag of one node only": nodes(ETag=lambda number: '"one"' if number % 2 == 0 else None),
    "Last-Modified": nodes(Last_Modified=lambda number: DATES[number % 2]),
}


@pytest.mark.parametrize("honours_if_range", [False, True], ids=["206", "200"])
@pytest.mark.parametrize("name", NODES)
def test_nodes_with_names_of_their_own_for_a_file_do_not_stop_it(
    folder: Path, name: str, honours_if_range: bool
) -> None:
    handler = type("Fresh", (NODES[name],), {"honours_if_range": honours_if_range})
    with serving(folder, handler=handler) as address:
        source = HttpSource(f"{address}/long.bin", attempts=1)
        for start in (150_000, 100_000, 199_000):
            assert source.read_at(start, 500) == DATA[start : start + 500]
        assert len(handler.requests) <= 7  # the ETag is looked into once
        source.close()


@pytest.fixture
def scene(folder: Path) -> Iterator[Path]:
    from kpc.encoder.coding.scene_writer import write
    from kpc.format.coding.quantise import quantise_scene
    from scenes import tiny_scene

    for seed, name in enumerate(("scene", "other")):
        made = tiny_scene(4)
        made.scales[0]["xy"][:] += seed
        write(quantise_scene(made, [dict.fromkeys(s, 0.01) for s in made.scales]), folder / f"{name}.kpc")
    yield folder / "scene.kpc"


def test_a_replaced_file_is_noticed_whatever_the_nodes_say(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "FIRST_BYTES", 600)  # so that most chunks are not there on opening
    handler = type("Fresh", (NODES["ETag"],), {"honours_if_range": False})
    other = scene.with_name("other.kpc").read_bytes()
    with serving(scene.parent, handler=handler) as address:
        reader = SceneReader(f"{address}/scene.kpc", in_parts=True)
        reader.stored(len(reader.index) - 2)  # From now on the source trusts the size and the checksums alone.
        size = scene.stat().st_size
        scene.write_bytes((other + bytes(size))[:size])
        with pytest.raises(FormatError, match=r"damaged .* may have been replaced on the server"):
            for number in range(len(reader.index)):
                reader.stored(number)
        scene.write_bytes(other + b"longer")
        with pytest.raises(NetworkError, match="changed on the server"):
            reader.source.read_at(reader.source.size - 50, 50)
        reader.source.close()


def test_a_scene_is_read_alike_from_servers_of_all_kinds(scene: Path) -> None:
    local = kpc.load(scene)
    handlers = [strict("bytes */{}"), *UNDERSTOOD.values(), *NODES.values()]
    for handler in handlers:
        with serving(scene.parent, handler=handler) as address:
            remote = kpc.load(f"{address}/scene.kpc")
        for a, b in zip(local.scales, remote.scales, strict=True):
            assert all(np.array_equal(a[name], b[name]) for name in a)
