"""Planes that groups of a clip share, which are stored once beside the groups (spec/kpc-format.md, "Groups").

A PLNE chunk of a group under SHARED stands for such a plane. Reading puts the entry of the shared plane in its place,
with an offset at which the slice of a file that is a group reads beside itself; so whatever reads scenes reads groups
that share planes, too. Writing finds what groups store alike.
"""

import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import google_crc32c

from kpc.format.common.errors import FormatError
from kpc.format.container.container import (
    ENTRY,
    EXPANSION_LIMIT,
    HEADER,
    Beside,
    Codec,
    Entry,
    Reader,
    header_and_index,
)
from kpc.format.container.scene_layout import PLANE_KIND, SCALE_LIMIT
from kpc.format.container.slices import BESIDE, Pieces
from kpc.format.container.sources import RemoteSource, Source
from kpc.format.scene.scene import ALL_PLANES

# The part of a memory budget that the bytes of shared planes may take which are kept for other groups.
KEPT_SHARE = 1 / 8


class SharedPlanes:
    """The shared planes of a file. Of a file on a server, their bytes are kept, so that they are fetched once for all
    groups, which several threads may read; only threads that begin at the same time may fetch some twice.

    Args:
        reader: of the file; learns which of its chunks are shared planes.
        group_count: number of groups.
        budget: bytes of memory for a group.

    Attributes:
        numbers: of their chunks.

    Raises:
        FormatError: one breaks a rule of the format.
    """

    def __init__(self, reader: Reader, group_count: int, budget: int) -> None:
        self._reader = reader
        self.numbers = [number for number, entry in enumerate(reader.index) if entry.kind == PLANE_KIND]
        self._places: dict[tuple[int, int], list[tuple[int, int]]] = {}  # first group and chunk, by scale and plane
        for number in self.numbers:
            entry = reader.index[number]
            self._check(number, entry, group_count)
            self._places.setdefault((entry.scale, entry.plane), []).append((entry.group, number))
        for found in self._places.values():
            found.sort()
            for (group, _), (other, number) in pairwise(found):
                if group == other:
                    raise FormatError(f"{self._named(number)} is there twice for group {group}; join the clip again")
        reader.beside = {number: self._beside(number) for number in self.numbers}
        self._entries = {(entry.offset, entry.stored_length): entry for entry in map(self._entry, self.numbers)}
        self._limit = int(budget * KEPT_SHARE)
        self._kept: OrderedDict[tuple[int, int], bytes] = OrderedDict()  # the one that was used last comes last
        self._keeping = threading.Lock()
        self._fetching = {place: threading.Lock() for place in self._entries}

    def _entry(self, number: int) -> Entry:
        return self._reader.index[number]

    def _beside(self, number: int) -> Beside:
        entry = self._entry(number)
        plane = ALL_PLANES[entry.plane] if entry.plane < len(ALL_PLANES) else entry.plane
        return Beside(number, f"the shared plane {plane} of scale {entry.scale}", self._reader.available(number))

    def _named(self, number: int) -> str:
        return f"{self._reader.name}: chunk {number} (PLNE), {self._beside(number).name},"

    def _check(self, number: int, entry: Entry, group_count: int) -> None:
        if entry.codec not in (Codec.RAW, Codec.ZSTD, Codec.PREDICTIVE, Codec.TRANSFORM, Codec.SHARED):
            raise FormatError(f"{self._named(number)} uses codec {entry.codec}, unknown to this reader; update kpc")
        if (
            entry.codec == Codec.SHARED
            or entry.group >= group_count
            or entry.scale >= SCALE_LIMIT
            or entry.plane >= len(ALL_PLANES)
            or entry.row_start
            or not entry.row_count
        ):
            raise FormatError(
                f"{self._named(number)} has no rows or no bytes of its own, or a place that no group has: rows from "
                f"{entry.row_start}, {entry.row_count} of them, for groups from {entry.group} on; join the clip again"
            )

    @property
    def kept_bytes(self) -> int:
        """The most bytes that are kept in memory."""
        if not isinstance(self._reader.source, RemoteSource):
            return 0
        return min(sum(length for _, length in self._entries), self._limit)

    def are_there(self, group: int) -> bool:
        """Return whether all shared planes are there that a group may use; False only in a partial file."""
        chunks = (self._chunk(scale, plane, group) for scale, plane in self._places)
        return all(chunk is None or self._reader.available(chunk) for chunk in chunks)

    def resolve(self, reader: Reader, group: int) -> None:
        """Put the shared planes in the place of the chunks of a group that stand for them.

        Args:
            reader: of the group; its index is changed.
            group: its number.

        Raises:
            FormatError: a chunk stands for no shared plane, or for one of another size.
        """
        index, beside = list(reader.index), {}
        for number, entry in enumerate(index):
            if entry.kind == PLANE_KIND and entry.codec == Codec.SHARED:
                chunk = self._stood_for(f"{reader.name}: chunk {number} (PLNE)", entry, group)
                shared = self._entry(chunk)
                at = BESIDE + shared.offset
                index[number] = replace(
                    entry, codec=shared.codec, stored_length=shared.stored_length, crc=shared.crc, offset=at
                )
                beside[number] = self._reader.beside[chunk]
        reader.index, reader.beside, reader.kept_bytes = tuple(index), beside, self.kept_bytes

    def _stood_for(self, named: str, entry: Entry, group: int) -> int:
        """Return the chunk that one of a group stands for."""
        if entry.row_start or entry.stored_length or entry.crc:
            raise FormatError(f"{named} is shared and has bytes or a first row of its own; join the clip again")
        chunk = self._chunk(entry.scale, entry.plane, group)
        if chunk is None:
            raise FormatError(
                f"{named} stands for a shared plane {entry.plane} of scale {entry.scale}, which the clip does not "
                "have; join the clip again"
            )
        shared = self._entry(chunk)
        if (entry.row_count, entry.raw_length) != (shared.row_count, shared.raw_length):
            raise FormatError(
                f"{named} stands for {entry.row_count} rows and a length of {entry.raw_length:,}, the shared plane in "
                f"chunk {chunk} of the clip has {shared.row_count} and {shared.raw_length:,}; join the clip again"
            )
        return chunk

    def _chunk(self, scale: int, plane: int, group: int) -> int | None:
        """Return the chunk of the shared plane of a scale and plane that is for a group."""
        found = self._places.get((scale, plane), [])
        at = bisect_right(found, group, key=lambda one: one[0])
        return found[at - 1][1] if at else None

    def read(self, source: Source, offset: int, length: int, until: int) -> bytes:
        """Return the bytes of a shared plane.

        Args:
            source: the file, by a connection of the thread that reads.
            offset, length: where they are.
            until: the end of what will be read next, in order; it is fetched with the same request.

        Raises:
            FormatError, NetworkError: the source cannot be read.
        """
        place = offset, length
        if not isinstance(source, RemoteSource) or place not in self._entries:
            return source.read_at(offset, length)
        with self._fetching[place]:  # a thread that wants the same waits for it
            with self._keeping:
                if (kept := self._kept.get(place)) is not None:
                    self._kept.move_to_end(place)
                    return kept
            source.will_read(offset, self._end_of_unkept(offset, until) - offset)
            body = source.read_at(offset, length)
            # What came damaged must be fetched again.
            if length <= self._limit and google_crc32c.value(body) == self._entries[place].crc:
                self._keep(place, body)
            return body

    def _keep(self, place: tuple[int, int], body: bytes) -> None:
        with self._keeping:
            self._kept[place] = body
            while sum(map(len, self._kept.values())) > self._limit:
                self._kept.popitem(last=False)

    def _end_of_unkept(self, offset: int, until: int) -> int:
        """Return where the shared planes end that lie one after the other from `offset` on, none of which is kept."""
        end = offset
        with self._keeping:
            for place in sorted(self._entries):
                if place[0] == end and end + place[1] <= until and place not in self._kept:
                    end += place[1]
        return end


def put_back(reader: Reader) -> Source:
    """Return the file of a group by itself: what it shares lies in it, in its place.

    Args:
        reader: of the group, whose chunks `SharedPlanes.resolve` has put in place.
    """
    if not reader.beside:
        return reader.source
    head = header_and_index(reader.index, reader.header.value_count)
    return Pieces(head, reader.source, [(entry.offset, entry.stored_length) for entry in reader.index], reader.name)


# --- writing


def stored_alike(readers: Sequence[Reader]) -> list[dict[int, int]]:
    """Return for each group which of its chunks are planes that groups next to it store byte for byte alike: the number
    of each, and the first of these groups.

    Planes in several segments, and those that are no longer than an entry of the index, are left out, and so are groups
    that would be too small without what they share to claim their values.

    Raises:
        FormatError: a plane is damaged.
    """
    found: list[dict[int, int]] = [{} for _ in readers]
    sole = [_sole_segments(reader) for reader in readers]
    for group, (one, other) in enumerate(pairwise(readers)):
        for place, number in sole[group].items():
            next_number = sole[group + 1].get(place)
            if next_number is not None and _are_alike(one, number, other, next_number):
                found[group + 1][next_number] = found[group].setdefault(number, group)
    return found


def _sole_segments(reader: Reader) -> dict[tuple[int, int], int]:
    """Return the chunks of a scene that may be shared, by scale and plane."""
    chunks: dict[tuple[int, int], list[int]] = {}
    for number, entry in enumerate(reader.index):
        if entry.kind == PLANE_KIND:
            chunks.setdefault((entry.scale, entry.plane), []).append(number)
    sole = {place: numbers[0] for place, numbers in chunks.items() if len(numbers) == 1}
    sole = {place: number for place, number in sole.items() if reader.index[number].stored_length > ENTRY.size}
    own = HEADER.size + sum(entry.stored_length for entry in reader.index)
    own -= sum(reader.index[number].stored_length for number in sole.values())
    is_large_enough = max(reader.header.value_count, reader.header.largest_raw) <= own * EXPANSION_LIMIT
    return sole if is_large_enough else {}


def _are_alike(one: Reader, number: int, other: Reader, other_number: int) -> bool:
    entries = [replace(reader.index[k], offset=0) for reader, k in ((one, number), (other, other_number))]
    return entries[0] == entries[1] and one.stored(number) == other.stored(other_number)


def without_shared(reader: Reader, shared: Mapping[int, int]) -> bytes:
    """Return the file of a group in which some chunks stand for shared planes.

    Args:
        reader: of its whole file.
        shared: the numbers of these chunks.

    Raises:
        FormatError: a chunk is damaged.
    """
    entries = [
        replace(entry, codec=Codec.SHARED, stored_length=0, crc=0) if number in shared else entry
        for number, entry in enumerate(reader.index)
    ]
    own = [reader.stored(number) for number in range(len(entries)) if number not in shared]
    return b"".join([header_and_index(entries, reader.header.value_count), *own])
