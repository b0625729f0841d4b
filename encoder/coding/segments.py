"""Encoding of plane segments: their rows, and which of the codecs PREDICTIVE and TRANSFORM a segment takes."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np

from kpc.encoder.coding.predictive import encode_symbols
from kpc.format.coding.quantise import QuantisedPlane
from kpc.format.common.errors import FormatError
from kpc.format.container.container import Codec
from kpc.format.container.segments import SegmentSideInfo, rows_per_segment
from kpc.format.core.decoding import decode_segment


def segment_bounds(plane: QuantisedPlane, over_time: bool, segment_rows: int | None = None) -> list[tuple[int, int]]:
    """Return the first row of each segment, and the row after its last.

    Args:
        plane: to be encoded; if its symbols were chosen for certain segments, these.
        over_time: whether it is a time plane.
        segment_rows: rows of a segment of other time planes; None: `rows_per_segment`.
    """
    rows, _, channels = plane.symbols.shape
    count = segment_rows if segment_rows and over_time else rows_per_segment(plane.coded, channels, over_time)
    return list(pairwise([*(plane.starts or range(0, rows, count)), rows]))


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
    rows, columns, channels = symbols.shape
    try:
        found, where = decode_segment(Codec.TRANSFORM, body, rows, columns, channels, implied)
    except FormatError:  # the occupancy has changed since they were encoded
        return False
    return np.array_equal(found, symbols) and np.array_equal(where, coded)
