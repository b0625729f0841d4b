// Texture look-ups alone, to measure how many the device can do (kpc.tools.bench.machine_limits). COMPUTE: 1 for a
// compute shader (GL 4.3).

uniform sampler2D planes;
uniform float side;  // of the texture, in texels

vec4 looked_up(vec2 at) {
    vec4 sum = vec4(0.0);
    at /= side;
    for (int i = 0; i < LOOK_UPS; i++) {
        sum += textureLod(planes, at, 0.0);
        at += vec2(0.37, 1.13) / side;  // a short way on, as along a ray
    }
    return sum;
}

#if COMPUTE
layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba32f) uniform writeonly image2D rgba_picture;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    imageStore(rgba_picture, at, looked_up(vec2(at) + 0.5));
}
#else
out vec4 rgba;

void main() {
    rgba = looked_up(gl_FragCoord.xy);
}
#endif
