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
    return len(body) > 1 and body[1] & (1 << MODE_BITS) - 1 == MAP_IMPLIED
