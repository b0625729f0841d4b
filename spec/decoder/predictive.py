"""Section 7.5: the PREDICTIVE plane codec."""

from .common import clamp, require
from .entropy import log_class

SCALAR, TRELLIS, DEPENDENT = range(3)  # quantisers
UNARY, ESCAPE = 4, 7  # binarisation of a residual
START = 0, 16  # (v, deviation) to the left of the first texel
FAR_NEIGHBOURS = [(1, 1), (1, -1), (0, 2), (2, 0), (1, 2), (2, 1), (2, -1), (1, -2)]  # nw ne ww nn nww nnw nne nee


class Channel:
    """v (the symbols) and deviation of one channel, with their padding."""

    def __init__(self, W):
        self.W, self.known = W, {}  # (v, deviation) by (y, x)

    def padded(self, y, x):
        """Return (v, deviation) at (y, x), x from -2 to W + 1."""
        if x < 0:
            return self.known[y - 1, 0] if y > 0 else START
        return self.known[y, min(x, self.W - 1)]

    def neighbour(self, y, x, up, back):
        """Return (v, deviation) of the neighbour (y - up, x - back) of the texel (y, x)."""
        if y == 0 and up > 0:
            return self.padded(0, x - 1)
        return self.padded(max(y - up, 0), x - back)


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

                # 1. Prediction
                w, dev_w = channel.neighbour(y, x, 0, 1)
                n, dev_n = channel.neighbour(y, x, 1, 0)
                far = [channel.neighbour(y, x, up, back) for up, back in FAR_NEIGHBOURS]
                (nw, dev_nw), (ne, dev_ne), (ww, dev_ww), (nn, dev_nn), *_ = far
                gradient = abs(w - nw) + abs(n - nw) + abs(n - ne) + abs(w - ww) + abs(n - nn)
                k = weights[min(gradient.bit_length(), 7) * len(weights) >> 3]
                prediction = 64 * (w + n) + k[0] * (w - n)
                prediction += sum(k[i] * (2 * a - (w + n)) for i, (a, _) in enumerate(far, 1))
                prediction = clamp(prediction, -16384, 16256)

                # 2. Activity
                own = 2 * dev_w + 2 * dev_n + dev_nw + dev_ne + dev_ww + dev_nn
                activity = (4 * own if c == 0 else 11 * own + 5 * cross[y, x] >> 2) + 20 * gradient
                activity_class = log_class(activity + 128 >> 6) - 2

                # 3. Rounded prediction
                parity = trellis_state % 2
                quantiser_here = TRELLIS if quantiser == DEPENDENT and activity_class >= 4 else quantiser
                if quantiser_here == TRELLIS:
                    rounded = 2 * (prediction - 128 * parity + 128 >> 8) + parity
                else:
                    rounded = prediction + 64 >> 7
                remainder = prediction - 128 * rounded
                if quantiser_here == DEPENDENT:
                    part = parity
                else:
                    part = min(3 * abs(remainder) >> (7 if quantiser_here == TRELLIS else 6), 2)

                # 4. Residual
                residual = decisions.signed(("residual", 3 * activity_class + part), UNARY, ESCAPE)
                if remainder < 0:
                    residual = -residual

                # 5. Symbol
                sign = (residual > 0) - (residual < 0)
                if quantiser_here == SCALAR:
                    v = rounded + residual
                elif quantiser_here == TRELLIS:
                    v = rounded + 2 * residual
                else:
                    v = rounded + 2 * residual - sign * parity
                require(-128 <= v <= 127, "a symbol exceeds 8 bits")
                symbols[y, x, c] = v
                channel.known[y, x] = v, abs(128 * v - prediction) >> 3

                # 6. Trellis state
                branch = residual % 2 if quantiser_here == DEPENDENT else v % 4 >> 1
                trellis_state = trellis_state >> 1 ^ 5 * parity ^ 2 * branch
        update_cross(cross, channel, H, W, c)
    return symbols


def update_cross(cross, channel, H, W, c):
    """Smooth the deviations of a channel into cross[y, x], the activity that the next channel expects."""
    for y in range(H):
        for x in range(W):
            smooth = sum(
                (2 - abs(i)) * (2 - abs(j)) * channel.padded(clamp(y + i, 0, H - 1), x + j)[1]
                for i in (-1, 0, 1)
                for j in (-1, 0, 1)
            )
            smooth >>= 1
            cross[y, x] = smooth if c == 0 else cross[y, x] + (smooth - cross[y, x] >> 3)
