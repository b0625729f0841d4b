/* Section 8.1: MOTION. */

#include "entropy.h"

#define UNARY 4
#define ESCAPE 15
#define MODELS SIGNED_MODELS(UNARY, ESCAPE)
#define CONTEXTS 20

static Model models[CONTEXTS * MODELS];

/* The grid: its sizes, how far apart in the arrays neighbours along each axis are, and what has been decoded. */
typedef struct {
    u32 node_count[4], stride[4];
    i16 *symbols;
    i32 *residuals; /* their magnitudes */
    u16 *decoded[4];
    u32 decoded_count[4];
} Grid;

/* A pass: the nodes at `position` along `axis`. Of references that do not take part, tap is 0. */
typedef struct {
    u32 axis, position, ref[4];
    i64 tap[4];
} Pass;

/* 8.1, pass: prediction and context of a component, and its symbol. Return whether it has 16 bits. */
INLINE u32 decode_component(Decoder *d, const Grid *grid, const Pass *pass, u32 at, i32 earlier_and_beside) {
    i64 sum = 32;
    i32 activity = earlier_and_beside;
    u32 stride = grid->stride[pass->axis], line = at - pass->position * stride;
    for (u32 k = 0; k < 4; k++) {
        if (pass->tap[k] == 0) continue;
        u32 reference = line + pass->ref[k] * stride;
        sum += pass->tap[k] * grid->symbols[reference];
        activity += (k == 1 || k == 2 ? 2 : 1) * grid->residuals[reference];
    }
    sum >>= 6;
    i32 prediction = sum < -32768 ? -32768 : sum > 32767 ? 32767 : (i32)sum;
    i32 residual = signed_number(d, models + min(log_class((u32)activity), CONTEXTS - 1) * MODELS, UNARY, ESCAPE);
    i32 symbol = prediction + residual;
    grid->symbols[at] = (i16)symbol;
    grid->residuals[at] = magnitude(residual);
    return symbol >= -32768 && symbol <= 32767;
}

/* 8.1, pass(axis, new). */
static Status decode_pass(Decoder *decoder, const Grid *grid, const Pass *pass) {
    Decoder d = *decoder;
    u32 other[3], n = 0;
    for (u32 axis = 0; axis < 4; axis++)
        if (axis != pass->axis) other[n++] = axis;
    const u16 *lists[3] = {grid->decoded[other[0]], grid->decoded[other[1]], grid->decoded[other[2]]};
    const u32 stride[3] = {grid->stride[other[0]], grid->stride[other[1]], grid->stride[other[2]]};
    for (u32 i = 0; i < grid->decoded_count[other[0]]; i++)
        for (u32 j = 0; j < grid->decoded_count[other[1]]; j++) {
            for (u32 k = 0; k < grid->decoded_count[other[2]]; k++) {
                u32 at = pass->position * grid->stride[pass->axis] + lists[0][i] * stride[0] +
                         lists[1][j] * stride[1] + lists[2][k] * stride[2];
                i32 sum = 0;
                for (u32 c = 0; c < 3; c++) {
                    const i32 *r = grid->residuals + at + c;
                    if (i > 0) sum += *(r - (lists[0][i] - lists[0][i - 1]) * stride[0]);
                    if (j > 0) sum += *(r - (lists[1][j] - lists[1][j - 1]) * stride[1]);
                    if (k > 0) sum += *(r - (lists[2][k] - lists[2][k - 1]) * stride[2]);
                }
                for (u32 c = 0; c < 3; c++) {
                    if (!decode_component(&d, grid, pass, at + c, sum)) return MOTION_RANGE;
                    sum += 3 * grid->residuals[at + c];
                }
            }
            if (d.missing) return WORDS_DO_NOT_END;
        }
    *decoder = d;
    return OK;
}

/* floor(a / b) for b other than 0. */
INLINE i64 floor_quotient(i64 a, i64 b) { return a / b - (a % b != 0 && (a < 0) != (b < 0)); }

/* 8.1, the factors of step 3, for `references` of which those that do not exist are -1. */
static void find_taps(Pass *pass, const i32 *references) {
    i64 total = 0;
    for (u32 k = 0; k < 4; k++) {
        i64 A = 64, B = 1;
        pass->tap[k] = 0, pass->ref[k] = 0;
        if (references[k] < 0) continue;
        for (u32 j = 0; j < 4; j++)
            if (j != k && references[j] >= 0) {
                A *= (i32)pass->position - references[j];
                B *= references[k] - references[j];
            }
        pass->ref[k] = (u32)references[k];
        pass->tap[k] = floor_quotient(2 * A + B, 2 * B);
        total += pass->tap[k];
    }
    pass->tap[1] += 64 - total;
}

/* 8.1, step 3, of one axis: all gaps of its list. `next` is for the new list, and becomes the grid's. */
static Status halve_gaps(Decoder *d, Grid *grid, u32 axis, u16 **next) {
    u16 *list = grid->decoded[axis], *made = *next;
    i32 count = (i32)grid->decoded_count[axis];
    u32 found = 0;
    for (i32 k = 0; k < count; k++) {
        made[found++] = list[k];
        if (k + 1 == count || list[k + 1] - list[k] < 2) continue;
        Pass pass = {.axis = axis, .position = (u32)(list[k] + list[k + 1]) >> 1};
        i32 references[4] = {k > 0 ? list[k - 1] : -1, list[k], list[k + 1], k + 2 < count ? list[k + 2] : -1};
        find_taps(&pass, references);
        Status status = decode_pass(d, grid, &pass);
        if (status != OK) return status;
        made[found++] = (u16)pass.position;
    }
    grid->decoded[axis] = made, grid->decoded_count[axis] = found;
    *next = list;
    return OK;
}

/* 8.1, passes. */
static Status decode_grid(Decoder *d, Grid *grid, u16 *next[4]) {
    Pass first = {0};
    Status status = decode_pass(d, grid, &first);
    i32 halving = 0;
    for (u32 axis = 0; axis < 4 && status == OK; axis++) {
        u32 last = grid->node_count[axis] - 1;
        Pass end = {.axis = axis, .position = last, .tap = {0, 64, 0, 0}};
        status = decode_pass(d, grid, &end);
        grid->decoded[axis][grid->decoded_count[axis]++] = (u16)last;
        halving = max(halving, bits(grid->node_count[axis] - 2));
    }
    for (; halving > 0; halving--)
        for (u32 axis = 0; axis < 4 && status == OK; axis++)
            if (bits(grid->node_count[axis] - 2) >= halving) status = halve_gaps(d, grid, axis, &next[axis]);
    return status;
}

static Status decode_motion(const u8 *body, u32 length, u8 *raw, u32 raw_length) {
    Decoder d;
    Grid grid = {.symbols = (i16 *)(raw + 12), .stride = {3, 3, 3, 3}};
    u16 *next[4];
    if (length < 12 || raw_length < 12) return CONTENT_LENGTH;
    for (u32 axis = 0; axis < 4; axis++) {
        u32 nodes = grid.node_count[axis] = load_u16(body + 2 * axis);
        if (nodes < 2 || nodes > (axis == 0 ? AXIS_LIMIT : MOTION_LIMIT)) return BAD_ARGUMENT;
    }
    for (u32 axis = 3; axis > 0; axis--) grid.stride[axis - 1] = grid.stride[axis] * grid.node_count[axis];
    u64 count = (u64)grid.stride[0] * grid.node_count[0]; /* at most 3 x 2^38; the stride at most 3 x 2^24 */
    if (raw_length != 12 + 2 * count) return CONTENT_LENGTH;
    Status status = open_coded_data(&d, body + 12, length - 12);
    if (status != OK) return status;
    grid.residuals = take(4 * count);
    u32 has_memory = grid.residuals != 0;
    for (u32 axis = 0; axis < 4; axis++) {
        grid.decoded[axis] = take(2 * grid.node_count[axis]), next[axis] = take(2 * grid.node_count[axis]);
        grid.decoded_count[axis] = 1;
        has_memory = has_memory && grid.decoded[axis] && next[axis];
    }
    if (!has_memory) return NO_MEMORY;
    copy(raw, body, 12);
    new_models(models, CONTEXTS * MODELS);
    status = decode_grid(&d, &grid, next);
    return status == OK ? check_end(&d) : status;
}

/* 8.1: decode MOVE to its content under RAW (6.3), `raw_length` bytes. The sizes are those of its head. */
EXPORT(kpc_motion) Status kpc_motion(const u8 *body, u32 length, u8 *raw, u32 raw_length) {
    u32 marked = mark();
    Status status = decode_motion(body, length, raw, raw_length);
    release(marked);
    return status;
}
