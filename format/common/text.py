"""Text in files of unknown encoding, and names that are not valid Unicode.

Names of files are bytes on Linux, in whatever encoding their maker used. Python stands for bytes that are not UTF-8 by
surrogates (PEP 383): with them a file is found, but they can be neither printed nor stored in a UTF-8 document.
"""

import codecs
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from kpc.format.common.errors import MediaError

# Byte order marks and their encodings; that of UTF-32 begins as that of UTF-16 does.
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)

# Units of `byte_text`, by their powers of ten.
UNITS = {9: "GB", 6: "MB", 3: "KB", 0: "bytes"}

# Names that a message lists.
NAMES_SHOWN = 8


def open_text(path: str | os.PathLike[str]) -> TextIO:
    """Open a text in UTF-8, with or without a byte order mark, or in UTF-16 or UTF-32 with one.

    Bytes that are not UTF-8 become surrogates, so that names in a list are those of the files.
    """
    with open(path, "rb") as file:
        head = file.read(4)
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if head.startswith(mark)), "utf-8-sig")
    return Path(path).open(encoding=encoding, errors="surrogateescape")


def valid_unicode(text: str | os.PathLike[str]) -> str:
    """Return text with a replacement character (U+FFFD) for each surrogate."""
    return re.sub("[\ud800-\udfff]", "\ufffd", os.fspath(text))


def check_unicode(path: str | os.PathLike[str], format_name: str) -> None:
    """Refuse a path that a library cannot open, since it takes text.

    Raises:
        MediaError: the path is not valid Unicode.
    """
    if valid_unicode(path) != os.fspath(path):
        raise MediaError(
            f"{os.fspath(path)}: {format_name} files need names that are valid Unicode; choose another name"
        )


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one."""
    return f"{count:,} {noun}" + "s" * (count != 1)


def agreeing(count: int, one: str, more: str) -> str:
    """Return the words that agree with a number: `one` if it is one, else `more`."""
    return one if count == 1 else more


def spanned(low: str, high: str) -> str:
    """Return a range of two numbers as text, or the number that both are."""
    return low if low == high else f"{low} to {high}"


def byte_text(count: int) -> str:
    """Return a number of bytes for a message, in the largest unit of which it is one: "20 KB", "1.5 GB"."""
    power = max((p for p in (9, 6, 3) if count >= 10**p), default=0)
    return f"{count / 10**power:.3g} {UNITS[power]}"


def first_names(names: Sequence[str], command: str = "kpinfo --json") -> str:
    """Return the first NAMES_SHOWN names for a message, and how many more the given command lists."""
    shown = ", ".join(names[:NAMES_SHOWN])
    more = len(names) - NAMES_SHOWN
    return f"{shown} ({more:,} more; {command} lists all)" if more > 0 else shown


def option_name(field: str) -> str:
    """Return the option of a command that sets a field of its options, whose name ends with its unit."""
    return "--" + field.removesuffix("_s").removesuffix("_db").replace("_", "-")


def escaped(text: str | os.PathLike[str]) -> str:
    """Return text with escapes for what breaks a line or controls a terminal: line breaks, control codes, and marks
    that turn the direction of writing. Names of files may hold all of them.
    """
    return re.sub("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]", lambda code: one_line(code[0]), os.fspath(text))


def notice(text: str) -> None:
    """Print one line on stderr, `escaped`."""
    print(escaped(text), file=sys.stderr, flush=True)


def one_line(text: str) -> str:
    """Return text for a message, with what cannot be printed (line breaks, control codes, surrogates) as escapes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
