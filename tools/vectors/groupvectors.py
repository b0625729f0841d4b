"""The conformance vectors of clips in groups, made of other vectors: a part of `kpc.tools.vectors.specvectors`."""

import struct
from collections.abc import Sequence
from typing import Any

import google_crc32c
from kpc.format.container.container import ENTRY, HEADER, Entry, Reader, header_and_index
from kpc.format.container.groups import Groups

TIMES = (0.0, 0.125, 0.3, 0.31, 0.32, 0.5, 0.6875, 1.0)

SCENES = ("moved-contracted", "hybrid-moved", "one-texel", "wrap")
"""Vectors of 12, 12, 12 and 1 frames at one rate."""
DRAFT = "version-0"
"""The third of them, as a file of version 0."""
SLOWER = "minimal"
"""One of a frame at another."""

NOTE = ("note", b"readers skip what they need not know")

Group = tuple[int, int, bytes]
"""First frame, number of frames, and file of a group."""


def packed(
    groups: Sequence[Group], *, beside: Sequence[tuple[str, bytes]] = (), value_count: int | None = None
) -> bytes:
    """A clip in groups, whether they make one or not; with chunks of other kinds after them."""
    bodies = [body for *_, body in groups] + [body for _, body in beside]
    places = [("GRUP", number, start, count) for number, (start, count, _) in enumerate(groups)] + [
        (kind, 0, 0, 0) for kind, _ in beside
    ]
    entries = [
        Entry(kind, number, 0, 0, start, count, 0, len(body), len(body), google_crc32c.value(body))
        for (kind, number, start, count), body in zip(places, bodies, strict=True)
    ]
    most = max(struct.unpack_from("<Q", body, 40)[0] for *_, body in groups) if value_count is None else value_count
    return header_and_index(entries, most) + b"".join(bodies)


def of_the_draft(data: bytes) -> bytes:
    """The same file as it was when the format was a draft, of version 0."""
    head = data[:8] + struct.pack("<H", 0) + data[10:60]
    return head + struct.pack("<I", google_crc32c.value(head)) + data[64:]


def valid(scenes: dict[str, bytes]) -> dict[str, tuple[bytes, bool]]:
    """Files by name, and whether they are prefixes; `scenes`: other vectors. None holds a zstd frame, so these do not either."""
    one, other, third, still = (scenes[name] for name in SCENES)
    joined = packed([(0, 12, one), (9, 12, other), (20, 12, third), (32, 1, still)])
    return {
        "groups": (joined, False),
        "groups-apart": (packed([(7, 12, one), (19, 12, third)], beside=[NOTE]), False),
        "groups-one": (packed([(40, 12, third)]), False),
        "groups-versions": (packed([(0, 12, scenes[DRAFT]), (12, 12, other)]), False),
        "version-0-groups": (of_the_draft(packed([(40, 12, scenes[DRAFT])])), False),
        "groups-prefix": (joined[: Reader(joined).index[1].offset + len(other) // 2], True),
    }


def invalid(scenes: dict[str, bytes]) -> dict[str, tuple[bytes, str, str]]:
    """Files by name, the error and a part of its message."""
    one, other, third, still = (scenes[name] for name in SCENES)
    good = packed([(0, 12, third), (9, 12, other)])
    entry = HEADER.size + ENTRY.size  # of the second group

    def changed(at: int, layout: str, number: int) -> bytes:
        out = bytearray(good)
        struct.pack_into(layout, out, at, number)
        struct.pack_into("<I", out, 56, google_crc32c.value(bytes(out[HEADER.size : HEADER.size + 2 * ENTRY.size])))
        struct.pack_into("<I", out, 60, google_crc32c.value(bytes(out[:60])))
        return bytes(out)

    broken, frames = "FormatError", "each must begin and end later"
    return {
        "groups-gap": (packed([(0, 12, third), (13, 12, other)]), broken, frames),
        "groups-back": (packed([(3, 12, third), (0, 12, other)]), broken, frames),
        "groups-within": (packed([(0, 12, third), (0, 12, other)]), broken, frames),
        "groups-three": (packed([(0, 12, third), (9, 12, other), (11, 12, one)]), broken, "not in three"),
        "groups-long": (packed([(0, 12, third), (1, 1 << 24, other)]), broken, "frames are more than"),
        "groups-numbers": (changed(entry + 4, "<H", 2), broken, "not numbered from 0"),
        "groups-twice": (changed(entry + 4, "<H", 0), broken, "not numbered from 0"),
        "groups-codec": (changed(entry + 16, "<H", 1), broken, "claims a codec"),
        "groups-raw-length": (changed(entry + 24, "<I", 7), broken, "claims a codec"),
        "groups-plane": (changed(entry + 7, "<B", 1), broken, "claims a codec"),
        "groups-empty": (changed(entry + 12, "<I", 0), broken, "claims a codec"),
        "groups-count": (changed(entry + 12, "<I", 13), broken, "not 13 at"),
        "groups-rate": (packed([(0, 1, still), (1, 1, scenes[SLOWER])]), broken, "not 1 at"),
        "groups-values": (packed([(0, 12, third), (9, 12, other)], value_count=7), broken, "more than the header's 7"),
        "groups-beside": (packed([(0, 12, third)], beside=[("SCNE", b"")]), broken, "lies beside groups"),
        "groups-in-groups": (packed([(0, 21, good)]), broken, "a clip in groups"),
        "groups-no-file": (
            packed([(0, 12, third), (9, 12, other)])[: -len(other)] + bytes(len(other)),
            broken,
            "not a .kpc file",
        ),
        "groups-cut": (packed([(0, 12, third), (9, 12, other[:-1])]), broken, "cut off"),
        "groups-trailing": (packed([(0, 12, third), (9, 12, other + b"\0")]), broken, "follow the end"),
        "groups-damaged": (
            packed([(0, 12, third), (9, 12, other[:-1] + bytes([other[-1] ^ 1]))]),
            broken,
            "is damaged",
        ),
    }


def described(data: bytes, partial: bool, names: dict[bytes, str]) -> dict[str, Any]:
    """As `kpc.tools.vectors.specvectors.described`: what a decoder must find. `names`: of the vectors that groups are."""
    groups = Groups(data, allow_partial=partial)
    entries = sorted((entry for entry in groups.reader.index if entry.kind == "GRUP"), key=lambda entry: entry.group)
    shown = [(time, *groups.timeline.at(time)) for time in TIMES]
    return {
        "partial": partial,
        "zstd": None,
        "groups": [
            {
                "row_start": entry.row_start,
                "row_count": entry.row_count,
                "scene": names.get(data[entry.offset : entry.offset + entry.stored_length]),
            }
            for entry in entries
        ],
        "times": [
            {
                "time": time,
                "group": number,
                "time_in_it": round(time_in_it, 9),
                "mix": {str(part): round(share, 9) for part, _, share in groups.timeline.blend_at(time)},
            }
            for time, number, time_in_it in shown
        ],
    }
