// Features of a point: the product over planes of bilinear samples, four channels a texel, corner-aligned.
//
// All planes lie in one texture. The block of a plane at a scale holds its layers of four channels side by side. `at`,
// in [0, 1] over the plane, reads at block.xy + at block.zw, a layer further on for each layer; all these are shares of
// the texture. No filter reaches into a neighbour. Rows are the time planes cut at one time: one line of the `rows`
// texture for each axis, scale and layer.

vec4 plane_layer(sampler2D planes, vec4 block, float layer_width, vec2 at, int layer) {
    return textureLod(planes, vec2(float(layer) * layer_width, 0.0) + block.xy + at * block.zw, 0.0);
}

vec4 row_layer(sampler2D rows, vec2 texel, float position, int line) {
    return textureLod(rows, vec2(position + 0.5, float(line) + 0.5) * texel, 0.0);
}
