// Which blocks have changed since a picture: those whose sample pixel differs from it by more than a tolerance, and those
// with a neighbour whose sample pixel differs by more than twice the tolerance.

#include "follow.glsl"

uniform sampler2D before;   // the picture
uniform sampler2D sampled;  // the sample pixels now, one of each block
uniform int turn;
uniform float tolerance;

out vec4 changed;

float difference_of(ivec2 block) {
    ivec2 size = textureSize(before, 0);
    vec4 off = abs(texelFetch(sampled, block, 0) - texelFetch(before, sample_pixel(block, turn, size), 0));
    return max(max(off.r, off.g), max(off.b, off.a));
}

void main() {
    ivec2 block = ivec2(gl_FragCoord.xy), last = textureSize(sampled, 0) - 1;
    float off = 0.0;
    for (int i = 0; i < 9; ++i) {
        ivec2 neighbour = clamp(block + ivec2(i % 3, i / 3) - 1, ivec2(0), last);
        off = max(off, (neighbour == block ? 1.0 : 0.5) * difference_of(neighbour));
    }
    changed = vec4(off > tolerance);
}
