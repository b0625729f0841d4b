"""Addresses, passwords in them, redirections and proxies, as curl and browsers treat them."""

import base64
import logging
import socket
import threading
from collections.abc import Iterator
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from kpc.format.common.errors import NetworkError, UnreachableError
from kpc.format.container import http, http_client
from kpc.format.container.http import HttpSource
from kpc.format.container.http_address import Address
from kpc.player.sharing.file_server import Handler, serving
from kpc.tools.cli import kpinfo

DATA = bytes(range(256)) * 300


def basic(text: str) -> str:
    return f"Basic {base64.b64encode(text.encode()).decode()}"


class Guarded(Handler):
    """Asks for a password below /private/, as a server, and records what it gets.

    Attributes:
        seen: (path, Authorization) of all requests.
    """

    seen: ClassVar[list[tuple[str, str | None]]] = []
    expected: ClassVar[str] = basic("j\u00fcrgen:p@ss/w\u00f6rt")
    scheme: ClassVar[str] = 'Basic realm="films"'

    def do_GET(self) -> None:
        self.seen.append((self.path, self.headers.get("Authorization")))
        if self.path.startswith("/to/"):
            self.send_response(302)
            self.send_header("Location", self.target(self.path.removeprefix("/to/")))
            self.send_header("Content-Length", "0")
            self.end_headers()
        elif self.path.startswith("/private/") and self.headers.get("Authorization") != self.expected:
            self.send_response(401)
            self.send_header("WWW-Authenticate", self.scheme)
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            super().do_GET()

    def target(self, rest: str) -> str:
        return f"/{rest}"


@pytest.fixture(autouse=True)
def _apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retry without long pauses, and without the proxies of this machine."""
    monkeypatch.setattr(http, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(http_client, "CONNECT_TIMEOUT_S", 2.0)
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    Guarded.seen.clear()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "private").mkdir()
    for name in ("data.bin", "private/data.bin", "gr\u00fc\u00dfe 100%.bin"):
        (tmp_path / name).write_bytes(DATA)
    return tmp_path


@pytest.fixture
def host(folder: Path) -> Iterator[str]:
    with serving(folder, handler=Guarded) as address:
        yield address.removeprefix("http://")


def read(url: str) -> None:
    source = HttpSource(url, attempts=1)
    assert source.size == len(DATA) and source.read_at(70_000, 100) == DATA[70_000:70_100]
    source.close()


@pytest.mark.parametrize("userinfo", ["j\u00fcrgen:p%40ss%2Fw\u00f6rt", "j%C3%BCrgen:p%40ss%2fw%c3%b6rt"])
def test_user_and_password_are_sent_with_every_request(host: str, userinfo: str) -> None:
    read(f"http://{userinfo}@{host}/private/data.bin")
    assert Guarded.seen == [("/private/data.bin", Guarded.expected)] * 2
    clone = HttpSource(f"http://{userinfo}@{host}/private/data.bin")
    copied = clone.clone()
    assert copied.read_at(10, 10) == DATA[10:20]
    clone.close(), copied.close()


def test_a_user_without_a_password_and_none_at_all() -> None:
    assert Address.parse("http://me@a/").authorization == basic("me:")
    assert Address.parse("http://:key@a/").authorization == basic(":key")
    assert Address.parse("http://a/@b:c").authorization is Address.parse("http://@a/").authorization is None


@pytest.mark.parametrize(
    ("userinfo", "words"),
    [
        ("", "401 Unauthorized: there are no user and password in the address, so none were sent"),
        ("me:wrong-one@", "401 Unauthorized: user and password in the address were sent and not accepted"),
    ],
)
def test_a_refused_password_is_named_but_not_shown(
    host: str, userinfo: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert kpinfo.main([f"http://{userinfo}{host}/private/data.bin?key=token"]) == 1
    message = capsys.readouterr().err
    assert words in message and "/private/data.bin" in message and "kpinfo" in message
    assert not any(secret in message for secret in ("wrong-one", "me:", "token"))


def test_another_kind_of_authentication_is_named(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Guarded, "scheme", 'Digest realm="films", nonce="1"')
    with pytest.raises(NetworkError, match="wants Digest authentication; only Basic is supported"):
        HttpSource(f"http://me:wrong@{host}/private/data.bin")


def test_a_password_follows_a_redirection_to_the_same_host_only(
    host: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    password = "j\u00fcrgen:p%40ss%2Fw\u00f6rt"
    read(f"http://{password}@{host}/to/private/data.bin")
    assert Guarded.seen[1] == ("/private/data.bin", Guarded.expected)
    port = host.split(":")[1]
    for other in (f"http://localhost:{port}", f"http://me@localhost:{port}"):
        Guarded.seen.clear()
        monkeypatch.setattr(Guarded, "target", lambda self, rest, other=other: f"{other}/{rest}")
        read(f"http://{password}@{host}/to/data.bin")
        assert Guarded.seen[0] == ("/to/data.bin", Guarded.expected)
        assert Guarded.seen[1] == ("/data.bin", basic("me:") if "me@" in other else None)
    monkeypatch.setattr(Guarded, "target", lambda self, rest: f"http://localhost:{port}/{rest}")
    with pytest.raises(NetworkError, match=r"not sent, since it redirects to another host \(localhost\)"):
        HttpSource(f"http://{password}@{host}/to/private/data.bin")


@pytest.mark.parametrize(
    ("location", "keeps"),
    [
        ("/there", True),
        ("http://A.example:80/there", True),
        ("https://a.example/there", True),
        ("https://a.example:8443/there", False),
        ("http://a.example:8080/there", False),
        ("http://b.example/there", False),
        ("//b.a.example/there", False),
        ("http://a.example\\@b.example/there", True),
    ],
)
def test_who_gets_the_password_after_a_redirection(location: str, keeps: bool) -> None:
    start = Address.parse("http://me:secret@a.example/here")
    target = start.redirected(location).with_secrets_of(start)
    assert target.authorization == (start.authorization if keeps else None)
    assert keeps == (target.host == "a.example" and target.port in (80, 443))
    secure = Address.parse("https://me:secret@a.example/here")
    assert Address.parse("http://a.example/here").with_secrets_of(secure).authorization is None


def test_a_redirection_that_expires_is_followed_anew(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = HttpSource(f"http://{host}/to/data.bin")
    monkeypatch.setattr(Guarded, "target", lambda self, rest: f"/{rest}?signature=2")
    before = Guarded.do_GET

    def expiring(self: Guarded) -> None:
        if self.path == "/data.bin":
            self.send_error(403)
        else:
            before(self)

    monkeypatch.setattr(Guarded, "do_GET", expiring)
    assert source.read_at(70_000, 100) == DATA[70_000:70_100]
    assert [path for path, _ in Guarded.seen] == ["/to/data.bin", "/data.bin", "/to/data.bin", "/data.bin?signature=2"]
    source.close()


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("HTTP://A.Example/B c\u00f6.kpc?x=\u00e4 b#part", "http://a.example/B%20c%C3%B6.kpc?x=%C3%A4%20b"),
        ("http://a.example/100%/%41%e4?50%", "http://a.example/100%25/%41%e4?50%25"),
        ("http://m\u00fcller.example:81/", "http://xn--mller-kva.example:81/"),
        ("http://[::1]:8000/a", "http://[::1]:8000/a"),
        (" http://a.example/a\udcff ", "http://a.example/a%FF"),
        ("http://me:pw@[fe80::1%25eth0]/", "http://[fe80::1%25eth0]/"),
    ],
)
def test_addresses_are_encoded_as_browsers_do(text: str, url: str) -> None:
    assert Address.parse(text).url == url


def test_spaces_umlauts_and_queries_reach_the_server(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read(f"http://{host}/gr\u00fc\u00dfe 100%.bin?token=a b&c=\u00e4")
    assert Guarded.seen[0][0] == "/gr%C3%BC%C3%9Fe%20100%25.bin?token=a%20b&c=%C3%A4"
    # A server sends the bytes of UTF-8 in a Location header.
    location = "/gr\u00fc\u00dfe 100%.bin".encode().decode("latin-1")
    monkeypatch.setattr(Guarded, "target", lambda self, rest: location)
    read(f"http://{host}/to/anything")


def test_ipv6_hosts(folder: Path) -> None:
    class Server(ThreadingHTTPServer):
        address_family = socket.AF_INET6

    try:
        server = Server(("::1", 0), partial(Guarded, directory=str(folder)))
    except OSError:
        pytest.skip("no IPv6 on this machine")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        read(f"http://j\u00fcrgen:p%40ss%2Fw\u00f6rt@[::1]:{server.server_address[1]}/private/data.bin")
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize(
    "address",
    [
        "http://me:pass/word@a.example/",
        "http://me:secret@a.example:port/",
        "http://me:secret@a.example:99999/",
        "http://me:secret@[::1/",
        "http://me:secret\u2100@a.example/",
        "http://me:secret@stra\u00dfe.example/",
        "http://me:secret@a b.example/",
        "http://me:secret@/",
        "http://me:secret@a..\u00fc/",
    ],
)
def test_invalid_addresses_are_refused_without_their_password(address: str, caplog: pytest.LogCaptureFixture) -> None:
    with (
        caplog.at_level(logging.DEBUG),
        pytest.raises(NetworkError, match=r"not a valid address|no http or https") as e,
    ):
        HttpSource(address, attempts=1)
    assert not any(secret in f"{e.value} {caplog.text}" for secret in ("secret", "word@", "me:"))
    assert e.value.__cause__ is None or "secret" not in str(e.value.__cause__)


class Proxy(Handler):
    """A proxy that wants a password and answers itself; it tunnels to nowhere."""

    seen: ClassVar[list[tuple[str, str, str | None, str | None]]] = []
    status: ClassVar[int] = 407

    def do_GET(self) -> None:
        self.seen.append(
            (self.command, self.path, self.headers.get("Proxy-Authorization"), self.headers.get("Authorization"))
        )
        if self.headers.get("Proxy-Authorization") != basic("me:p@ss"):
            self.send_error(self.status)
        elif self.command == "CONNECT":
            self.send_response(200)
            self.end_headers()
            self.close_connection = True
        else:
            self.path = "/data.bin"
            super().do_GET()

    do_CONNECT = do_GET


@pytest.fixture
def proxy(folder: Path) -> Iterator[str]:
    Proxy.seen.clear()
    with serving(folder, handler=Proxy) as address:
        yield address.removeprefix("http://")


def test_the_password_of_a_proxy_is_sent_to_it(proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", f"http://me:p%40ss@{proxy}")
    read("http://you:secret@a.example/x.kpc")
    assert Proxy.seen == [("GET", "http://a.example/x.kpc", basic("me:p@ss"), basic("you:secret"))] * 2
    monkeypatch.delenv("http_proxy")
    monkeypatch.setenv("ALL_PROXY", f"me:p%40ss@{proxy}")  # curl, too, takes it without a scheme
    read("http://a.example/x.kpc")
    # For https it is sent with CONNECT, and the password of the server is not.
    Proxy.seen.clear()
    with pytest.raises(NetworkError):
        HttpSource("https://you:secret@a.example/x.kpc", attempts=1)
    assert Proxy.seen == [("CONNECT", "a.example:443", basic("me:p@ss"), None)]


@pytest.mark.parametrize("scheme", ["http", "https"])
def test_a_proxy_that_refuses_is_named(proxy: str, scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(f"{scheme}_proxy", f"http://{proxy}")
    words = f"the proxy 127.0.0.1 answers 407 .*no user and password in {scheme}_proxy"
    with pytest.raises(NetworkError, match=words):
        HttpSource(f"{scheme}://you:secret@a.example/x.kpc")
    monkeypatch.setenv(f"{scheme}_proxy", f"http://me:wrong@{proxy}")
    with pytest.raises(NetworkError, match=f"407 .*user and password in {scheme}_proxy were sent") as error:
        HttpSource(f"{scheme}://you:secret@a.example/x.kpc")
    assert "wrong" not in str(error.value) and "secret" not in str(error.value)
    assert len(Proxy.seen) == 2  # neither was repeated


def test_a_proxy_that_forbids_a_tunnel_or_cannot_be_used_is_named(proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("https_proxy", f"http://{proxy}")
    monkeypatch.setattr(Proxy, "status", 403)
    with pytest.raises(NetworkError, match=r"the proxy 127.0.0.1 answers 403 .*check https_proxy"):
        HttpSource("https://a.example/x.kpc")
    monkeypatch.setenv("http_proxy", "socks5://me:secret@127.0.0.1:1080")
    with pytest.raises(NetworkError, match=r"http_proxy: socks5://127.0.0.1:1080: .* only http and https proxies") as e:
        HttpSource("http://a.example/x.kpc")
    assert "secret" not in str(e.value)
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{port}")
    with pytest.raises(UnreachableError, match="through the proxy, the connection fails"):
        HttpSource("http://a.example/x.kpc", attempts=1, report=lambda message: None)


@pytest.mark.parametrize(
    ("exceptions", "url", "bypasses"),
    [
        ("example", "http://a.example/", True),
        (".example, other", "http://a.example/", True),
        ("a.example:8000", "http://a.example:8000/", True),
        ("a.example:8000", "http://a.example/", False),
        ("xample", "http://a.example/", False),
        ("*", "http://a.example/", True),
        ("127.0.0.0/8", "http://127.0.0.1:8000/", True),
        ("10.0.0.0/8,127.0.0.1", "http://127.0.0.1:8000/", True),
        ("10.0.0.0/8", "http://127.0.0.1/", False),
        ("::1", "http://[::1]:8000/", True),
        ("[::1]", "http://[::1]/", True),
        ("fe80::/10", "http://[::1]/", False),
    ],
)
def test_no_proxy_names_hosts_domains_and_networks(
    exceptions: str, url: str, bypasses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", "http://proxy.example:3128")
    monkeypatch.setenv("no_proxy", exceptions)
    assert (http_client._proxy_for(Address.parse(url)) is None) == bypasses
