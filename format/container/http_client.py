"""GET requests for one URL over urllib3: connection reuse, proxies, passwords, redirections, and temporary failures."""

import contextlib
import copy
import ipaddress
import re
import urllib.request

import urllib3

from kpc.format.common.errors import NetworkError
from kpc.format.container.http_address import Address, printable

# The most redirections that are followed for one request.
MAX_REDIRECTS = 5

# Responses that end a redirection that was followed before: it may have led to an address that expires.
EXPIRED_STATUS = {401, 403, 404, 410}

# Time-outs in seconds: for connecting, and between two pieces of a response.
CONNECT_TIMEOUT_S, READ_TIMEOUT_S = 5.0, 10.0


class TemporaryFailure(Exception):
    """A request failed in a way that may pass: it is repeated."""

    def __init__(self, reason: str, *, pause_s: float = 0.0, is_slow: bool = False) -> None:
        super().__init__(printable(reason))
        self.pause_s, self.is_slow = pause_s, is_slow


class HttpClient:
    """Sends GET requests for one URL.

    User and password in the URL are sent to its host, not to others that it redirects to. Those of a proxy are taken
    from its address in the environment.

    Attributes:
        name: the URL without user, password, query and fragment, which may be secret.

    Raises:
        NetworkError: the URL is not an http or https address.
    """

    def __init__(self, url: str) -> None:
        self._given = self._address = Address.parse(url)  # `_address`: after redirections
        self.name = self._given.name
        self._pools: dict[Address | None, urllib3.PoolManager] = {}  # by proxy

    def clone(self) -> "HttpClient":
        """Return a client for the same URL with connections of its own."""
        other = copy.copy(self)
        other._pools = {}
        return other

    def forget_redirection(self) -> None:
        """Start from the original URL again: the target of a redirection may be gone."""
        self._address = self._given

    def close(self) -> None:
        """Close idle connections."""
        for pool in self._pools.values():
            pool.clear()

    def get(self, headers: dict[str, str]) -> urllib3.BaseHTTPResponse:
        """Return the response to a GET, after redirections; its body has not been read.

        Raises:
            NetworkError: the address or a redirection is invalid, there is no secure connection, or a proxy refuses.
            TemporaryFailure: no response came.
        """
        address = self._address
        for _ in range(MAX_REDIRECTS + 1):
            response = self._request(address, headers)
            location = response.headers.get("Location")
            if response.status in (301, 302, 303, 307, 308) and location is not None:
                response.close()
                address = self._redirected(address, location)
            elif response.status in EXPIRED_STATUS and address is self._address is not self._given:
                response.close()
                address = self._address = self._given
            else:
                self._address = address
                return response
        raise NetworkError(f"{self.name}: more than {MAX_REDIRECTS} redirections; check the address")

    def refusal(self, response: urllib3.BaseHTTPResponse) -> str:
        """Say what the server answers to the last `get` in place of the file, and what to do."""
        answer = f"answers {response.status} {response.reason or ''}".strip()
        if response.status == 407:
            return self._proxy_refusal(self._address, answer)
        if response.status != 401:
            return f"the server {answer}; check the address"
        if self._address.authorization is not None:
            scheme = response.headers.get("WWW-Authenticate", "Basic")
            if not re.search(r"\bbasic\b", scheme, re.IGNORECASE):
                return f"the server {answer} and wants {scheme.split(' ')[0]} authentication; only Basic is supported"
            return f"the server {answer}: user and password in the address were sent and not accepted; check them"
        if self._given.authorization is not None:
            return (
                f"the server {answer}: user and password in the address were not sent, since it redirects to another "
                f"host ({self._address.host}); use the final address"
            )
        return (
            f"the server {answer}: there are no user and password in the address, so none were sent; write "
            f"{self._address.scheme}://USER:PASSWORD@{self._address.host}/..."
        )

    def _request(self, address: Address, headers: dict[str, str]) -> urllib3.BaseHTTPResponse:
        if address.authorization is not None:
            headers = headers | {"Authorization": address.authorization}
        try:
            return self._pool(address).request(
                "GET",
                address.url,
                headers=headers,
                preload_content=False,
                decode_content=False,
                redirect=False,
                retries=False,
            )
        except (urllib3.exceptions.LocationValueError, UnicodeError):
            raise NetworkError(f"{self.name}: not a valid address; check it") from None  # it may hold secrets
        except urllib3.exceptions.SSLError as error:
            raise NetworkError(f"{self.name}: no secure connection ({describe_failure(error)})") from error
        except (urllib3.exceptions.HTTPError, OSError) as error:
            refused = re.search(r"Tunnel connection failed: (4\d\d[^'\"]*)", str(error))
            if refused is not None:
                answer = self._proxy_refusal(address, f"answers {refused[1].strip()}")
                raise NetworkError(f"{self.name}: {printable(answer)}") from error
            raise TemporaryFailure(describe_failure(error)) from error

    def _redirected(self, address: Address, location: str) -> Address:
        """Return the address that a redirection leads to, with the password that may be sent there."""
        try:
            target = address.redirected(location)
        except NetworkError as error:
            raise NetworkError(f"{self.name}: redirects to no http or https address; check it") from error
        if address.scheme == "https" and target.scheme != "https":
            raise NetworkError(f"{self.name}: the server redirects from https to http; use the final address")
        return target.with_secrets_of(address).with_secrets_of(self._given)

    def _proxy_refusal(self, address: Address, answer: str) -> str:
        """Say what a proxy answered in place of the server, and what to do."""
        proxy = _proxy_for(address)
        if proxy is None:
            return f"the server {answer}; check the address"
        variable = _proxy_variable(address)
        if not answer.startswith("answers 407"):
            return f"the proxy {proxy.host} {answer}; check {variable}, or add the server to no_proxy"
        if proxy.authorization is not None:
            return f"the proxy {proxy.host} {answer}: user and password in {variable} were sent; check them"
        return (
            f"the proxy {proxy.host} {answer}: there are no user and password in {variable}, so none were sent; write "
            f"{proxy.scheme}://USER:PASSWORD@{proxy.host}:{proxy.port}"
        )

    def _pool(self, address: Address) -> urllib3.PoolManager:
        """Return the connection pool for an address: through a proxy if the environment names one."""
        proxy = _proxy_for(address)
        if proxy not in self._pools:
            timeout = urllib3.Timeout(connect=CONNECT_TIMEOUT_S, read=READ_TIMEOUT_S)
            if proxy is None:
                self._pools[proxy] = urllib3.PoolManager(timeout=timeout)
            else:
                headers = {} if proxy.authorization is None else {"Proxy-Authorization": proxy.authorization}
                self._pools[proxy] = urllib3.ProxyManager(proxy.url, proxy_headers=headers, timeout=timeout)
        return self._pools[proxy]


def _proxy_for(address: Address) -> Address | None:
    """Return the proxy for an address from the environment: `http_proxy`, `https_proxy`, `all_proxy`, `no_proxy`.

    Raises:
        NetworkError: it is no http or https address.
    """
    proxies, variable = urllib.request.getproxies(), _proxy_variable(address)
    proxy = proxies.get(variable.removesuffix("_proxy"))
    if not proxy or _is_excepted(address, proxies.get("no", "")):
        return None
    try:
        return Address.parse(proxy if "://" in proxy else f"http://{proxy}")
    except NetworkError as error:
        raise NetworkError(f"{variable}: {error}; only http and https proxies are supported") from None


def _proxy_variable(address: Address) -> str:
    """Return the name of the environment variable that holds the proxy for an address, if there is one."""
    return f"{address.scheme}_proxy" if urllib.request.getproxies().get(address.scheme) else "all_proxy"


def _is_excepted(address: Address, exceptions: str) -> bool:
    """Return whether `no_proxy` or the system names the host: by its name or domain, as an IP address or in a network
    such as 10.0.0.0/8.
    """
    host = f"[{address.host}]" if ":" in address.host else address.host
    if urllib.request.proxy_bypass(f"{host}:{address.port}"):
        return True
    with contextlib.suppress(ValueError):
        ip = ipaddress.ip_address(address.host)
        for entry in exceptions.split(","):
            with contextlib.suppress(ValueError):
                if ip in ipaddress.ip_network(entry.strip(" []"), strict=False):
                    return True
    return False


def describe_failure(error: Exception) -> str:
    """Say in a few words why a connection failed."""
    if isinstance(error, urllib3.exceptions.ProxyError):
        return f"through the proxy, {describe_failure(error.original_error)}"
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
