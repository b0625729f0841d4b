/* Section 7.5: TRANSFORM. */

#include "segments.h"

#define LARGEST_SIDE 16
#define LEVEL_MODELS 18
#define LEVEL_UNARY 5
#define LEVEL_ESCAPE 12
#define END_MODELS 6
#define END_UNARY 2
#define END_ESCAPE 4
#define END_CONTEXTS 10
#define FREQUENCY_CLASSES 9
#define MAGNITUDE_CLASSES 16
#define SIGN_CLASSES 20
#define DEFAULT_OFFSET 3
/* Magnitudes are kept up to here for contexts: one such makes magnitude_class 15 alone, and so would larger ones. */
#define KEPT_MAGNITUDE 255

static Model level_models[MAGNITUDE_CLASSES * FREQUENCY_CLASSES * LEVEL_MODELS];
static Model end_models[END_CONTEXTS * END_MODELS];
static Model sign_models[SIGN_CLASSES];
static Model qoffset_models[8 * 8];

/* Four numbers, and rows of 16 for any N, of which the first N count. Loops over k run over N / 4 such fours. */
typedef i32 Four __attribute__((vector_size(16)));
typedef union {
    Four four[LARGEST_SIDE / 4];
    i32 at[LARGEST_SIDE];
} Line;

static Line basis[LARGEST_SIDE];       /* [i][k] */
static Line qsteps[8][LARGEST_SIDE];   /* by qoffset, [i][j] */
static Line level[LARGEST_SIDE];       /* [i][j], of the current block */
static Line column[LARGEST_SIDE];      /* [j][y] */
static Line output[LARGEST_SIDE];      /* [y][x] */
static Line context_sum[LARGEST_SIDE]; /* [i][j], the parts of magnitude_class from around the block */
static Line residual_left, residual_top, left_edge;

/* What is kept of blocks. `mag` has N + 2 rows and columns for each, so that mag beyond the block is 0. */
typedef struct {
    Segment *segment;
    u32 N, log2_N, down, across;
    u8 *active, *qoffset, *mag, *end;
    i32 *dc;
    Line *bottom_edges;
    u8 *no_magnitudes;
} Blocks;

/* A block that is being decoded. */
typedef struct {
    u32 by, bx, channel, has_left, has_above, end;
    const Line *qstep;
    Line *top_edge;
    i32 dc_prediction;
} Block;

/* 7.5, "Initial models". */
static void begin_models(void) {
    new_models(qoffset_models, 64);
    new_models(end_models, END_CONTEXTS * END_MODELS);
    new_models(level_models, MAGNITUDE_CLASSES * FREQUENCY_CLASSES * LEVEL_MODELS);
    for (u32 context = 0; context < MAGNITUDE_CLASSES * FREQUENCY_CLASSES; context++)
        for (u32 number = 0; number <= LEVEL_UNARY; number++) {
            u32 rank = number < 2 ? number : 2, is_mean = context % FREQUENCY_CLASSES == FREQUENCY_CLASSES - 1;
            u32 entry = is_mean ? MEAN_PROBABILITY[rank] : LEVEL_PROBABILITY[rank][context / FREQUENCY_CLASSES];
            level_models[context * LEVEL_MODELS + number] = entry << 16 | INITIAL_COUNT;
        }
    for (u32 sign = 0; sign < SIGN_CLASSES; sign++) sign_models[sign] = (u32)SIGN_PROBABILITY[sign] << 16 | INITIAL_COUNT;
}

/* 7.5, "Tables" and "Quantiser offsets": basis and quantisation steps. */
static void begin_tables(u32 N, u32 log2_N, u32 base_step) {
    const i32 *scale = FREQUENCY_SCALE[log2_N - 2];
    for (u32 i = 0; i < N; i++)
        for (u32 y = 0; y < N; y++) {
            u32 angle = 16 / N * i * (2 * y + 1) % 64, k = angle < 32 ? angle : 64 - angle;
            basis[i].at[y] = i == 0 ? 128 : k <= 16 ? COSINE[k] : -COSINE[32 - k];
            for (u32 q = 0; q < 8; q++)
                qsteps[q][i].at[y] = max(((i32)base_step * OFFSET_SCALE[q] * scale[i] * scale[y] + 131072) >> 18, 1);
        }
}

/* 7.5, "Blocks": which are active. */
static void find_active(Blocks *b) {
    u32 H = b->segment->rows, W = b->segment->columns;
    for (u32 y = 0; y < H; y++)
        for (u32 x = 0; x < W; x++) b->active[y / b->N * b->across + x / b->N] |= b->segment->coded[y * W + x];
}

/* 7.5, "Quantiser offsets". */
static void decode_qoffsets(Blocks *b, Decoder *decoder) {
    Decoder d = *decoder;
    for (u32 by = 0; by < b->down && !d.missing; by++)
        for (u32 bx = 0; bx < b->across; bx++) {
            u8 *here = b->qoffset + by * b->across + bx;
            u32 above = by > 0 ? *(here - b->across) : DEFAULT_OFFSET, left = bx > 0 ? *(here - 1) : above;
            u32 expected = (left + (by > 0 ? above : left) + 1) >> 1, node = 1;
            if (b->active[by * b->across + bx]) {
                for (u32 k = 0; k < 3; k++) node = 2 * node + adaptive(&d, &qoffset_models[expected * 8 + node]);
                *here = (u8)(node - 8);
            } else
                *here = (u8)expected;
        }
    *decoder = d;
}

/* 7.5, step 1, from the blocks around. */
INLINE i32 expected_from_neighbours(const Blocks *b, const Block *block) {
    const i32 *here = b->dc + block->by * b->across + block->bx;
    if (block->by == 0) return block->bx == 0 ? 0 : here[-1];
    const i32 *above = here - b->across;
    if (block->bx == 0) return *above;
    i32 low = min(here[-1], *above), high = max(here[-1], *above);
    return clamp(here[-1] + *above - above[-1], low, high);
}

INLINE i32 sum_of(Four a) { return a[0] + a[1] + a[2] + a[3]; }
INLINE Four within(Four a, i32 low, i32 high) {
    Four lows = {low, low, low, low}, highs = {high, high, high, high};
    return __builtin_elementwise_min(__builtin_elementwise_max(a, lows), highs);
}

/* 7.5, step 1, from the edges, for an active block. */
static i32 predict_dc(const Block *block, i32 expected_dc, u32 N) {
    i32 left = 0, top = 0, qstep = block->qstep[0].at[0];
    if (block->has_left || block->has_above) {
        for (u32 k = 0; k < N / 4; k++) left += sum_of(left_edge.four[k]), top += sum_of(block->top_edge->four[k]);
        if (!block->has_left) left = top;
        if (!block->has_above) top = left;
        expected_dc = (4 * (left + top) + expected_dc) >> 1;
    }
    i32 over = expected_dc + (qstep >> 1);
    return over / qstep - (over % qstep < 0); /* rounded down */
}

/* 7.5, step 3: 2 * beside + 3 * previous_mag, of the frequencies that have levels. */
static void sum_around(const u8 *here, const u8 *left, const u8 *above, u32 end, u32 N) {
    for (u32 i = 0; i < N && i < end; i++)
        for (u32 j = 0; j < N && i + j < end; j++) {
            u32 at = i * (N + 2) + j, below = at + N + 2;
            i32 beside = left[at] + left[at + 1] + left[below] + above[at] + above[at + 1] + above[below];
            context_sum[i].at[j] = 2 * beside + 3 * here[at];
        }
}

/* 7.5, steps 3 and 4: magnitudes, and the sign of the level (0, 0). */
static void decode_magnitudes(Decoder *decoder, const Block *block, u8 *mag, u32 N, u32 log2_N) {
    Decoder d = *decoder;
    for (i32 diagonal = (i32)block->end - 1; diagonal >= 0; diagonal--) {
        i32 frequency_class = diagonal == 0 ? 8 : min(5 * diagonal >> log2_N, 7);
        for (i32 i = max(0, diagonal - (i32)N + 1); i <= min(diagonal, (i32)N - 1); i++) {
            i32 j = diagonal - i;
            u8 *m = mag + (u32)i * (N + 2) + (u32)j, *m1 = m + N + 2, *m2 = m1 + N + 2;
            i32 higher = 2 * m[1] + 2 * m1[0] + m1[1] + m[2] + m2[0];
            i32 magnitude_class = min(log_class((u32)(3 * higher + context_sum[i].at[j])), 15);
            Model *models = level_models + (magnitude_class * FREQUENCY_CLASSES + frequency_class) * LEVEL_MODELS;
            if (!adaptive(&d, models)) continue;
            i32 found = positive(&d, models + 1, LEVEL_UNARY, LEVEL_ESCAPE);
            *m = (u8)min(found, KEPT_MAGNITUDE);
            level[i].at[j] = diagonal == 0 && !literal(&d, 1) ? -found : found;
        }
    }
    level[0].at[0] += block->dc_prediction;
    *decoder = d;
}

/* 7.5, step 5, subtract. */
INLINE void subtract(u32 i, u32 j, i32 a, u32 N, u32 log2_N) {
    i32 at_left = (basis[j].at[0] * a + 64) >> 7, at_top = (basis[i].at[0] * a + 64) >> 7, half = 1 << (6 + log2_N);
    i32 shift = 7 + (i32)log2_N;
    for (u32 k = 0; k < N / 4; k++) {
        residual_left.four[k] -= (basis[i].four[k] * at_left + half) >> shift;
        residual_top.four[k] -= (basis[j].four[k] * at_top + half) >> shift;
    }
}

/* 7.5, step 5, bias. */
INLINE i32 find_bias(const Block *block, u32 i, u32 j, u32 N) {
    Four left = {0}, top = {0};
    for (u32 k = 0; k < N / 4; k++) {
        left += basis[i].four[k] * within(residual_left.four[k], -4095, 4095);
        top += basis[j].four[k] * within(residual_top.four[k], -4095, 4095);
    }
    return (block->has_left ? basis[j].at[0] * (sum_of(left) >> 7) : 0) +
           (block->has_above ? basis[i].at[0] * (sum_of(top) >> 7) : 0);
}

/* 7.5, step 5: the sign of one level. */
INLINE u32 decode_sign(Decoder *d, i32 bias, i32 amplitude, i32 qstep, u32 log2_N) {
    if (bias == 0) return literal(d, 1);
    i32 likelier = log_class((u32)magnitude(bias)) + log_class((u32)amplitude) - 2 * log_class((u32)qstep);
    i32 sign_class = clamp(likelier - 2 * (i32)log2_N - 3, 0, SIGN_CLASSES - 1);
    return adaptive(d, &sign_models[sign_class]) == (bias > 0);
}

/* 7.5, step 5: the signs of all levels but the first. */
static void decode_signs(Decoder *decoder, const Block *block, u32 N, u32 log2_N) {
    Decoder d = *decoder;
    u32 has_edge = block->has_left || block->has_above;
    for (u32 k = 0; k < N / 4; k++) {
        residual_left.four[k] = 8 * left_edge.four[k];
        residual_top.four[k] = 8 * block->top_edge->four[k];
    }
    subtract(0, 0, clamp(level[0].at[0] * block->qstep[0].at[0], -32768, 32767), N, log2_N);
    for (u32 diagonal = 1; diagonal < block->end; diagonal++)
        for (u32 i = diagonal < N ? 0 : diagonal - N + 1; i <= diagonal && i < N; i++) {
            u32 j = diagonal - i;
            i32 mag = level[i].at[j];
            if (!mag) continue;
            i32 amplitude = min(mag * block->qstep[i].at[j], 32767);
            i32 bias = has_edge ? find_bias(block, i, j, N) : 0;
            u32 is_positive = decode_sign(&d, bias, amplitude, block->qstep[0].at[0], log2_N);
            if (!is_positive) level[i].at[j] = -mag;
            if (has_edge) subtract(i, j, is_positive ? amplitude : -amplitude, N, log2_N);
        }
    *decoder = d;
}

/* 7.5, steps 6 and 7: levels to texels. Only the frequencies that have levels are added up. */
static void transform_back(const Block *block, u32 N, u32 log2_N) {
    u32 used = block->end == 0 ? 1 : block->end < N ? block->end : N, fours = N / 4;
    for (u32 j = 0; j < used; j++) {
        Line sum = {{{0}}};
        for (u32 i = 0; i < used; i++) {
            if (!level[i].at[j]) continue;
            i32 coefficient = clamp(level[i].at[j] * block->qstep[i].at[j], -32768, 32767);
            for (u32 k = 0; k < fours; k++) sum.four[k] += basis[i].four[k] * coefficient;
        }
        for (u32 k = 0; k < fours; k++) column[j].four[k] = (sum.four[k] + 64) >> 7;
    }
    for (u32 y = 0; y < N; y++) {
        Line sum = {{{0}}};
        for (u32 j = 0; j < used; j++)
            for (u32 k = 0; k < fours; k++) sum.four[k] += basis[j].four[k] * column[j].at[y];
        for (u32 k = 0; k < fours; k++)
            output[y].four[k] = within((sum.four[k] + (1 << (9 + log2_N))) >> (i32)(10 + log2_N), -128, 127);
    }
}

/* 7.5, "The symbol of a coded texel", and the edges for the blocks to come. */
static void store_block(const Blocks *b, const Block *block) {
    const Segment *s = b->segment;
    u32 N = b->N, y0 = block->by * N, x0 = block->bx * N, M = s->channels;
    u32 rows = s->rows - y0 < N ? s->rows - y0 : N, columns = s->columns - x0 < N ? s->columns - x0 : N;
    for (u32 y = 0; y < rows; y++) {
        u32 texel = (y0 + y) * s->columns + x0;
        for (u32 x = 0; x < columns; x++)
            if (s->coded[texel + x]) s->symbols[(texel + x) * M + block->channel] = (i8)output[y].at[x];
    }
    for (u32 y = 0; y < N; y++) left_edge.at[y] = output[y].at[N - 1];
    *block->top_edge = output[N - 1];
}

/* 7.5, steps 1 to 7 of one active block. */
static void decode_block(Blocks *b, Decoder *d, Block *block, i32 expected_dc) {
    u32 N = b->N, at = block->by * b->across + block->bx, size = (N + 2) * (N + 2);
    u8 *mag = b->mag + at * size;
    const u8 *left = block->has_left ? mag - size : b->no_magnitudes;
    const u8 *above = block->has_above ? mag - b->across * size : b->no_magnitudes;
    block->qstep = qsteps[b->qoffset[at]];
    block->dc_prediction = predict_dc(block, expected_dc, N);
    u32 total = (block->has_left ? b->end[at - 1] : 0) + (block->has_above ? b->end[at - b->across] : 0) + b->end[at];
    i32 code = positive(d, end_models + min(log_class(total), END_CONTEXTS - 1) * END_MODELS, END_UNARY, END_ESCAPE);
    b->end[at] = (u8)(block->end = (u32)min(code - 1, 2 * (i32)N - 1));
    sum_around(mag, left, above, block->end, N);
    fill(mag, 0, size);
    fill(level, 0, N * sizeof(Line));
    decode_magnitudes(d, block, mag, N, b->log2_N);
    b->dc[at] = clamp(level[0].at[0] * block->qstep[0].at[0], -32768, 32767);
    if (block->end > 1) decode_signs(d, block, N, b->log2_N);
    transform_back(block, N, b->log2_N);
    store_block(b, block);
}

/* 7.5, "Levels": all channels. */
static void decode_levels(Blocks *b, Decoder *d) {
    Block block = {0};
    for (block.channel = 0; block.channel < b->segment->channels; block.channel++)
        for (block.by = 0; block.by < b->down && !d->missing; block.by++)
            for (block.bx = 0; block.bx < b->across; block.bx++) {
                u32 at = block.by * b->across + block.bx;
                i32 expected_dc = expected_from_neighbours(b, &block);
                b->dc[at] = expected_dc;
                if (!b->active[at]) continue;
                block.has_left = block.bx > 0 && b->active[at - 1];
                block.has_above = block.by > 0 && b->active[at - b->across];
                block.top_edge = b->bottom_edges + block.bx;
                decode_block(b, d, &block, expected_dc);
            }
}

/* 7.5: head, map, quantiser offsets and levels. */
Status decode_transform(const u8 *body, u32 length, Segment *s, u32 implied) {
    Blocks b = {.segment = s, .N = length > 2 ? body[0] : 0};
    Decoder d;
    if ((b.N != 4 && b.N != 8 && b.N != 16) || body[1] > IMPLIED || body[2] == 0) return TRANSFORM_FLAGS;
    if (b.N != 4 && b.N > 2 * s->rows) return TRANSFORM_SIDE;
    if (b.N != 4 && b.N > 2 * s->columns) return TRANSFORM_SIDE;
    Status status = open_coded_data(&d, body + 3, length - 3);
    if (status == OK) status = begin_map(&d, s, body[1], implied);
    if (status != OK) return status;
    b.log2_N = b.N == 4 ? 2 : b.N == 8 ? 3 : 4;
    b.down = (s->rows + b.N - 1) / b.N, b.across = (s->columns + b.N - 1) / b.N;
    u64 count = (u64)b.down * b.across, size = (b.N + 2) * (b.N + 2);
    b.active = take(count), b.qoffset = take(count), b.end = take(count), b.mag = take(count * size);
    b.dc = take(4 * count), b.bottom_edges = take(sizeof(Line) * (u64)b.across), b.no_magnitudes = take(size);
    if (!b.active || !b.qoffset || !b.end || !b.mag || !b.dc || !b.bottom_edges || !b.no_magnitudes) return NO_MEMORY;
    begin_tables(b.N, b.log2_N, body[2]);
    begin_models();
    find_active(&b);
    if (!d.missing) decode_qoffsets(&b, &d);
    if (d.missing) return WORDS_DO_NOT_END;
    decode_levels(&b, &d);
    return check_end(&d);
}
