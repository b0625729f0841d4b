"""What the headers of a response say (RFC 9110). They come from a server and may say anything."""

import re

import urllib3

# What a response says of the bytes that it holds; "*" is unknown, or none.
CONTENT_RANGE = re.compile(r"bytes[ =]+(?:(\d{1,18})-(\d{1,18})|\*)/(\d{1,18}|\*)", re.IGNORECASE)


def validator_of(response: urllib3.BaseHTTPResponse) -> tuple[str, str] | None:
    """Return the header that identifies this version of a file, and its value: a strong ETag, else the date."""
    etag, date = response.headers.get("ETag"), response.headers.get("Last-Modified")
    if etag is not None and re.fullmatch(r'"[\x21\x23-\x7e]{0,200}"', etag):
        return "ETag", etag
    return ("Last-Modified", date) if date is not None and re.fullmatch(r"[\x20-\x7e]{1,64}", date) else None


def range_of(response: urllib3.BaseHTTPResponse) -> tuple[int | None, int | None, int | None]:
    """Return the first and last byte that a response holds and the size of the file; None for what it does not say."""
    match = CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", "").strip())
    if match is None:
        return None, None, None
    first, last, size = (int(number) if number is not None and number != "*" else None for number in match.groups())
    return first, last, size


def length_of(response: urllib3.BaseHTTPResponse) -> int | None:
    """Return the bytes that a response holds, if it says so."""
    length = response.headers.get("Content-Length", "")
    return int(length) if re.fullmatch(r"\d{1,18}", length) else None


def retry_after(response: urllib3.BaseHTTPResponse) -> float:
    """Return the pause in seconds that a server asks for, at most 30."""
    value = response.headers.get("Retry-After", "")
    return min(float(value), 30.0) if re.fullmatch(r"\d{1,9}", value) else 0.0
