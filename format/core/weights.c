/* Section 8.3: WEIGHTS. */

#include "entropy.h"

#define UNARY 4
#define ESCAPE 10
#define LARGEST_INTEGER 2048
#define FINEST (-24)
#define COARSEST 15

static Model models[SIGNED_MODELS(UNARY, ESCAPE)];

/* 6.5: the lengths of the arrays, by the sizes in the head. Return how many there are. */
static u32 array_lengths(u32 is_hybrid, const u8 *head, u32 *lengths) {
    u32 features = load_u16(head), hidden = load_u16(head + 2);
    if (!is_hybrid) {
        u32 found[5] = {features, 9 * hidden, hidden, 3 * features * hidden, 3 * features};
        copy(lengths, found, sizeof found);
        return 5;
    }
    u32 width = hidden;
    hidden = load_u16(head + 4);
    u32 found[8] = {width * features, width, width, 9 * hidden, hidden, hidden * width, 3 * hidden, 3};
    copy(lengths, found, sizeof found);
    return 8;
}

/* The bits of the f16 that is integer x 2^exponent, which must be one; 0xFFFF where it is beyond 65504. */
static u32 half(i32 integer, i32 exponent) {
    u32 size = (u32)magnitude(integer), sign = integer < 0 ? 0x8000 : 0;
    if (size == 0) return 0;
    i32 length = bits(size), leading = length - 1 + exponent; /* exponent of the leading bit */
    if (leading > 15) return 0xFFFF;
    if (leading < -14) return sign | size << (exponent - FINEST); /* subnormal: a multiple of 2^-24 */
    u32 significand = length > 11 ? size >> (length - 11) : size << (11 - length);
    return sign | (u32)(leading + 15) << 10 | (significand & 1023);
}

/* 8.3: decode DECO, or HYBR where `is_hybrid` is 1, to its content under RAW (6.5), `raw_length` bytes. */
EXPORT(kpc_weights) Status kpc_weights(u32 is_hybrid, const u8 *body, u32 length, u8 *raw, u32 raw_length) {
    Decoder d;
    u32 lengths[8], head = is_hybrid ? 10 : 8;
    u64 total = 0;
    if (length < head || raw_length < head) return CONTENT_LENGTH;
    u32 arrays = array_lengths(is_hybrid, body, lengths);
    if (load_u16(body) > SCALE_LIMIT * CHANNEL_LIMIT || load_u16(body + 2) > HIDDEN_LIMIT) return BAD_ARGUMENT;
    if (is_hybrid && load_u16(body + 4) > HIDDEN_LIMIT) return BAD_ARGUMENT;
    for (u32 k = 0; k < arrays; k++) total += lengths[k];
    if (raw_length != head + 2 * total) return CONTENT_LENGTH;
    const i8 *exponents = (const i8 *)body + head;
    for (u32 k = 0; k < arrays && head + k < length; k++)
        if (exponents[k] < FINEST || exponents[k] > COARSEST) return WEIGHTS_EXPONENT;
    if (length < head + arrays) return CUT_WITHIN_WORDS;
    Status status = open_coded_data(&d, body + head + arrays, length - head - arrays);
    if (status != OK) return status;
    copy(raw, body, head);
    u8 *next = raw + head;
    u32 fits = 1;
    for (u32 k = 0; k < arrays && !d.missing; k++) {
        new_models(models, SIGNED_MODELS(UNARY, ESCAPE));
        for (u32 n = 0; n < lengths[k]; n++, next += 2) {
            i32 integer = signed_number(&d, models, UNARY, ESCAPE);
            u32 found = magnitude(integer) > LARGEST_INTEGER ? 0xFFFF : half(integer, exponents[k]);
            if (found == 0xFFFF) fits = 0;
            store_u16(next, found);
        }
    }
    status = check_end(&d);
    return status == OK && !fits ? WEIGHTS_RANGE : status;
}
