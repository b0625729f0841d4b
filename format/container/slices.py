"""A part of a source as a source of its own: a file within a file."""

from collections.abc import Callable

from kpc.format.container.container import RemoteSource, Source


def sliced(source: Source, offset: int, length: int, name: str) -> Source:
    """`length` bytes of a source from `offset` on, fewer where it ends sooner; on a network if that is."""
    return (
        RemoteSlice(source, offset, length, name)
        if isinstance(source, RemoteSource)
        else Slice(source, offset, length, name)
    )


class Slice:
    """See `sliced`."""

    def __init__(self, source: Source, offset: int, length: int, name: str) -> None:
        self.name, self.size = name, max(min(length, source.size - offset), 0)
        self._source, self._offset = source, offset

    def read_at(self, offset: int, length: int) -> bytes:
        return self._source.read_at(self._offset + offset, max(min(length, self.size - offset), 0))

    def hold(self, offset: int, length: int) -> None:
        self._source.hold(self._offset + offset, max(min(length, self.size - offset), 0))


class RemoteSlice(Slice):
    """The same of a source behind a network, which it has to itself: what is done to the one is done to the other."""

    def __init__(self, source: RemoteSource, offset: int, length: int, name: str) -> None:
        super().__init__(source, offset, length, name)
        self._remote = source

    @property
    def received(self) -> int:
        return self._remote.received

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
    def say(self) -> Callable[[str | None], None]:
        return self._remote.say

    @say.setter
    def say(self, told: Callable[[str | None], None]) -> None:
        self._remote.say = told

    def interrupt(self) -> None:
        self._remote.interrupt()

    def forget(self) -> None:
        self._remote.forget()

    def close(self) -> None:
        self._remote.close()

    def another(self) -> RemoteSource:
        return RemoteSlice(self._remote.another(), self._offset, self.size, self.name)
