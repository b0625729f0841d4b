"""Plane segments under codecs 2 and 3, whichever way they are told: symbol by symbol (`kpc.format.symbols`) or in blocks (`kpc.format.blocks`)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kpc.format.blocks import decode_blocks, goes_on_from_borders, holds_blocks
from kpc.format.container import CODEC_BORDERS, CODEC_SYMBOLS
from kpc.format.symbols import Guide, decode_symbols, encode_symbols, guide_of


SEGMENT_ROWS, WHOLE = 32, 16
"""Of a time plane, the fewest that are decoded together, but for what is left at its end: each segment begins without neighbours and with
counters that know nothing. With 16 rows files of room and soldier are two and three percent larger; with 32 rows and a rest of 11, as their
frames have it, shelf_hand's are. And rows, of which segments have a multiple: blocks do not end with them (`kpc.format.blocks`)."""


def rows_of_segments(rows: int, over_time: bool) -> int:
    """In each segment, but the last, of a plane of so many rows: all of a space plane's."""
    if not over_time:
        return rows
    count = max(1, rows // SEGMENT_ROWS)
    return -(-rows // (count * WHOLE)) * WHOLE


@dataclass(frozen=True, eq=False)
class Told:
    """A plane that is told in blocks. Its symbols follow from these, which cannot be found from them.

    Attributes:
        segments: of each by its first row, what is stored.
    """

    segments: Mapping[int, bytes]


PlaneGuide = Guide | Told
SegmentGuide = Guide | bytes


def guide_at(guide: PlaneGuide | None, start: int) -> SegmentGuide | None:
    """Of the segment that begins in a row."""
    return guide.segments.get(start) if isinstance(guide, Told) else guide


def guide_together(guides: Mapping[int, SegmentGuide | None]) -> PlaneGuide | None:
    """Of a plane whose segments, by their first rows, have these: of those in blocks if there are any, else the one that all have that have any
    (what has none was smaller as it is)."""
    if bodies := {start: guide for start, guide in guides.items() if isinstance(guide, bytes)}:
        return Told(bodies)
    known = [guide for guide in guides.values() if isinstance(guide, Guide)]
    return known[0] if known and all(guide == known[0] for guide in known) else None


def encode_coded(symbols: np.ndarray, coded: np.ndarray, guide: SegmentGuide | None = None) -> bytes:
    """Code (H, W, M) int8 symbols, 0 wherever (H, W) `coded` is False: as `own_guide` has it, if they have one, else symbol by symbol."""
    return guide if isinstance(guide, bytes) else encode_symbols(symbols, coded, guide)


def own_guide(guide: SegmentGuide | None, symbols: np.ndarray, coded: np.ndarray) -> SegmentGuide | None:
    """A guide, unless it tells other symbols in blocks."""
    if not isinstance(guide, bytes):
        return guide
    told, where = decode_blocks(guide, *symbols.shape)
    return guide if np.array_equal(told, symbols) and np.array_equal(where, coded) else None


def codec_of(body: SegmentGuide | None) -> int:
    """Of what `encode_coded` makes by a guide, or made."""
    return CODEC_BORDERS if isinstance(body, bytes) and goes_on_from_borders(body) else CODEC_SYMBOLS


def decode_coded(body: bytes, rows: int, columns: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Undo `encode_coded`: (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    decode = decode_blocks if holds_blocks(body) else decode_symbols
    return decode(body, rows, columns, channels)


def segment_guide(body: bytes) -> SegmentGuide | None:
    """Of what `decode_coded` decodes.

    Raises:
        FormatError: as `decode_coded`.
    """
    return bytes(body) if holds_blocks(body) else guide_of(body)
