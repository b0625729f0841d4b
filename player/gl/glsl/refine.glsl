// One plane of space, written finer along the axis along which a row is to be folded into it.

#include "planes.glsl"

uniform sampler2D planes;
uniform vec4 source;         // the plane's block in `planes`
uniform float source_width;  // of one layer there
uniform vec2 origin;         // its block in what is written, texels
uniform float width;         // of one layer
uniform vec2 at_texel;       // of the plane to one texel that is written

layout(location = 0) out vec4 refined;

void main() {
    vec2 local = gl_FragCoord.xy - origin;
    float layer = floor(local.x / width);
    vec2 position = vec2(local.x - layer * width, local.y) - 0.5;
    refined = plane_layer(planes, source, source_width, position * at_texel, int(layer));
}
