// Puts what a march gave on the screen: its colours, or one of the other things it met.
//
// VIEW: 0 colour, 1 |colour - without|, 2 depth, 3 samples.

#include "space.glsl"

uniform sampler2D seen;
uniform sampler2D met;
uniform sampler2D without;  // what a march of the static part has seen
uniform vec2 viewport;      // pixels
uniform vec2 depths;        // shown from bright to dark
uniform float even;         // CONTRACTED: how far steps are even
uniform float most_samples;
uniform float share;        // of the picture; the rest is there already

layout(location = 0) out vec4 shown;

// Black, violet, orange, white.
vec3 heat(float x) {
    return clamp(vec3(1.6 * x, 1.9 * x * x - 0.25 * x, 1.3 * x * (1.0 - 1.6 * x) + 1.3 * x * x * x * x), 0.0, 1.0);
}

void main() {
    vec2 at = gl_FragCoord.xy / viewport;
    vec4 colour = texture(seen, at);
    vec3 rgb = colour.rgb;
#if VIEW == 1
    rgb = abs(rgb - texture(without, at).rgb);
#elif VIEW == 2
    float depth = progress_of(texture(met, at).x / max(colour.a, 1e-6), even);
    float near = progress_of(depths.x, even), far = progress_of(depths.y, even);
    rgb = colour.a * heat(1.0 - clamp((depth - near) / (far - near), 0.0, 1.0));
#elif VIEW == 3
    rgb = heat(texture(met, at).y / most_samples);
#endif
    shown = vec4(rgb, share);
}
