// A picture of a march stretched to a larger one: colours by a cubic, and by straight lines what is divided by one another.

#include "cubic.glsl"

uniform sampler2D seen_small;
uniform sampler2D met_small;
uniform vec2 size;  // of the larger one, pixels

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    vec2 at = gl_FragCoord.xy / size;
    seen = vec4(clamp(cubic(seen_small, at), 0.0, 1.0), textureLod(seen_small, at, 0.0).a);
    met = textureLod(met_small, at, 0.0);
}
