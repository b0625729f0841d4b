// Puts what is shown on a screen that is larger.

#include "cubic.glsl"

uniform sampler2D shown_small;
uniform vec2 viewport;  // pixels
uniform float share;    // of the picture; the rest is there already

layout(location = 0) out vec4 shown;

void main() {
    shown = vec4(cubic(shown_small, gl_FragCoord.xy / viewport), share);
}
