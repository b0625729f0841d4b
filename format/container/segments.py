"""Plane segments under the context codecs PREDICTIVE and TRANSFORM: which codec a segment takes, and with what side
information.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from kpc.format.coding.predictive import PredictionWeights, decode_symbols, encode_symbols, needs_occupancy, weights_in
from kpc.format.coding.transform import decode_blocks
from kpc.format.common.errors import FormatError
from kpc.format.container.container import Codec

# Rows of a segment of a time plane, at least, unless the plane has fewer. Each segment starts without neighbours and
# with new models: files of 16-row segments are 2 % (room) and 3 % (soldier) larger (docs/design/entropy-coding.md).
SEGMENT_ROWS = 32
# Segments have a multiple of this many rows, the largest side of blocks, since blocks do not go beyond a segment.
ROW_MULTIPLE = 16


def rows_per_segment(rows: int, over_time: bool) -> int:
    """Return the rows of each segment but the last: all of a space plane's, at least SEGMENT_ROWS of a time plane's."""
    if not over_time:
        return rows
    count = max(1, rows // SEGMENT_ROWS)
    return -(-rows // (count * ROW_MULTIPLE)) * ROW_MULTIPLE


@dataclass(frozen=True, eq=False)
class TransformSegments:
    """Side information of a plane under TRANSFORM: its encoded segments, since levels cannot be found from symbols.

    Attributes:
        segments: the stored bytes of each segment, by its first row.
    """

    segments: Mapping[int, bytes]


PlaneSideInfo = PredictionWeights | TransformSegments  # of a plane
SegmentSideInfo = (
    PredictionWeights | bytes
)  # of a segment: weights, or the bytes that it was encoded as under TRANSFORM


def side_info_at(side_info: PlaneSideInfo | None, start: int) -> SegmentSideInfo | None:
    """Return the side information of the segment that begins at row `start`."""
    return side_info.segments.get(start) if isinstance(side_info, TransformSegments) else side_info


def merge_side_info(segments: Mapping[int, SegmentSideInfo | None]) -> PlaneSideInfo | None:
    """Return the side information of a plane from that of its segments by their first rows.

    TransformSegments if any segment is under TRANSFORM; else the weights, if all segments that have some have the same.
    """
    if bodies := {start: info for start, info in segments.items() if isinstance(info, bytes)}:
        return TransformSegments(bodies)
    known = [info for info in segments.values() if isinstance(info, PredictionWeights)]
    return known[0] if known and all(info == known[0] for info in known) else None


def encode_segment(
    symbols: np.ndarray,
    coded: np.ndarray,
    side_info: SegmentSideInfo | None = None,
    implied: np.ndarray | None = None,
) -> bytes:
    """Encode a segment under the codec that `choose_codec` returns."""
    return choose_codec(symbols, coded, side_info, implied)[1]()


def choose_codec(
    symbols: np.ndarray, coded: np.ndarray, side_info: SegmentSideInfo | None, implied: np.ndarray | None
) -> tuple[Codec, Callable[[], bytes]]:
    """Return the codec of a segment and a function that encodes it: TRANSFORM if its side information is of these
    symbols.

    Args:
        symbols: (H, W, M) int8, 0 where not coded.
        coded: (H, W) bool.
        implied: (H, W) bool, the map that the occupancy implies; None where it is not known.
    """
    if isinstance(side_info, bytes):
        if _decodes_to(side_info, symbols, coded, implied):
            return Codec.TRANSFORM, partial(bytes, side_info)
        side_info = None
    return Codec.PREDICTIVE, partial(encode_symbols, symbols, coded, side_info, implied)


def _decodes_to(body: bytes, symbols: np.ndarray, coded: np.ndarray, implied: np.ndarray | None) -> bool:
    """Return whether blocks decode to just these symbols."""
    try:
        rows, columns, channels = symbols.shape
        found, where = decode_blocks(body, rows, columns, channels, implied)
    except FormatError:  # the occupancy has changed since they were encoded
        return False
    return np.array_equal(found, symbols) and np.array_equal(where, coded)


def decode_segment(
    codec: int, body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Decode a segment under PREDICTIVE or TRANSFORM.

    Args:
        implied: (rows, columns) bool, the map that the occupancy implies; needed where the body `needs_occupancy`.

    Returns:
        (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the body is cut off, too long or damaged.
    """
    decode = decode_blocks if codec == Codec.TRANSFORM else decode_symbols
    return decode(body, rows, columns, channels, implied)


def side_info_of(codec: int, body: bytes) -> SegmentSideInfo | None:
    """Return the side information in what `decode_segment` decodes."""
    return bytes(body) if codec == Codec.TRANSFORM else weights_in(body)


__all__ = [
    "SEGMENT_ROWS",
    "PlaneSideInfo",
    "SegmentSideInfo",
    "TransformSegments",
    "choose_codec",
    "decode_segment",
    "encode_segment",
    "merge_side_info",
    "needs_occupancy",
    "rows_per_segment",
    "side_info_at",
    "side_info_of",
]
