"""The conformance vectors of planes that groups of a clip share, made of other vectors."""

import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import google_crc32c

from kpc.format.container.container import Codec, Entry, Reader, header_and_index
from kpc.format.container.scene_layout import GROUP_KIND, SCALE_LIMIT
from kpc.tools.vectors.files import HEADER_FIELDS, sealed, with_entry

Stored = tuple[Entry, bytes]  # a chunk, wherever it lies
Refused = tuple[bytes, str, str]  # a file, the name of the error, a part of its message

# Vectors with the same planes but for their grids or weights, of 12 frames.
ALIKE = ("occupancy-noise", "weights")
TRANSFORMED = "transform-implied"  # one of 12 frames, whose planes have other sizes
MIRRORED = ("predictive-implied-left", "predictive-implied-right")  # static ones
SMALLEST = "minimal"  # one of one frame at another rate


def file_of(chunks: Sequence[Stored], value_count: int | None = None) -> bytes:
    """Return a file of chunks, among them groups; None: of the most values that one of these has."""
    if value_count is None:
        offset, layout = HEADER_FIELDS["value_count"]
        groups = (body for entry, body in chunks if entry.kind == GROUP_KIND)
        value_count = max(struct.unpack_from(layout, body, offset)[0] for body in groups)
    entries, bodies = zip(*chunks, strict=True)
    return header_and_index(entries, value_count, compress=False) + b"".join(bodies)


def chunk(kind: str, number: int, start: int, count: int, body: bytes) -> Stored:
    """Return a chunk of a clip that is no plane."""
    return Entry(kind, number, 0, 0, start, count, 0, len(body), len(body), google_crc32c.value(body)), body


def plane_of(scene: bytes, number: int, group: int) -> Stored:
    """Return a plane of a scene as a shared plane that is for groups from `group` on."""
    reader = Reader(scene)
    return replace(reader.index[number], group=group), reader.stored(number)


def without(scene: bytes, numbers: Collection[int]) -> bytes:
    """Return a scene as a group in which some chunks stand for shared planes."""
    reader = Reader(scene)
    entries = [
        replace(entry, codec=Codec.SHARED, stored_length=0, crc=0) if number in numbers else entry
        for number, entry in enumerate(reader.index)
    ]
    own = [reader.stored(number) for number in range(len(entries)) if number not in numbers]
    return header_and_index(entries, reader.header.value_count, compress=False) + b"".join(own)


def put_in(reader: Reader) -> bytes:
    """Return the file of a group, whose chunks are resolved, as a vector holds it."""
    bodies = [reader.stored(number) for number in range(len(reader.index))]
    return header_and_index(reader.index, reader.header.value_count, compress=False) + b"".join(bodies)


def _planes(scene: bytes) -> list[int]:
    """Return the chunks of a scene that are whole planes."""
    index = Reader(scene).index
    places = [(entry.scale, entry.plane) for entry in index if entry.kind == "PLNE"]
    return [
        number
        for number, entry in enumerate(index)
        if entry.kind == "PLNE" and places.count((entry.scale, entry.plane)) == 1
    ]


def valid(scenes: Mapping[str, bytes]) -> dict[str, tuple[bytes, bool]]:
    """Return files by name, and whether they are prefixes; none has a chunk under ZSTD."""
    one, other = (scenes[name] for name in ALIKE)
    late, (left, right) = scenes[TRANSFORMED], (scenes[name] for name in MIRRORED)
    early, later = _planes(one), _planes(late)
    first_group = chunk(GROUP_KIND, 0, 0, 12, without(one, early))
    runs = [
        *(plane_of(one, number, 0) for number in early),
        first_group,
        chunk(GROUP_KIND, 1, 9, 12, without(other, early)),
        *(plane_of(late, number, 2) for number in later),
        chunk(GROUP_KIND, 2, 21, 12, without(late, later)),
        chunk(GROUP_KIND, 3, 33, 12, without(late, later[:1])),
    ]
    # Groups before the planes and in another order; one plane that no group uses, and one that has a group's own beside
    # it.
    stray = replace(plane_of(one, early[0], 1)[0], scale=SCALE_LIMIT - 1), plane_of(one, early[0], 1)[1]
    strewn = [
        chunk(GROUP_KIND, 1, 9, 12, without(other, early[1:])),
        first_group,
        stray,
        *(plane_of(one, number, 0) for number in reversed(early)),
    ]
    sides = [
        *(plane_of(left, number, 0) for number in _planes(left)),
        chunk(GROUP_KIND, 0, 0, 1, without(left, _planes(left))),
        chunk(GROUP_KIND, 1, 1, 1, without(right, _planes(right))),
    ]
    strewn_file, runs_file = file_of(strewn), file_of(runs)
    cuts = [Reader(strewn_file).index[-2].offset, Reader(runs_file).index[-2].offset]
    return {
        "groups-shared": (runs_file, False),
        "groups-shared-strewn": (strewn_file, False),
        "groups-shared-implied": (file_of(sides), False),
        "groups-shared-prefix": (strewn_file[: cuts[0]], True),
        "groups-shared-cut": (runs_file[: cuts[1]], True),
    }


def invalid(scenes: Mapping[str, bytes]) -> dict[str, Refused]:
    """Return files by name, the error and a part of its message."""
    scene = scenes[SMALLEST]
    number = _planes(scene)[0]
    group, plane = without(scene, [number]), plane_of(scene, number, 0)
    first, most = chunk(GROUP_KIND, 0, 0, 1, group), Reader(scene).header.value_count

    def clip(*planes: Stored) -> bytes:
        return file_of([*planes, first])

    def clip_of(group: bytes, shared: Stored = plane) -> bytes:
        return file_of([shared, chunk(GROUP_KIND, 0, 0, 1, group)])

    def in_group(**fields: int) -> bytes:
        """Return the clip with other fields of the entry that stands for a plane."""
        changed = group
        for name, value in fields.items():
            changed = with_entry(changed, number, name, value)
        return clip_of(sealed(changed))

    def of_plane(**fields: Any) -> bytes:
        return clip((replace(plane[0], **fields), plane[1]))

    def bytes_in_group() -> bytes:
        """Return the clip in which the chunk that stands for a plane has bytes of its own."""
        reader = Reader(scene)
        entries = [replace(e, codec=Codec.SHARED) if k == number else e for k, e in enumerate(reader.index)]
        bodies = b"".join(reader.stored(k) for k in range(len(entries)))
        return clip_of(header_and_index(entries, most, compress=False) + bodies)

    decoder = next(k for k, entry in enumerate(Reader(scene).index) if entry.kind == "DECO")
    absent, own, place = "which the clip does not have", "has bytes or a first row", "a place that no group has"
    files = {
        "alone": (group, "stands for a shared plane"),
        "missing": (clip(), absent),
        "later": (file_of([plane_of(scene, number, 1), first, chunk(GROUP_KIND, 1, 1, 1, scene)]), absent),
        "other-plane": (of_plane(plane=(plane[0].plane + 1) % 3), absent),
        "other-scale": (of_plane(scale=1), absent),
        "rows": (of_plane(row_count=3), "stands for 2 rows"),
        "length": (in_group(raw_length=4), "and a length of 4"),
        "start": (in_group(row_start=1), own),
        "crc": (in_group(crc=1), own),
        "bytes": (bytes_in_group(), own),
        "decoder": (clip_of(without(scene, [decoder])), "uses codec 8"),
        "twice": (clip(plane, plane), "is there twice"),
        "group": (clip(plane_of(scene, number, 1)), place),
        "scale": (of_plane(scale=SCALE_LIMIT), place),
        "plane": (of_plane(plane=6), place),
        "first-row": (of_plane(row_start=1), place),
        "empty": (of_plane(row_count=0), place),
        "shared": (clip((replace(plane[0], codec=Codec.SHARED), plane[1])), place),
        "codec": (of_plane(codec=Codec.MOTION), "uses codec 4"),
        "damaged": (clip((plane[0], plane[1][:-1] + b"\7")), "is damaged"),
        "raw-length": (
            clip_of(sealed(with_entry(group, number, "raw_length", 6)), (replace(plane[0], raw_length=6), plane[1])),
            "not the 6 it claims",
        ),
    }
    return {f"shared-{name}": (data, "FormatError", message) for name, (data, message) in files.items()}
