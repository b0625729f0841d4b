// Multiplies a row of a time plane into one plane of space, for a march that then needs the planes alone.
//
// Exact at the texels of what is written. Between them the product of two interpolations becomes the interpolation of a
// product. That error falls with the square of the distance between texels: plane and row have been made finer along the row.

uniform sampler2D refined;   // the planes, where they are written, too
uniform sampler2D rows;      // texel for texel
uniform vec2 refined_texel;  // 1 / size of the texture, as the next
uniform vec2 folded_rows_texel;
uniform vec2 origin;         // the plane's block, texels
uniform float width;         // of one layer
uniform bool upright;        // the row runs along the plane's rows, else along its columns
uniform int line;            // of the row's first layer
uniform float largest;       // number that can be written

layout(location = 0) out vec4 folded;

void main() {
    vec2 local = gl_FragCoord.xy - origin;
    float layer = floor(local.x / width), along = upright ? local.y : local.x - layer * width;
    vec4 product = textureLod(refined, gl_FragCoord.xy * refined_texel, 0.0)
                 * textureLod(rows, vec2(along, float(line) + layer + 0.5) * folded_rows_texel, 0.0);
    folded = clamp(product, -largest, largest);
}
