"""Plane segments under codecs 2 and 3, whichever way they are told: symbol by symbol (`kpc.format.coding.predictive`) or in blocks (`kpc.format.coding.transform`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from kpc.format.coding.predictive import (
    IMPLIED,
    THIRD,
    PredictionWeights,
    decode_symbols,
    encode_symbols,
    map_mode,
    weights_in,
)
from kpc.format.coding.transform import decode_blocks, holds_blocks
from kpc.format.common.errors import FormatError
from kpc.format.container.container import CODEC_SYMBOLS, CODEC_THIRD

SEGMENT_ROWS, WHOLE = 32, 16
"""Of a time plane, the fewest that are decoded together, but for what is left at its end: each segment begins without neighbours and with
counters that know nothing. With 16 rows files of room and soldier are two and three percent larger; with 32 rows and a rest of 11, as their
frames have it, shelf_hand's are. And rows, of which segments have a multiple: blocks do not end with them (`kpc.format.coding.transform`)."""


def rows_per_segment(rows: int, over_time: bool) -> int:
    """In each segment, but the last, of a plane of so many rows: all of a space plane's."""
    if not over_time:
        return rows
    count = max(1, rows // SEGMENT_ROWS)
    return -(-rows // (count * WHOLE)) * WHOLE


@dataclass(frozen=True, eq=False)
class TransformSegments:
    """A plane that is told in blocks. Its symbols follow from these, which cannot be found from them.

    Attributes:
        segments: of each by its first row, what is stored.
    """

    segments: Mapping[int, bytes]


PlaneSideInfo = PredictionWeights | TransformSegments
SegmentSideInfo = PredictionWeights | bytes


def side_info_at(side_info: PlaneSideInfo | None, start: int) -> SegmentSideInfo | None:
    """Of the segment that begins in a row."""
    return side_info.segments.get(start) if isinstance(side_info, TransformSegments) else side_info


def merge_side_info(guides: Mapping[int, SegmentSideInfo | None]) -> PlaneSideInfo | None:
    """Of a plane whose segments, by their first rows, have these: of those in blocks if there are any, else the one that all have that have any
    (what has none was smaller as it is)."""
    if bodies := {start: side_info for start, side_info in guides.items() if isinstance(side_info, bytes)}:
        return TransformSegments(bodies)
    known = [side_info for side_info in guides.values() if isinstance(side_info, PredictionWeights)]
    return known[0] if known and all(side_info == known[0] for side_info in known) else None


def encode_segment(
    symbols: np.ndarray, coded: np.ndarray, side_info: SegmentSideInfo | None = None, implied: np.ndarray | None = None
) -> bytes:
    """Code (H, W, M) int8 symbols, 0 wherever (H, W) `coded` is False: as their side_info has it, if it does, else symbol by symbol. `implied`:
    `kpc.format.coding.quantise.needed_texels`, if a reader knows them."""
    return choose_codec(symbols, coded, side_info, implied)[1]()


def choose_codec(
    symbols: np.ndarray, coded: np.ndarray, side_info: SegmentSideInfo | None, implied: np.ndarray | None
) -> tuple[int, Callable[[], bytes]]:
    """The codec of what `encode_segment` makes, and what makes it."""
    if isinstance(side_info, bytes):
        if _tells(side_info, symbols, coded, implied):
            return codec_of(side_info), partial(bytes, side_info)
        side_info = None
    codec = CODEC_THIRD if map_mode(coded, implied) & THIRD else CODEC_SYMBOLS
    return codec, partial(encode_symbols, symbols, coded, side_info, implied)


def _tells(body: bytes, symbols: np.ndarray, coded: np.ndarray, implied: np.ndarray | None) -> bool:
    """Whether blocks are of just these symbols."""
    try:
        told, where = decode_blocks(body, *symbols.shape, implied=implied)
    except FormatError:  # they were told by another occupancy
        return False
    return np.array_equal(told, symbols) and np.array_equal(where, coded)


def codec_of(body: bytes) -> int:
    """Of what `encode_segment` made."""
    return CODEC_THIRD if len(body) > 1 and body[1] & THIRD else CODEC_SYMBOLS


def decode_segment(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Undo `encode_segment`: (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels. `implied`: those, where the
    body `needs_occupancy`.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    decode = decode_blocks if holds_blocks(body) else decode_symbols
    return decode(body, rows, columns, channels, implied)


def needs_occupancy(body: bytes) -> bool:
    """Whether occupancy says which texels are coded."""
    return len(body) > 1 and body[1] & IMPLIED != 0


def side_info_of(body: bytes) -> SegmentSideInfo | None:
    """Of what `decode_segment` decodes.

    Raises:
        FormatError: as `decode_segment`.
    """
    return bytes(body) if holds_blocks(body) else weights_in(body)
