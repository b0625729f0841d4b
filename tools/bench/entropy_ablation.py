"""What `kpbench entropy` measures: the contribution of each part of the entropy coder, on the planes of real files.

A variant compiles `kpc.encoder.coding.predictive` or `kpc.encoder.coding.transform` once more with one of the functions
they use replaced, and encodes the segments of a file again. Since the coder is lossless, sizes tell everything.
Segments that do not use the changed part keep their size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from types import FunctionType, ModuleType
from typing import Any, Protocol

import numpy as np
from numba import njit

from kpc.encoder.coding import predictive, rans, texel_map, transform
from kpc.encoder.coding.scene_writer import scene_chunks
from kpc.encoder.coding.segments import encode_segment
from kpc.format.coding.quantise import needed_texels
from kpc.format.common.compiling import MONITOR
from kpc.format.common.progress import in_parts, progress
from kpc.format.container.container import Chunk, Codec, pack
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.segments import SegmentSideInfo, side_info_at
from kpc.format.scene.scene import ALL_PLANES

# Decodings of which the median time counts, after one that warms up.
DECODINGS = 5

# Bits of a stored probability, in the variant with static tables.
TABLE_BITS = 12

# Printed while numba compiles: a changed coder is in no cache.
NOTICE = "compiling changed coders, which every run does anew"

# Recorded decisions of adaptive models lie below this in a trace, and those of the texel map from this index on.
RECORDED, MAP_INDEX = -10000, 4096


@dataclass(frozen=True)
class Segment:
    """A plane segment and its encoded form."""

    symbols: np.ndarray  # (H, W, M) int8
    coded: np.ndarray  # (H, W) bool
    implied: np.ndarray  # (H, W) bool, the texel map derived from occupancy
    side_info: SegmentSideInfo | None
    body: bytes

    @property
    def is_transform(self) -> bool:
        """Whether the transform codec codes it."""
        return isinstance(self.side_info, bytes)

    @property
    def codes_map(self) -> bool:
        """Whether its texel map is coded, not derived."""
        return not self.coded.all() and not np.array_equal(self.coded, self.implied)


def measure(scene: Path) -> dict[str, dict[str, float]]:
    """Measure all variants that affect a file.

    Returns:
        By variant: `plane_bytes` of all planes; for complete codecs also `decode_ms` of the planes on one core; for the
        baseline also `file_bytes`, and `read_ms` of `kpc.format.container.scene_io.read`.
    """
    MONITOR.notice = NOTICE
    quantised = read(scene)
    chunks = scene_chunks(quantised)
    segments = []
    for chunk in chunks:
        if chunk.kind == "PLNE":
            name = ALL_PLANES[chunk.plane]
            plane = quantised.scales[chunk.scale][name]
            rows = slice(chunk.row_start, chunk.row_start + chunk.row_count)
            symbols, coded = plane.symbols[rows], plane.coded[rows]
            implied = needed_texels(quantised.occupancy, name, *plane.coded.shape)[rows]
            side_info = side_info_at(plane.side_info, chunk.row_start)
            body = encode_segment(symbols, coded, side_info, implied)
            segments.append(Segment(symbols, coded, implied, side_info, body))
    values = sum(plane.symbols.size for planes in quantised.scales for plane in planes.values())
    read_ms = _median_ms(partial(read, scene.read_bytes()))
    found = {
        "baseline": _decoding(pack(chunks, values)) | {"file_bytes": scene.stat().st_size, "read_ms": read_ms},
        "zstd": _decoding(pack(_without_entropy_coder(chunks), values)),
    }
    for name, variant in progress(list(VARIANTS.items()), "entropy", unit="variants"):
        if any(map(variant.affects, segments)):
            size = variant.compiled()
            sizes = [size(one) if variant.affects(one) else len(one.body) for one in in_parts(segments)]
            found[name] = {"plane_bytes": sum(sizes)}
    return found


def _without_entropy_coder(chunks: Sequence[Chunk]) -> list[Chunk]:
    return [replace(chunk, codec=Codec.RAW, encode=None) if chunk.kind == "PLNE" else chunk for chunk in chunks]


def _decoding(data: bytes) -> dict[str, float]:
    """Return the size and the decoding time of the planes of a file."""
    reader = SceneReader(data)
    planes = [number for number, entry in enumerate(reader.index) if entry.kind == "PLNE"]
    decode_ms = _median_ms(lambda: [reader.segment(number) for number in planes])
    return {"plane_bytes": sum(reader.index[n].stored_length for n in planes), "decode_ms": decode_ms}


def _median_ms(work: Callable[[], object]) -> float:
    """Return the median CPU time of `work` in milliseconds, after one call that warms up."""
    times = []
    for _ in range(DECODINGS + 1):
        start = process_time()
        work()
        times.append(1e3 * (process_time() - start))
    return float(np.median(times[1:]))


# --- functions that replace those of the coder


@njit
def _context_by_fraction(active, part):
    """Replace `residual_context`: ignore the activity."""
    return part


@njit
def _context_by_activity(active, part):
    """Replace `residual_context`: ignore the fraction of the prediction."""
    return active * predictive.FRACTIONS


@njit
def _no_cross_channel(cross, above, here, below, m):
    """Replace `update_cross_channel`: ignore residuals of earlier channels."""


@njit
def _record_decision(bit, models, index, state, position, words, trace):
    """Replace `code_bit_adaptive`: record the model and the bit, below everything that `code_bit` writes."""
    trace[position] = RECORDED - 2 * index - bit
    return bit, state, position + 1


@njit
def _record_map_decision(bit, models, index, state, position, words, trace):
    """Replace `code_bit_adaptive` for the texel map, whose models are separate."""
    trace[position] = RECORDED - 2 * (MAP_INDEX + index) - bit
    return bit, state, position + 1


@njit
def _no_sign_bias(gap, dct_basis, i, j, has_left, has_above):
    """Replace `sign_bias`: all signs are equally likely."""
    return 0


@njit
def _context_by_frequency(here, left, above, before, i, j, side):
    """Replace `level_context`: ignore the levels around."""
    classes = transform.FREQUENCY_CLASSES
    return min(5 * (i + j) // side, classes - 2) if i + j else classes - 1


@njit
def _context_without_frequency(here, left, above, before, i, j, side):
    """Replace `level_context`: ignore the frequency, except that of the mean."""
    context = transform.level_context(here, left, above, before, i, j, side)
    return context if i + j == 0 else context // transform.FREQUENCY_CLASSES * transform.FREQUENCY_CLASSES


@njit
def _context_without_channel(here, left, above, before, i, j, side):
    """Replace `level_context`: ignore the channel before."""
    return transform.level_context(here, left, above, np.zeros_like(before), i, j, side)


@njit
def _even_level_models():
    """Replace `new_level_models`: all bits are equally likely at first."""
    return rans.new_models(transform.MAGNITUDE_CONTEXTS * transform.FREQUENCY_CLASSES * transform.MODELS_PER_CONTEXT)


@njit
def _even_sign_models():
    """Replace `new_sign_models`: both signs are equally likely at first."""
    return rans.new_models(len(transform.SIGN_PROBABILITIES))


# --- compiling a coder with changes

# The functions of a codec that are compiled anew, each after those that it calls.
RECOMPILED = {
    predictive: (
        "begin_row",
        "update_cross_channel",
        "trellis_transition",
        "next_trellis_state",
        "channel_shares",
        "sum_above",
        "predict",
        "nearest",
        "round_prediction",
        "residual_to_offset",
        "offset_to_residual",
        "residual_context",
        "activity",
        "code_unsigned",
        "code_signed",
        "collect",
        "code_symbols",
    ),
    transform: ("code_unsigned", "code_magnitude", "code_signs", "code_levels"),
}


def compile_encoder(codec: ModuleType, encoder: str, changes: dict[str, Any]) -> Callable[..., Any]:
    """Return the function `encoder` of a codec that uses `changes` in place of the functions of these names."""
    names = vars(rans) | vars(codec) | changes
    for name in RECOMPILED[codec]:
        if name not in changes:
            names[name] = njit(FunctionType(names[name].py_func.__code__, names, name))
    original = vars(codec)[encoder]
    return FunctionType(original.__code__, names, encoder, original.__defaults__)


def _recording_map_coder() -> Callable[..., Any]:
    """Return `code_map` that records decisions in the trace."""
    names = vars(rans) | vars(texel_map) | {"code_bit_adaptive": _record_map_decision}
    coder: Any = texel_map.code_map
    return njit(FunctionType(coder.py_func.__code__, names, "code_map"))


def encode_by_tables(trace: np.ndarray) -> bytes:
    """Return as many bytes as a trace of recorded decisions takes with static probabilities, which are stored.

    A model costs TABLE_BITS and its decisions their entropy; bits without a model cost one bit each.
    """
    recorded = trace[trace <= RECORDED].astype(np.int64)
    counts = np.bincount(RECORDED - recorded, minlength=2)
    pairs = np.append(counts, [0] * (len(counts) % 2)).reshape(-1, 2)  # of zeros and ones, by model
    uses = pairs.sum(1)
    shares = pairs / np.maximum(uses, 1)[:, None]
    bits = -(pairs * np.log2(np.where(shares > 0, shares, 1))).sum() + TABLE_BITS * np.count_nonzero(uses)
    return bytes(round(float(bits + np.count_nonzero(trace > RECORDED)) / 8))


# --- variants


class Variant(Protocol):
    """One change of the entropy coder."""

    def affects(self, segment: Segment) -> bool:
        """Return whether a segment uses what is changed."""

    def compiled(self) -> Callable[[Segment], int]:
        """Return a function that returns the bytes of an affected segment."""


@dataclass(frozen=True)
class PredictiveVariant:
    """A change of the predictive codec.

    Attributes:
        changes: functions that replace others.
        set_counts: numbers of sets of prediction weights to try; none: the prediction is the mean of left and above.
        changes_symbols: whether the encoder would have chosen other symbols for dependent quantisation, so that
            segments with it cannot be compared.
    """

    changes: dict[str, Any]
    set_counts: tuple[int, ...] = predictive.SET_COUNTS
    changes_symbols: bool = False

    def affects(self, segment: Segment) -> bool:
        return not segment.is_transform and not (self.changes_symbols and segment.side_info is not None)

    def compiled(self) -> Callable[[Segment], int]:
        encode = compile_encoder(predictive, "encode_with_weights", self.changes)
        return partial(predictive_size, encode=encode, set_counts=self.set_counts)


def predictive_size(segment: Segment, encode: Callable[..., bytes | None], set_counts: tuple[int, ...]) -> int:
    """Return the bytes of a segment by a variant of `predictive.encode_with_weights`, with the best number of sets."""
    symbols, coded = np.array(segment.symbols, order="C"), np.array(segment.coded, order="C")
    unused_bytes = 0
    if isinstance(segment.side_info, predictive.PredictionWeights):
        quantiser, tried = predictive.DEPENDENT, [segment.side_info.weights]
    else:
        follows = predictive.follows_trellis(symbols, coded)
        quantiser = predictive.TRELLIS if follows else predictive.SCALAR
        neighbours = predictive.collect_neighbours(symbols, coded)
        tried = [predictive.fit_weights(neighbours, count) for count in set_counts]
        if not tried:
            tried = [np.zeros((1, predictive.WEIGHT_COUNT), np.int8)]
            unused_bytes = predictive.WEIGHT_COUNT
    bodies = [encode(weights, symbols, coded, quantiser, segment.implied) for weights in tried]
    return min(len(body) for body in bodies if body is not None) - unused_bytes


@dataclass(frozen=True)
class TransformVariant:
    """A change of the transform codec: functions that replace others."""

    changes: dict[str, Any]

    def affects(self, segment: Segment) -> bool:
        return segment.is_transform

    def compiled(self) -> Callable[[Segment], int]:
        encode = compile_encoder(transform, "encode_blocks", self.changes)
        return lambda segment: len(encode(blocks_of(segment), segment.coded, segment.implied))


def blocks_of(segment: Segment) -> transform.TransformBlocks:
    """Return the transform blocks of a segment under the transform codec."""
    rows, columns, channels = segment.symbols.shape
    return transform.decode_levels(segment.body, rows, columns, channels, segment.implied)


class CodedMapVariant:
    """Texel maps are coded even where they follow from occupancy."""

    def affects(self, segment: Segment) -> bool:
        return not segment.codes_map and not segment.coded.all()

    def compiled(self) -> Callable[[Segment], int]:
        def size(segment: Segment) -> int:
            if segment.is_transform:
                return len(transform.encode_blocks(blocks_of(segment), segment.coded))
            return len(encode_segment(segment.symbols, segment.coded, segment.side_info))

        return size


def _static_tables() -> dict[str, Any]:
    return {
        "code_bit_adaptive": _record_decision,
        "code_map": _recording_map_coder(),
        "encode_trace": encode_by_tables,
    }


VARIANTS: dict[str, Variant] = {
    "signalled significance maps": CodedMapVariant(),
    "one set of prediction weights": PredictiveVariant({}, (1,)),
    "prediction by the mean of left and above": PredictiveVariant({}, ()),
    "no activity contexts": PredictiveVariant({"residual_context": _context_by_fraction}),
    "no fraction contexts": PredictiveVariant({"residual_context": _context_by_activity}),
    "no residuals of earlier channels": PredictiveVariant(
        {"update_cross_channel": _no_cross_channel}, changes_symbols=True
    ),
    "static probability tables": PredictiveVariant(_static_tables()),
    "transform: no sign contexts": TransformVariant({"sign_bias": _no_sign_bias}),
    "transform: no neighbouring levels": TransformVariant({"level_context": _context_by_frequency}),
    "transform: no frequency contexts": TransformVariant({"level_context": _context_without_frequency}),
    "transform: no earlier channel": TransformVariant({"level_context": _context_without_channel}),
    "transform: uniform initial probabilities": TransformVariant(
        {"new_level_models": _even_level_models, "new_sign_models": _even_sign_models}
    ),
}
