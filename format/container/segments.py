"""Plane segments: how many rows they have, and the side information of those under PREDICTIVE and TRANSFORM."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kpc.format.container.container import Codec

# Map modes (spec/kpc-format.md, "Texel map"): all texels are coded; the map is stored; it follows from the occupancy.
MAP_ALL, MAP_CODED, MAP_IMPLIED = range(3)
# Flags of a segment under PREDICTIVE: the map mode in the lowest bits, above it the quantiser.
MODE_BITS = 2
SCALAR, TRELLIS, DEPENDENT = range(3)
WEIGHT_COUNT = 9  # weights of a set, each in 1/64

# Rows of a segment of a time plane, at least, unless the plane has fewer or its segments would take too long to decode.
# Each segment starts without neighbours and with new models: files of 16-row segments are 2 % (room) and 3 % (soldier)
# larger (docs/design/entropy-coding.md).
SEGMENT_ROWS = 32
# Segments have a multiple of this many rows, the largest side of blocks, since blocks do not go beyond a segment.
ROW_MULTIPLE = 16
# Nanoseconds that the decoder core takes, of trained planes (docs/design/entropy-coding.md): under PREDICTIVE for each
# symbol, and more if its texel is coded; under TRANSFORM for each symbol and for each byte.
PREDICTIVE_NS, CODED_NS = 7, 29
TRANSFORM_NS, TRANSFORM_BYTE_NS = 6, 270
# What a segment of a time plane may take, unless it has but ROW_MULTIPLE rows.
SEGMENT_NS = 3_000_000


def rows_of_segments(rows: int, over_time: bool) -> list[int]:
    """Return the rows that each segment but the last of a plane may have, falling.

    A space plane is one segment. Those of a time plane have at least SEGMENT_ROWS, the first number, or fewer where
    they would take too long to decode, and at least ROW_MULTIPLE.
    """
    if not over_time:
        return [rows]
    counts = range(max(1, rows // SEGMENT_ROWS), max(1, -(-rows // ROW_MULTIPLE)) + 1)
    return sorted({-(-rows // (count * ROW_MULTIPLE)) * ROW_MULTIPLE for count in counts}, reverse=True)


def rows_per_segment(coded: np.ndarray, channels: int, over_time: bool) -> int:
    """Return the rows of each segment but the last under PREDICTIVE.

    Args:
        coded: (H, W) bool, the coded texels of the plane.
        channels: M, symbols of a texel.
        over_time: whether it is a time plane.
    """
    each_ns = channels * (PREDICTIVE_NS * coded.shape[1] + CODED_NS * coded.sum(axis=1))
    *more, fewest = rows_of_segments(len(coded), over_time)
    fitting = (n for n in more if np.add.reduceat(each_ns, range(0, len(coded), n)).max() <= SEGMENT_NS)
    return next(fitting, fewest)


def transform_ns(body: bytes, symbols: int) -> int:
    """Return about how many nanoseconds the decoder core takes for a segment of so many symbols under TRANSFORM."""
    return TRANSFORM_NS * symbols + TRANSFORM_BYTE_NS * len(body)


@dataclass(frozen=True, eq=False)
class PredictionWeights:
    """Weights that the symbols of a DEPENDENT plane were chosen with; with others they take far more bits.

    Attributes:
        weights: (C, WEIGHT_COUNT) int8, in 1/64; C is one of SET_COUNTS.
    """

    weights: np.ndarray

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PredictionWeights) and np.array_equal(self.weights, other.weights)


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


def side_info_of(codec: int, body: bytes) -> SegmentSideInfo | None:
    """Return the side information of a segment that can be decoded, from what is stored."""
    if codec == Codec.TRANSFORM:
        return bytes(body)
    if body[1] >> MODE_BITS != DEPENDENT:
        return None
    sets = body[0]
    return PredictionWeights(np.frombuffer(body, np.int8, WEIGHT_COUNT * sets, 2).reshape(sets, WEIGHT_COUNT))


def needs_occupancy(body: bytes) -> bool:
    """Return whether the map of a segment under PREDICTIVE or TRANSFORM follows from the occupancy."""
    return _map_mode(body) == MAP_IMPLIED


def stores_map(body: bytes) -> bool:
    """Return whether a segment under PREDICTIVE or TRANSFORM holds its map."""
    return _map_mode(body) == MAP_CODED


def _map_mode(body: bytes) -> int | None:
    return body[1] & (1 << MODE_BITS) - 1 if len(body) > 1 else None
