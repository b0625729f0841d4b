"""Section 7.4: the PREDICTIVE plane codec."""

from typing import NamedTuple

from .common import clamp, require
from .entropy import log_class

SCALAR, TRELLIS, DEPENDENT = range(3)  # quantisers
UNARY, ESCAPE = 4, 7  # binarisation of a residual
START = 0, 16  # (padded, dev) to the left of the first row
FAR_NEIGHBOURS = [(1, 1), (1, -1), (0, 2), (2, 0), (1, 2), (2, 1), (2, -1), (1, -2)]  # nw ne ww nn nww nnw nne nee


class Channel:
    """padded (the symbols) and dev (the deviations) of one channel, at all positions where they are defined."""

    def __init__(self, W):
        self.W, self.known = W, {}  # (padded, dev) by (y, x)

    def at(self, y, x):
        """Return (padded, dev) at (y, x), x from -2 to W + 1."""
        if x < 0:
            return self.known[y - 1, 0] if y > 0 else START
        return self.known[y, min(x, self.W - 1)]

    def neighbour(self, y, x, up, back):
        """Return (padded, dev) of the neighbour (y - up, x - back) of the texel (y, x)."""
        if y == 0 and up > 0:
            return self.at(0, x - 1)
        return self.at(max(y - up, 0), x - back)


class Prediction(NamedTuple):
    gradient: int
    prediction: int
    activity_class: int


class Rounded(NamedTuple):
    rule: int
    rounded: int
    remainder: int
    context: int


def decode_symbols(decisions, coded, H, W, M, quantiser, weights):
    """Return {(y, x, c): symbol} of the coded texels; weights: a list of sets of 9."""
    symbols, cross = {}, {}
    for c in range(M):
        channel = Channel(W)
        for y in range(H):
            trellis_state = 0
            for x in range(W):
                if not coded[y, x]:
                    from_left = y == 0 or (x > 0 and coded[y, x - 1])
                    channel.known[y, x] = channel.neighbour(y, x, *((0, 1) if from_left else (1, -1)))
                    continue
                parity = trellis_state % 2
                predicted = predict(channel, y, x, weights, cross[y, x] if c else None)
                here = round_prediction(predicted, quantiser, parity)
                residual = decisions.signed(("residual", here.context), UNARY, ESCAPE)
                if here.remainder < 0:
                    residual = -residual
                symbol = reconstruct(here, residual, parity)
                require(-128 <= symbol <= 127, "a symbol exceeds 8 bits")
                symbols[y, x, c] = symbol
                channel.known[y, x] = symbol, abs(128 * symbol - predicted.prediction) >> 3
                branch = residual % 2 if here.rule == DEPENDENT else symbol % 4 >> 1
                trellis_state = trellis_state >> 1 ^ 5 * parity ^ 2 * branch
        update_cross(cross, channel, H, W, c)
    return symbols


def predict(channel, y, x, weights, cross):  # steps 1 and 2
    """cross: None in the first channel."""
    w, dev_w = channel.neighbour(y, x, 0, 1)
    n, dev_n = channel.neighbour(y, x, 1, 0)
    far = [channel.neighbour(y, x, up, back) for up, back in FAR_NEIGHBOURS]
    (nw, dev_nw), (ne, dev_ne), (ww, dev_ww), (nn, dev_nn), *_ = far
    gradient = abs(w - nw) + abs(n - nw) + abs(n - ne) + abs(w - ww) + abs(n - nn)
    weight = weights[min(gradient.bit_length(), 7) * len(weights) >> 3]
    prediction = 64 * (w + n) + weight[0] * (w - n)
    prediction += sum(weight[i] * (2 * a - (w + n)) for i, (a, _) in enumerate(far, 1))
    own = 2 * dev_w + 2 * dev_n + dev_nw + dev_ne + dev_ww + dev_nn
    activity = 20 * gradient + (4 * own if cross is None else 11 * own + 5 * cross >> 2)
    return Prediction(gradient, clamp(prediction, -16384, 16256), log_class(activity + 128 >> 6) - 2)


def round_prediction(predicted, quantiser, parity):  # steps 3 and 4
    prediction, activity_class = predicted.prediction, predicted.activity_class
    rule = TRELLIS if quantiser == DEPENDENT and activity_class >= 4 else quantiser
    rounded = 2 * (prediction - 128 * parity + 128 >> 8) + parity if rule == TRELLIS else prediction + 64 >> 7
    remainder = prediction - 128 * rounded
    part = parity if rule == DEPENDENT else min(3 * abs(remainder) >> (7 if rule == TRELLIS else 6), 2)
    return Rounded(rule, rounded, remainder, 3 * activity_class + part)


def reconstruct(here, residual, parity):  # step 5
    if here.rule == SCALAR:
        return here.rounded + residual
    if here.rule == TRELLIS:
        return here.rounded + 2 * residual
    sign = (residual > 0) - (residual < 0)
    return here.rounded + 2 * residual - sign * parity


def update_cross(cross, channel, H, W, c):
    """Smooth the deviations of a channel into cross[y, x]."""
    for y in range(H):
        for x in range(W):
            smooth = sum(
                (2 - abs(i)) * (2 - abs(j)) * channel.at(clamp(y + i, 0, H - 1), x + j)[1]
                for i in (-1, 0, 1)
                for j in (-1, 0, 1)
            )
            smooth >>= 1
            cross[y, x] = smooth if c == 0 else cross[y, x] + (smooth - cross[y, x] >> 3)
