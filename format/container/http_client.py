"""GET requests for one URL over urllib3: connection reuse, proxies, redirections, and temporary failures."""

import copy
import urllib.request
from urllib.parse import urljoin, urlsplit, urlunsplit

import urllib3

from kpc.format.common.errors import NetworkError

SCHEMES = ("http", "https")

# The most redirections that are followed for one request.
MAX_REDIRECTS = 5

# Time-outs in seconds: for connecting, and between two pieces of a response.
CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 5.0, 10.0


def is_url(text: str) -> bool:
    """Return whether `text` is a URL that `HttpSource` accepts, not a path."""
    return text.partition("://")[0].lower() in SCHEMES and "://" in text


class TemporaryFailure(Exception):
    """A request failed in a way that may pass: it is repeated."""

    def __init__(self, reason: str, *, pause_s: float = 0.0, is_slow: bool = False) -> None:
        super().__init__(printable(reason))
        self.pause_s, self.is_slow = pause_s, is_slow


class HttpClient:
    """Sends GET requests for one URL.

    Attributes:
        name: the URL without user, password, query and fragment, which may be secret.

    Raises:
        NetworkError: the URL is not an http or https address.
    """

    def __init__(self, url: str) -> None:
        self.name = _without_secrets(url)
        self._url = self._address = url  # as given, and after redirections
        self._pools: dict[str | None, urllib3.PoolManager] = {}  # by proxy
        _check_scheme(url, self.name)

    def clone(self) -> "HttpClient":
        """Return a client for the same URL with connections of its own."""
        other = copy.copy(self)
        other._pools = {}
        return other

    def forget_redirection(self) -> None:
        """Start from the original URL again: the target of a redirection may be gone."""
        self._address = self._url

    def close(self) -> None:
        """Close idle connections."""
        for pool in self._pools.values():
            pool.clear()

    def get(self, headers: dict[str, str]) -> urllib3.BaseHTTPResponse:
        """Return the response to a GET, after redirections; its body has not been read.

        Raises:
            NetworkError: the address or a redirection is invalid, or there is no secure connection.
            TemporaryFailure: no response came.
        """
        address = self._address
        for _ in range(MAX_REDIRECTS + 1):
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
                raise NetworkError(f"{self.name}: not a valid address ({error})") from error
            except urllib3.exceptions.SSLError as error:
                raise NetworkError(f"{self.name}: no secure connection ({describe_failure(error)})") from error
            except (urllib3.exceptions.HTTPError, OSError) as error:
                raise TemporaryFailure(describe_failure(error)) from error
            target = response.headers.get("Location")
            if response.status not in (301, 302, 303, 307, 308) or target is None:
                self._address = address
                return response
            response.close()
            before, address = address, _resolve_redirect(address, target)
            _check_scheme(address, self.name)
            if before.lower().startswith("https:") and not address.lower().startswith("https:"):
                raise NetworkError(f"{self.name}: the server redirects from https to http; use the final address")
        raise NetworkError(f"{self.name}: more than {MAX_REDIRECTS} redirections; check the address")

    def _pool(self, address: str) -> urllib3.PoolManager:
        """Return the connection pool for an address: through a proxy if the environment names one."""
        parts = urlsplit(address)
        proxy = urllib.request.getproxies().get(parts.scheme.lower())
        if proxy is not None and urllib.request.proxy_bypass(parts.hostname or ""):
            proxy = None
        if proxy not in self._pools:
            timeout = urllib3.Timeout(connect=CONNECT_TIMEOUT_S, read=READ_TIMEOUT_S)
            self._pools[proxy] = (
                urllib3.PoolManager(timeout=timeout) if proxy is None else urllib3.ProxyManager(proxy, timeout=timeout)
            )
        return self._pools[proxy]


def _resolve_redirect(address: str, target: str) -> str:
    """Return the address a redirection leads to, or "" if it is malformed."""
    try:
        joined = urljoin(address, target)
        return joined if urlsplit(joined).hostname else ""
    except ValueError:
        return ""


def _check_scheme(address: str, name: str) -> None:
    if not is_url(address) or not urlsplit(address).hostname:
        raise NetworkError(f"{name}: leads to no http or https address; check it")


def _without_secrets(url: str) -> str:
    """Return the URL without user, password, query and fragment, for messages."""
    try:
        parts = urlsplit(url)
        host = parts.hostname or ""
        port = f":{parts.port}" if parts.port is not None else ""
    except ValueError as error:
        raise NetworkError(f"not a valid address ({error})") from error
    host = f"[{host}]" if ":" in host else host
    return printable(urlunsplit((parts.scheme, host + port, parts.path, "", "")))


def printable(text: str) -> str:
    """Replace characters that could control the terminal, and limit the length of text from a server or address."""
    return "".join(c if c.isprintable() else "?" for c in text)[:1000]


def describe_failure(error: Exception) -> str:
    """Say in a few words why a connection failed."""
    if isinstance(error, urllib3.exceptions.NameResolutionError):
        return "the name of the server is unknown"
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
