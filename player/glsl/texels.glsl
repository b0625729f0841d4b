// Nothing but look-ups: how many there can be, kpc.tools.limits.

uniform sampler2D planes;
uniform float side;  // of the texture, in texels
out vec4 seen;

void main() {
    vec4 sum = vec4(0.0);
    vec2 at = gl_FragCoord.xy / side;
    for (int i = 0; i < LOOK_UPS; i++) {
        sum += textureLod(planes, at, 0.0);
        at += vec2(0.37, 1.13) / side;  // a short way on, as along a ray
    }
    seen = sum;
}
