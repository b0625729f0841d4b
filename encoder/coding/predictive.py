"""PREDICTIVE, a codec of plane segments: symbols are predicted from neighbours, residuals coded in contexts.

    set count (1 byte) | flags (1 byte) | weights (9 bytes a set) | rANS words: of the map, then of the residuals,
    channel by channel

(spec/kpc-format.md, "PREDICTIVE".) A prediction is a weighted mean of ten neighbours. The weights are the segment's
own, one set for each class of local gradients: where a plane is flat it pays to average quantisation noise, where it
is steep to extrapolate. The size of the residuals nearby, in this channel and in those before it, selects the
context. All arithmetic is on integers.

A segment has one of three *quantisers*:

    SCALAR      any symbol may follow any other
    TRELLIS     trellis-coded quantisation (Marcellin and Fischer, IEEE Trans. Comm. 38, 1990): along a row, the
                symbols before determine whether the next one is even or odd
    DEPENDENT   dependent quantisation where the neighbourhood is flat, else as TRELLIS: not the symbol but its
                difference from the rounded prediction is even, or odd and zero (ITU-T H.266, 8.7.3; Schwarz et al.,
                Data Compression Conference 2019)

Whether symbols follow the trellis can be seen from them. Dependent ones can be coded only with the weights that they
were chosen with: these are the side information of a plane, `PredictionWeights`.

Names in this module
    v r             symbols of a channel, and residuals in 1/16 symbol: rings of three rows, two columns wider on
                    either side, so that column x is at X = x + 2; v0 r0 are the current row, v1 r1 the one above,
                    v2 r2 the one above that
    w n nw ne ...   neighbours by compass direction; ww and nn are two texels away
    cross           residuals of the channels before, smoothed
    trellis         state of the trellis, 0 to 7; odd where the symbol, or the difference, has to be odd
    state position words trace      of `kpc.encoder.coding.rans`
"""

import numpy as np

from kpc.encoder.coding.rans import code_signed, encode_trace, new_models
from kpc.encoder.coding.texel_map import code_map, map_mode
from kpc.format.container.segments import (
    DEPENDENT,
    MAP_CODED,
    MODE_BITS,
    SCALAR,
    TRELLIS,
    WEIGHT_COUNT,
    PredictionWeights,
)
from kpc.jit import compiled, inlined

SET_COUNTS = (1, 2, 4, 8)  # sets of weights that a segment may have
FLAT_ACTIVITY = 4  # neighbourhoods whose activity is less than this are flat

UNARY, ESCAPES = 4, 7  # of `code_signed`, for residuals
# Models of a context: whether there is a residual, whether it is positive, and, for either sign, its magnitude.
MODELS_PER_CONTEXT = 2 + 2 * (UNARY + ESCAPES)
# Contexts: classes of activity, times the distance of the prediction from a whole symbol (or, if DEPENDENT, the
# parity of the trellis).
ACTIVITIES, FRACTIONS = 22, 3
MAX_DECISIONS = 2 + UNARY + 2 * ESCAPES  # bits that a symbol takes in a trace, at most

# Fit of weights: iterations of reweighting, values used at most, and a ridge that keeps a flat plane solvable.
REWEIGHTINGS, FIT_VALUES, RIDGE = 4, 1 << 14, 4.0

INITIAL_RESIDUAL = 16  # r where nothing is known: one symbol

GRADIENT_CLASSES = np.array([min(k.bit_length(), 7) for k in range(5 * 255 + 1)])  # class of a gradient, one of 8
# 2 log2(k / 2) of k >= 2, rounded down after linear interpolation between powers of two.
_LOGARITHMS = np.array(
    [0, 0] + [2 * (k.bit_length() - 2) + (k >> k.bit_length() - 2 & 1) for k in range(2, 2443)], np.int8
)


def encode_symbols(
    symbols: np.ndarray,
    coded: np.ndarray,
    side_info: PredictionWeights | None = None,
    implied: np.ndarray | None = None,
) -> bytes:
    """Encode a segment: DEPENDENT if the symbols follow their side information, else with the number of weight sets
    that is shortest.

    Args:
        symbols: (H, W, M) int8, 0 where not coded.
        coded: (H, W) bool.
        side_info: the weights that the symbols were chosen with, if any.
        implied: (H, W) bool, the map that the occupancy implies; None where it is not known.
    """
    if side_info is not None:
        body = encode_with_weights(side_info.weights, symbols, coded, DEPENDENT, implied)
        if body is not None:
            return body
    symbols, coded = np.array(symbols, order="C"), np.array(coded, order="C")  # kernels are compiled for this layout
    neighbours, quantiser = collect_neighbours(symbols, coded), TRELLIS if follows_trellis(symbols, coded) else SCALAR
    bodies = (
        encode_with_weights(fit_weights(neighbours, count), symbols, coded, quantiser, implied) for count in SET_COUNTS
    )
    return min((body for body in bodies if body is not None), key=len)


def encode_with_weights(
    weights: np.ndarray, symbols: np.ndarray, coded: np.ndarray, quantiser: int, implied: np.ndarray | None = None
) -> bytes | None:
    """Encode a segment with given (C, WEIGHT_COUNT) int8 weights; None if the symbols do not follow the quantiser."""
    # Kernels are compiled for this layout, and anew for arrays that are read-only.
    followed, coded, weights = (np.array(one, order="C") for one in (symbols, coded, weights))
    trace = np.empty(coded.size + int(coded.sum()) * symbols.shape[2] * MAX_DECISIONS, np.int16)
    position, mode = 0, map_mode(coded, implied)
    if mode == MAP_CODED:
        _, position = code_map(coded, 0, position, None, trace)
    _, position, fits = code_symbols(followed, coded, quantiser, weights, 0, position, None, trace, new_neighbours(0))
    if not fits or not np.array_equal(followed, symbols):
        return None
    head = bytes([len(weights), mode | quantiser << MODE_BITS])
    return head + weights.tobytes() + encode_trace(trace[:position])


# --- weights


def collect_neighbours(symbols: np.ndarray, coded: np.ndarray) -> np.ndarray:
    """Return (N, 2 + WEIGHT_COUNT) int16 of the N coded symbols, for `fit_weights`.

    Column 0 is the gradient class; the others are twice the differences of the symbol, and of its neighbours, from
    the mean of w and n.
    """
    values = int(coded.sum()) * symbols.shape[2]
    trace, neighbours = np.empty(values * MAX_DECISIONS, np.int16), new_neighbours(values)
    code_symbols(symbols, coded, SCALAR, np.zeros((1, WEIGHT_COUNT), np.int8), 0, 0, None, trace, neighbours)
    return neighbours


def new_neighbours(count: int) -> np.ndarray:
    """Return room for what `collect_neighbours` returns of `count` symbols; with 0 `code_symbols` collects nothing."""
    return np.empty((count, 2 + WEIGHT_COUNT), np.int16)


def fit_weights(neighbours: np.ndarray, count: int) -> np.ndarray:
    """Return (count, WEIGHT_COUNT) int8 weights that make the sum of absolute residuals small in each gradient class.

    An encoder may use any weights.
    """
    weights = np.zeros((count, WEIGHT_COUNT), np.int8)
    classes = neighbours[:, 0] * count >> 3
    for number in range(count):
        own = neighbours[classes == number, 1:]
        own = own[:: -(-len(own) // FIT_VALUES) or 1].astype(np.float32)
        weights[number] = np.clip(np.rint(64 * _fit_least_absolute(own[:, 0], own[:, 1:])), -128, 127)
    return weights


def _fit_least_absolute(wanted: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return (K,) float64 x that makes |wanted - columns x|_1 small, by iteratively reweighted least squares."""
    importance = np.ones(len(wanted), wanted.dtype)
    for _ in range(REWEIGHTINGS):
        weighted = columns * importance[:, None]
        normal = (weighted.T @ columns).astype(np.float64) + RIDGE * np.eye(columns.shape[1])
        solution = np.linalg.solve(normal, (wanted @ weighted).astype(np.float64))
        importance = 1 / (np.abs(wanted - columns @ solution.astype(columns.dtype)) + 1)
    return solution


# --- kernels that encoder and decoder share


@compiled()
def follows_trellis(symbols, coded):
    """Return whether the parity of every symbol is the one that the trellis demands."""
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
    """Return the state after a symbol; a row begins with 0, and in an odd state a symbol is odd.

    Ungerboeck's code of 8 states with parity checks 13 and 04 (octal; IEEE Trans. Inf. Theory 28, 1982, table I).
    """
    return state >> 1 ^ 5 * (state & 1) ^ symbol & 2


@inlined
def residual_to_offset(residual, quantiser, odd):
    """Return the difference of the symbol from the rounded prediction. `odd`: whether the trellis state is."""
    if quantiser < DEPENDENT:
        return residual << quantiser
    return 2 * residual - (odd if residual > 0 else -odd if residual < 0 else 0)


@inlined
def offset_to_residual(offset, quantiser, odd):
    """Return the residual of a difference from the rounded prediction, or of one near to it that is allowed."""
    if quantiser < DEPENDENT:
        return offset >> quantiser
    size = abs(offset) + odd >> 1
    return size if offset > 0 else -size


@inlined
def round_prediction(predicted, quantiser, odd):
    """Return the symbol nearest to a prediction, under TRELLIS the nearest that may follow; ties go up."""
    return nearest(predicted, odd, 1) if quantiser == TRELLIS else nearest(predicted, 0, 0)


@inlined
def residual_context(active, part):
    """Return the context of a residual: class of activity, and class of the fraction of the prediction or parity of
    the trellis.
    """
    return active * FRACTIONS + part


@inlined
def next_trellis_state(trellis, value, residual, quantiser):
    """Return the trellis state after a symbol: by its value or, if DEPENDENT, by its residual."""
    if quantiser == SCALAR:
        return 0
    return trellis_transition(trellis, value if quantiser == TRELLIS else 2 * residual)


@compiled()
def code_symbols(symbols, coded, quantiser, weights, state, position, words, trace, neighbours):
    """Code (H, W, M) symbols where `coded`: (state, position, whether all fit 8 bits). Encoding moves them onto the
    quantiser.

    One function, since its state (rows of v and r, the neighbours to the left) would be the parameters of any part of
    it.

    Args:
        quantiser: SCALAR, TRELLIS or DEPENDENT.
        weights: (C, WEIGHT_COUNT) int8, in 1/64.
        neighbours: of `new_neighbours`, to be filled as far as it reaches.
    """
    H, W, M = symbols.shape
    sets = tap_weights(weights)
    models = new_models(ACTIVITIES * FRACTIONS * MODELS_PER_CONTEXT)
    v, r = np.zeros((3, W + 4), np.int32), np.zeros((3, W + 4), np.int32)
    cross = np.zeros((H, W), np.int16)
    classes = GRADIENT_CLASSES * len(sets) >> 3
    taps, steep = np.zeros((len(sets), W), np.int32), np.zeros(W, np.int32)
    active_above = np.zeros(W, np.int32)
    collected = 0
    for m in range(M):
        for y in range(H):
            here, above, higher = y % 3, (y + 2) % 3, (y + 1) % 3
            v0, v1, v2, r0, r1, r2, past = v[here], v[above], v[higher], r[here], r[above], r[higher], cross[y]
            begin_row(v0, v1, v2, y, 0)
            begin_row(r0, r1, r2, y, INITIAL_RESIDUAL)
            if y > 0:
                sum_above(sets, v1, v2, r1, r2, past, m, taps, steep, active_above)
            trellis, w, ww, rw, rww = 0, v0[1], v0[0], r0[1], r0[0]
            for x in range(W):
                X = x + 2
                if not coded[y, x]:
                    ww, rww = w, rw
                    if not (y == 0 or (x > 0 and coded[y, x - 1])):
                        w, rw = v1[X + 1], r1[X + 1]
                    v0[X], r0[X] = w, rw
                    continue
                if y == 0:  # there is no row above: all of it is taken to be the left neighbour
                    v1[x : x + 5], v2[x : x + 5], r1[x : x + 5], r2[x : x + 5] = w, w, rw, rw
                    own = slice(x, x + 1)
                    sum_above(
                        sets, v1[x:], v2[x:], r1[x:], r2[x:], past[x:], m, taps[:, own], steep[own], active_above[own]
                    )
                predicted, gradient = predict(sets, classes, w, ww, v1[X - 1], x, taps, steep)
                active, odd = activity(active_above[x], rw, rww, gradient, m), trellis & 1
                local = TRELLIS if quantiser == DEPENDENT and active >= FLAT_ACTIVITY else quantiser
                whole = round_prediction(predicted, local, odd)
                fraction = predicted - (whole << 7)
                part = min(odd if local == DEPENDENT else 3 * abs(fraction) >> 6 + local, FRACTIONS - 1)
                first = residual_context(active, part) * MODELS_PER_CONTEXT
                sign = -1 if fraction < 0 else 1
                residual = sign * offset_to_residual(int(symbols[y, x, m]) - whole, local, odd)
                residual, state, position = code_signed(
                    residual, models, first, UNARY, ESCAPES, state, position, words, trace
                )
                value = whole + residual_to_offset(sign * residual, local, odd)
                if not -128 <= value <= 127:
                    return state, position, False
                symbols[y, x, m] = value
                trellis = next_trellis_state(trellis, value, residual, local)
                if collected < len(neighbours):
                    collect(neighbours[collected], value, gradient, w, ww, v1, v2, X)
                    collected += 1
                ww, rww = w, rw
                w, rw = value, abs((value << 7) - predicted) >> 3
                v0[X], r0[X] = w, rw
            v0[W + 2 :], r0[W + 2 :] = v0[W + 1], r0[W + 1]
            if words is not None and position > words.size:
                return state, position, True
            if y > 0:
                update_cross_channel(cross[y - 1], r2, r1, r0, m)
        last = r[(H - 1) % 3]
        update_cross_channel(cross[H - 1], r[max(H - 2, 0) % 3], last, last, m)
    return state, position, True


@inlined
def collect(row, value, gradient, w, ww, v1, v2, X):
    """Fill a row of `collect_neighbours`."""
    n = v1[X]
    both = w + n
    row[0], row[1], row[2] = GRADIENT_CLASSES[gradient], 2 * value - both, w - n
    row[3], row[4] = 2 * v1[X - 1] - both, 2 * v1[X + 1] - both
    row[5], row[6] = 2 * ww - both, 2 * v2[X] - both
    row[7], row[8] = 2 * v1[X - 2] - both, 2 * v2[X - 1] - both
    row[9], row[10] = 2 * v2[X + 1] - both, 2 * v1[X + 2] - both


@compiled()
def tap_weights(weights):
    """Return (C, 1 + WEIGHT_COUNT) int32, in 1/128: weights of w n nw ne ww nn and the four farther neighbours in a
    plain sum.

    (C, WEIGHT_COUNT) stored weights are of w - n, and of what the others exceed the mean of w and n by.
    """
    sets = np.empty((len(weights), 1 + WEIGHT_COUNT), np.int32)
    for c in range(len(weights)):
        first, rest = int(weights[c, 0]), 64
        for k in range(1, WEIGHT_COUNT):
            other = int(weights[c, k])
            rest -= other
            sets[c, k + 1] = 2 * other
        sets[c, 0], sets[c, 1] = rest + first, rest - first
    return sets


@inlined
def channel_shares(m):
    """Return the weights, in quarters, of residuals in this channel and in those before it; the first channel has
    none before it.
    """
    return (16, 0) if m == 0 else (11, 5)


@inlined
def sum_above(sets, v1, v2, r1, r2, past, m, taps, steep, active_above):
    """Compute, for each texel of a row, the part that the rows above have in its prediction, gradient and activity.

    All of a row at once, since this does not depend on symbols of the row itself.

    Args:
        sets: (C, 1 + WEIGHT_COUNT), of `tap_weights`.
        taps: (C, W), to be filled: the part of the prediction, by each set.
        steep, active_above: (W,), to be filled.
    """
    W = steep.size
    for c in range(len(sets)):
        n, nw, ne, nn = sets[c, 1], sets[c, 2], sets[c, 3], sets[c, 5]
        nww, nnw, nne, nee = sets[c, 6], sets[c, 7], sets[c, 8], sets[c, 9]
        for x in range(W):
            X = x + 2
            row_above = nww * v1[X - 2] + nw * v1[X - 1] + n * v1[X] + ne * v1[X + 1] + nee * v1[X + 2]
            taps[c, x] = row_above + nnw * v2[X - 1] + nn * v2[X] + nne * v2[X + 1]
    now, before = channel_shares(m)
    for x in range(W):
        X = x + 2
        steep[x] = abs(v1[X] - v1[X - 1]) + abs(v1[X] - v1[X + 1]) + abs(v1[X] - v2[X])
        active_above[x] = now * (2 * r1[X] + r1[X - 1] + r1[X + 1] + r2[X]) + before * int(past[x])


@inlined
def predict(sets, classes, w, ww, nw, x, taps, steep):
    """Return the prediction of a symbol, in 1/128, and the gradient around it, which selects the set through
    `classes`.
    """
    gradient = abs(w - nw) + abs(w - ww) + steep[x]
    c = classes[gradient] if len(sets) > 1 else 0  # whatever depends on the gradient waits long for it
    return min(max(sets[c, 0] * w + sets[c, 4] * ww + taps[c, x], -128 * 128), 127 * 128), gradient


@inlined
def nearest(predicted, odd, doubled):
    """Return the symbol nearest to a prediction; where `doubled` is 1, among the even or the odd ones."""
    return (predicted - (odd << 7) + (64 << doubled) >> 7 + doubled << doubled) + odd


@inlined
def activity(active_above, rw, rww, gradient, m):
    """Return the class of activity, one of ACTIVITIES, from residuals around and in the channels before, and from the
    gradient.
    """
    total = (active_above + channel_shares(m)[0] * (2 * rw + rww) >> 2) + 20 * gradient
    return int(_LOGARITHMS[total + 128 >> 6])


@inlined
def begin_row(here, above, higher, y, unknown):
    """Extend rows beyond the segment: to the left by the start of the row above; above row 0, from row 1 on, by row 0
    itself.
    """
    here[:2] = above[2] if y > 0 else unknown
    if y == 1:
        for x in range(higher.size):
            higher[x] = above[x]


@inlined
def update_cross_channel(cross, above, here, below, m):
    """Update a row of `cross` with r of this channel, smoothed by (1 2 1) x (1 2 1) / 2, an eighth of the way."""
    for x in range(cross.size):
        X = x + 2
        top = above[X - 1] + 2 * above[X] + above[X + 1]
        middle = here[X - 1] + 2 * here[X] + here[X + 1]
        smooth = top + 2 * middle + (below[X - 1] + 2 * below[X] + below[X + 1]) >> 1
        past = int(cross[x])
        cross[x] = smooth if m == 0 else past + (smooth - past >> 3)
