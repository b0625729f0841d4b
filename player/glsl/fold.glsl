// Multiplies a row of a time plane into one plane of space, for a march that then needs the planes alone.
//
// Exact at the texels of what is written. Between them the product of two interpolations becomes the interpolation of a
// product. That error falls with the square of the distance between texels: the result is written finer along the row.

#include "planes.glsl"

uniform sampler2D planes;
uniform sampler2D rows;
uniform vec2 rows_texel;
uniform vec4 source;         // the plane's block in `planes`
uniform float source_width;  // of one layer there
uniform vec2 origin;         // its block in what is written, texels
uniform float width;         // of one layer
uniform vec2 at_texel;       // of the plane to one texel that is written
uniform float row_texel;     // texels of the row to one that is written along it
uniform bool upright;        // the row runs along the plane's rows, else along its columns
uniform int line;            // of the row's first layer

layout(location = 0) out vec4 folded;

void main() {
    vec2 local = gl_FragCoord.xy - origin;
    float layer = floor(local.x / width);
    vec2 position = vec2(local.x - layer * width, local.y) - 0.5;
    folded = plane_layer(planes, source, source_width, position * at_texel, int(layer))
           * row_layer(rows, rows_texel, (upright ? position.y : position.x) * row_texel, line + int(layer));
}
