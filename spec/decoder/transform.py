"""Section 7.5: the TRANSFORM plane codec."""

from .common import clamp
from .entropy import log_class

COSINE = [181, 180, 178, 173, 167, 160, 151, 140, 128, 115, 101, 85, 69, 53, 35, 18, 0]
FREQUENCY_SCALE = {
    4: [52, 55, 64, 80],
    8: [52, 53, 55, 59, 64, 71, 80, 87],
    16: [52, 52, 53, 54, 55, 57, 59, 61, 64, 67, 71, 75, 80, 84, 87, 90],
}
OFFSET_SCALE = [181, 128, 91, 64, 45, 32, 23, 16]
LOG2 = {4: 2, 8: 3, 16: 4}

END_UNARY, END_ESCAPE = 2, 4  # binarisation of 1 + end
LEVEL_UNARY, LEVEL_ESCAPE = 5, 12  # binarisation of a magnitude
LEVEL_PRIOR = [  # by model number (0, 1, 2 and beyond) and magnitude class
    [27, 66, 61, 86, 79, 96, 118, 143, 168, 190, 206, 220, 230, 238, 243, 248],
    [19, 26, 24, 37, 37, 48, 67, 90, 120, 151, 179, 201, 217, 229, 235, 244],
    [110, 100, 90, 86, 82, 80, 87, 98, 117, 135, 160, 184, 204, 220, 230, 243],
]
DC_PRIOR = [243, 210, 220]
SIGN_PRIOR = [134, 135, 138, 141, 152, 159, 164, 170, 178, 184, 190, 197, 205, 212, 218, 224, 229, 234, 239, 244]


def basis(N, i, y):
    """Return 128 sqrt(2) cos(pi i (2 y + 1) / (2 N)), rounded; 128 for i = 0."""
    if i == 0:
        return 128
    angle = 16 // N * i * (2 * y + 1) % 64
    k = min(angle, 64 - angle)
    return COSINE[k] if k <= 16 else -COSINE[32 - k]


def diagonal(N, number):
    """Return the positions (i, j) with i + j = number, by rising i."""
    return [(i, number - i) for i in range(N) if 0 <= number - i < N]


def decode_qoffsets(decisions, is_active):
    """Return {(by, bx): quantiser offset}; is_active: {(by, bx): whether a texel is coded}, in raster order."""
    qoffset = {}
    for by, bx in is_active:
        left_qoffset = qoffset[by, bx - 1] if bx else qoffset[by - 1, bx] if by else 3
        above_qoffset = qoffset[by - 1, bx] if by else left_qoffset
        expected = left_qoffset + above_qoffset + 1 >> 1
        if is_active[by, bx]:
            node = 1
            for _ in range(3):
                node = 2 * node + decisions.adaptive(("qoffset", expected, node))
            expected = node - 8
        qoffset[by, bx] = expected
    return qoffset


def quantisation_steps(N, base_step, qoffset):
    """Return {(i, j): quantisation step of a level, in 1/8 of a symbol}."""
    scale = FREQUENCY_SCALE[N]
    return {
        (i, j): max(base_step * OFFSET_SCALE[qoffset] * scale[i] * scale[j] + 131072 >> 18, 1)
        for i in range(N)
        for j in range(N)
    }


def decode_symbols(decisions, coded, H, W, M, N, base_step):
    """Return {(y, x, c): symbol} of the coded texels."""
    is_active = {
        (by, bx): any(coded.get((by * N + y, bx * N + x)) for y in range(N) for x in range(N))
        for by in range(-(-H // N))
        for bx in range(-(-W // N))
    }
    qoffset = decode_qoffsets(decisions, is_active)
    symbols, end, mag = {}, {}, {}  # end and mag by (c, by, bx) and (c, by, bx, i, j), 0 where absent
    for c in range(M):
        dc, right_edge, bottom_edge = {}, {}, {}
        for by, bx in is_active:
            dc[by, bx] = median_prediction(dc, by, bx)
            if not is_active[by, bx]:
                continue
            qstep = quantisation_steps(N, base_step, qoffset[by, bx])
            left_edge, top_edge = right_edge.get((by, bx - 1)), bottom_edge.get((by - 1, bx))
            dc_prediction = predict_dc(dc[by, bx], left_edge, top_edge, qstep)
            neighbours = (c, by, bx - 1), (c, by - 1, bx), (c - 1, by, bx)
            end[c, by, bx] = block_end = decode_end(decisions, sum(end.get(block, 0) for block in neighbours), N)
            level = decode_levels(decisions, mag, c, by, bx, block_end, N)
            level[0, 0] = level.get((0, 0), 0) + dc_prediction
            coefficient = decode_signs(decisions, level, qstep, block_end, left_edge, top_edge, N)
            dc[by, bx] = coefficient[0, 0]
            output = inverse_transform(coefficient, N)
            right_edge[by, bx], bottom_edge[by, bx] = [row[-1] for row in output], output[-1]
            for y in range(N):
                for x in range(N):
                    if coded.get((by * N + y, bx * N + x)):
                        symbols[by * N + y, bx * N + x, c] = output[y][x]
    return symbols


def median_prediction(dc, by, bx):
    if by == 0 or bx == 0:
        return dc[by, bx - 1] if bx else dc[by - 1, bx] if by else 0
    dc_left, dc_above, dc_corner = dc[by, bx - 1], dc[by - 1, bx], dc[by - 1, bx - 1]
    return clamp(dc_left + dc_above - dc_corner, min(dc_left, dc_above), max(dc_left, dc_above))


def predict_dc(expected_dc, left_edge, top_edge, qstep):
    if left_edge or top_edge:
        expected_dc = 4 * (sum(left_edge or top_edge) + sum(top_edge or left_edge)) + expected_dc >> 1
    return (expected_dc + qstep[0, 0] // 2) // qstep[0, 0]


def decode_end(decisions, total, N):
    context = min(log_class(total), 9)
    value = decisions.positive(lambda k: decisions.adaptive(("end", context, k)), END_UNARY, END_ESCAPE)
    return min(value - 1, 2 * N - 1)


def decode_levels(decisions, mag, c, by, bx, end, N):
    """Return {(i, j): level}, without a sign but for (0, 0), and note their magnitudes."""

    def known(block, i, j):
        return mag.get((*block, i, j), 0)

    here, left, above, previous = (c, by, bx), (c, by, bx - 1), (c, by - 1, bx), (c - 1, by, bx)
    level = {}
    for number in range(end - 1, -1, -1):
        for i, j in diagonal(N, number):
            higher = 2 * known(here, i, j + 1) + 2 * known(here, i + 1, j)
            higher += known(here, i + 1, j + 1) + known(here, i, j + 2) + known(here, i + 2, j)
            beside = sum(known(b, i + di, j + dj) for b in (left, above) for di, dj in ((0, 0), (0, 1), (1, 0)))
            total = 3 * higher + 2 * beside + 3 * known(previous, i, j)
            magnitude_class = min(log_class(total), 15)
            frequency_class = min(5 * (i + j) // N, 7) if i + j else 8
            magnitude = decode_magnitude(decisions, magnitude_class, frequency_class)
            mag[c, by, bx, i, j] = level[i, j] = magnitude
            if magnitude and (i, j) == (0, 0) and not decisions.literal(1):
                level[i, j] = -magnitude
    return level


def decode_magnitude(decisions, magnitude_class, frequency_class):
    def adaptive(k):
        prior = DC_PRIOR[min(k, 2)] if frequency_class == 8 else LEVEL_PRIOR[min(k, 2)][magnitude_class]
        initial = (256 * prior, 8) if k <= LEVEL_UNARY else (32768, 0)
        return decisions.adaptive(("level", magnitude_class, frequency_class, k), initial)

    return decisions.positive(lambda k: adaptive(k + 1), LEVEL_UNARY, LEVEL_ESCAPE) if adaptive(0) else 0


def decode_signs(decisions, level, qstep, end, left_edge, top_edge, N):
    """Return {(i, j): coefficient}, which the boundary residuals of the block help to sign."""
    left_residual = [8 * a for a in left_edge or [0] * N]
    top_residual = [8 * a for a in top_edge or [0] * N]
    shift = 7 + LOG2[N]

    def subtract(i, j, a):
        at_left, at_top = basis(N, j, 0) * a + 64 >> 7, basis(N, i, 0) * a + 64 >> 7
        for k in range(N):
            left_residual[k] -= basis(N, i, k) * at_left + (1 << shift - 1) >> shift
            top_residual[k] -= basis(N, j, k) * at_top + (1 << shift - 1) >> shift

    def correlation(residual, along, across):
        return basis(N, across, 0) * (sum(basis(N, along, k) * clamp(residual[k], -4095, 4095) for k in range(N)) >> 7)

    subtract(0, 0, clamp(level[0, 0] * qstep[0, 0], -32768, 32767))
    for number in range(1, end):
        for i, j in diagonal(N, number):
            if level[i, j] == 0:
                continue
            amplitude = min(level[i, j] * qstep[i, j], 32767)
            bias = correlation(left_residual, i, j) if left_edge else 0
            bias += correlation(top_residual, j, i) if top_edge else 0
            if bias == 0:
                is_positive = decisions.literal(1)
            else:
                sign_class = log_class(abs(bias)) + log_class(amplitude) - 2 * log_class(qstep[0, 0]) - 2 * LOG2[N] - 3
                sign_class = clamp(sign_class, 0, 19)
                agrees = decisions.adaptive(("sign", sign_class), (256 * SIGN_PRIOR[sign_class], 8))
                is_positive = agrees == (bias > 0)
            level[i, j] = level[i, j] if is_positive else -level[i, j]
            subtract(i, j, amplitude if is_positive else -amplitude)
    return {(i, j): clamp(value * qstep[i, j], -32768, 32767) for (i, j), value in level.items()}


def inverse_transform(coefficient, N):
    """Return the symbols output[y][x] of a block."""
    rows = range(N)
    column = [[sum(basis(N, i, y) * coefficient.get((i, j), 0) for i in rows) + 64 >> 7 for j in rows] for y in rows]
    shift = 10 + LOG2[N]
    return [
        [clamp(sum(basis(N, j, x) * column[y][j] for j in rows) + (1 << shift - 1) >> shift, -128, 127) for x in rows]
        for y in rows
    ]
