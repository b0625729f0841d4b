/* Section 8.2: OCCUPANCY. */

#include "entropy.h"

static Model models[2048];

/* 8.2, a row. A row of the context that lies outside the grid is a row of zeros; each row is followed by a 0. */
static u32 decode_row(Decoder *decoder, u8 *here, const u8 *const rows[7], u32 columns) {
    Decoder d = *decoder;
    const u8 *y1 = rows[0], *z1 = rows[1], *z1y = rows[2], *s1 = rows[3], *s1z = rows[4], *s1y1 = rows[5], *s1z1 = rows[6];
    u32 left = 0, past = 0;
    for (u32 x = 0; x < columns; x++) {
        u32 context = left << 10 | (u32)y1[x] << 9 | (u32)z1[x] << 8 | (u32)z1y[x] << 7 | (u32)y1[x + 1] << 6 |
                      (u32)z1[x + 1] << 5 | (u32)s1[x] << 4 | past << 3 | (u32)s1z[x] << 2 | (u32)s1y1[x] << 1 | s1z1[x];
        here[x] = (u8)(left = adaptive(&d, &models[context]));
        past = s1[x];
    }
    *decoder = d;
    return !d.missing;
}

/* 8.2: all bits, into `raw`. */
static Status decode_bits(Decoder *d, u32 S, u32 Z, u32 Y, u32 X, u8 *raw) {
    /* Two slots, each row with a 0 after it: this slot and the one before. */
    u32 row = X + 1, layer = row * Y, bit = 0;
    u64 slot_size = (u64)layer * Z;
    u8 *outside = take(row), *slots[2] = {take(slot_size), take(slot_size)};
    if (!outside || !slots[0] || !slots[1]) return NO_MEMORY;
    new_models(models, 2048);
    for (u32 s = 0; s < S; s++)
        for (u32 z = 0; z < Z; z++)
            for (u32 y = 0; y < Y; y++) {
                u8 *now = slots[s & 1] + z * layer + y * row, *past = slots[~s & 1] + z * layer + y * row;
                const u8 *rows[7] = {
                    y > 0 ? now - row : outside,
                    z > 0 ? now - layer : outside,
                    z > 0 && y + 1 < Y ? now - layer + row : outside,
                    s > 0 ? past : outside,
                    s > 0 && z + 1 < Z ? past + layer : outside,
                    s > 0 && y > 0 ? past - row : outside,
                    s > 0 && z > 0 ? past - layer : outside,
                };
                if (!decode_row(d, now, rows, X)) return WORDS_DO_NOT_END;
                for (u32 x = 0; x < X; x++, bit++) {
                    u8 before = bit & 7 ? raw[bit >> 3] : 0;
                    raw[bit >> 3] = (u8)(before | now[x] << (bit & 7));
                }
            }
    return check_end(d);
}

/* 8.2: decode OCCU to its content under RAW (6.4), `raw_length` bytes. The sizes are those of its head. */
EXPORT(kpc_occupancy) Status kpc_occupancy(const u8 *body, u32 length, u8 *raw, u32 raw_length) {
    Decoder d;
    u32 marked = mark();
    if (length < 8 || raw_length < 8) return CONTENT_LENGTH;
    u32 S = load_u16(body), Z = load_u16(body + 2), Y = load_u16(body + 4), X = load_u16(body + 6);
    if (!S || !Z || !Y || !X || max(max((i32)S, (i32)Z), max((i32)Y, (i32)X)) > AXIS_LIMIT) return BAD_ARGUMENT;
    u64 cells = (u64)S * Z * Y * X; /* below 2^56 */
    if (raw_length - 8 != (cells + 7) / 8 || cells > 0xFFFFFFFFu) return CONTENT_LENGTH;
    Status status = open_coded_data(&d, body + 8, length - 8);
    if (status != OK) return status;
    copy(raw, body, 8);
    status = decode_bits(&d, S, Z, Y, X, raw + 8);
    release(marked);
    return status;
}
