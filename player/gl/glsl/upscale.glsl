// A picture stretched to a larger one: colours by a cubic, the rest bilinearly.

#include "cubic.glsl"

uniform sampler2D rgba_small;
uniform sampler2D sums_small;
uniform vec2 size;  // of the larger one, pixels

layout(location = 0) out vec4 rgba;
layout(location = 1) out vec4 sums;

void main() {
    vec2 at = gl_FragCoord.xy / size;
    rgba = vec4(clamp(cubic(rgba_small, at), 0.0, 1.0), textureLod(rgba_small, at, 0.0).a);
    sums = textureLod(sums_small, at, 0.0);
}
