/* Section 7: what the codecs of plane segments share. */

#ifndef KPC_SEGMENTS_H
#define KPC_SEGMENTS_H

#include "entropy.h"

/* A segment: `coded` is one byte for each texel, `symbols` is [rows][columns][channels]. */
typedef struct {
    u32 rows, columns, channels;
    u8 *coded;
    i8 *symbols;
} Segment;

void decode_map(Decoder *decoder, u8 *coded, u32 rows, u32 columns);
Status decode_raw(const u8 *body, u32 length, Segment *segment);
Status decode_predictive(const u8 *body, u32 length, Segment *segment, u32 implied);
Status decode_transform(const u8 *body, u32 length, Segment *segment, u32 implied);

/* 7.2: make the map of a segment, of which an implied one is in `coded` before. */
INLINE Status begin_map(Decoder *d, Segment *segment, u32 mode, u32 implied) {
    if (mode == IMPLIED) return implied ? OK : NO_IMPLIED_MAP;
    fill(segment->coded, 1, segment->rows * segment->columns);
    if (mode == STORED) decode_map(d, segment->coded, segment->rows, segment->columns);
    return OK;
}

#endif
