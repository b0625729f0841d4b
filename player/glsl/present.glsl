// Puts what a march gave on the screen: its colours, or one of the other things it met.

#include "space.glsl"

uniform sampler2D seen;
uniform sampler2D met;
uniform sampler2D without;  // what a march of the static part has seen
uniform int view;           // 0 colour, 1 |colour - without|, 2 depth, 3 samples
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
    vec2 sums = texture(met, at).xy;
    vec3 rgb = colour.rgb;
    if (view == 1) rgb = abs(rgb - texture(without, at).rgb);
    if (view == 2) {
        float depth = progress_of(sums.x / max(colour.a, 1e-6), even);
        float near = progress_of(depths.x, even), far = progress_of(depths.y, even);
        rgb = colour.a * heat(1.0 - clamp((depth - near) / (far - near), 0.0, 1.0));
    }
    if (view == 3) rgb = heat(sums.y / most_samples);
    shown = vec4(rgb, share);
}
