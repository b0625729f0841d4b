/* Section 5: functions of the entropy coder that need not be inlined. */

#include "entropy.h"

u32 RATE[ADAPTATION_LIMIT + 1];

/* 5.3: rate of each count. */
void prepare_rates(void) {
    for (u32 count = 0; count <= ADAPTATION_LIMIT; count++) RATE[count] = 327680 / (5 * count + 8);
}

/* 5.3 */
void new_models(Model *models, u32 count) {
    for (u32 k = 0; k < count; k++) models[k] = EVEN_PROBABILITY << 8;
}

/* 5.1 */
Status open_coded_data(Decoder *d, const u8 *body, u32 length) {
    if (length < 4 || length % 2) return CUT_WITHIN_WORDS;
    *d = (Decoder){load_u32(body), body + 4, body + length, 0};
    return d->state < LOWEST_STATE ? STATE_TOO_SMALL : OK;
}

/* 5.1 */
Status check_end(const Decoder *d) {
    return d->missing || d->next != d->end || d->state != LOWEST_STATE ? WORDS_DO_NOT_END : OK;
}
