/* Sections 7.1, 7.3 and 7.6: a plane segment under any codec, RAW, and dequantisation. */

#include "segments.h"

/* 7.1: decode the segment of `rows` x `columns` texels of `channels` symbols that `body` holds. `coded`, a byte for each
   texel, and `symbols`, [rows][columns][channels], are the results. Where `implied` is 1, `coded` holds the implied map
   of `kpc_implied_map` before. A frame of codec ZSTD must have been decompressed. */
EXPORT(kpc_segment)
Status kpc_segment(u32 codec, const u8 *body, u32 length, u32 rows, u32 columns, u32 channels, u32 implied, u8 *coded,
                   i8 *symbols) {
    Segment segment = {rows, columns, channels, coded, symbols};
    u32 marked = mark();
    Status status = BAD_ARGUMENT;
    if (!rows || !columns || !channels || rows > AXIS_LIMIT || columns > AXIS_LIMIT || channels > CHANNEL_LIMIT ||
        (u64)rows * columns * channels > 0xFFFFFFFFu)
        return status;
    fill(symbols, 0, rows * columns * channels);
    if (codec == CODEC_RAW || codec == CODEC_ZSTD) status = decode_raw(body, length, &segment);
    if (codec == CODEC_PREDICTIVE) status = decode_predictive(body, length, &segment, implied);
    if (codec == CODEC_TRANSFORM) status = decode_transform(body, length, &segment, implied);
    release(marked);
    return status;
}

/* 7.3 */
Status decode_raw(const u8 *body, u32 length, Segment *s) {
    u32 texels = s->rows * s->columns, start = 1, count = 0;
    if (length < 1 || body[0] > STORED) return RAW_MAP_MODE;
    if (body[0] == STORED) {
        start += (texels + 7) / 8;
        if (length < start) return RAW_MAP_SHORT;
        if (texels % 8 && body[start - 1] >> texels % 8) return RAW_MAP_BITS;
    }
    for (u32 i = 0; i < texels; i++) {
        s->coded[i] = body[0] == STORED ? body[1 + i / 8] >> i % 8 & 1 : 1;
        count += s->coded[i];
    }
    if (length != start + (u64)s->channels * count) return RAW_LENGTH;
    for (u32 c = 0; c < s->channels; c++)
        for (u32 i = 0; i < texels; i++)
            if (s->coded[i]) s->symbols[i * s->channels + c] = (i8)body[start++];
    return OK;
}

/* 7.6: values of `texels` texels, float32 [texels][channels]. WebAssembly rounds after each operation. */
EXPORT(kpc_dequantise)
Status kpc_dequantise(const i8 *symbols, u32 texels, u32 channels, const float *step, const float *offset,
                      float *values) {
    for (u32 i = 0; i < texels; i++, symbols += channels, values += channels)
        for (u32 c = 0; c < channels; c++) {
            float product = (float)symbols[c] * step[c];
            values[c] = product + offset[c];
        }
    return OK;
}
