/* Section 5: the entropy coder. All of it is inlined, so that the decoder's state stays in registers. */

#ifndef KPC_ENTROPY_H
#define KPC_ENTROPY_H

#include "kpc_core.h"

/* 5.3: a model is P << 8 | count. */
typedef u32 Model;
extern u32 RATE[ADAPTATION_LIMIT + 1];
void prepare_rates(void);
void new_models(Model *models, u32 count);

/* 5.1: state, the words that are left, and whether a word was missing, which counts as 0. */
typedef struct {
    u32 state;
    const u8 *next, *end;
    u32 missing;
} Decoder;

Status open_coded_data(Decoder *d, const u8 *body, u32 length);
Status check_end(const Decoder *d);

/* 5.2 */
INLINE u32 renormalise(Decoder *d) {
    d->state <<= 16;
    if (d->next == d->end) return d->missing = 1;
    d->state |= load_u16(d->next);
    d->next += 2;
    return 0;
}

INLINE u32 decision(Decoder *d, u32 p) {
    u32 low = d->state & 4095, high = d->state >> 12, bit = low < p;
    d->state = bit ? p * high + low : (4096 - p) * high + low - p;
    if (d->state < LOWEST_STATE) renormalise(d);
    return bit;
}

/* 5.3 */
INLINE u32 adaptive(Decoder *d, Model *model) {
    u32 P = *model >> 8, count = *model & 255, rate = RATE[count];
    u32 bit = decision(d, P >> 4);
    if (bit)
        P += (65536 - P) * rate >> 16;
    else
        P -= P * rate >> 16;
    *model = P << 8 | (count + (count < ADAPTATION_LIMIT));
    return bit;
}

/* 5.4 */
INLINE u32 literal(Decoder *d, u32 n) {
    u32 number = 0;
    for (; n > 0; n--) number = 2 * number + decision(d, 2048);
    return number;
}

INLINE i32 positive(Decoder *d, Model *models, u32 unary, u32 escape) {
    u32 length = 0;
    for (u32 k = 0; k < unary; k++)
        if (!adaptive(d, models + k)) return (i32)k + 1;
    while (length < escape && adaptive(d, models + unary + length)) length++;
    return (i32)(unary + (1u << length) + literal(d, length));
}

INLINE i32 signed_number(Decoder *d, Model *models, u32 unary, u32 escape) {
    if (!adaptive(d, models)) return 0;
    u32 is_positive = adaptive(d, models + 1);
    i32 found = positive(d, models + (is_positive ? 2 : 2 + unary + escape), unary, escape);
    return is_positive ? found : -found;
}

#define SIGNED_MODELS(unary, escape) (2 + 2 * ((unary) + (escape)))

/* 5.5 */
INLINE i32 bits(u32 n) { return n ? 32 - __builtin_clz(n) : 0; }
INLINE i32 log_class(u32 n) { return n < 2 ? (i32)n : 2 * bits(n) - 2 + (i32)(n >> (bits(n) - 2) & 1); }

#endif
