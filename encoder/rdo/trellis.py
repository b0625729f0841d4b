"""Trellis-coded quantisation of planes with a Lagrangian cost.

On the trellis, symbols lie half as far apart as with uniform quantisation of the same rate, but along a row only
every other symbol may follow (`kpc.encoder.coding.predictive.next_trellis_state`). A Viterbi search finds the path
through a row of least cost J = D + lambda R (`kpc.encoder.rdo.distortion`): for each symbol it adds

    u^2 + 2 u (EDGE_COUPLING * sum of u of the four adjacent texels
               + CORNER_COUPLING * sum of u of the four diagonal texels + cross-channel errors)
        + LAM * bits(symbol | symbols before it),        u = sqrt(weight) (symbol - value / step)

Each survivor has the predictions and contexts that its own symbols lead to (Marcellin and Fischer, IEEE Trans. Comm.
38, 1990). The bits are those of the entropy coder's contexts, estimated from the result of the search before; rows
below and channels to come have the errors that the search before left. So neighbouring errors get opposite signs, and
look-ups, which interpolate between texels, see less of them; and channels compensate each other's errors.

At low rates (`LOW_RATE_BITS`) the symbols follow the trellis only around predictions that are not flat: the predicted
symbol itself may then always follow (mode DEPENDENT), not only every other time.

What this gains: docs/design/rate-distortion.md, "Trellis-coded quantisation".
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kpc.encoder.coding.predictive import (
    ACTIVITIES,
    FLAT_ACTIVITY,
    GRADIENT_CLASSES,
    INITIAL_RESIDUAL,
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
from kpc.format.coding.quantise import SYMBOL_MAX, SYMBOL_MIN, QuantisedPlane, bfloat16_ceil, quantise_plane
from kpc.format.container.segments import DEPENDENT, SCALAR, TRELLIS, PredictionWeights, rows_per_segment
from kpc.jit import compiled

# Figures behind these constants: docs/design/rate-distortion.md, "Trellis-coded quantisation".
LOW_RATE_BITS = 1.3  # bits per symbol below which the trellis is followed only around predictions that are not flat
LOW_RATE_LAM = 1.0  # lambda there, in squared steps
# How much finer the steps are there, so that a bit costs the same distortion.
LOW_RATE_STEP_RATIO = math.sqrt(LOW_RATE_LAM / LAM)
STATES = 8  # of the trellis
PASSES = 4  # searches; the first does not know the bits of symbols, nor the errors of rows below
# Sets of prediction weights. In mode DEPENDENT the file holds those of the search: one set, unless the plane has
# MANY_SYMBOLS or more.
PREDICTOR_SETS, MANY_SYMBOLS = 4, 1 << 17
MAGNITUDE_BINS = 40  # magnitudes of residuals whose bits are distinguished


def trellis_quantise(
    plane: QuantisedPlane,
    values: np.ndarray,  # (H, W, M) float32
    step: np.ndarray,  # (M,)
    significant: np.ndarray,  # (H, W, M)
    identity: bool,
    correlation: np.ndarray = NO_CORRELATION,
    low_rate_bits: float = LOW_RATE_BITS,
) -> QuantisedPlane:
    """Requantise a plane on the trellis.

    Texels that are not coded stay so and hold 0; so do texels of a time plane that are too close to the identity. Where
    8 bits are too few for `step` by a factor of two, all symbols may follow each other (mode SCALAR), since the symbols
    that the trellis permits would be too far apart. Lambda stays that of `step`.

    Args:
        plane: quantised to the nearest symbols.
        values: of the plane.
        step: quantisation steps that were asked for.
        significant: cost of a squared error in each value, relative to others of its channel; not negative.
        identity: whether texels that are not coded are 1 (a time plane).
        correlation: as in `kpc.encoder.rdo.curvature.Curvature`, or NO_CORRELATION.
        low_rate_bits: bits per symbol below which mode DEPENDENT is used.
    """
    mode = TRELLIS if np.median(plane.step / step) < 2 else SCALAR
    search = _Search(plane, values, step, significant, identity, correlation, mode)
    search.run(1)
    if mode == SCALAR or search.bits_per_symbol >= low_rate_bits:
        search.run(PASSES - 1)
        return search.result()
    finer = bfloat16_ceil((step / LOW_RATE_STEP_RATIO).astype(np.float32))
    requantised = quantise_plane(values, finer, identity=identity, needed=plane.coded)
    search = _Search(requantised, values, finer, significant, identity, correlation, DEPENDENT)
    search.run(PASSES)
    return search.result()


def requested_trellis_step(plane: QuantisedPlane) -> np.ndarray:
    """Return the steps, (M,) float64, that `trellis_quantise` was given to make this plane, where 8 bits sufficed."""
    return plane.step.astype(np.float64) * (1.0 if plane.side_info is None else LOW_RATE_STEP_RATIO)


class _Search:
    """Iterated search for the symbols of one plane; arguments as for `trellis_quantise`, and the trellis mode."""

    def __init__(
        self,
        plane: QuantisedPlane,
        values: np.ndarray,
        step: np.ndarray,
        significant: np.ndarray,
        identity: bool,
        correlation: np.ndarray,
        mode: int,
    ) -> None:
        self.plane, self.identity, self.correlation, self.mode = plane, identity, correlation, mode
        self._step_ratio = LOW_RATE_STEP_RATIO if mode == DEPENDENT else 1.0
        coarser = plane.step / step
        self.wanted = (values.astype(np.float64) - plane.offset) / plane.step
        coded = np.ascontiguousarray(plane.coded)
        weight = distortion_weights(significant, coded)
        if identity:
            coded = choose_coded_texels(self.wanted / self._step_ratio, weight, coded)
        self.rows = rows_per_segment(coded, values.shape[2], identity)
        self.coded, self.weight = coded, weight * np.float32(coarser**2)
        self.symbols = np.where(coded[..., None], plane.symbols, np.int8(0))
        self.counts = np.zeros((2 * ACTIVITIES, MAGNITUDE_BINS))
        self.errors = np.zeros((values.shape[0] + 2, values.shape[1] + 2, values.shape[2]), np.float32)
        if identity:
            self.errors[1:-1, 1:-1] = np.where(coded[..., None], 0, np.sqrt(self.weight) * -self.wanted)

    def run(self, passes: int) -> None:
        """Search `passes` times, each time with predictors and bits from the result before."""
        for _ in range(passes):
            neighbours = collect_neighbours(self.symbols, self.coded)
            many = self.mode != DEPENDENT or len(neighbours) >= MANY_SYMBOLS
            self.predictors = fit_weights(neighbours, PREDICTOR_SETS if many else 1)
            rate_costs = LAM * self._step_ratio**2 * _residual_bits(self.counts)
            # Arrays of one memory layout, so that the search is compiled once.
            problem = Problem(
                np.ascontiguousarray(self.wanted),
                np.ascontiguousarray(self.weight),
                self.coded,
                self.rows,
                self.mode,
                self.predictors,
                rate_costs,
                np.ascontiguousarray(self.correlation),
            )
            self.symbols, self.counts = search(problem, self.errors)

    @property
    def bits_per_symbol(self) -> float:
        return float((self.counts * _residual_bits(self.counts)).sum() / max(self.counts.sum(), 1))

    def result(self) -> QuantisedPlane:
        """Return the plane with the symbols found."""
        starts = tuple(range(0, len(self.symbols), self.rows))
        if self.mode == DEPENDENT:  # symbols depend on predictions, whose weights are part of the file
            side_info = PredictionWeights(self.predictors)
            return replace(self.plane, symbols=self.symbols, coded=self.coded, side_info=side_info, starts=starts)
        coded = np.asarray(self.symbols.any(axis=2)) if self.identity else self.coded
        return replace(self.plane, symbols=self.symbols, coded=coded, starts=starts)


def _residual_bits(counts: np.ndarray) -> np.ndarray:
    """Return the bits (2 ACTIVITIES, MAGNITUDE_BINS) of residuals by magnitude, from their counts in each context.

    The first half is for even states of the trellis, the second for odd ones. The expected magnitude doubles with every
    other activity.
    """
    return magnitude_bits(counts, 0.04 * 2.0 ** (np.tile(np.arange(ACTIVITIES), 2) / 2 - 1.5))


class Problem(NamedTuple):
    """What a search is given.

    Attributes:
        wanted: (H, W, M) float64, the values in steps.
        weight: (H, W, M) float32 distortion weights.
        coded: (H, W) bool.
        rows: rows per segment; segments are predicted independently.
        mode: TRELLIS, DEPENDENT or SCALAR (`kpc.encoder.coding.predictive`).
        predictors: prediction weights.
        rate_costs: (contexts, MAGNITUDE_BINS), lambda times the bits of a residual.
        correlation: as for `trellis_quantise`.
    """

    wanted: np.ndarray
    weight: np.ndarray
    coded: np.ndarray
    rows: int
    mode: int
    predictors: np.ndarray
    rate_costs: np.ndarray
    correlation: np.ndarray


class _Prediction(NamedTuple):
    """State of the predictor; names of neighbours as in `kpc.encoder.coding.predictive`.

    Attributes:
        v: (3, W + 4) int32, symbols of this row and the two above, by row modulo 3.
        r: (3, W + 4) int32, residuals of the same.
        taps: prediction weights as integers.
        sums: (sets, W) int32, weighted sums of the symbols above.
        gradients: (W,) int32, of the symbols above.
        activities: (W,) int32, of the residuals above.
        cross: (H, W) int16, residuals of earlier channels.
        classes: gradient classes, for the choice of the set of weights.
    """

    v: np.ndarray
    r: np.ndarray
    taps: np.ndarray
    sums: np.ndarray
    gradients: np.ndarray
    activities: np.ndarray
    cross: np.ndarray
    classes: np.ndarray


class _Survivors(NamedTuple):
    """Paths of the Viterbi search along a row, by position and final state.

    Attributes:
        values: (W + 4, STATES) int64 symbols.
        residuals: (W + 4, STATES) int64.
        errors: (W + 2, STATES) float32, weighted errors u.
        origins: (W, STATES) int64, the states that the paths come from.
        contexts: (W, STATES) int64, entropy contexts of the residuals.
        magnitudes: (W, STATES) int64, of the residuals, clipped to the bins.
    """

    values: np.ndarray
    residuals: np.ndarray
    errors: np.ndarray
    origins: np.ndarray
    contexts: np.ndarray
    magnitudes: np.ndarray


@compiled()
def search(
    problem: Problem,
    errors: np.ndarray,  # (H + 2, W + 2, M) float32
) -> tuple[np.ndarray, np.ndarray]:
    """Find the symbols of least cost, (H, W, M) int8, row by row, and count their residuals by context and magnitude.

    `errors` holds the weighted errors u of all texels with a border of 0; those of coded texels are updated.
    """
    H, W, M = problem.wanted.shape
    taps = tap_weights(problem.predictors)
    symbols, counts = np.zeros((H, W, M), np.int8), np.zeros(problem.rate_costs.shape)
    prediction = _Prediction(
        np.zeros((3, W + 4), np.int32),
        np.zeros((3, W + 4), np.int32),
        taps,
        np.zeros((len(taps), W), np.int32),
        np.zeros(W, np.int32),
        np.zeros(W, np.int32),
        np.zeros((H, W), np.int16),
        GRADIENT_CLASSES * len(problem.predictors) >> 3,
    )
    survivors = _Survivors(
        np.zeros((W + 4, STATES), np.int64),
        np.zeros((W + 4, STATES), np.int64),
        np.zeros((W + 2, STATES), np.float32),
        np.zeros((W, STATES), np.int64),
        np.zeros((W, STATES), np.int64),
        np.zeros((W, STATES), np.int64),
    )
    v, r, cross = prediction.v, prediction.r, prediction.cross
    for m in range(M):
        from_channels = cross_channel_errors(errors, problem.correlation, m)
        for y in range(H):
            row = y % problem.rows  # within its segment
            v0, v1, v2 = v[y % 3], v[(y + 2) % 3], v[(y + 1) % 3]
            r0, r1, r2 = r[y % 3], r[(y + 2) % 3], r[(y + 1) % 3]
            begin_row(v0, v1, v2, row, 0)
            begin_row(r0, r1, r2, row, INITIAL_RESIDUAL)
            if row > 0:
                sum_above(
                    taps, v1, v2, r1, r2, cross[y], m, prediction.sums, prediction.gradients, prediction.activities
                )
            state = _search_row(problem, prediction, survivors, errors, from_channels, m, y)
            for x in range(W - 1, -1, -1):  # trace the best path back
                v0[x + 2], r0[x + 2] = survivors.values[x + 2, state], survivors.residuals[x + 2, state]
                if problem.coded[y, x]:
                    symbols[y, x, m] = survivors.values[x + 2, state]
                    errors[y + 1, x + 1, m] = survivors.errors[x + 1, state]
                    counts[survivors.contexts[x, state], survivors.magnitudes[x, state]] += 1
                state = survivors.origins[x, state]
            v0[W + 2 :], r0[W + 2 :] = v0[W + 1], r0[W + 1]
            if row > 0:
                update_cross_channel(cross[y - 1], r2, r1, r0, m)
            if row == problem.rows - 1 or y == H - 1:
                update_cross_channel(cross[y], r1 if row > 0 else r0, r0, r0, m)
    return symbols, counts


@compiled()
def _search_row(
    problem: Problem,
    prediction: _Prediction,
    survivors: _Survivors,
    errors: np.ndarray,  # (H + 2, W + 2, M) float32
    from_channels: np.ndarray,  # (H, W) float32
    m: int,
    y: int,
) -> int:
    """Find the path of least cost along a row of a channel; return its final state.

    The loop body is one function because survivors, predictions and costs depend on each other symbol by symbol, and
    calls would take most of the time.
    """
    wanted, weight, coded, mode, rate_costs = (
        problem.wanted,
        problem.weight,
        problem.coded,
        problem.mode,
        problem.rate_costs,
    )
    V, R, U, origins = survivors.values, survivors.residuals, survivors.errors, survivors.origins
    sums, gradients, activities = prediction.sums, prediction.gradients, prediction.activities
    v1, v2, r1, r2 = (
        prediction.v[(y + 2) % 3],
        prediction.v[(y + 1) % 3],
        prediction.r[(y + 2) % 3],
        prediction.r[(y + 1) % 3],
    )
    cross, first_row = prediction.cross[y], y % problem.rows == 0
    spacing = 1 if mode == SCALAR else 2  # of the symbols that may follow
    cost, before = np.full(STATES, np.inf), np.full(STATES, np.inf)
    cost[0] = 0
    for s in range(STATES):
        for x in range(2):  # arrays assigned to slices would have their message about shapes compiled
            V[x, s], R[x, s] = prediction.v[y % 3][x], prediction.r[y % 3][x]
    for x in range(coded.shape[1]):
        X = x + 2
        before, cost = cost, before
        cost[:] = np.inf
        root, here = math.sqrt(weight[y, x, m]), errors[y + 1, x + 1, m]
        outside = (
            from_channels[y, x]
            + EDGE_COUPLING * (errors[y, x + 1, m] + errors[y + 2, x + 1, m])
            + CORNER_COUPLING * (errors[y, x, m] + errors[y, x + 2, m] + errors[y + 2, x, m] + errors[y + 2, x + 2, m])
        )
        for s in range(STATES):
            if before[s] == np.inf:
                continue
            # Symbols and residuals to the left: one texel away, and two, by the path of this survivor.
            w, rw = V[X - 1, s], R[X - 1, s]
            earlier = origins[x - 1, s] if x else s
            ww, rww = V[X - 2, earlier], R[X - 2, earlier]
            if not coded[y, x]:
                left = first_row or (x > 0 and coded[y, x - 1])
                V[X, s], R[X, s] = (w, rw) if left else (v1[X + 1], r1[X + 1])
                cost[s], origins[x, s], U[x + 1, s] = before[s] + 2 * here * EDGE_COUPLING * U[x, s], s, here
                continue
            if first_row:  # the row above repeats the symbol to the left
                v1[x : x + 5], v2[x : x + 5], r1[x : x + 5], r2[x : x + 5] = w, w, rw, rw
                sum_above(
                    prediction.taps,
                    v1[x:],
                    v2[x:],
                    r1[x:],
                    r2[x:],
                    cross[x:],
                    m,
                    sums[:, x : x + 1],
                    gradients[x : x + 1],
                    activities[x : x + 1],
                )
            predicted, gradient = predict(
                prediction.taps, prediction.classes, w, ww, int(v1[X - 1]), x, sums, gradients
            )
            context, odd = activity(activities[x], rw, rww, gradient, m), s & 1 if mode != SCALAR else 0
            local_mode = TRELLIS if mode == DEPENDENT and context >= FLAT_ACTIVITY else mode
            rounded = round_prediction(predicted, local_mode, odd)
            if odd and local_mode == DEPENDENT:
                context += ACTIVITIES
            coupled = outside + EDGE_COUPLING * U[x, s]
            best = min(max(wanted[y, x, m] - coupled / root, SYMBOL_MIN), SYMBOL_MAX)  # of least distortion
            away = best - rounded
            size = int((abs(away) + (1 if odd and local_mode == DEPENDENT else 0)) / spacing)
            nearest = size if away > 0 else -size
            for residual in (nearest - 1, nearest, nearest + 1, 0):
                value = rounded + residual_to_offset(residual, local_mode, odd)
                if not SYMBOL_MIN <= value <= SYMBOL_MAX:
                    continue
                size = min(abs(residual), MAGNITUDE_BINS - 1)
                u = root * (value - wanted[y, x, m])
                total = before[s] + u * (u + 2 * coupled) + rate_costs[context, size]
                # In mode SCALAR survivors differ in the parities of their last three symbols.
                to = (
                    (s << 1 | value & 1) & STATES - 1
                    if mode == SCALAR
                    else next_trellis_state(s, value, residual, local_mode)
                )
                if total < cost[to]:
                    cost[to], origins[x, to] = total, s
                    survivors.contexts[x, to], survivors.magnitudes[x, to] = context, size
                    V[X, to], R[X, to], U[x + 1, to] = value, abs((value << 7) - predicted) >> 3, u
    return int(np.argmin(cost))
