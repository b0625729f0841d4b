// One space plane, upsampled along the axis along which a time row is to be folded into it.

#include "planes.glsl"

uniform sampler2D planes;
uniform vec4 source;         // the plane's block in `planes`
uniform float source_width;  // of one layer there
uniform vec2 origin;         // of its block in what is written, texels
uniform float width;         // of one layer, texels
uniform vec2 per_texel;      // share of the plane that one written texel steps over

layout(location = 0) out vec4 upsampled_plane;

void main() {
    vec2 local = gl_FragCoord.xy - origin;
    float layer = floor(local.x / width);
    vec2 position = vec2(local.x - layer * width, local.y) - 0.5;
    upsampled_plane = plane_layer(planes, source, source_width, position * per_texel, int(layer));
}
