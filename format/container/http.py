"""A file on a web server as a `Source`: its bytes by HTTP range requests (RFC 9110, section 14). Any static host will do.

    opening            GET, Range: bytes=0-65535      tells the size, and brings header and index of all but very long files
    read_at, hold      GET, Range: bytes=a-b          with If-Range: a file that changes meanwhile is noticed, not mixed up

Answers are read as they come: `read_at` waits for the bytes it wants, not for all that were asked for. A connection that breaks
off is taken up again behind the last byte that came, after a pause that doubles each time; only then does an error reach the
caller. A server without ranges sends the whole file, which is kept as far as it has come.

urllib3 does what sits below: connections kept open, TLS, proxies, time-outs. It is pure Python, depends on nothing, and hands
out the bytes of an answer as they arrive.
"""

import contextlib
import copy
import random
import re
import sys
import threading
import time as clock
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import urljoin, urlsplit, urlunsplit

import urllib3
from kpc.format.common.errors import BudgetError, InterruptedRead, NetworkError, UnreachableError
from kpc.format.container.container import DEFAULT_BUDGET

SCHEMES = ("http", "https")
FIRST_BYTES = 1 << 16
"""Asked for on opening: header and index of 1600 chunks, or of a short clip all that the first coarse picture takes."""
PIECE_BYTES = 1 << 16
"""Read from a connection at most at a time."""
KEPT_BYTES = 1 << 26
"""Of what has been read of a long answer."""
REDIRECTS = 5
ATTEMPTS = 5
"""Requests that may fail in a row without a single new byte."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 8.0
"""Before the second request and between later ones, times a random factor in [1/2, 3/2], so that players that one server lost do
not all come back at once."""
CONNECT_S, SILENCE_S = 5.0, 10.0
"""Time-outs: for a connection to be made, and between two pieces of an answer."""
PATIENCE_S, LEAST_BYTES_S = 30.0, 1000.0
"""An answer that takes longer than this and its bytes at this rate counts as broken off: nobody is kept waiting for ever."""
TEMPORARY = {408, 425, 429, 500, 502, 503, 504}


def is_url(text: str) -> bool:
    """Whether `text` is a URL that `HttpSource` takes, and no path."""
    return text.partition("://")[0].lower() in SCHEMES and "://" in text


def report_on_stderr(message: str | None) -> None:
    """What becomes of a connection, for the user of a command; None: all is well again."""
    if message is not None:
        print(message, file=sys.stderr, flush=True)


@dataclass
class _Answer:
    """Bytes start to stop of the file, of which `data` is there. More comes through `response`, up to `asked`."""

    start: int
    stop: int
    data: bytearray = field(default_factory=bytearray)
    response: urllib3.BaseHTTPResponse | None = None
    asked: int = 0
    waited_s: float = 0.0
    came: int = 0

    @property
    def reached(self) -> int:
        return self.start + len(self.data)

    def holds(self, offset: int) -> bool:
        """Whether `offset` is there, or is what comes next."""
        return self.start <= offset <= self.reached

    def discard(self, offset: int) -> None:
        """What came before `offset`."""
        del self.data[: offset - self.start]
        self.start = offset

    def check_pace(self) -> None:
        if self.waited_s > PATIENCE_S + self.came / LEAST_BYTES_S:
            raise _Interrupted("the connection is too slow", is_slow=True)

    def drop_connection(self) -> None:
        if self.response is not None:
            self.response.close()
            self.response = None


class _Interrupted(Exception):
    """An answer failed in a way that may pass."""

    def __init__(self, reason: str, *, pause_s: float = 0.0, is_slow: bool = False) -> None:
        super().__init__(_plain(reason))
        self.pause_s, self.is_slow = pause_s, is_slow


class HttpSource:
    """See the module. One thread at a time may read; any may `close`.

    Args:
        url: http or https.
        limit: bytes of memory for a file whose server has no ranges.
        attempts: see ATTEMPTS; infinity never gives up.
        say: told of trouble with the connection, in one line, and with None that it is over.

    Attributes:
        name: the URL without what may be secret in it. size: of the file, bytes.
        has_ranges: False if the server sends whole files only.
        received: bytes that came so far.
        attempts, say: as above; may be changed at any time.

    Raises:
        NetworkError: no such file, no http URL, or an answer that cannot be used; UnreachableError: no answer at all.
        BudgetError: a server without ranges holds more than `limit`.
    """

    def __init__(
        self,
        url: str,
        *,
        limit: int = DEFAULT_BUDGET,
        attempts: float = ATTEMPTS,
        report: Callable[[str | None], None] = report_on_stderr,
    ) -> None:
        self.name, self.attempts, self.received_bytes, self.has_ranges = _without_secrets(url), attempts, 0, True
        self._url = self._address = url
        self._limit, self.report, self._closed = limit, report, threading.Event()
        self._pools: dict[str | None, urllib3.PoolManager] = {}
        self._size: int | None = None
        self._validator: tuple[str, str] | None = None
        self._reading, self._troubled = threading.Lock(), False
        self._interruption = threading.Event()
        self._parked: _Answer | None = None
        """What came of the last answer that was left for another."""
        _check_scheme(url, self.name)
        self._answer = _Answer(0, FIRST_BYTES)
        self._bring(1)
        assert self._size is not None
        self.size: int = self._size

    def read_at(self, offset: int, length: int) -> bytes:
        """`length` bytes from `offset`, fewer only at the end of the file; waits until they are there."""
        end = min(offset + length, self.size)
        if end <= offset:
            return b""
        self.will_read(offset, length)
        self._bring(end)
        if self.has_ranges and offset - self._answer.start > KEPT_BYTES:
            self._answer.discard(offset)
        start = offset - self._answer.start
        return bytes(self._answer.data[start : start + end - offset])

    def will_read(self, offset: int, length: int) -> None:
        """The next reads lie within these bytes, in order: they cost one request together."""
        answer, end = self._answer, min(offset + length, self.size)
        if answer.start <= offset and end <= answer.stop:
            return
        if not answer.holds(offset):
            answer.drop_connection()
            before = self._parked
            if answer.data and answer.reached < answer.stop:
                self._parked = answer
            self._answer = answer = before if before is not None and before.holds(offset) else _Answer(offset, end)
        answer.discard(offset)
        answer.stop = max(end, answer.reached)

    def clone(self) -> "HttpSource":
        """The same file through connections of its own, for another thread; nothing is asked for before it reads. Without ranges it
        would be fetched as a whole once more."""
        other = copy.copy(self)
        other._pools, other._reading, other._closed, other._interruption = (
            {},
            threading.Lock(),
            threading.Event(),
            threading.Event(),
        )
        other._answer, other._parked, other._troubled, other.received_bytes = _Answer(0, 0), None, False, 0
        return other

    def interrupt(self) -> None:
        """Something else is wanted sooner: what another thread is reading fails with InterruptedRead, once some bytes have come.
        They are kept, with all before them, for when it is read again."""
        if self.has_ranges:
            self._interruption.set()

    def discard(self) -> None:
        """Read anew what is asked for next: it came damaged."""
        self._answer.drop_connection()
        self._answer, self._parked = (_Answer(0, 0) if self.has_ranges else _Answer(0, self.size)), None

    def close(self) -> None:
        """Let go of the connection. What is being read fails with UnreachableError."""
        self._closed.set()
        if (response := self._answer.response) is not None:
            with contextlib.suppress(OSError, RuntimeError, ValueError):  # it may just have come to its end
                response.shutdown()
        if self._reading.acquire(timeout=0.1):  # else the reader itself lets go, once an answer or a time-out comes
            self._answer.drop_connection()
            self._reading.release()
        for pool in self._pools.values():
            pool.clear()

    # --- one answer, over as many requests as it takes

    def _bring(self, end: int) -> None:
        """Read on until the bytes up to `end` are there."""
        answer, failures = self._answer, 0
        while answer.reached < min(end, answer.stop):
            before = answer.reached
            try:
                with self._reading:
                    if answer.response is None:
                        self._connect(answer)
                    if answer.response is not None:
                        self._receive(answer, end)
            except _Interrupted as trouble:
                answer.drop_connection()
                self._address = self._url  # the place that a redirection named may be gone
                failures = 1 if answer.reached > before and not trouble.is_slow else failures + 1
                if self._closed.is_set():
                    raise UnreachableError(f"{self.name}: closed") from trouble
                if failures >= self.attempts:
                    raise UnreachableError(f"{self.name}: {trouble}; check the address and the connection") from trouble
                pause = min(FIRST_PAUSE_S * 2 ** min(failures - 1, 10), LONGEST_PAUSE_S) * random.uniform(0.5, 1.5)
                pause = max(pause, trouble.pause_s)
                self.report(f"{self.name}: {trouble}; trying again in {pause:.1f} s")
                self._troubled = True
                self._closed.wait(pause)

    def _receive(self, answer: _Answer, end: int) -> None:
        """One piece after the other, up to `end` or the end of the response."""
        while answer.reached < min(end, answer.asked):
            piece = self._piece(answer, answer.asked - answer.reached)
            if not piece:
                raise _Interrupted(f"the connection breaks off at byte {answer.reached} of {self._size}")
            answer.data += piece
            self.received_bytes += len(piece)
            if self._troubled:
                self.report(None)
                self._troubled = False
            answer.check_pace()
            if self._interruption.is_set() and answer.reached < end:
                self._interruption.clear()
                raise InterruptedRead(f"{self.name}: interrupted")
        if answer.reached == answer.asked and answer.response is not None:
            if self._piece(answer, 1):
                answer.response.close()
            else:
                answer.response.release_conn()  # to be used again
            answer.response = None

    def _piece(self, answer: _Answer, most: int) -> bytes:
        """What has come by now of a response, at least a byte unless it ends here."""
        assert answer.response is not None
        if self._closed.is_set():
            raise _Interrupted("closed")
        started = clock.monotonic()
        try:
            piece: bytes = answer.response.read1(min(PIECE_BYTES, most))
        except (urllib3.exceptions.HTTPError, OSError, ValueError) as error:
            raise _Interrupted(_reason(error)) from error
        answer.waited_s += clock.monotonic() - started
        answer.came += len(piece)
        return piece

    def _connect(self, answer: _Answer) -> None:
        """Ask for what is missing of an answer, and check that what comes is that."""
        headers = {"Accept-Encoding": "identity", "User-Agent": "kpc"}
        if self.has_ranges:
            headers["Range"] = f"bytes={answer.reached}-{answer.stop - 1}"
            if self._validator is not None:
                headers["If-Range"] = self._validator[1]
        response = self._request(headers)
        answer.response, answer.waited_s, answer.came = response, 0.0, 0
        if response.status in TEMPORARY:
            raise _Interrupted(
                f"the server answers {response.status} {response.reason}", pause_s=_retry_after(response)
            )
        encoding = response.headers.get("Content-Encoding", "identity")
        if response.status in (200, 206) and encoding != "identity":
            raise self._refused(
                answer, f"the server sends it compressed ({encoding[:40]}), which ranges of a file must not be"
            )
        if response.status == 206 and self.has_ranges:
            self._accept_range(answer, response)
        elif response.status == 200:
            self._accept_whole(answer, response)
        elif response.status == 416 and self._size is not None:
            raise self._refused(answer, "changed on the server while it was read; open it again")
        elif response.status == 416:
            raise self._refused(answer, "is empty")
        else:
            raise self._refused(answer, f"the server answers {response.status} {response.reason}; check the address")

    def _accept_range(self, answer: _Answer, response: urllib3.BaseHTTPResponse) -> None:
        said = response.headers.get("Content-Range", "")
        match = re.fullmatch(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18})", said.strip())
        if match is None:
            raise self._refused(answer, f"the server does not say which bytes it sends (Content-Range: {said[:60]!r})")
        first, last, size = map(int, match.groups())
        if first != answer.reached or not first <= last < size:
            raise self._refused(answer, f"the server sends bytes {first}-{last}/{size}, not from {answer.reached} on")
        if self._size is None:
            self._size, self._validator = size, _validator(response)
            answer.stop = min(answer.stop, size)
        elif size != self._size or not self._is_same(response):
            raise self._refused(answer, "changed on the server while it was read; open it again")
        answer.asked = min(last + 1, answer.stop)

    def _accept_whole(self, answer: _Answer, response: urllib3.BaseHTTPResponse) -> None:
        """The whole file: the server has no ranges, or If-Range found that it changed."""
        length = response.headers.get("Content-Length")
        size = int(length) if length is not None and re.fullmatch(r"\d{1,18}", length) else None
        first_time = self._size is None
        if not first_time and (self.has_ranges or size not in (self._size, None) or not self._is_same(response)):
            raise self._refused(answer, "changed on the server while it was read; open it again")
        if first_time:
            if (size or 0) > self._limit:
                answer.drop_connection()
                raise BudgetError(
                    f"{self.name}: the server has no ranges, and the whole of {size:,} bytes is more than the budget "
                    f"of {self._limit:,}"
                )
            if self.has_ranges:
                self.report(f"{self.name}: the server has no ranges, all of it has to be downloaded")
                self.report(None)
            self.has_ranges, self._validator = False, _validator(response)
            if size is None:
                size = self._read_to_end(answer)
            if size == 0:
                raise self._refused(answer, "is empty")
            self._size = answer.stop = size
        else:
            left = answer.reached  # what is already there comes once more
            while left and (piece := self._piece(answer, left)):
                left -= len(piece)
            if left:
                raise _Interrupted(f"the connection breaks off before byte {answer.reached} of {self._size}")
        answer.asked = answer.stop

    def _read_to_end(self, answer: _Answer) -> int:
        """A whole file that comes without its length, as far as the limit allows."""
        answer.data.clear()
        while piece := self._piece(answer, PIECE_BYTES):
            answer.data += piece
            answer.check_pace()
            if len(answer.data) > self._limit:
                answer.drop_connection()
                raise BudgetError(
                    f"{self.name}: the server has no ranges and sends more than the budget of {self._limit:,} bytes"
                )
        self.received_bytes += len(answer.data)
        answer.drop_connection()
        return len(answer.data)

    def _request(self, headers: dict[str, str]) -> urllib3.BaseHTTPResponse:
        """The answer to a GET, after redirections."""
        address = self._address
        for _ in range(REDIRECTS + 1):
            try:
                response = self._pool(address).request(
                    "GET",
                    address,
                    headers=headers,
                    preload_content=False,
                    decode_content=False,
                    redirect=False,
                    retries=False,
                )
            except (urllib3.exceptions.LocationValueError, UnicodeError) as error:
                raise NetworkError(f"{self.name}: no address that can be asked ({error})") from error
            except urllib3.exceptions.SSLError as error:
                raise NetworkError(f"{self.name}: no secure connection ({_reason(error)})") from error
            except (urllib3.exceptions.HTTPError, OSError) as error:
                raise _Interrupted(_reason(error)) from error
            target = response.headers.get("Location")
            if response.status not in (301, 302, 303, 307, 308) or target is None:
                self._address = address
                return response
            response.close()
            before, address = address, _joined(address, target)
            _check_scheme(address, self.name)
            if before.lower().startswith("https:") and not address.lower().startswith("https:"):
                raise NetworkError(f"{self.name}: the server leads from a secure connection to one that is not")
        raise NetworkError(f"{self.name}: more than {REDIRECTS} redirections")

    def _pool(self, address: str) -> urllib3.PoolManager:
        """The connections to use: through a proxy where the environment names one."""
        parts = urlsplit(address)
        proxy = urllib.request.getproxies().get(parts.scheme.lower())
        if proxy is not None and urllib.request.proxy_bypass(parts.hostname or ""):
            proxy = None
        if proxy not in self._pools:
            timeout = urllib3.Timeout(connect=CONNECT_S, read=SILENCE_S)
            direct = proxy is None
            self._pools[proxy] = (
                urllib3.PoolManager(timeout=timeout) if direct else urllib3.ProxyManager(proxy, timeout=timeout)
            )
        return self._pools[proxy]

    def _is_same(self, response: urllib3.BaseHTTPResponse) -> bool:
        """Whether an answer is of the file that was opened, as far as the server says."""
        return (
            self._validator is None
            or response.headers.get(self._validator[0], self._validator[1]) == self._validator[1]
        )

    def _refused(self, answer: _Answer, message: str) -> NetworkError:
        answer.drop_connection()
        return NetworkError(f"{self.name}: {_plain(message)}")


def _validator(response: urllib3.BaseHTTPResponse) -> tuple[str, str] | None:
    """The header by which a server tells a file from a later one, and its value: a strong ETag, else the date."""
    etag, date = response.headers.get("ETag"), response.headers.get("Last-Modified")
    if etag is not None and re.fullmatch(r'"[\x21\x23-\x7e]{0,200}"', etag):
        return "ETag", etag
    return ("Last-Modified", date) if date is not None and re.fullmatch(r"[\x20-\x7e]{1,64}", date) else None


def _retry_after(response: urllib3.BaseHTTPResponse) -> float:
    """Seconds that a server asks to be left alone, within reason."""
    said = response.headers.get("Retry-After", "")
    return min(float(said), 30.0) if re.fullmatch(r"\d{1,9}", said) else 0.0


def _joined(address: str, target: str) -> str:
    """Where a redirection leads; nowhere if that makes no sense."""
    try:
        joined = urljoin(address, target)
        return joined if urlsplit(joined).hostname else ""
    except ValueError:
        return ""


def _check_scheme(address: str, name: str) -> None:
    if not is_url(address) or not urlsplit(address).hostname:
        raise NetworkError(f"{name}: leads to no http or https address")


def _without_secrets(url: str) -> str:
    """The URL without user, password, query and fragment, for messages."""
    try:
        parts = urlsplit(url)
        place = parts.hostname or ""
        port = f":{parts.port}" if parts.port is not None else ""
    except ValueError as error:
        raise NetworkError(f"no address that can be asked ({error})") from error
    place = f"[{place}]" if ":" in place else place
    return _plain(urlunsplit((parts.scheme, place + port, parts.path, "", "")))


def _plain(text: str) -> str:
    """What a server or an address says, fit for a terminal, which obeys some characters."""
    return "".join(c if c.isprintable() else "?" for c in text)[:1000]


def _reason(error: Exception) -> str:
    """Why a connection failed, in a few words."""
    if isinstance(error, urllib3.exceptions.NameResolutionError):
        return "no such server is known"
    if isinstance(error, urllib3.exceptions.TimeoutError) and not isinstance(
        error, urllib3.exceptions.NewConnectionError
    ):
        return "the server does not answer in time"
    if any(isinstance(e, urllib3.exceptions.IncompleteRead) for e in (error, *error.args)):
        return "the connection breaks off"
    cause: BaseException = error
    while (
        below := cause.__cause__ or next((a for a in reversed(cause.args) if isinstance(a, Exception)), None)
    ) is not None:
        cause = below
    words = getattr(cause, "strerror", None) or str(cause) or type(cause).__name__
    return f"the connection fails ({words[:120]})"
