// Puts a picture on the screen.
//
// MODE: 0 colour, 1 |colour - static part|, 2 depth, 3 number of samples.

#include "space.glsl"

uniform sampler2D rgba;
uniform sampler2D sums;
uniform sampler2D static_rgba;
uniform vec2 viewport;      // pixels
uniform vec2 origin;        // of the viewport on the screen, pixels
uniform vec2 depths;        // shown from bright to dark, world units
uniform float uniform_distance;         // CONTRACTED: how far along a ray samples are evenly spaced
uniform float most_samples;
uniform float opacity;      // of the picture over what is there

layout(location = 0) out vec4 shown;

// Black, violet, orange, white.
vec3 heat(float x) {
    return clamp(vec3(1.6 * x, 1.9 * x * x - 0.25 * x, 1.3 * x * (1.0 - 1.6 * x) + 1.3 * x * x * x * x), 0.0, 1.0);
}

void main() {
    vec2 at = (gl_FragCoord.xy - origin) / viewport;
    vec4 colour = texture(rgba, at);
    vec3 rgb = colour.rgb;
#if MODE == 1
    rgb = abs(rgb - texture(static_rgba, at).rgb);
#elif MODE == 2
    float depth = parameter_of(texture(sums, at).x / max(colour.a, 1e-6), uniform_distance);
    float near = parameter_of(depths.x, uniform_distance), far = parameter_of(depths.y, uniform_distance);
    rgb = colour.a * heat(1.0 - clamp((depth - near) / (far - near), 0.0, 1.0));
#elif MODE == 3
    rgb = heat(texture(sums, at).y / most_samples);
#endif
    shown = vec4(rgb, opacity);
}
