// A picture of a march stretched to a larger one, by straight lines.
//
// CUBIC: 1 where colours are by a cubic, for what is shown as it is. Where what is off is marched again, it would take longer than it spares.

#include "cubic.glsl"

uniform sampler2D seen_small;
uniform sampler2D met_small;
uniform vec2 size;  // of the larger one, pixels

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    vec2 at = gl_FragCoord.xy / size;
    seen = textureLod(seen_small, at, 0.0);
#if CUBIC
    seen.rgb = clamp(cubic(seen_small, at), 0.0, 1.0);
#endif
    met = textureLod(met_small, at, 0.0);
}
