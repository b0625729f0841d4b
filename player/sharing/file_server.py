"""A small web server with byte ranges that serves a folder to this machine."""

import email.utils
import http.server
import os
import re
import sys
import threading
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import IO, ClassVar

from kpc.format.common.errors import UsageError

# Bytes sent at a time: few where the rate is limited, so that it is even.
LIMITED_PIECE_BYTES, PIECE_BYTES = 4096, 1 << 20


class Link:
    """A network link of limited rate that all requests share.

    Attributes:
        rate: bytes per second; infinity does not wait.
        delay_s: seconds before every response.
    """

    def __init__(self, rate: float = float("inf"), delay_s: float = 0.0) -> None:
        self.rate, self.delay_s = rate, delay_s
        self._free, self._lock = 0.0, threading.Lock()

    def wait(self, count: int) -> None:
        """Wait until `count` more bytes have passed."""
        with self._lock:
            self._free = max(self._free, clock.monotonic()) + count / self.rate
            until = self._free
        clock.sleep(max(until - clock.monotonic(), 0.0))


class Handler(http.server.SimpleHTTPRequestHandler):
    """Python's file handler with byte ranges: one range per request, and If-Range.

    Attributes:
        link: what responses pass through.
        is_shared: whether pages of other servers may read the files.
    """

    protocol_version = "HTTP/1.1"
    is_shared = True
    link: ClassVar[Link] = Link()
    timeout = 60
    disable_nagle_algorithm = True  # otherwise a short body waits until its header is acknowledged

    def __init__(self, *args: object, link: Link | None = None, **kwargs: object) -> None:
        self.shared = link or self.link
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        """Answer a request after the delay of the link."""
        self.answer_request(super().do_GET)

    def do_HEAD(self) -> None:
        """Answer with the headers of the whole file alone."""
        self.answer_request(super().do_HEAD)

    def answer_request(self, answer_folder: Callable[[], None]) -> None:
        """Answer with what the path of the request names, or that there is no such file.

        Args:
            answer_folder: answers a request of a folder.
        """
        clock.sleep(self.shared.delay_s)
        try:
            path = Path(self.translate_path(self.path))
            if path.is_dir():
                answer_folder()
                return
            if not path.is_file():
                raise FileNotFoundError
            file = open(path, "rb")
        except (OSError, ValueError):  # ValueError: names that no file has, such as those with null bytes
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with file:
            self.answer(file, os.fstat(file.fileno()))

    def answer(self, file: IO[bytes], stat: os.stat_result) -> None:
        """Send a file, or the requested range of it; of a request by HEAD the headers alone."""
        size, etag = stat.st_size, self.etag(stat)
        wanted = re.fullmatch(r"bytes=(\d{1,18})-(\d{0,18})", self.headers.get("Range", ""))
        is_head = self.command == "HEAD"  # to which ranges do not apply
        if not is_head and wanted is not None and self.headers.get("If-Range", etag) == etag:
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
        self.send_header("Content-Type", self.guess_type(self.path.partition("?")[0]))
        self.send_header("Content-Length", str(last + 1 - first))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("ETag", etag)
        self.send_header("Last-Modified", email.utils.formatdate(stat.st_mtime, usegmt=True))
        self.end_headers()
        if is_head:
            return
        file.seek(first)
        self.send(file, last + 1 - first)

    def etag(self, stat: os.stat_result) -> str:
        """Return a tag that changes with the file."""
        return f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'

    def send(self, file: IO[bytes], count: int) -> None:
        """Send `count` bytes, no faster than the link."""
        most = LIMITED_PIECE_BYTES if self.shared.rate < float("inf") else PIECE_BYTES
        while count and (piece := file.read(min(most, count))):
            self.shared.wait(len(piece))
            try:
                self.wfile.write(piece)
            except OSError:  # the client has disconnected
                self.close_connection = True
                return
            count -= len(piece)

    def end_headers(self) -> None:
        """Send the headers that let players in a browser read the file, and end the headers."""
        if self.is_shared:
            self.send_header("Access-Control-Allow-Origin", "*")
            self.send_header("Access-Control-Expose-Headers", "Content-Range, ETag, Accept-Ranges")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, since a player sends many requests."""


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Report nothing if a client has disconnected."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


@contextmanager
def serving(
    folder: Path, *, port: int = 0, link: Link | None = None, handler: type[Handler] = Handler
) -> Iterator[str]:
    """Serve a folder to this machine while the context lasts.

    Args:
        folder: to serve.
        port: to serve it at; 0 for any that is free.
        link: that all requests share; None for that of the handler.
        handler: answers requests.

    Yields:
        The URL of the folder, without a slash at its end.

    Raises:
        UsageError: the given port is in use, or may not be used.
    """
    try:
        server = _Server(("127.0.0.1", port), partial(handler, directory=str(folder), link=link))
    except OSError as error:
        if not port:
            raise
        raise UsageError(f"--port {port}: {error.strerror}; choose another port, or 0 for any that is free") from error
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
