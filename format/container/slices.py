"""A part of a source as a source of its own: a file within a file."""

from collections.abc import Callable

from kpc.format.container.sources import RemoteSource, Source


def sliced(source: Source, offset: int, length: int, name: str) -> Source:
    """Return `length` bytes of a source from `offset` on as a source, remote if that is; fewer where it ends sooner."""
    return (
        RemoteSlice(source, offset, length, name)
        if isinstance(source, RemoteSource)
        else Slice(source, offset, length, name)
    )


class Slice:
    """A part of a local source, see `sliced`."""

    def __init__(self, source: Source, offset: int, length: int, name: str) -> None:
        self.name, self.size = name, max(min(length, source.size - offset), 0)
        self._source, self._offset = source, offset

    def read_at(self, offset: int, length: int) -> bytes:
        return self._source.read_at(self._offset + offset, max(min(length, self.size - offset), 0))

    def will_read(self, offset: int, length: int) -> None:
        self._source.will_read(self._offset + offset, max(min(length, self.size - offset), 0))


class RemoteSlice(Slice):
    """A part of a remote source that it has to itself: interrupting, discarding and closing go on to that source."""

    def __init__(self, source: RemoteSource, offset: int, length: int, name: str) -> None:
        super().__init__(source, offset, length, name)
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
        return RemoteSlice(self._remote.clone(), self._offset, self.size, self.name)
