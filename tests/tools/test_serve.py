import http.client
import os
import subprocess
import sys
import time as clock
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from kpc.player.sharing.file_server import Link, serving
from kpc.tools.cli import serve

DATA = bytes(range(256)) * 40


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "served").mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    (tmp_path / "served" / "scene.kpc").write_bytes(DATA)
    return tmp_path / "served"


def get(url: str, path: str, method: str = "GET", **headers: str) -> tuple[http.client.HTTPResponse, bytes]:
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10)
    try:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        response = connection.getresponse()
        return response, response.read()
    finally:
        connection.close()


@pytest.mark.parametrize(
    ("wanted", "status", "span"),
    [
        ("bytes=0-99", 206, (0, 100)),
        ("bytes=100-", 206, (100, 10240)),
        ("bytes=10000-99999", 206, (10000, 10240)),
        ("bytes=10240-", 416, (0, 0)),
        ("bytes=5-4", 416, (0, 0)),
        ("bytes=-5", 200, (0, 10240)),
        ("bytes=0-1,3-4", 200, (0, 10240)),
        ("lines=0-1", 200, (0, 10240)),
    ],
)
def test_ranges(folder: Path, wanted: str, status: int, span: tuple[int, int]) -> None:
    with serving(folder) as url:
        response, body = get(url, "/scene.kpc", Range=wanted)
        assert response.status == status and body == DATA[slice(*span)]
        if status == 206:
            assert response.headers["Content-Range"] == f"bytes {span[0]}-{span[1] - 1}/10240"


def test_a_changed_file_is_sent_whole(folder: Path) -> None:
    with serving(folder) as url:
        response, _ = get(url, "/scene.kpc", Range="bytes=0-9")
        etag = response.headers["ETag"]
        assert get(url, "/scene.kpc", Range="bytes=0-9", If_Range=etag)[1] == DATA[:10]
        (folder / "scene.kpc").write_bytes(DATA[::-1])
        response, body = get(url, "/scene.kpc", Range="bytes=0-9", If_Range=etag)
        assert response.status == 200 and body == DATA[::-1]


def test_nothing_outside_the_folder_is_served(folder: Path) -> None:
    with serving(folder) as url:
        for path in ("/../secret", "/%2e%2e/secret", "/nothing.kpc"):
            response, body = get(url, path)
            assert response.status == 404 and b"secret" not in body.replace(b"/secret", b"")


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_names_that_no_file_has_are_not_found(folder: Path, method: str, capfd: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(folder / "pipe.kpc")
    names = ["%00", "a%00b", "a" * 5000, "%ed%b0%80", "%ff", "pipe.kpc", "%5b"]
    with serving(folder) as url:
        for path in [*(f"/{name}" for name in names), "x://[/../.."]:
            assert get(url, path, method)[0].status == 404
    assert capfd.readouterr().err == ""


def test_head_answers_as_get_without_a_body(folder: Path) -> None:
    with serving(folder) as url:
        (one, body), (other, nothing) = get(url, "/scene.kpc"), get(url, "/scene.kpc", "HEAD", Range="bytes=0-9")
    assert body == DATA and nothing == b"" and one.status == other.status == 200
    for headers in (one.headers, other.headers):
        del headers["Date"]
    assert one.headers.items() == other.headers.items() and "ETag" in other.headers


def test_a_slow_link_is_slow(folder: Path) -> None:
    with serving(folder, link=Link(rate=50_000, delay_s=0.05)) as url:
        started = clock.monotonic()
        assert get(url, "/scene.kpc")[1] == DATA
        assert 0.2 < clock.monotonic() - started


def test_the_command_prints_addresses(folder: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "kpc.tools.cli.serve",
        str(folder),
        "--port",
        "0",
        "--rate",
        "8Mbit",
        "--delay",
        "1ms",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        assert url.endswith("/scene.kpc") and get(url, "/scene.kpc")[1] == DATA
        server.terminate()


def test_a_port_in_use_is_reported(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(folder) as url:
        port = str(urlsplit(url).port)
        assert serve.main([str(folder), "--port", port]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"serve: --port {port}: ") and "choose another port" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [["nowhere"], [".", "--port", "70000"], [".", "--rate", "fast"], [".", "--delay", "1s"]]
)
def test_invalid_options_are_reported(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = serve.main(arguments)
    except SystemExit as error:
        code = error.code  # type: ignore[assignment]
    assert code == 2 and arguments[-1] in capsys.readouterr().err
