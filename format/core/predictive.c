/* Section 7.4: PREDICTIVE. */

#include "segments.h"

#define UNARY 4
#define ESCAPE 7
#define MODELS SIGNED_MODELS(UNARY, ESCAPE)
#define CONTEXTS 66
#define WEIGHTS 9
#define INITIAL_DEVIATION 16

enum { SCALAR = 0, TRELLIS = 1, DEPENDENT = 2 };

/* The weights of a set in a plain sum, in 1/128: those of the neighbours in the current row, and of the rows above. */
typedef struct {
    i32 w, ww;
    i16 nww, nw, n, ne, nee, nnw, nn, nne;
} Set;

/* A row of padded and of dev, with column 0 at EDGE. */
#define EDGE 8
#define ROW (EDGE + AXIS_LIMIT + 8)
typedef struct {
    i16 padded[ROW], dev[ROW];
} Row;

/* The state of a segment. */
typedef struct {
    Segment *segment;
    u32 set_count, quantiser, channel, y;
    Set sets[8];
    Row *rows[3]; /* y, y - 1 and y - 2 */
    i16 *cross;
} Predictor;

/* All that decoding a symbol reads is at fixed addresses, which spares registers. The parts of gradient, activity and
   prediction that come from the rows above and the channels before; of the prediction, for each set. */
static i32 steep[AXIS_LIMIT + 4], around[AXIS_LIMIT + 4], taps[8][AXIS_LIMIT + 4];
static Row row_memory[3];
static Model models[CONTEXTS * MODELS];

/* 7.4, table: weights of a set, each on the neighbour that the formula of the prediction has it on. */
static Set plain_weights(const i8 *weight) {
    i32 rest = 64;
    for (u32 k = 1; k < WEIGHTS; k++) rest -= weight[k];
    Set set = {.w = rest + weight[0], .ww = 2 * weight[3], .n = (i16)(rest - weight[0])};
    set.nw = (i16)(2 * weight[1]), set.ne = (i16)(2 * weight[2]), set.nn = (i16)(2 * weight[4]);
    set.nww = (i16)(2 * weight[5]), set.nnw = (i16)(2 * weight[6]);
    set.nne = (i16)(2 * weight[7]), set.nee = (i16)(2 * weight[8]);
    return set;
}

/* 7.4, "Neighbourhood": what rows are beyond the segment on the left, and that row 0 stands for the row above it. */
static void begin_row(Predictor *p) {
    Row *here = p->rows[0], *above = p->rows[1];
    i16 *padded = here->padded + EDGE, *dev = here->dev + EDGE;
    padded[-1] = padded[-2] = p->y > 0 ? above->padded[EDGE] : 0;
    dev[-1] = dev[-2] = p->y > 0 ? above->dev[EDGE] : INITIAL_DEVIATION;
    if (p->y != 1) return;
    u32 length = 2 * (p->segment->columns + 4);
    copy(p->rows[2]->padded + EDGE - 2, above->padded + EDGE - 2, length);
    copy(p->rows[2]->dev + EDGE - 2, above->dev + EDGE - 2, length);
}

#ifdef __wasm_simd128__
typedef i16 Shorts __attribute__((vector_size(16)));
typedef i32 Ints __attribute__((vector_size(16)));

/* Pairs (a[0], b[0]) to (a[3], b[3]), of which `dot` multiplies each with a pair of weights and adds the products. */
INLINE Shorts pairs(const i16 *a, const i16 *b) {
    Shorts x, y;
    copy(&x, a, 16), copy(&y, b, 16);
    return __builtin_shufflevector(x, y, 0, 8, 1, 9, 2, 10, 3, 11);
}
INLINE Ints dot(Shorts values, i16 a, i16 b) {
    return __builtin_wasm_dot_s_i32x4_i16x8(values, (Shorts){a, b, a, b, a, b, a, b});
}

/* 7.4, step 1: what the rows above add to the predictions of texels x to x + 3. */
INLINE void sum_taps(const Predictor *p, const i16 *v1, const i16 *v2, u32 x) {
    Shorts first = pairs(v1 - 2, v1 - 1), second = pairs(v1, v1 + 1), third = pairs(v1 + 2, v2 - 1);
    Shorts fourth = pairs(v2, v2 + 1);
    for (u32 set = 0; set < p->set_count; set++) {
        const Set *s = &p->sets[set];
        Ints sum = dot(first, s->nww, s->nw) + dot(second, s->n, s->ne) + dot(third, s->nee, s->nnw) +
                   dot(fourth, s->nn, s->nne);
        copy(&taps[set][x], &sum, 16);
    }
}
#else
INLINE void sum_taps(const Predictor *p, const i16 *v1, const i16 *v2, u32 x) {
    for (u32 set = 0; set < p->set_count; set++) {
        const Set *s = &p->sets[set];
        for (i32 k = 0; k < 4; k++)
            taps[set][x + (u32)k] = s->nww * v1[k - 2] + s->nw * v1[k - 1] + s->n * v1[k] + s->ne * v1[k + 1] +
                                    s->nee * v1[k + 2] + s->nnw * v2[k - 1] + s->nn * v2[k] + s->nne * v2[k + 1];
    }
}
#endif

/* 7.4, steps 1 and 2: the parts that come from the rows above, of a whole row. */
static void sum_above(const Predictor *p) {
    u32 W = p->segment->columns;
    const u8 *coded = p->segment->coded + p->y * W;
    const i16 *cross = p->cross + p->y * W;
    i32 now = p->channel ? 11 : 16, before = p->channel ? 5 : 0;
    for (u32 x = 0; x < W; x += 4) {
        const i16 *v1 = p->rows[1]->padded + EDGE + x, *v2 = p->rows[2]->padded + EDGE + x;
        const i16 *r1 = p->rows[1]->dev + EDGE + x, *r2 = p->rows[2]->dev + EDGE + x;
        if (x + 4 <= W && load_u32(coded + x) == 0) continue;
        sum_taps(p, v1, v2, x);
        for (i32 k = 0; k < 4; k++) {
            steep[x + (u32)k] = magnitude(v1[k] - v1[k - 1]) + magnitude(v1[k] - v1[k + 1]) + magnitude(v1[k] - v2[k]);
            around[x + (u32)k] = now * (2 * r1[k] + r1[k - 1] + r1[k + 1] + r2[k]) + before * cross[x + (u32)k];
        }
    }
}

/* 7.4, steps 1 and 2, in row 0, where all neighbours above are the one to the left. */
INLINE void stand_in_above(const Predictor *p, u32 x, i32 w, i32 rw) {
    for (u32 set = 0; set < p->set_count; set++) {
        const Set *s = &p->sets[set];
        taps[set][x] = (s->n + s->nw + s->ne + s->nn + s->nww + s->nnw + s->nne + s->nee) * w;
    }
    steep[x] = 0;
    around[x] = (p->channel ? 11 : 16) * 5 * rw + (p->channel ? 5 * p->cross[x] : 0);
}

/* 7.4, steps 3 to 5: decode the symbol of a prediction, and the part of the next trellis state that depends on it. */
INLINE i32 decode_symbol(Decoder *d, i32 prediction, i32 activity_class, i32 parity, u32 quantiser, i32 *branch) {
    u32 rule = quantiser == DEPENDENT && activity_class >= 4 ? TRELLIS : quantiser;
    i32 rounded = rule == TRELLIS ? 2 * ((prediction - 128 * parity + 128) >> 8) + parity : (prediction + 64) >> 7;
    i32 remainder = prediction - 128 * rounded;
    i32 part = rule == DEPENDENT ? parity : min(3 * magnitude(remainder) >> (rule == TRELLIS ? 7 : 6), 2);
    i32 residual = signed_number(d, models + (3 * activity_class + part) * MODELS, UNARY, ESCAPE);
    if (remainder < 0) residual = -residual;
    i32 sign = (residual > 0) - (residual < 0);
    i32 symbol = rounded + (rule == SCALAR ? residual : 2 * residual) - (rule == DEPENDENT ? sign * parity : 0);
    *branch = rule == DEPENDENT ? 2 * (residual & 1) : symbol & 2;
    return symbol;
}

/* 7.4, "Decoding a symbol", of a row. Return whether all symbols have 8 bits. */
INLINE u32 decode_row_of(const Predictor *p, Decoder *decoder, u32 quantiser, u32 is_first_row) {
    Decoder d = *decoder;
    u32 W = p->segment->columns, set_count = p->set_count;
    const u8 *coded = p->segment->coded + p->y * W;
    Row *here = p->rows[0];
    const Row *above = p->rows[1];
    i32 own_share = p->channel ? 11 : 16, trellis_state = 0;
    i32 w = here->padded[EDGE - 1], ww = w, rw = here->dev[EDGE - 1], rww = rw;
    for (u32 x = 0; x < W; x++) {
        if (!coded[x]) {
            ww = w, rww = rw;
            if (!is_first_row && (x == 0 || !coded[x - 1])) w = above->padded[EDGE + x + 1], rw = above->dev[EDGE + x + 1];
            here->padded[EDGE + x] = (i16)w, here->dev[EDGE + x] = (i16)rw;
            continue;
        }
        if (is_first_row) stand_in_above(p, x, w, rw);
        i32 nw = is_first_row ? w : above->padded[EDGE + x - 1];
        i32 gradient = magnitude(w - nw) + magnitude(w - ww) + steep[x];
        u32 set = set_count > 1 ? (u32)min(bits((u32)gradient), 7) * set_count >> 3 : 0;
        i32 prediction = clamp(p->sets[set].w * w + p->sets[set].ww * ww + taps[set][x], -16384, 16256);
        i32 activity = ((own_share * (2 * rw + rww) + around[x]) >> 2) + 20 * gradient;
        i32 activity_class = log_class((u32)(activity + 128) >> 6) - 2, parity = trellis_state & 1, branch;
        i32 symbol = decode_symbol(&d, prediction, activity_class, parity, quantiser, &branch);
        if (symbol < -128 || symbol > 127) return 0;
        if (quantiser != SCALAR) trellis_state = trellis_state >> 1 ^ 5 * parity ^ branch;
        ww = w, rww = rw;
        w = symbol, rw = magnitude(128 * symbol - prediction) >> 3;
        here->padded[EDGE + x] = (i16)w, here->dev[EDGE + x] = (i16)rw;
    }
    for (u32 x = W; x < W + 2; x++) here->padded[EDGE + x] = (i16)w, here->dev[EDGE + x] = (i16)rw;
    *decoder = d;
    return 1;
}

/* A function for each quantiser, which the compiler makes without the others' branches. */
static u32 decode_first_row(const Predictor *p, Decoder *d) { return decode_row_of(p, d, p->quantiser, 1); }
static u32 decode_scalar_row(const Predictor *p, Decoder *d) { return decode_row_of(p, d, SCALAR, 0); }
static u32 decode_trellis_row(const Predictor *p, Decoder *d) { return decode_row_of(p, d, TRELLIS, 0); }
static u32 decode_dependent_row(const Predictor *p, Decoder *d) { return decode_row_of(p, d, DEPENDENT, 0); }

static u32 decode_row(const Predictor *p, Decoder *d) {
    if (p->y == 0) return decode_first_row(p, d);
    sum_above(p);
    if (p->quantiser == SCALAR) return decode_scalar_row(p, d);
    return p->quantiser == TRELLIS ? decode_trellis_row(p, d) : decode_dependent_row(p, d);
}

/* Store the symbols of row y, which is complete. */
static void store_row(const Predictor *p) {
    u32 W = p->segment->columns, M = p->segment->channels;
    const u8 *coded = p->segment->coded + p->y * W;
    i8 *symbols = p->segment->symbols + p->y * W * M + p->channel;
    for (u32 x = 0; x < W; x++)
        if (coded[x]) symbols[x * M] = (i8)p->rows[0]->padded[EDGE + x];
}

/* 7.4, "After each channel": row y of `cross`, from the deviations of the rows around it. All sums are below 2^16. */
static void update_cross(const Predictor *p, u32 y, const Row *row_above, const Row *row, const Row *row_below) {
    i16 *cross = p->cross + y * p->segment->columns;
    const i16 *above = row_above->dev + EDGE, *here = row->dev + EDGE, *below = row_below->dev + EDGE;
    for (i32 x = 0; x < (i32)p->segment->columns; x++) {
        u16 top = (u16)(above[x - 1] + 2 * above[x] + above[x + 1]);
        u16 middle = (u16)(here[x - 1] + 2 * here[x] + here[x + 1]);
        u16 bottom = (u16)(below[x - 1] + 2 * below[x] + below[x + 1]);
        i16 smooth = (i16)((u16)(top + 2 * middle + bottom) >> 1);
        cross[x] = p->channel == 0 ? smooth : (i16)(cross[x] + ((i16)(smooth - cross[x]) >> 3));
    }
}

/* 7.4, "Order": all symbols, channel by channel. */
static Status decode_symbols(Predictor *p, Decoder *d) {
    u32 H = p->segment->rows;
    new_models(models, CONTEXTS * MODELS);
    for (p->channel = 0; p->channel < p->segment->channels; p->channel++) {
        for (p->y = 0; p->y < H; p->y++) {
            begin_row(p);
            if (!decode_row(p, d)) return SYMBOL_RANGE;
            if (d->missing) return WORDS_DO_NOT_END;
            store_row(p);
            if (p->y > 0) update_cross(p, p->y - 1, p->rows[p->y > 1 ? 2 : 1], p->rows[1], p->rows[0]);
            Row *oldest = p->rows[2];
            p->rows[2] = p->rows[1], p->rows[1] = p->rows[0], p->rows[0] = oldest;
        }
        update_cross(p, H - 1, p->rows[H > 1 ? 2 : 1], p->rows[1], p->rows[1]);
    }
    return OK;
}

/* 7.4: head, map and symbols. */
Status decode_predictive(const u8 *body, u32 length, Segment *segment, u32 implied) {
    static Predictor p;
    Decoder d;
    u32 count = length > 1 ? body[0] : 0, flags = length > 1 ? body[1] : 255;
    if ((count != 1 && count != 2 && count != 4 && count != 8) || (flags & 3) > IMPLIED || flags >> 2 > DEPENDENT)
        return PREDICTIVE_FLAGS;
    if (length < 2 + WEIGHTS * count) return PREDICTIVE_WEIGHTS;
    p = (Predictor){.segment = segment, .set_count = count, .quantiser = flags >> 2};
    for (u32 set = 0; set < count; set++) p.sets[set] = plain_weights((const i8 *)body + 2 + WEIGHTS * set);
    for (u32 row = 0; row < 3; row++) p.rows[row] = &row_memory[row];
    Status status = open_coded_data(&d, body + 2 + WEIGHTS * count, length - 2 - WEIGHTS * count);
    if (status == OK) status = begin_map(&d, segment, flags & 3, implied);
    if (status != OK) return status;
    p.cross = take(2 * ((u64)segment->columns * segment->rows + 4)); /* 4 more, which sum_above may read */
    if (!p.cross) return NO_MEMORY;
    if (!d.missing) status = decode_symbols(&p, &d);
    return status == OK ? check_end(&d) : status;
}
