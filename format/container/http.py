"""A file on a web server as a `Source`, read by HTTP range requests (RFC 9110, section 14). Any static host will do.

    opening               GET, Range: bytes=0-65535    gives the size, and header and index of all but very long files
    read_at, will_read    GET, Range: bytes=a-b        with If-Range, so that a file that changes meanwhile is noticed

Responses are read as they arrive: `read_at` waits for the bytes it needs, not for all that were requested. A connection
that breaks off is resumed behind the last byte received, after a pause that doubles each time; only then does an error
reach the caller. A server without range requests sends the whole file, which is kept in memory as far as it has come.

urllib3 does what lies below: connection reuse, TLS, proxies and time-outs.
"""

import contextlib
import copy
import random
import threading
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field

import urllib3

from kpc.format.common.errors import BudgetError, InterruptedRead, NetworkError, UnreachableError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.common.text import notice
from kpc.format.container.beginning import BEGINNING_BYTES
from kpc.format.container.http_address import printable
from kpc.format.container.http_client import HttpClient, TemporaryFailure, describe_failure
from kpc.format.container.http_headers import length_of, range_of, retry_after, validator_of

# Requested on opening: enough for header and index of 1600 chunks, or for the first coarse picture of a short clip.
FIRST_BYTES = 1 << 16

# The most bytes read from a connection at once.
PIECE_BYTES = 1 << 16

# Bytes of a long response that are kept behind the current position.
KEPT_BYTES = 1 << 26

# The most bytes before the ones requested that a response may begin with.
MAX_SKIPPED_BYTES = 1 << 22

# Requests that may fail in a row without a single new byte.
MAX_ATTEMPTS = 5

# Pause before the second request, and the longest pause between later ones, in seconds. Each is multiplied by a random
# factor in [1/2, 3/2], so that the players that a server lost do not all come back at once.
FIRST_PAUSE_S, MAX_PAUSE_S = 0.25, 8.0

# A response that takes longer than GRACE_S plus its bytes at MIN_BYTES_PER_S counts as broken off.
GRACE_S, MIN_BYTES_PER_S = 30.0, 1000.0

# Responses after which a request is repeated: time-outs, overload and temporary failures of servers and gateways.
TEMPORARY_STATUS = {408, 425, 429, 500, 502, 503, 504}


def report_on_stderr(message: str | None) -> None:
    """Print the state of a connection for the user of a command; None means that it works again."""
    if message is not None:
        notice(message)


@dataclass
class _Download:
    """A range of the file that is being downloaded, over as many requests as it takes.

    Attributes:
        start, stop: the range, in bytes of the file.
        data: what has been received so far, from `start` on.
        response: the open response that continues `data`; None if there is none.
        response_stop: the end of what `response` sends.
        waited_s, received_bytes: time spent waiting for `response`, and what it has sent.
    """

    start: int
    stop: int
    data: bytearray = field(default_factory=bytearray)
    response: urllib3.BaseHTTPResponse | None = None
    response_stop: int = 0
    waited_s: float = 0.0
    received_bytes: int = 0

    @property
    def reached(self) -> int:
        """The first byte of the file that has not been received."""
        return self.start + len(self.data)

    def holds(self, offset: int) -> bool:
        """Return whether `offset` has been received or is the next byte to come."""
        return self.start <= offset <= self.reached

    def discard(self, offset: int) -> None:
        """Discard what lies before `offset`."""
        del self.data[: offset - self.start]
        self.start = offset

    def check_rate(self) -> None:
        """Give up a response that comes too slowly."""
        if self.waited_s > GRACE_S + self.received_bytes / MIN_BYTES_PER_S:
            raise TemporaryFailure("the connection is too slow", is_slow=True)

    def close_response(self) -> None:
        """Close the open response, if there is one."""
        if self.response is not None:
            self.response.close()
            self.response = None


class HttpSource:
    """A file on a web server; see the module. One thread at a time may read, any may `close` or `interrupt`.

    Args:
        url: http or https.
        limit: the most memory in bytes that the file may take if the server does not support range requests.
        attempts: requests that may fail in a row; infinity never gives up.
        report: called with one line about trouble with the connection, and with None once it works again.

    Attributes:
        name: the URL without user, password, query and fragment, which may be secret.
        size: of the file, bytes.
        has_ranges: whether the server supports range requests; else it sends whole files.
        received_bytes: bytes received so far.
        attempts, report: as above; may be changed at any time.

    Raises:
        NetworkError: there is no such file, the URL is not http or https, or the response cannot be used.
        UnreachableError: there is no response at all.
        BudgetError: a server without range requests holds more than `limit` bytes.
    """

    def __init__(
        self,
        url: str,
        *,
        limit: int = DEFAULT_BUDGET,
        attempts: float = MAX_ATTEMPTS,
        report: Callable[[str | None], None] = report_on_stderr,
    ) -> None:
        self._client = HttpClient(url)
        self.name, self.attempts, self.received_bytes, self.has_ranges = self._client.name, attempts, 0, True
        self._limit, self.report, self._closed = limit, report, threading.Event()
        self._size: int | None = None
        self._validator: tuple[str, str] | None = None
        self._beginning = b""
        self._reading, self._retrying = threading.Lock(), False
        self._interruption = threading.Event()
        self._parked: _Download | None = None  # the last unfinished download that was left for another
        self._download = _Download(0, FIRST_BYTES)
        self._fetch(1)
        assert self._size is not None
        self.size: int = self._size
        self._fetch(min(BEGINNING_BYTES, self.size))
        self._beginning = bytes(self._download.data[:BEGINNING_BYTES])

    def read_at(self, offset: int, length: int) -> bytes:
        """Return `length` bytes from `offset`, fewer only at the end of the file; wait until they are there."""
        end = min(offset + length, self.size)
        if end <= offset:
            return b""
        self.will_read(offset, length)
        self._fetch(end)
        if self.has_ranges and offset - self._download.start > KEPT_BYTES:
            self._download.discard(offset)
        start = offset - self._download.start
        return bytes(self._download.data[start : start + end - offset])

    def will_read(self, offset: int, length: int) -> None:
        """Announce that the next reads lie within this range, in order, so that one request serves them all."""
        download, end = self._download, min(offset + length, self.size)
        if download.start <= offset and end <= download.stop:
            return
        if not download.holds(offset):
            download.close_response()
            before = self._parked
            if download.data and download.reached < download.stop:
                self._parked = download
            self._download = download = (
                before if before is not None and before.holds(offset) else _Download(offset, end)
            )
        download.discard(offset)
        download.stop = max(end, download.reached)

    def clone(self) -> "HttpSource":
        """Return a source of the same file with connections of its own, for another thread.

        It requests nothing before it is read. Without range requests it would download the whole file once more.
        """
        other = copy.copy(self)
        other._client, other._reading = self._client.clone(), threading.Lock()
        other._closed, other._interruption = threading.Event(), threading.Event()
        other._parked, other._retrying, other.received_bytes = None, False, 0
        other._download = _Download(0, 0 if self.has_ranges else self.size)
        return other

    def interrupt(self) -> None:
        """Cancel the read of another thread in favour of a more urgent one: it fails with InterruptedRead.

        The read ends after its next bytes. What has been received is kept until it is repeated.
        """
        if self.has_ranges:
            self._interruption.set()

    def discard(self) -> None:
        """Drop everything received: it came damaged and has to be requested again."""
        self._download.close_response()
        self._download, self._parked = _Download(0, 0 if self.has_ranges else self.size), None

    def close(self) -> None:
        """Close the connection. A read in progress fails with UnreachableError."""
        self._closed.set()
        if (response := self._download.response) is not None:
            with contextlib.suppress(OSError, RuntimeError, ValueError):  # The response may just have ended.
                response.shutdown()
        if self._reading.acquire(timeout=0.1):
            # Otherwise the reading thread closes the response, once bytes arrive or a time-out expires.
            self._download.close_response()
            self._reading.release()
        self._client.close()

    def _fetch(self, end: int) -> None:
        """Continue the current download until the bytes up to `end` have been received, with retries."""
        download, failures = self._download, 0
        while download.reached < min(end, download.stop):
            before = download.reached
            try:
                with self._reading:
                    if download.response is None:
                        self._open_response(download)
                    if download.response is not None:
                        self._receive(download, end)
            except TemporaryFailure as trouble:
                download.close_response()
                self._client.forget_redirection()
                failures = 1 if download.reached > before and not trouble.is_slow else failures + 1
                if self._closed.is_set():
                    raise UnreachableError(f"{self.name}: closed") from trouble
                if failures >= self.attempts:
                    raise UnreachableError(f"{self.name}: {trouble}; check the address and the connection") from trouble
                pause = min(FIRST_PAUSE_S * 2 ** min(failures - 1, 10), MAX_PAUSE_S) * random.uniform(0.5, 1.5)
                pause = max(pause, trouble.pause_s)
                self.report(f"{self.name}: {trouble}; trying again in {pause:.1f} s")
                self._retrying = True
                self._closed.wait(pause)

    def _receive(self, download: _Download, end: int) -> None:
        """Receive piece by piece, up to `end` or the end of the response."""
        while download.reached < min(end, download.response_stop):
            piece = self._read_piece(download, download.response_stop - download.reached)
            if not piece:
                raise TemporaryFailure(f"the connection breaks off at byte {download.reached} of {self._size}")
            download.data += piece
            self.received_bytes += len(piece)
            if self._retrying:
                self.report(None)
                self._retrying = False
            download.check_rate()
            if self._interruption.is_set() and download.reached < end:
                self._interruption.clear()
                raise InterruptedRead(f"{self.name}: interrupted")
        if download.reached == download.response_stop and download.response is not None:
            if self._read_piece(download, 1):
                download.response.close()
            else:
                download.response.release_conn()  # for reuse
            download.response = None

    def _read_piece(self, download: _Download, limit: int) -> bytes:
        """Return what has arrived of the response, up to `limit` bytes; wait for at least one unless it ends here."""
        assert download.response is not None
        if self._closed.is_set():
            raise TemporaryFailure("closed")
        started = clock.monotonic()
        try:
            piece: bytes = download.response.read1(min(PIECE_BYTES, limit))
        except (urllib3.exceptions.HTTPError, OSError, ValueError) as error:
            raise TemporaryFailure(describe_failure(error)) from error
        download.waited_s += clock.monotonic() - started
        download.received_bytes += len(piece)
        return piece

    def _open_response(self, download: _Download) -> None:
        """Request the missing part of a download and check the response."""
        response = self._request(download, f"bytes={download.reached}-{download.stop - 1}" if self.has_ranges else None)
        if response.status == 416 and self._size is None:
            response = self._request_less(download, response)
        if response.status == 206 and self.has_ranges:
            self._accept_range(download, response)
        elif response.status == 200:
            self._accept_whole(download, response)
        elif response.status == 416 and self._size is not None and range_of(response)[2] != self._size:
            raise self._changed(download)
        else:
            raise self._error(download, self._client.refusal(response))

    def _request(self, download: _Download, wanted: str | None) -> urllib3.BaseHTTPResponse:
        """Send a request with a Range header, or without one if `wanted` is None."""
        headers = {"Accept-Encoding": "identity", "User-Agent": "kpc"}
        if wanted is not None:
            headers["Range"] = wanted
            if self._validator is not None:
                headers["If-Range"] = self._validator[1]
        download.close_response()
        response = self._client.get(headers)
        download.response, download.waited_s, download.received_bytes = response, 0.0, 0
        if response.status in TEMPORARY_STATUS:
            raise TemporaryFailure(
                f"the server answers {response.status} {response.reason}", pause_s=retry_after(response)
            )
        encoding = response.headers.get("Content-Encoding", "").strip()
        if response.status in (200, 206) and encoding.lower() not in ("", "identity"):
            raise self._error(
                download,
                f"the server sends it compressed ({encoding[:40]}), which ranges do not allow; switch that off there",
            )
        return response

    def _request_less(self, download: _Download, refused: urllib3.BaseHTTPResponse) -> urllib3.BaseHTTPResponse:
        """Repeat the first request, since some servers refuse a range that goes beyond the end of a small file: ask for
        what there is, or for the whole file if the server does not say how much that is.
        """
        size = range_of(refused)[2]
        if size == 0:
            raise self._error(download, "is empty; upload the file again")
        if size is not None and size < download.stop:
            response = self._request(download, f"bytes=0-{size - 1}")
            if response.status != 416:
                return response
        return self._request(download, None)

    def _accept_range(self, download: _Download, response: urllib3.BaseHTTPResponse) -> None:
        """Check a 206 response, which holds the range that was requested, a first part of it, or more."""
        first, last, size = range_of(response)
        said = response.headers.get("Content-Range", "")[:60]
        if first is None or last is None:
            raise self._error(download, f"the server does not say which bytes it sends (Content-Range: {said!r})")
        if size is None and self._size is None:
            response = self._request(download, "bytes=0-")  # the last byte of which is the last of the file
            first, last, size = range_of(response)
            size = last + 1 if size is None and last is not None else size
            if response.status != 206 or first != 0 or last is None or size is None:
                raise self._error(download, f"the server does not say how long the file is (Content-Range: {said!r})")
        size = self._size if size is None else size
        assert size is not None
        if self._size not in (None, size):
            raise self._changed(download)
        if not first <= download.reached <= last or not first < size or first + (length_of(response) or 0) > size:
            raise self._error(download, f"the server sends {said!r}, not the bytes from {download.reached} on")
        if self._size is None:
            self._size, self._validator = size, validator_of(response)
            download.stop = min(download.stop, size)
        elif not self._is_same(response):
            self._compare_beginning(download)
            self._open_response(download)
            return
        self._skip(download, first)
        download.response_stop = min(last + 1, download.stop)

    def _accept_whole(self, download: _Download, response: urllib3.BaseHTTPResponse) -> None:
        """Check a 200 response, the whole file: the server has no ranges, or takes the file for another one."""
        size = length_of(response)
        if self._size is None:
            self._accept_first_whole(download, response, size)
        elif size not in (self._size, None):
            raise self._changed(download)
        elif self.has_ranges and not self._is_same(response):
            self._compare_beginning(download)
            self._open_response(download)
            return
        else:
            self._skip(download, 0)
        download.response_stop = download.stop

    def _accept_first_whole(self, download: _Download, response: urllib3.BaseHTTPResponse, size: int | None) -> None:
        """Take over a file of a server without range requests, on opening."""
        if (size or 0) > self._limit:
            download.close_response()
            raise BudgetError(
                f"{self.name}: the server does not support range requests, and the whole file of "
                f"{size:,} bytes is more than the budget of {self._limit:,} bytes; download it first"
            )
        if self.has_ranges:
            self.report(f"{self.name}: the server does not support range requests, so the whole file is downloaded")
            self.report(None)
        self.has_ranges, self._validator = False, validator_of(response)
        if size is None:
            size = self._read_to_end(download)
        if size == 0:
            raise self._error(download, "is empty; upload the file again")
        self._size = download.stop = size

    def _skip(self, download: _Download, position: int) -> None:
        """Read a response that begins at `position` up to where the download continues. What it repeats must be the
        same as before.
        """
        if self.has_ranges and download.reached - position > MAX_SKIPPED_BYTES:
            raise TemporaryFailure("the server sends much more of the file than was requested")
        while position < download.reached:
            piece = self._read_piece(download, download.reached - position)
            if not piece:
                raise TemporaryFailure(f"the connection breaks off before byte {download.reached} of {self._size}")
            begin, position = position, position + len(piece)
            held = download.data[max(begin - download.start, 0) : max(position - download.start, 0)]
            if not piece.endswith(held):
                raise self._changed(download)
            download.check_rate()

    def _compare_beginning(self, download: _Download) -> None:
        """Find out whether the file is still the one that was opened, although its ETag or date differs.

        Some servers have several nodes with different ETags for one file. If the beginning is the same, ETags and dates
        count no more, and the checksums of chunks tell whether the file is replaced.

        Raises:
            NetworkError: the file has changed.
        """
        download.close_response()
        validator, self._validator = self._validator, None
        beginning = _Download(0, len(self._beginning))
        try:
            while beginning.reached < beginning.stop:
                if beginning.response is None:
                    self._open_response(beginning)
                self._receive(beginning, beginning.stop)
            if beginning.data != self._beginning:
                raise self._changed(beginning)
        except BaseException:
            self._validator = validator
            raise
        finally:
            beginning.close_response()

    def _read_to_end(self, download: _Download) -> int:
        """Receive a whole file whose response lacks a length, and return its size; it must not exceed the limit."""
        download.data.clear()
        while piece := self._read_piece(download, PIECE_BYTES):
            download.data += piece
            download.check_rate()
            if len(download.data) > self._limit:
                download.close_response()
                raise BudgetError(
                    f"{self.name}: the server does not support range requests and sends more than the budget of "
                    f"{self._limit:,} bytes; download it first"
                )
        self.received_bytes += len(download.data)
        download.close_response()
        return len(download.data)

    def _is_same(self, response: urllib3.BaseHTTPResponse) -> bool:
        """Return whether a response is of the file that was opened, as far as the server says."""
        return (
            self._validator is None
            or response.headers.get(self._validator[0], self._validator[1]) == self._validator[1]
        )

    def _changed(self, download: _Download) -> NetworkError:
        return self._error(download, "changed on the server while it was read; open it again")

    def _error(self, download: _Download, message: str) -> NetworkError:
        download.close_response()
        return NetworkError(f"{self.name}: {printable(message)}")
