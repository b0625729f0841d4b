"""Where a file's bytes come from: a disk, memory, or HTTP range requests."""

import errno
import io
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Protocol, runtime_checkable

from kpc.format.common.errors import FormatError, NetworkError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.container.beginning import BEGINNING_BYTES
from kpc.format.container.http_address import Address, is_url, lacks_scheme


@runtime_checkable
class Source(Protocol):
    """Random access to bytes.

    Attributes:
        name: of the file, for messages.
        size: bytes that are there.
    """

    name: str
    size: int

    def read_at(self, offset: int, length: int) -> bytes:
        """Return `length` bytes from `offset` on; fewer only at the end."""

    def will_read(self, offset: int, length: int) -> None:
        """Announce that the next reads lie within these bytes, in order, so that a remote source may fetch them with
        one request.
        """


@runtime_checkable
class RemoteSource(Source, Protocol):
    """A source behind a network (`kpc.format.container.http.HttpSource`)."""

    attempts: float
    report: Callable[[str | None], None]

    @property
    def received_bytes(self) -> int:
        """Bytes received so far."""

    @property
    def has_ranges(self) -> bool:
        """False if the server sends whole files only."""

    def clone(self) -> "RemoteSource":
        """Return a second source of the same file, for another thread."""

    def interrupt(self) -> None:
        """Make a read in another thread fail with InterruptedRead, since other bytes are wanted sooner. What has
        arrived is kept.
        """

    def discard(self) -> None:
        """Drop what is cached: the next read fetches anew, since what came was damaged."""

    def close(self) -> None:
        """Close the connection; a read in progress fails."""


AnySource = str | os.PathLike[str] | bytes | BinaryIO | Source  # what `open_source` takes


def open_source(source: AnySource, *, limit: int = DEFAULT_BUDGET) -> Source:
    """Open a path, an http or https address, bytes, or a seekable binary file; return a `Source` unchanged.

    Args:
        limit: bytes of memory that a file may take if its server has no range requests.

    Raises:
        OSError: the file cannot be read.
        NetworkError: the server cannot be reached or does not have the file, or the address has another scheme.
    """
    if isinstance(source, str) and is_url(source):
        from kpc.format.container.http import HttpSource  # imported late: the HTTP client is slow to load

        return HttpSource(source, limit=limit)
    if isinstance(source, str) and re.match(r"\s*[A-Za-z][A-Za-z0-9+.-]+://", source) and not os.path.exists(source):
        Address.parse(source)  # raises the error that names the schemes
    if isinstance(source, (str, os.PathLike)):
        try:
            return _FileSource(Path(source))
        except FileNotFoundError as error:
            if isinstance(source, str) and lacks_scheme(source):
                raise NetworkError(f"{source}: no such file; an address begins with http:// or https://") from error
            raise
    if isinstance(source, (bytes, bytearray, memoryview)):
        return _BytesSource(bytes(source))
    if isinstance(source, Source):
        return source
    return _FileSource(None, source)


class _BytesSource:
    """Bytes in memory."""

    def __init__(self, data: bytes, name: str = "<bytes>"):
        self.data, self.name, self.size = memoryview(data), name, len(data)

    def read_at(self, offset: int, length: int) -> bytes:
        return bytes(self.data[offset : offset + length])

    def will_read(self, offset: int, length: int) -> None:
        """Do nothing: all bytes are in memory."""


def _identity(file: BinaryIO) -> tuple[int, int]:
    """Return what distinguishes an open file from one that replaces it under its name."""
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino


def _beginning(file: BinaryIO) -> bytes:
    """Return what distinguishes a file from another that is written in its place."""
    file.seek(0)
    return file.read(BEGINNING_BYTES)


class _FileSource:
    """A seekable file object; a file known by its path is opened anew for each read."""

    def __init__(self, path: Path | None, file: BinaryIO | None = None):
        self.path, self.file = path, file
        self.name = str(path if path is not None else getattr(file, "name", "<file>"))
        if file is not None:
            self.size = file.seek(0, io.SEEK_END)
        else:
            if Path(self.name).is_fifo():  # opening it would wait for a writer, without a word
                raise OSError(errno.ESPIPE, "is a pipe, and scenes are read in any order; save it to a file", self.name)
            with open(self.name, "rb") as opened:  # so that an unreadable file is reported here, not later
                self.size, self._identity = opened.seek(0, io.SEEK_END), _identity(opened)
                self._beginning = _beginning(opened)

    def read_at(self, offset: int, length: int) -> bytes:
        if self.file is not None:
            self.file.seek(offset)
            return self.file.read(length)
        with open(self.name, "rb") as opened:
            opened.seek(offset)
            found = opened.read(length)
            # afterwards, since a file that is written anew in place loses its beginning first
            is_same = _identity(opened) == self._identity and opened.seek(0, io.SEEK_END) >= self.size
            if not is_same or not _beginning(opened).startswith(self._beginning):
                raise FormatError(f"{self.name}: changed while it was read; open it again")
            return found

    def will_read(self, offset: int, length: int) -> None:
        """Do nothing: the operating system reads ahead."""
