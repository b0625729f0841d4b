"""A part of a source as a source of its own: a file within a file."""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Protocol

from kpc.format.container.sources import RemoteSource, Source

# From here on, positions in a part are those in the whole source: of what the part needs that lies beside it.
BESIDE = 1 << 60


class BesideReader(Protocol):
    """What reads beside a part."""

    def read(self, source: Source, offset: int, length: int, until: int) -> bytes:
        """Return `length` bytes of a source from `offset` on; all up to `until` will be read next, in order."""


def sliced(source: Source, offset: int, length: int, name: str, beside: BesideReader | None = None) -> Source:
    """Return `length` bytes of a source from `offset` on as a source, remote if that is; fewer where it ends sooner.

    Args:
        beside: reads from BESIDE on; None if nothing does.
    """
    if isinstance(source, RemoteSource):
        return RemoteSlice(source, offset, length, name, beside)
    return Slice(source, offset, length, name, beside)


class Slice:
    """A part of a local source, see `sliced`."""

    def __init__(self, source: Source, offset: int, length: int, name: str, beside: BesideReader | None = None) -> None:
        self.name, self.size = name, max(min(length, source.size - offset), 0)
        self._source, self._offset, self._beside = source, offset, beside
        self._announced = range(0)  # positions beside the part that will be read next

    def read_at(self, offset: int, length: int) -> bytes:
        if offset >= BESIDE and self._beside is not None:
            at = offset - BESIDE
            until = self._announced.stop if at in self._announced else 0
            return self._beside.read(self._source, at, length, max(until, at + length))
        return self._source.read_at(self._offset + offset, max(min(length, self.size - offset), 0))

    def will_read(self, offset: int, length: int) -> None:
        if offset >= BESIDE:
            self._announced = range(offset - BESIDE, offset - BESIDE + length)
        else:
            self._source.will_read(self._offset + offset, max(min(length, self.size - offset), 0))


class RemoteSlice(Slice):
    """A part of a remote source that it has to itself: interrupting, discarding and closing go on to that source."""

    def __init__(
        self, source: RemoteSource, offset: int, length: int, name: str, beside: BesideReader | None = None
    ) -> None:
        super().__init__(source, offset, length, name, beside)
        self._remote = source

    @property
    def received_bytes(self) -> int:
        return self._remote.received_bytes

    @property
    def has_ranges(self) -> bool:
        return self._remote.has_ranges

    @property
    def attempts(self) -> float:
        return self._remote.attempts

    @attempts.setter
    def attempts(self, most: float) -> None:
        self._remote.attempts = most

    @property
    def report(self) -> Callable[[str | None], None]:
        return self._remote.report

    @report.setter
    def report(self, function: Callable[[str | None], None]) -> None:
        self._remote.report = function

    def interrupt(self) -> None:
        self._remote.interrupt()

    def discard(self) -> None:
        self._remote.discard()

    def close(self) -> None:
        self._remote.close()

    def clone(self) -> RemoteSource:
        return RemoteSlice(self._remote.clone(), self._offset, self.size, self.name, self._beside)


class Pieces:
    """Bytes in memory and parts of a source, one after the other, as a source.

    Args:
        head: the bytes, which come first.
        source: of the parts.
        parts: offset and length of each.
        name: for messages.
    """

    def __init__(self, head: bytes, source: Source, parts: Sequence[tuple[int, int]], name: str) -> None:
        self.name, self._head, self._source = name, head, source
        self._parts = [part for part in parts if part[1]]
        self._starts = list(accumulate((length for _, length in self._parts), initial=len(head)))
        self.size = self._starts[-1]

    def read_at(self, offset: int, length: int) -> bytes:
        found, end = [self._head[offset : offset + length]], min(offset + length, self.size)
        at = max(offset, len(self._head))
        while at < end:
            number = bisect_right(self._starts, at) - 1
            start, stop = at - self._starts[number], min(end, self._starts[number + 1]) - self._starts[number]
            # Whole parts are read, since what reads beside a part knows no other.
            found.append(self._source.read_at(*self._parts[number])[start:stop])
            at = self._starts[number] + stop
        return b"".join(found)

    def will_read(self, offset: int, length: int) -> None:
        """Do nothing: the parts lie anywhere."""
