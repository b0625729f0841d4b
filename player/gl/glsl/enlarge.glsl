// Puts a picture that is ready to be shown on a larger screen.

#include "cubic.glsl"

uniform sampler2D shown_small;
uniform vec2 viewport;  // pixels
uniform vec2 origin;    // of the viewport on the screen, pixels
uniform float opacity;  // of the picture over what is there

layout(location = 0) out vec4 shown;

void main() {
    shown = vec4(cubic(shown_small, (gl_FragCoord.xy - origin) / viewport), opacity);
}
