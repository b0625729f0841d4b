"""http and https addresses as browsers read them: what is requested, what may be shown, and for whom a password is."""

import base64
import re
from dataclasses import dataclass, field, replace
from urllib.parse import SplitResult, quote, unquote, unquote_to_bytes, urljoin, urlsplit, urlunsplit

from kpc.format.common.errors import NetworkError

SCHEMES = ("http", "https")
DEFAULT_PORTS = {"http": 80, "https": 443}

# Letters that two versions of IDNA turn into different hosts (sharp s, final sigma, joiners).
AMBIGUOUS_LETTERS = "\u00df\u03c2\u200c\u200d"

# What is left as it is in a path or query; "%" is looked at apart. urllib3 encodes a few more.
PRINTABLE_ASCII = "".join(map(chr, range(0x21, 0x7F)))


def is_url(text: str) -> bool:
    """Return whether `text` is an http or https address, not a path."""
    return text.partition("://")[0].lower() in SCHEMES and "://" in text


def lacks_scheme(text: str) -> bool:
    """Return whether `text` reads as an http or https address without its scheme, such as "localhost:8000/a.kpc"."""
    return (
        re.match(r"(localhost|([\w-]+\.)+[a-z]{2,}|\d+(\.\d+){3}|[\w.-]+(?=:\d))(:\d{1,5})?/", text, re.I) is not None
    )


def public_name(text: str) -> str:
    """Return an address of any scheme without user, password, query and fragment, which may be secret."""
    try:
        return _split(text)[-1]
    except ValueError:
        return f"{printable(text.partition('://')[0])}://..."


@dataclass(frozen=True)
class Address:
    """An http or https address.

    Attributes:
        name: for messages: without user, password, query and fragment, which may be secret.
        scheme: in lower case.
        host: in ASCII; an IPv6 address without brackets.
        port: that of the scheme if the address has none.
        url: as it is requested: in ASCII, without user, password and fragment.
        authorization: the value of the header that sends user and password (RFC 7617); None without them.
    """

    name: str
    scheme: str
    host: str
    port: int
    url: str = field(repr=False)
    authorization: str | None = field(repr=False)

    @staticmethod
    def parse(text: str) -> "Address":
        """Take an address apart. User and password may be percent-encoded, and so must be `/ ? # @` in them.

        Raises:
            NetworkError: it is not a valid http or https address; the message quotes no part that may be secret.
        """
        try:
            parts, shown, port, name = _split(text)
            host = shown if ":" in shown else _ascii_host(shown)
        except ValueError:  # its text may quote a password, as may the exceptions that it stands for
            encode = ", and write / ? # @ in a password as %2F %3F %23 %40" if "@" in text else ""
            shown = "" if "@" in text else printable(re.split("[?#]", text, maxsplit=1)[0]) + ": "
            raise NetworkError(f"{shown}not a valid address; check its host and port{encode}") from None
        if parts.scheme not in SCHEMES:
            raise NetworkError(
                f"{name}: no http or https address; other schemes cannot be read, so download it or give its path"
            )
        if not host:
            raise NetworkError(f"{name}: no http or https address, since it names no host; check it")
        url = urlunsplit((parts.scheme, _netloc(host, port), _encoded(parts.path), _encoded(parts.query), ""))
        port = DEFAULT_PORTS[parts.scheme] if port is None else port
        return Address(name, parts.scheme, host, port, url, _authorization(parts.netloc.rpartition("@")[0]))

    def redirected(self, location: str) -> "Address":
        """Return the address to which a Location header leads from here.

        Args:
            location: the header as http.client decodes it, in Latin-1; it may be relative.

        Raises:
            NetworkError: it leads to no valid http or https address.
        """
        # Servers send UTF-8. Bytes that are none are kept and percent-encoded.
        location = location.encode("latin-1", "replace").decode("utf-8", "surrogateescape")
        try:
            joined = urljoin(self.url, location)
        except ValueError:
            raise NetworkError("not a valid address") from None
        return Address.parse(joined)

    def with_secrets_of(self, other: "Address") -> "Address":
        """Return this address with the user and password of another, unless it has its own or is of another server.

        The https address of an http one counts as the same server; other schemes, hosts and ports do not.
        """
        before, after = ((address.scheme, address.port) for address in (other, self))
        same = self.host == other.host and (before == after or (before, after) == (("http", 80), ("https", 443)))
        return replace(self, authorization=other.authorization) if same and self.authorization is None else self


def _split(text: str) -> tuple[SplitResult, str, int | None, str]:
    """Return the parts of an address, its host, its port, and the address without what may be secret.

    Raises:
        ValueError: it is none; the text of the error may quote what is secret.
    """
    # Browsers read "\\" as "/"; otherwise two readers could find two hosts in one address.
    parts = urlsplit(re.sub(r"^[^?#]*", lambda match: match[0].replace("\\", "/"), text.strip()))
    host, port = parts.hostname or "", parts.port
    return parts, host, port, printable(urlunsplit((parts.scheme, _netloc(host, port), parts.path, "", "")))


def _netloc(host: str, port: int | None) -> str:
    return (f"[{host}]" if ":" in host else host) + (f":{port}" if port is not None else "")


def printable(text: str) -> str:
    """Replace characters that could control the terminal, and limit the length of text from a server or address."""
    return "".join(c if c.isprintable() else "?" for c in text)[:1000]


def _ascii_host(host: str) -> str:
    """Return a host name as DNS knows it.

    Raises:
        ValueError: it is not valid.
    """
    host = unquote(host)
    if not host.isascii():
        if any(letter in host for letter in AMBIGUOUS_LETTERS):
            raise ValueError("ambiguous")
        host = host.encode("idna").decode("ascii").lower()
    labels = host.removesuffix(".").split(".") if host else []
    if len(host) > 253 or not all(re.fullmatch(r"[\w~-]{1,63}", label, re.ASCII) for label in labels):
        raise ValueError("not a host name")
    return host


def _encoded(text: str) -> str:
    """Percent-encode what an address may not hold: spaces, control characters, letters beyond ASCII (in UTF-8), and
    each "%" that encodes nothing.
    """
    text = re.sub(r"%(?![0-9A-Fa-f]{2})", "%25", text)
    return quote(text, safe=PRINTABLE_ASCII, errors="surrogateescape")


def _authorization(userinfo: str) -> str | None:
    """Return the Basic credentials for the part of an address before "@"; None if it is empty."""
    user, _, password = (unquote_to_bytes(part) for part in userinfo.encode("utf-8", "surrogateescape").partition(b":"))
    return f"Basic {base64.b64encode(user + b':' + password).decode()}" if user or password else None
