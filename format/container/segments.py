"""Plane segments under codecs 2 and 3, whichever way they are told: symbol by symbol (`kpc.format.coding.predictive`) or in blocks (`kpc.format.coding.transform`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from kpc.format.coding.predictive import IMPLIED, THIRD, Guide, decode_symbols, encode_symbols, guide_of, map_flags
from kpc.format.coding.transform import decode_blocks, holds_blocks
from kpc.format.common.errors import FormatError
from kpc.format.container.container import CODEC_SYMBOLS, CODEC_THIRD

SEGMENT_ROWS, WHOLE = 32, 16
"""Of a time plane, the fewest that are decoded together, but for what is left at its end: each segment begins without neighbours and with
counters that know nothing. With 16 rows files of room and soldier are two and three percent larger; with 32 rows and a rest of 11, as their
frames have it, shelf_hand's are. And rows, of which segments have a multiple: blocks do not end with them (`kpc.format.coding.transform`)."""


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


def encode_coded(
    symbols: np.ndarray, coded: np.ndarray, guide: SegmentGuide | None = None, implied: np.ndarray | None = None
) -> bytes:
    """Code (H, W, M) int8 symbols, 0 wherever (H, W) `coded` is False: as their guide has it, if it does, else symbol by symbol. `implied`:
    `kpc.format.coding.quantise.needed_texels`, if a reader knows them."""
    return form_of(symbols, coded, guide, implied)[1]()


def form_of(
    symbols: np.ndarray, coded: np.ndarray, guide: SegmentGuide | None, implied: np.ndarray | None
) -> tuple[int, Callable[[], bytes]]:
    """The codec of what `encode_coded` makes, and what makes it."""
    if isinstance(guide, bytes):
        if _tells(guide, symbols, coded, implied):
            return codec_of(guide), partial(bytes, guide)
        guide = None
    codec = CODEC_THIRD if map_flags(coded, implied) & THIRD else CODEC_SYMBOLS
    return codec, partial(encode_symbols, symbols, coded, guide, implied)


def _tells(body: bytes, symbols: np.ndarray, coded: np.ndarray, implied: np.ndarray | None) -> bool:
    """Whether blocks are of just these symbols."""
    try:
        told, where = decode_blocks(body, *symbols.shape, implied=implied)
    except FormatError:  # they were told by another occupancy
        return False
    return np.array_equal(told, symbols) and np.array_equal(where, coded)


def codec_of(body: bytes) -> int:
    """Of what `encode_coded` made."""
    return CODEC_THIRD if len(body) > 1 and body[1] & THIRD else CODEC_SYMBOLS


def decode_coded(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Undo `encode_coded`: (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels. `implied`: those, where the
    body `wants_occupancy`.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    decode = decode_blocks if holds_blocks(body) else decode_symbols
    return decode(body, rows, columns, channels, implied)


def wants_occupancy(body: bytes) -> bool:
    """Whether occupancy says which texels are coded."""
    return len(body) > 1 and body[1] & IMPLIED != 0


def segment_guide(body: bytes) -> SegmentGuide | None:
    """Of what `decode_coded` decodes.

    Raises:
        FormatError: as `decode_coded`.
    """
    return bytes(body) if holds_blocks(body) else guide_of(body)
