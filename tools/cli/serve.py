"""serve: a small web server with byte ranges, to try streaming with; as slow as you like.

python -m kpc.tools.cli.serve FOLDER
python -m kpc.tools.cli.serve FOLDER --port 9000 --rate 10Mbit --delay 40ms

It serves one folder to this machine alone, and is no server for the world: any static host is better at that.
"""

import argparse
import email.utils
import http.server
import os
import re
import sys
import threading
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import IO, ClassVar

from kpc.format.common import cli
from kpc.format.common.errors import UsageError

PIECE_BYTES = 4096
"""Sent at a time where the rate is limited."""


class Link:
    """A connection to the world that all requests share: so many bytes a second, each answer so much later.

    Attributes:
        rate: bytes a second; infinity does not wait. delay_s: before every answer.
    """

    def __init__(self, rate: float = float("inf"), delay_s: float = 0.0) -> None:
        self.rate, self.delay_s = rate, delay_s
        self._free, self._lock = 0.0, threading.Lock()

    def wait(self, count: int) -> None:
        """Until so many more bytes are through."""
        with self._lock:
            self._free = max(self._free, clock.monotonic()) + count / self.rate
            until = self._free
        clock.sleep(max(until - clock.monotonic(), 0.0))


class Handler(http.server.SimpleHTTPRequestHandler):
    """Python's own, and byte ranges: one a request, and If-Range."""

    protocol_version = "HTTP/1.1"
    link: ClassVar[Link] = Link()
    timeout = 60
    disable_nagle_algorithm = True  # else a short body waits for the answer to its header

    def __init__(self, *args: object, link: Link | None = None, **kwargs: object) -> None:
        self.shared = link or self.link
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        clock.sleep(self.shared.delay_s)
        path = Path(self.translate_path(self.path))
        if path.is_dir():
            super().do_GET()
            return
        try:
            with open(path, "rb") as file:
                self.answer(file, os.fstat(file.fileno()))
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)

    def answer(self, file: IO[bytes], stat: os.stat_result) -> None:
        """The file, or the range of it that is asked for."""
        size, etag = stat.st_size, self.etag(stat)
        wanted = re.fullmatch(r"bytes=(\d{1,18})-(\d{0,18})", self.headers.get("Range", ""))
        if wanted is not None and self.headers.get("If-Range", etag) == etag:
            first, last = int(wanted[1]), min(int(wanted[2] or size - 1), size - 1)
            if first > last:
                self.send_response(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                self.send_header("Content-Range", f"bytes */{size}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(HTTPStatus.PARTIAL_CONTENT)
            self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
        else:
            first, last = 0, size - 1
            self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Content-Length", str(last + 1 - first))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("ETag", etag)
        self.send_header("Last-Modified", email.utils.formatdate(stat.st_mtime, usegmt=True))
        self.end_headers()
        file.seek(first)
        self.send(file, last + 1 - first)

    def etag(self, stat: os.stat_result) -> str:
        return f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'

    def send(self, file: IO[bytes], count: int) -> None:
        """The body, no faster than the line."""
        most = PIECE_BYTES if self.shared.rate < float("inf") else 1 << 20
        while count and (piece := file.read(min(most, count))):
            self.shared.wait(len(piece))
            try:
                self.wfile.write(piece)
            except OSError:  # the reader has gone
                self.close_connection = True
                return
            count -= len(piece)

    def end_headers(self) -> None:
        self.send_header("Access-Control-Allow-Origin", "*")  # so that players in a browser may read it
        self.send_header("Access-Control-Expose-Headers", "Content-Range, ETag, Accept-Ranges")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: a player asks often."""


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """A reader that hangs up is nothing to talk about."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


@contextmanager
def serving(
    folder: Path, *, port: int = 0, link: Link | None = None, handler: type[Handler] = Handler
) -> Iterator[str]:
    """Serve a folder to this machine while the context lasts; gives the URL of the folder, without a slash at its end."""
    server = _Server(("127.0.0.1", port), partial(handler, directory=str(folder), link=link))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "serve", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser("serve", description="Serve a folder to this machine by HTTP, with byte ranges.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--port", type=int, default=8000, help="default: %(default)s")
    parser.add_argument(
        "--rate", type=_rate, default=float("inf"), metavar="10Mbit", help="bits a second, all requests together"
    )
    parser.add_argument("--delay", type=_delay, default=0.0, metavar="40ms", help="before every answer")
    options = parser.parse_args(argv)
    if not options.folder.is_dir():
        raise UsageError(f"{options.folder}: no such folder")
    if not 0 <= options.port < 65536:
        raise UsageError(f"--port {options.port} is none")
    with serving(options.folder, port=options.port, link=Link(options.rate, options.delay)) as url:
        for path in sorted(options.folder.glob("*.kpc")):
            print(f"{url}/{path.name}", flush=True)
        print(f"serve: {options.folder} at {url}; Ctrl-C ends it", file=sys.stderr)
        threading.Event().wait()


def _rate(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kKM]?)bit", text)
    if match is None or float(match[1]) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no rate; write 10Mbit")
    return float(match[1]) * {"": 1, "k": 1e3, "K": 1e3, "M": 1e6}[match[2]] / 8


def _delay(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)ms", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no delay; write 40ms")
    return float(match[1]) / 1e3


if __name__ == "__main__":
    sys.exit(main())
