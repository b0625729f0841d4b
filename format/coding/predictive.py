"""Plane segments under codecs 2 and 3: every symbol predicted from its neighbours, the error coded in contexts (spec, section 6).

    C (1 byte) | flags (1 byte) | weights (9 C bytes) | rANS words: of the map, then of the symbols, channel by channel

A prediction is a weighted mean of ten neighbours. Its weights are the segment's own, a set for each class of slopes around a texel:
where a plane is flat it pays to average the noise of quantisation away, where it is steep to extrapolate. How far predictions were
off nearby, in this channel and in those before it, says how far this one may be, and so which counters the error is coded with. All
of this is in integers; all that is stored beside the errors is the weights.

Symbols may follow the *trellis* of trellis-coded quantisation (Marcellin and Fischer, IEEE Trans. Comm. 38, 1990): along a row, the
symbols before say whether the next one is even or odd, `trellis_transition`. So each has only every other value to choose from, which saves a
bit, and yet by its choice of what comes before a writer has nearly all of them: at as many bits, errors are 1.09 dB smaller
(`kpc.encoder.rdo.trellis`). Whether symbols do is seen from themselves.

Where the neighbourhood is flat they may do so *around predictions*: not symbols but their differences from what is foreseen are even or odd,
and none is always among them. So where hardly anything is told a symbol may stay what is foreseen, wherever its row has led. Quantisers
that are even, or odd and zero, are those of dependent quantisation in VVC (ITU-T H.266, section 8.7.3; Schwarz et al., Data Compression
Conference 2019). Such symbols are told with the weights alone that foresaw them: a `PredictionWeights`.

Naming, throughout this module
    v           symbols of one channel; r  by how much predictions missed them, in 1 / 16 of a symbol. Rings of three rows with two
                more columns on either side: rows `here`, `above` and `higher`, column x at X = x + 2
    w n nw ne   values to the left, above, above to the left and to the right
    cross       what r was in the channels before, smoothed
    lattice     which symbols may follow: ANY; those on the TRELLIS; or AROUND predictions, where it is flat, and else on the trellis
    kind        of a symbol among them: ANY, TRELLIS or AROUND
    leaning steep restless      what lies above texels of a row, as `sum_above` has it
    place       on the trellis, one of 8; it is odd where symbols, or differences, have to be
    table       counters of `kpc.format.coding.rans`
    state at words trace    of `kpc.format.coding.rans.code_bit`
"""

from dataclasses import dataclass

import numpy as np
from kpc.format.coding.rans import check_end, code_bit_adaptive, code_signed, encode_trace, new_models, open_stream
from kpc.format.common.errors import FormatError
from kpc.format.common.jit import compiled, inlined

SET_COUNTS = (1, 2, 4, 8)
"""How many sets of weights a segment may store."""
WEIGHT_COUNT = 9
"""Of a set, each in 1 / 64."""
SCALAR, TRELLIS, DEPENDENT = range(3)
"""Lattices."""
FLAT_ACTIVITY = 4
"""Neighbourhoods less active than that are flat."""
MAP, LATTICE_BIT, THIRD, IMPLIED = 1, 1, 8, 16
"""Flags: a map tells which texels are coded; from this bit on, the lattice; codec 3; that has no map but occupancy, which implies one. With
neither all texels are coded. Maps of space planes took 0.4 KB a file (shelf_hand, liam)."""

UNARY, ESCAPES = 4, 7
"""Of `kpc.format.coding.rans.code_signed`."""
MODELS_PER_CONTEXT = 2 + 2 * (UNARY + ESCAPES)
"""Counters of a context: is there an error, is it positive; and of either sign, its magnitude."""
ACTIVITIES, FRACTIONS = 22, 3
"""Contexts: how active the neighbourhood is; and how far the prediction lies from a whole symbol or, around predictions, what place is."""
MAP_CONTEXTS = 1 << 10
MAX_DECISIONS = 2 + UNARY + 2 * ESCAPES
"""That a symbol takes."""

REWEIGHTINGS, FIT_VALUES, RIDGE = 4, 1 << 14, 4.0
"""Of the fit of weights: how often errors are weighted anew, the most values to fit, and what keeps it solvable on a flat plane."""

INITIAL_RESIDUAL = 16
"""r before anything is known: one symbol."""

GRADIENT_CLASSES = np.array([min(k.bit_length(), 7) for k in range(5 * 255 + 1)])
"""Of a gradient: one of 8 classes, of which each set of weights has as many."""
_LOGARITHMS = np.array(
    [0, 0] + [2 * (k.bit_length() - 2) + (k >> k.bit_length() - 2 & 1) for k in range(2, 2443)], np.int8
)
"""Of k >= 2: 2 log2(k / 2), rounded down after linear interpolation between powers of two."""


@dataclass(frozen=True, eq=False)
class PredictionWeights:
    """By what symbols around predictions were chosen, in each segment of a plane. Told by anything else they take far more bits.

    Attributes:
        weights: (C, WEIGHTS) int8; C is one of SET_COUNTS.
    """

    weights: np.ndarray

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PredictionWeights) and np.array_equal(self.weights, other.weights)


def encode_symbols(
    symbols: np.ndarray,
    coded: np.ndarray,
    side_info: PredictionWeights | None = None,
    implied: np.ndarray | None = None,
) -> bytes:
    """Code (H, W, M) int8 symbols, 0 wherever (H, W) `coded` is False: by their side_info, if they have one that they follow, else with as many
    sets of weights as make it shortest. `implied`: the map that needs not be told."""
    if (
        side_info is not None
        and (body := encode_with_weights(side_info.weights, symbols, coded, DEPENDENT, implied)) is not None
    ):
        return body
    symbols, coded = (
        np.array(symbols, order="C"),
        np.array(coded, order="C"),
    )  # compiled for this layout; and `code_symbols` writes
    neighbours, lattice = collect_neighbours(symbols, coded), TRELLIS if follows_trellis(symbols, coded) else SCALAR
    bodies = (
        encode_with_weights(fit_weights(neighbours, count), symbols, coded, lattice, implied) for count in SET_COUNTS
    )
    return min((body for body in bodies if body is not None), key=len)


def encode_with_weights(
    weights: np.ndarray, symbols: np.ndarray, coded: np.ndarray, lattice: int, implied: np.ndarray | None = None
) -> bytes | None:
    """The same, with (C, WEIGHTS) int8 weights that are given, C is one of SET_COUNTS; None where symbols do not follow the lattice."""
    followed, coded = np.array(symbols, order="C"), np.array(coded, order="C")
    trace, at = np.empty(coded.size + int(coded.sum()) * symbols.shape[2] * MAX_DECISIONS, np.int16), 0
    flags = map_mode(coded, implied)
    if flags & MAP:
        _, at = code_map(coded, 0, at, None, trace)
    _, at, fit = code_symbols(followed, coded, lattice, weights, 0, at, None, trace, None)
    if not fit or not np.array_equal(followed, symbols):
        return None
    return bytes([len(weights), flags | lattice << LATTICE_BIT]) + weights.tobytes() + encode_trace(trace[:at])


def decode_symbols(
    body: bytes, rows: int, columns: int, channels: int, implied: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Undo `encode_symbols`: (rows, columns, channels) int8 symbols and (rows, columns) bool, the coded texels.

    Raises:
        FormatError: the body is cut, too long, or says what only a damaged one would.
    """
    weights, lattice = _head(body)
    state, words = open_stream(body[2 + weights.size :], "plane segment")

    symbols, coded = np.zeros((rows, columns, channels), np.int8), initial_map(body[1], rows, columns, implied)
    at, fit = 0, True
    if body[1] & MAP:
        state, at = code_map(coded, state, at, words, None)
    if at <= len(words):
        state, at, fit = code_symbols(symbols, coded, lattice, weights, state, at, words, None, None)
    if not fit:
        raise FormatError("plane segment: a symbol leaves its 8 bits")
    check_end(state, at, words, "plane segment")
    return symbols, coded


def weights_in(body: bytes) -> PredictionWeights | None:
    """Of what `decode_symbols` decodes; None where symbols are not around predictions.

    Raises:
        FormatError: as `decode_symbols`.
    """
    weights, lattice = _head(body)
    return PredictionWeights(weights) if lattice == DEPENDENT else None


def _head(body: bytes) -> tuple[np.ndarray, int]:
    """Weights and lattice."""
    lattice = body[1] >> LATTICE_BIT & 3 if len(body) > 1 and known_flags(body[1]) else DEPENDENT + 1
    if lattice > DEPENDENT or body[0] not in SET_COUNTS:
        raise FormatError("plane segment: unknown number of sets of weights or flag")
    sets = body[0]
    if len(body) < 2 + WEIGHT_COUNT * sets:
        raise FormatError("plane segment: cut off within its weights")
    weights = np.frombuffer(body, np.int8, WEIGHT_COUNT * sets, 2).reshape(sets, WEIGHT_COUNT)
    return weights, lattice


def known_flags(flags: int) -> bool:
    """Whether they can be, whatever the lattice."""
    return flags < 2 * IMPLIED and (not flags & IMPLIED or flags & (THIRD | MAP) == THIRD)


def map_mode(coded: np.ndarray, implied: np.ndarray | None) -> int:
    """How the map of a segment is told: those flags. `implied`: by occupancy, None where that is not known."""
    if coded.all():
        return 0
    return THIRD | IMPLIED if implied is not None and np.array_equal(coded, implied) else MAP


def initial_map(flags: int, rows: int, columns: int, implied: np.ndarray | None) -> np.ndarray:
    """(rows, columns) bool: the coded texels, or, where a map is told, room for it.

    Raises:
        FormatError: they follow from an occupancy that is not known.
    """
    if not flags & IMPLIED:
        return np.ones((rows, columns), bool)
    if implied is None:
        raise FormatError("plane segment: which texels it tells follows from an occupancy that is not known")
    return np.array(implied, order="C")


def collect_neighbours(symbols: np.ndarray, coded: np.ndarray) -> np.ndarray:
    """(N, 2 + WEIGHTS) int16 of the N symbols that are coded: slope; twice the differences of symbol and neighbours to the mean of
    left and above."""
    values = int(coded.sum()) * symbols.shape[2]
    trace, neighbours = np.empty(values * MAX_DECISIONS, np.int16), np.empty((values, 2 + WEIGHT_COUNT), np.int16)
    code_symbols(symbols, coded, SCALAR, np.zeros((1, WEIGHT_COUNT), np.int8), 0, 0, None, trace, neighbours)
    return neighbours


def fit_weights(neighbours: np.ndarray, count: int) -> np.ndarray:
    """(count, WEIGHTS) int8: weights that make the sum of absolute errors small, for each class of slopes, by `collect_neighbours`.

    An encoder may take any weights.
    """
    weights = np.zeros((count, WEIGHT_COUNT), np.int8)
    classes = neighbours[:, 0] * count >> 3
    for number in range(count):
        own = neighbours[classes == number, 1:]
        own = own[:: -(-len(own) // FIT_VALUES) or 1].astype(np.float32)
        weights[number] = np.clip(np.rint(64 * least_absolute(own[:, 0], own[:, 1:])), -128, 127)
    return weights


def least_absolute(wanted: np.ndarray, around: np.ndarray) -> np.ndarray:
    """(K,) float64: factors of the columns of (N, K) `around` with which their sum misses (N,) `wanted` by least in all.

    Iteratively reweighted least squares, in the precision of the arguments.
    """
    importance = np.ones(len(wanted), wanted.dtype)
    for _ in range(REWEIGHTINGS):
        weighted = around * importance[:, None]
        normal = (weighted.T @ around).astype(np.float64) + RIDGE * np.eye(around.shape[1])
        solution = np.linalg.solve(normal, (wanted @ weighted).astype(np.float64))
        importance = 1 / (np.abs(wanted - around @ solution.astype(around.dtype)) + 1)
    return solution


# --- the walk that encoder and decoder share


@compiled()
def code_map(coded, state, at, words, trace):
    """Code `coded`, or decode into it, bit by bit in contexts of ten neighbours: (state, at)."""
    H, W = coded.shape
    table = new_models(MAP_CONTEXTS)
    for y in range(H):
        left, above, higher = 0, 0, 0  # of these rows the 2 texels before x, the 5 and the 3 around it
        for x in range(-2, W):
            above = above << 1 & 31 | (1 if y > 0 and x + 2 < W and coded[y - 1, x + 2] else 0)
            higher = higher << 1 & 7 | (1 if y > 1 and -1 <= x < W - 1 and coded[y - 2, x + 1] else 0)
            if x >= 0:
                bit = 1 if coded[y, x] else 0
                bit, state, at = code_bit_adaptive(bit, table, higher << 7 | above << 2 | left, state, at, words, trace)
                coded[y, x] = bit == 1
                left = left << 1 & 3 | bit
        if words is not None and at > words.size:
            break
    return state, at


@compiled()
def follows_trellis(symbols, coded):
    """Whether every symbol is even or odd as those before it in its row demand."""
    H, W, M = symbols.shape
    for m in range(M):
        for y in range(H):
            state = 0
            for x in range(W):
                if coded[y, x]:
                    symbol = int(symbols[y, x, m])
                    if (symbol ^ state) & 1:
                        return False
                    state = trellis_transition(state, symbol)
    return True


@inlined
def trellis_transition(state, symbol):
    """From one of 8 states, the first of a row 0; in an odd one a symbol is odd. Ungerboeck's code of parity checks 13 and 04
    (octal; IEEE Trans. Inf. Theory 28, 1982, table I)."""
    return state >> 1 ^ 5 * (state & 1) ^ symbol & 2


@inlined
def residual_to_offset(error, kind, odd):
    """How far from what is foreseen, as `round_prediction` has it, an error puts a symbol. `odd`: whether place is."""
    if kind < DEPENDENT:
        return error << kind
    return 2 * error - (odd if error > 0 else -odd if error < 0 else 0)


@inlined
def offset_to_residual(away, kind, odd):
    """The error that means a symbol so far from what is foreseen, or one near to it."""
    if kind < DEPENDENT:
        return away >> kind
    size = abs(away) + odd >> 1
    return size if away > 0 else -size


@inlined
def round_prediction(predicted, kind, odd):
    """The symbol nearest to a prediction, on the trellis one that may follow; ties go up."""
    return nearest(predicted, odd, 1) if kind == TRELLIS else nearest(predicted, 0, 0)


@inlined
def residual_context(active, part):
    """Of a symbol, by how restless its surroundings are, and by where between symbols it is foreseen or which may follow."""
    return active * FRACTIONS + part


@inlined
def next_trellis_state(place, value, error, kind):
    """After a symbol that an error made: by the one or, around predictions, by the other."""
    if kind == SCALAR:
        return 0
    return trellis_transition(place, value if kind == TRELLIS else 2 * error)


@compiled()
def code_symbols(symbols, coded, lattice, weights, state, at, words, trace, neighbours):
    """Code `symbols`, or decode into them, where `coded`: (state, at, whether all fit 8 bits). Those that do not follow the lattice are
    changed to near ones that do.

    Args:
        lattice: which symbols may follow.
        weights: (C, WEIGHTS) int8, in 1 / 64.
        neighbours: None, or as `collect_neighbours` returns them, to be filled.
    """
    H, W, M = symbols.shape
    sets = tap_weights(weights)
    table = new_models(ACTIVITIES * FRACTIONS * MODELS_PER_CONTEXT)
    v, r = np.zeros((3, W + 4), np.int32), np.zeros((3, W + 4), np.int32)
    cross = np.zeros((H, W), np.int16)
    classes = GRADIENT_CLASSES * len(sets) >> 3
    leaning, steep, restless = np.zeros((len(sets), W), np.int32), np.zeros(W, np.int32), np.zeros(W, np.int32)
    noted = 0
    for m in range(M):
        for y in range(H):
            here, above, higher = y % 3, (y + 2) % 3, (y + 1) % 3
            v0, v1, v2, r0, r1, r2, past = v[here], v[above], v[higher], r[here], r[above], r[higher], cross[y]
            begin_row(v0, v1, v2, y, 0)
            begin_row(r0, r1, r2, y, INITIAL_RESIDUAL)
            if y > 0:
                sum_above(sets, v1, v2, r1, r2, past, m, leaning, steep, restless)
            place, w, ww, rw, rww = 0, v0[1], v0[0], r0[1], r0[0]
            for x in range(W):
                X = x + 2
                if not coded[y, x]:
                    ww, rww = w, rw
                    if not (y == 0 or x > 0 and coded[y, x - 1]):
                        w, rw = v1[X + 1], r1[X + 1]
                    v0[X], r0[X] = w, rw
                    continue
                if y == 0:  # nothing is above but what is to the left
                    v1[x : x + 5], v2[x : x + 5] = w, w
                    r1[x : x + 5], r2[x : x + 5] = rw, rw
                    sum_above(
                        sets,
                        v1[x:],
                        v2[x:],
                        r1[x:],
                        r2[x:],
                        past[x:],
                        m,
                        leaning[:, x : x + 1],
                        steep[x : x + 1],
                        restless[x : x + 1],
                    )
                predicted, gradient = predict(sets, classes, w, ww, v1[X - 1], x, leaning, steep)
                active, odd = activity(restless[x], rw, rww, gradient, m), place & 1
                kind = TRELLIS if lattice == DEPENDENT and active >= FLAT_ACTIVITY else lattice
                whole = round_prediction(predicted, kind, odd)
                fraction = predicted - (whole << 7)
                part = min(odd if kind == DEPENDENT else 3 * abs(fraction) >> 6 + kind, FRACTIONS - 1)
                context = residual_context(active, part)
                sign = -1 if fraction < 0 else 1
                error = sign * offset_to_residual(int(symbols[y, x, m]) - whole, kind, odd)
                error, state, at = code_signed(
                    error, table, context * MODELS_PER_CONTEXT, UNARY, ESCAPES, state, at, words, trace
                )
                value = whole + residual_to_offset(sign * error, kind, odd)
                if not -128 <= value <= 127:
                    return state, at, False
                symbols[y, x, m] = value
                place = next_trellis_state(place, value, error, kind)
                if neighbours is not None:
                    row, n, nw = neighbours[noted], v1[X], v1[X - 1]
                    both = w + n
                    row[0], row[1], row[2] = GRADIENT_CLASSES[gradient], 2 * value - both, w - n
                    row[3], row[4], row[5], row[6] = (
                        2 * nw - both,
                        2 * v1[X + 1] - both,
                        2 * ww - both,
                        2 * v2[X] - both,
                    )
                    row[7], row[8] = 2 * v1[X - 2] - both, 2 * v2[X - 1] - both
                    row[9], row[10] = 2 * v2[X + 1] - both, 2 * v1[X + 2] - both
                    noted += 1
                ww, rww = w, rw
                w, rw = value, abs((value << 7) - predicted) >> 3
                v0[X], r0[X] = w, rw
            v0[W + 2 :], r0[W + 2 :] = v0[W + 1], r0[W + 1]
            if words is not None and at > words.size:
                return state, at, True
            if y > 0:
                update_cross_channel(cross[y - 1], r2, r1, r0, m)
        last = r[(H - 1) % 3]
        update_cross_channel(cross[H - 1], r[max(H - 2, 0) % 3], last, last, m)
    return state, at, True


@compiled()
def tap_weights(weights):
    """(C, 1 + WEIGHTS) int32, in 1 / 128: of w n nw ne ww nn, and of the four that lie farther away, in a sum of neighbours. (C, WEIGHTS) weights
    are of w - n and of what others are beyond the mean of w and n."""
    sets = np.empty((len(weights), 1 + WEIGHT_COUNT), np.int32)
    for c in range(len(weights)):
        rest = 64 - weights[c, 1:].sum()
        sets[c, 0], sets[c, 1] = rest + weights[c, 0], rest - weights[c, 0]
        sets[c, 2:] = 2 * weights[c, 1:].astype(np.int32)
    return sets


@inlined
def shares(m):
    """Of r in this channel and in those before it, in `activity`, in quarters. The first channel has none before it."""
    return (16, 0) if m == 0 else (11, 5)


@inlined
def sum_above(sets, v1, v2, r1, r2, past, m, leaning, steep, restless):
    """For each texel of a row, what lies above it adds to its prediction by each set, `leaning`; to the gradient; and to its activity.

    Apart from what lies to the left, since all of a row can be had at once. `sets`: of `tap_weights`."""
    W = steep.size
    for c in range(len(sets)):
        n, nw, ne, nn, nww, nnw, nne, nee = (
            sets[c, 1],
            sets[c, 2],
            sets[c, 3],
            sets[c, 5],
            sets[c, 6],
            sets[c, 7],
            sets[c, 8],
            sets[c, 9],
        )
        for x in range(W):
            X = x + 2
            leaning[c, x] = (
                nww * v1[X - 2]
                + nw * v1[X - 1]
                + n * v1[X]
                + ne * v1[X + 1]
                + nee * v1[X + 2]
                + nnw * v2[X - 1]
                + nn * v2[X]
                + nne * v2[X + 1]
            )
    now, before = shares(m)
    for x in range(W):
        X = x + 2
        steep[x] = abs(v1[X] - v1[X - 1]) + abs(v1[X] - v1[X + 1]) + abs(v1[X] - v2[X])
        restless[x] = now * (2 * r1[X] + r1[X - 1] + r1[X + 1] + r2[X]) + before * int(past[x])


@inlined
def predict(sets, classes, w, ww, nw, x, leaning, steep):
    """What neighbours say of a symbol, in 1 / 128, and how much they differ. `classes`: the set to take, by that."""
    gradient = abs(w - nw) + abs(w - ww) + steep[x]
    c = classes[gradient] if len(sets) > 1 else 0  # what waits for the gradient waits long
    return min(max(sets[c, 0] * w + sets[c, 4] * ww + leaning[c, x], -128 * 128), 127 * 128), gradient


@inlined
def nearest(predicted, odd, doubled):
    """The symbol nearest to a prediction; where `doubled` is 1, of the even or of the odd ones."""
    return (predicted - (odd << 7) + (64 << doubled) >> 7 + doubled << doubled) + odd


@inlined
def activity(restless, rw, rww, gradient, m):
    """How far predictions may be off, one of ACTIVITIES classes: by r around, by r of the channels before, and by `gradient`."""
    total = (restless + shares(m)[0] * (2 * rw + rww) >> 2) + 20 * gradient
    return int(_LOGARITHMS[total + 128 >> 6])


@inlined
def begin_row(here, above, higher, y, unknown):
    """What lies outside: to the left, the start of the row above; above the first row, from the second on, itself."""
    here[:2] = above[2] if y > 0 else unknown
    if y == 1:
        for x in range(higher.size):
            higher[x] = above[x]


@inlined
def update_cross_channel(cross, above, here, below, m):
    """Let `cross`, of one row, take in r of this channel: smoothed by (1 2 1) x (1 2 1) / 2, an eighth of the way."""
    for x in range(cross.size):
        X = x + 2
        smooth = (
            above[X - 1]
            + 2 * above[X]
            + above[X + 1]
            + 2 * (here[X - 1] + 2 * here[X] + here[X + 1])
            + below[X - 1]
            + 2 * below[X]
            + below[X + 1]
        ) >> 1
        past = int(cross[x])
        cross[x] = smooth if m == 0 else past + (smooth - past >> 3)
