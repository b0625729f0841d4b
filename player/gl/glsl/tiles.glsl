// Which texel of the raster of probes is whose: squares of SQUARE x SQUARE blocks lie TILE texels apart.
//
// A processor that draws hands tiles of 64 x 64 pixels to its cores, and a raster of a probe a block is one or two of them: spread
// out, there is something for each. Elsewhere SQUARE is more than all of a raster, and a texel's block is the one of its number.

vec2 texel_of(vec2 block) {
    return block + float(TILE - SQUARE) * floor((block + 0.5) / float(SQUARE));
}

vec2 block_of(vec2 texel) {
    return texel - float(TILE - SQUARE) * floor((texel + 0.5) / float(TILE));
}
