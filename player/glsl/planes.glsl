// Features of a point: the product over planes of bilinear samples, four channels a texel, corner-aligned.
//
// All planes lie in one texture. The block of a plane at a scale begins at `origin` (in texels) and holds its layers
// of four channels side by side. Positions never leave [0, size - 1], so that no filter reaches into a neighbour.
// Rows are the time planes cut at one time: one line of the `rows` texture for each axis, scale and layer.

vec4 plane_layer(sampler2D planes, vec2 texel, vec2 origin, float width, vec2 position, int layer) {
    return textureLod(planes, (origin + vec2(float(layer) * width, 0.0) + position + 0.5) * texel, 0.0);
}

vec4 row_layer(sampler2D rows, vec2 texel, float position, int axis, int scale, int layer) {
    return textureLod(rows, vec2(position + 0.5, float((axis * SCALES + scale) * LAYERS + layer) + 0.5) * texel, 0.0);
}
