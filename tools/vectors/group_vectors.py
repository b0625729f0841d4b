"""The conformance vectors of clips in groups, made of other vectors."""

from collections.abc import Sequence
from typing import Any

from kpc.format.container.container import Reader
from kpc.format.container.groups import Groups
from kpc.format.container.scene_layout import GROUP_KIND
from kpc.tools.vectors import shared_vectors
from kpc.tools.vectors.files import sealed, with_entry
from kpc.tools.vectors.metadata_vectors import MINIMAL
from kpc.tools.vectors.shared_vectors import chunk, file_of, put_in

TIMES = (0.0, 0.125, 0.3, 0.31, 0.32, 0.5, 0.6875, 1.0)

# Vectors of 12, 12, 12 and 1 frames at one rate.
SCENES = ("moved-contracted", "hybrid-moved", "one-texel", "wrap")
SLOWER = "minimal"  # a vector of one frame at another rate

NOTE = ("note", b"readers skip what they need not know")

Group = tuple[int, int, bytes]  # first frame, number of frames, and file of a group


def packed(
    groups: Sequence[Group], *, beside: Sequence[tuple[str, bytes]] = (), value_count: int | None = None
) -> bytes:
    """Return a file of groups, whether they make up a clip or not, with chunks of other kinds after them."""
    chunks = [chunk(GROUP_KIND, number, *group) for number, group in enumerate(groups)]
    return file_of([*chunks, *(chunk(kind, 0, 0, 0, body) for kind, body in beside)], value_count)


def valid(scenes: dict[str, bytes]) -> dict[str, tuple[bytes, bool]]:
    """Return files by name, and whether they are prefixes, made of the other vectors `scenes`; none has a chunk under
    ZSTD.
    """
    one, other, third, still = (scenes[name] for name in SCENES)
    joined = packed([(0, 12, one), (9, 12, other), (20, 12, third), (32, 1, still)])
    return {
        "groups": (joined, False),
        "groups-apart": (packed([(7, 12, one), (19, 12, third)], beside=[NOTE]), False),
        "groups-metadata": (packed([(0, 12, third)], beside=[NOTE, ("meta", MINIMAL)]), False),
        "groups-one": (packed([(40, 12, third)]), False),
        "groups-prefix": (joined[: Reader(joined).index[1].offset + len(other) // 2], True),
    } | shared_vectors.valid(scenes)


def invalid(scenes: dict[str, bytes]) -> dict[str, tuple[bytes, str, str]]:
    """Return files by name, the error and a part of its message."""
    one, other, third, still = (scenes[name] for name in SCENES)
    good = packed([(0, 12, third), (9, 12, other)])

    def changed(field: str, number: int) -> bytes:
        """Return the file with a field of the second group's entry changed."""
        return sealed(with_entry(good, 1, field, number))

    broken, frames = "FormatError", "each must begin and end later"
    return {
        "groups-gap": (packed([(0, 12, third), (13, 12, other)]), broken, frames),
        "groups-back": (packed([(3, 12, third), (0, 12, other)]), broken, frames),
        "groups-within": (packed([(0, 12, third), (0, 12, other)]), broken, frames),
        "groups-three": (packed([(0, 12, third), (9, 12, other), (11, 12, one)]), broken, "two groups at most"),
        "groups-long": (packed([(0, 12, third), (1, 1 << 24, other)]), broken, "exceed the limit"),
        "groups-numbers": (changed("group", 2), broken, "not numbered consecutively"),
        "groups-twice": (changed("group", 0), broken, "not numbered consecutively"),
        "groups-codec": (changed("codec", 1), broken, "has a codec"),
        "groups-raw-length": (changed("raw_length", 7), broken, "has a codec"),
        "groups-plane": (changed("plane", 1), broken, "has a codec"),
        "groups-empty": (changed("row_count", 0), broken, "has a codec"),
        "groups-count": (changed("row_count", 13), broken, "not 13 at"),
        "groups-rate": (packed([(0, 1, still), (1, 1, scenes[SLOWER])]), broken, "not 1 at"),
        "groups-values": (packed([(0, 12, third), (9, 12, other)], value_count=7), broken, "more than the header's 7"),
        "groups-beside": (packed([(0, 12, third)], beside=[("SCNE", b"")]), broken, "lies outside the groups"),
        "groups-metadata-twice": (packed([(0, 12, third)], beside=2 * [("meta", MINIMAL)]), broken, "2 meta chunks"),
        "groups-metadata-array": (packed([(0, 12, third)], beside=[("meta", b"[]")]), broken, "is no object"),
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
    } | shared_vectors.invalid(scenes)


def described(data: bytes, partial: bool, names: dict[bytes, str]) -> dict[str, Any]:
    """Return what a decoder must find, as `description.described` does; `names` are those of the vectors that are
    groups.
    """
    groups = Groups(data, allow_partial=partial)
    entries = sorted((entry for entry in groups.reader.index if entry.kind == "GRUP"), key=lambda entry: entry.group)
    shown = [(time, *groups.timeline.at(time)) for time in TIMES]
    has_metadata = any(entry.kind == "meta" for entry in groups.reader.index)
    return {
        "partial": partial,
        "zstd": None,
        **({"metadata": groups.metadata().document} if has_metadata else {}),
        "groups": [
            {
                "row_start": entry.row_start,
                "row_count": entry.row_count,
                "scene": names.get(put_in(groups.open(number))) if groups.available(number) else None,
            }
            for number, entry in enumerate(entries)
        ],
        "times": [
            {
                "time": time,
                "group": number,
                "local_time": round(time_in_it, 9),
                "blend": {str(part): round(share, 9) for part, _, share in groups.timeline.blend_at(time)},
            }
            for time, number, time_in_it in shown
        ],
    }
