/* Section 7.2: which texels are coded. */

#include "segments.h"

static Model map_models[MAP_CONTEXTS];

/* 7.2, stored maps. The bits of each context come from three windows that move along the rows. */
void decode_map(Decoder *decoder, u8 *coded, u32 rows, u32 columns) {
    Decoder d = *decoder;
    new_models(map_models, MAP_CONTEXTS);
    for (u32 y = 0; y < rows && !d.missing; y++) {
        u8 *row = coded + y * columns;
        const u8 *row1 = row - columns, *row2 = row1 - columns; /* rows y - 1 and y - 2 */
        u32 left = 0, above = 0, higher = 0; /* x - 2 .. x - 1; x - 2 .. x + 2 of row y - 1; x - 1 .. x + 1 of y - 2 */
        if (y > 0) above = (u32)row1[0] << 1 | (columns > 1 ? row1[1] : 0);
        if (y > 1) higher = row2[0];
        for (u32 x = 0; x < columns; x++) {
            above = (above << 1 & 31) | (y > 0 && x + 2 < columns ? row1[x + 2] : 0);
            higher = (higher << 1 & 7) | (y > 1 && x + 1 < columns ? row2[x + 1] : 0);
            row[x] = (u8)adaptive(&d, &map_models[higher << 7 | above << 2 | left]);
            left = (left << 1 & 3) | row[x];
        }
    }
    *decoder = d;
}

/* 7.2, implied maps: one byte, 0 or 1, for each projected cell of a plane. The grid is the content of OCCU under RAW
   (6.4), whose sizes the host has checked. */
EXPORT(kpc_project) Status kpc_project(const u8 *occupancy, u32 length, u32 plane, u8 *projected) {
    static const u8 AXES[6][2] = {{3, 2}, {3, 1}, {2, 1}, {3, 0}, {2, 0}, {1, 0}}; /* of columns and rows, in t z y x */
    u32 size[4], at[4];
    u64 cell = 0;
    if (length < 8 || plane > 5) return BAD_ARGUMENT;
    for (u32 axis = 0; axis < 4; axis++) size[axis] = load_u16(occupancy + 2 * axis);
    if (length - 8 != ((u64)size[0] * size[1] * size[2] * size[3] + 7) / 8) return CONTENT_LENGTH;
    u32 across = AXES[plane][0], down = AXES[plane][1];
    fill(projected, 0, size[down] * size[across]);
    for (at[0] = 0; at[0] < size[0]; at[0]++)
        for (at[1] = 0; at[1] < size[1]; at[1]++)
            for (at[2] = 0; at[2] < size[2]; at[2]++)
                for (at[3] = 0; at[3] < size[3]; at[3]++, cell++)
                    if (occupancy[8 + cell / 8] >> (cell & 7) & 1) projected[at[down] * size[across] + at[across]] = 1;
    return OK;
}

/* The first projected cell that touches the support of texel i, and the one after the last, along an axis of `texels`
   texels and `cells` cells: those of the inequalities of 7.2. */
INLINE void touching_cells(i32 i, i32 texels, i32 cells, i32 *first, i32 *after) {
    i32 apart = texels - 1;
    *first = 0, *after = cells;
    if (apart == 0) return;
    if (i > 1) *first = ((i - 1) * cells + apart - 1) / apart - 1;
    *after = min((i + 1) * cells / apart + 1, cells);
}

/* 7.2, implied maps: rows row_start to row_start + row_count - 1 of the map of a plane of `rows` x `columns` texels. */
EXPORT(kpc_implied_map)
Status kpc_implied_map(const u8 *projected, u32 cell_rows, u32 cell_columns, u32 rows, u32 columns, u32 row_start,
                       u32 row_count, u8 *coded) {
    u32 marked = mark();
    u32 largest = AXIS_LIMIT;
    if (!cell_rows || !cell_columns || !rows || !columns || cell_rows > largest || cell_columns > largest ||
        rows > largest || columns > largest || row_start > rows || row_count > rows - row_start)
        return BAD_ARGUMENT;
    u32 *before = take(4 * ((u64)cell_columns + 1)); /* occupied columns of cells before each, in the rows that count */
    if (!before) return NO_MEMORY;
    for (u32 y = 0; y < row_count; y++) {
        i32 first, after;
        touching_cells((i32)(row_start + y), (i32)rows, (i32)cell_rows, &first, &after);
        for (u32 b = 0; b < cell_columns; b++) {
            u8 any = 0;
            for (i32 a = first; a < after; a++) any |= projected[(u64)a * cell_columns + b];
            before[b + 1] = before[b] + any;
        }
        for (u32 x = 0; x < columns; x++) {
            touching_cells((i32)x, (i32)columns, (i32)cell_columns, &first, &after);
            coded[(u64)y * columns + x] = before[after] > before[first];
        }
    }
    release(marked);
    return OK;
}
