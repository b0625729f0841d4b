"""Runs of chunks that are adjacent in a file, which a remote source fetches with one request."""

from collections.abc import Iterable, Sequence

from kpc.format.container.container import Entry, Reader


def adjacent_runs(index: Sequence[Entry], numbers: Iterable[int], most_bytes: float = float("inf")) -> list[list[int]]:
    """Split chunks, in the order given, into runs that are adjacent in the file and at most `most_bytes` long."""
    found: list[list[int]] = []
    end = size = 0
    for number in numbers:
        entry = index[number]
        if found and entry.offset == end and size + entry.stored_length <= most_bytes:
            found[-1].append(number)
        else:
            found.append([number])
            size = 0
        end, size = entry.offset + entry.stored_length, size + entry.stored_length
    return found


def announce(reader: Reader, run: Sequence[int]) -> None:
    """Announce to the source that a run of adjacent chunks will be read in order."""
    start, last = reader.index[run[0]].offset, reader.index[run[-1]]
    reader.source.will_read(start, last.offset + last.stored_length - start)
