"""Which symbol a number becomes: trellis-coded quantisation, with an eye on what symbols cost.

Symbols lie half as far apart as plain rounding to the same number of bits would have them, but along a row only every other one may
follow (`kpc.format.coding.predictive.trellis_transition`). A Viterbi search finds the path through a row of least

    u^2 + 2 u (BESIDE * sum of u of the four texels around + ACROSS * sum of u of the four at the corners + others)
        + LAM * bits(symbol | those before it),        u = sqrt(worth) (symbol - value / step)

(`kpc.encoder.rdo.distortion`), each survivor with the predictions and contexts that its own symbols lead to (Marcellin and Fischer, IEEE Trans.
Comm. 38, 1990). Bits are counted in the contexts of the coder, from what the search before chose; rows below and channels to come have the
errors that the search before left them. So errors next to each other get opposite signs, and look-ups, which lie between texels, see less of
them; and a channel undoes what others err. What an error is worth differs from texel to texel by orders of magnitude
(`kpc.encoder.rdo.curvature`): where it is worth little, symbols are those that are foreseen.

Where little more than a bit is told of a symbol (`LOW_RATE_BITS`), they follow the trellis around predictions where it is flat: what is foreseen may
then follow everywhere, as it should where nothing else is said, and not only every other time.

Default scene, `fast`: at equal error of pictures of 1, 2 and 4 squared levels planes take 11 to 14 % fewer bytes than with symbols chosen
by rate and distortion around the nearest. Errors that know of each other save 5 to 8 % more, and 14 % where steps are fine (liam,
`balanced`, at equal error of held-out views).
"""

import math
from dataclasses import replace

import numpy as np
from kpc.encoder.rdo.distortion import (
    CORNER_COUPLING,
    EDGE_COUPLING,
    LAM,
    NO_CORRELATION,
    cross_channel_errors,
    distortion_weights,
    magnitude_bits,
)
from kpc.encoder.rdo.texel_map_rdo import choose_coded_texels
from kpc.format.coding.predictive import (
    ACTIVITIES,
    DEPENDENT,
    FLAT_ACTIVITY,
    GRADIENT_CLASSES,
    INITIAL_RESIDUAL,
    SCALAR,
    TRELLIS,
    PredictionWeights,
    activity,
    begin_row,
    collect_neighbours,
    fit_weights,
    next_trellis_state,
    predict,
    residual_to_offset,
    round_prediction,
    sum_above,
    tap_weights,
    update_cross_channel,
)
from kpc.format.coding.quantise import SYMBOL_MAX, SYMBOL_MIN, QuantisedPlane, bfloat16_ceil, quantise_plane
from kpc.format.common.jit import compiled
from kpc.format.container.segments import rows_per_segment

LOW_RATE_BITS = 1.3
"""Bits of a symbol below which the trellis goes around predictions. Liam and soldier, large planes alone, at equal slopes: squared errors
plus what bits are worth are 1 % less at 1.3 bits, 8 at 0.75, 15 at 0.5 and 24 at 0.4."""
LOW_RATE_LAM = 1.0
"""LAM of those. What bits are worth stays what it is: steps are sqrt(LAM / THIN_LAM) of what they are on the trellis. With 0.7 it is 0 to 1 %
less at 1.3 bits, and 3 to 5 % more at 0.5."""
LOW_RATE_STEP_RATIO = math.sqrt(LOW_RATE_LAM / LAM)
"""By how much steps around predictions are finer than those on the trellis at which bits are worth as much."""
STATES = 8
PASSES = 4
"""Searches: the first knows but the weights of rounded symbols, not what symbols cost, nor errors of rows below. Two more make files half a
percent smaller."""
PREDICTOR_SETS, MANY_SYMBOLS = 4, 1 << 17
"""Of weights. Around predictions files hold those of the search: one set, but for so many symbols or more."""
MAGNITUDE_BINS = 40
"""Magnitudes of errors whose bits are told apart."""


def trellis_quantise(
    plane: QuantisedPlane,
    values: np.ndarray,
    step: np.ndarray,
    significant: np.ndarray,
    identity: bool,
    together: np.ndarray = NO_CORRELATION,
    thin: float = LOW_RATE_BITS,
) -> QuantisedPlane:
    """A plane that is quantised to the nearest, with other symbols, and around predictions with other steps. What was left out stays so, and
    holds 0; and so does what is so near the identity that it is not worth telling.

    Where 8 bits are too few for (M,) `step` by a factor of two, all symbols may follow: those that the trellis allows would err more.
    Bits are worth what they are at the steps that were asked for.

    Args:
        significant: (H, W, M), what a squared error costs in each number, relative to others of its channel; none negative.
        together: as of `kpc.encoder.rdo.curvature.Curvature`, or ALONE.
        thin: bits of a symbol below which it goes around predictions.
    """
    lattice = TRELLIS if np.median(plane.step / step) < 2 else SCALAR
    search = _Search(plane, values, step, significant, identity, together, lattice)
    search.run(1)
    if lattice == SCALAR or search.bits_of_a_symbol >= thin:
        search.run(PASSES - 1)
        return search.found()
    finer = bfloat16_ceil((step / LOW_RATE_STEP_RATIO).astype(np.float32))
    around = quantise_plane(values, finer, identity=identity, needed=plane.coded)
    search = _Search(around, values, finer, significant, identity, together, DEPENDENT)
    search.run(PASSES)
    return search.found()


def requested_trellis_step(plane: QuantisedPlane) -> np.ndarray:
    """(M,) float64: for which steps `trellis_quantise` was asked when it made this plane, if it did and 8 bits were enough."""
    return plane.step.astype(np.float64) * (1.0 if plane.side_info is None else LOW_RATE_STEP_RATIO)


class _Search:
    """Searches for the symbols of one plane, each knowing what the one before found.

    Args: as of `trellis_quantise`; `lattice`: as of `kpc.format.coding.predictive`.
    """

    def __init__(
        self,
        plane: QuantisedPlane,
        values: np.ndarray,
        step: np.ndarray,
        significant: np.ndarray,
        identity: bool,
        together: np.ndarray,
        lattice: int,
    ) -> None:
        self.plane, self.identity, self.together, self.lattice = plane, identity, together, lattice
        self._finer = LOW_RATE_STEP_RATIO if lattice == DEPENDENT else 1.0
        self.rows = rows_per_segment(len(values), identity)
        coarser = plane.step / step
        self.wanted = (values.astype(np.float64) - plane.offset) / plane.step
        known = np.ascontiguousarray(plane.coded)
        worth = distortion_weights(significant, known)
        if identity:
            known = choose_coded_texels(self.wanted / self._finer, worth, known)
        self.known, self.worth = known, worth * np.float32(coarser**2)
        self.symbols = np.where(known[..., None], plane.symbols, np.int8(0))
        self.counts = np.zeros((2 * ACTIVITIES, MAGNITUDE_BINS))
        self.errors = np.zeros((values.shape[0] + 2, values.shape[1] + 2, values.shape[2]), np.float32)
        if identity:
            self.errors[1:-1, 1:-1] = np.where(known[..., None], 0, np.sqrt(self.worth) * -self.wanted)

    def run(self, times: int) -> None:
        for _ in range(times):
            neighbours = collect_neighbours(self.symbols, self.known)
            self.weights = fit_weights(
                neighbours, PREDICTOR_SETS if self.lattice != DEPENDENT or len(neighbours) >= MANY_SYMBOLS else 1
            )
            self.symbols, self.counts = _search(
                self.wanted,
                self.worth,
                self.known,
                self.rows,
                self.lattice,
                self.weights,
                LAM * self._finer**2 * _bits(self.counts),
                self.errors,
                self.together,
            )

    @property
    def bits_of_a_symbol(self) -> float:
        return float((self.counts * _bits(self.counts)).sum() / max(self.counts.sum(), 1))

    def found(self) -> QuantisedPlane:
        if self.lattice == DEPENDENT:  # what is coded tells what is foreseen
            return replace(
                self.plane, symbols=self.symbols, coded=self.known, side_info=PredictionWeights(self.weights)
            )
        return replace(
            self.plane, symbols=self.symbols, coded=self.symbols.any(axis=2) if self.identity else self.known
        )


def _bits(counts: np.ndarray) -> np.ndarray:
    """(2 ACTIVITIES, TOLD_APART) bits of errors by their magnitude, that came so often in each context: at even places, then at odd ones. What is
    expected doubles with every other context."""
    return magnitude_bits(counts, 0.04 * 2.0 ** (np.tile(np.arange(ACTIVITIES), 2) / 2 - 1.5))


@compiled()
def _search(
    wanted: np.ndarray,
    worth: np.ndarray,
    known: np.ndarray,
    rows: int,
    lattice: int,
    weights: np.ndarray,
    price: np.ndarray,
    errors: np.ndarray,
    together: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, M) int8 symbols of (H, W, M) numbers in steps, whose errors are worth as much as that; 0 where nothing is `known`; and how often
    errors came, as `_bits` counts them. Every so many `rows` a segment begins, which knows of none before. `lattice`: as of
    `kpc.format.coding.predictive`; where any may follow, survivors differ in which of their last three are odd. `price`: of `_bits`, in squared steps.
    `errors`: (H + 2, W + 2, M) float32, u of all texels, one row and one column of 0 around; those of known ones are found anew.
    `together`: as of `trellis_quantise`, or ALONE.

    v, r, cross and the names of neighbours as in `kpc.format.coding.predictive`; v0, r0 and errors of survivors are held by their states.
    """
    H, W, M = wanted.shape
    sets, classes = tap_weights(weights), GRADIENT_CLASSES * len(weights) >> 3
    apart = 1 if lattice == SCALAR else 2  # of symbols that may follow
    symbols, counts = np.zeros((H, W, M), np.int8), np.zeros(price.shape)
    v, r = np.zeros((3, W + 4), np.int32), np.zeros((3, W + 4), np.int32)
    leaning, steep, restless = np.zeros((len(sets), W), np.int32), np.zeros(W, np.int32), np.zeros(W, np.int32)
    cross = np.zeros((H, W), np.int16)
    V, R = np.zeros((W + 4, STATES), np.int64), np.zeros((W + 4, STATES), np.int64)  # of the survivor that ends there
    U = np.zeros((W + 2, STATES), np.float32)
    cost, before = np.zeros(STATES), np.zeros(STATES)
    came, context, missed = (
        np.zeros((W, STATES), np.int64),
        np.zeros((W, STATES), np.int64),
        np.zeros((W, STATES), np.int64),
    )
    for m in range(M):
        outside_others = cross_channel_errors(errors, together, m)
        for y in range(H):
            own = y % rows  # of its segment
            v0, v1, v2 = v[y % 3], v[(y + 2) % 3], v[(y + 1) % 3]
            r0, r1, r2, past = r[y % 3], r[(y + 2) % 3], r[(y + 1) % 3], cross[y]
            begin_row(v0, v1, v2, own, 0)
            begin_row(r0, r1, r2, own, INITIAL_RESIDUAL)
            if own > 0:
                sum_above(sets, v1, v2, r1, r2, past, m, leaning, steep, restless)
            for s in range(STATES):
                V[:2, s], R[:2, s] = v0[:2], r0[:2]
            cost[:] = np.inf
            cost[0] = 0
            for x in range(W):
                X = x + 2
                before, cost = cost, before
                cost[:] = np.inf
                root, here = math.sqrt(worth[y, x, m]), errors[y + 1, x + 1, m]
                outside = (
                    outside_others[y, x]
                    + EDGE_COUPLING * (errors[y, x + 1, m] + errors[y + 2, x + 1, m])
                    + CORNER_COUPLING
                    * (errors[y, x, m] + errors[y, x + 2, m] + errors[y + 2, x, m] + errors[y + 2, x + 2, m])
                )
                for s in range(STATES):
                    if before[s] == np.inf:
                        continue
                    # left of it, of this survivor: one and, by the way that it came, two texels away
                    w, rw = V[X - 1, s], R[X - 1, s]
                    old = came[x - 1, s] if x else s
                    ww, rww = V[X - 2, old], R[X - 2, old]
                    if not known[y, x]:
                        left = own == 0 or x > 0 and known[y, x - 1]
                        V[X, s], R[X, s] = (w, rw) if left else (v1[X + 1], r1[X + 1])
                        cost[s], came[x, s], U[x + 1, s] = before[s] + 2 * here * EDGE_COUPLING * U[x, s], s, here
                        continue
                    if own == 0:  # nothing is above but what is to the left
                        v1[x : x + 5], v2[x : x + 5], r1[x : x + 5], r2[x : x + 5] = w, w, rw, rw
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
                    predicted, gradient = predict(sets, classes, w, ww, int(v1[X - 1]), x, leaning, steep)
                    active, odd = activity(restless[x], rw, rww, gradient, m), s & 1 if lattice != SCALAR else 0
                    kind = TRELLIS if lattice == DEPENDENT and active >= FLAT_ACTIVITY else lattice
                    whole = round_prediction(predicted, kind, odd)
                    if odd and kind == DEPENDENT:
                        active += ACTIVITIES
                    near = outside + EDGE_COUPLING * U[x, s]
                    best = min(max(wanted[y, x, m] - near / root, SYMBOL_MIN), SYMBOL_MAX)  # as far as errors go
                    away = best - whole
                    size = int((abs(away) + (1 if odd and kind == DEPENDENT else 0)) / apart)
                    inside = size if away > 0 else -size
                    for error in (
                        inside - 1,
                        inside,
                        inside + 1,
                        0,
                    ):  # those around it, the next that costs less, what is foreseen
                        value = whole + residual_to_offset(error, kind, odd)
                        if not SYMBOL_MIN <= value <= SYMBOL_MAX:
                            continue
                        size = min(abs(error), MAGNITUDE_BINS - 1)
                        u = root * (value - wanted[y, x, m])
                        total = before[s] + u * (u + 2 * near) + price[active, size]
                        to = (
                            (s << 1 | value & 1) & STATES - 1
                            if lattice == SCALAR
                            else next_trellis_state(s, value, error, kind)
                        )
                        if total < cost[to]:
                            cost[to], came[x, to], context[x, to], missed[x, to] = total, s, active, size
                            V[X, to], R[X, to], U[x + 1, to] = value, abs((value << 7) - predicted) >> 3, u
            s = int(np.argmin(cost))
            for x in range(W - 1, -1, -1):
                v0[x + 2], r0[x + 2] = V[x + 2, s], R[x + 2, s]
                if known[y, x]:
                    symbols[y, x, m] = V[x + 2, s]
                    errors[y + 1, x + 1, m] = U[x + 1, s]
                    counts[context[x, s], missed[x, s]] += 1
                s = came[x, s]
            v0[W + 2 :], r0[W + 2 :] = v0[W + 1], r0[W + 1]
            if own > 0:
                update_cross_channel(cross[y - 1], r2, r1, r0, m)
            if own == rows - 1 or y == H - 1:
                update_cross_channel(cross[y], r1 if own > 0 else r0, r0, r0, m)
    return symbols, counts
