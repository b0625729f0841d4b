// The picture before, seen from where the camera is now: each pixel is taken from where the place that it shows was seen.
//
// How far away that is comes from the picture before, too: first the nearest there is around the same pixel, since what is in front
// may have moved over it, then what is where that leads; if it has not, that is what lies behind.

#include "ray.glsl"

uniform sampler2D seen_before;
uniform sampler2D met_before;
uniform vec2 size;  // of both

uniform float height;
uniform vec4 lens;
uniform mat3 axes;
uniform vec3 eye;
uniform vec4 lens_before;
uniform mat3 axes_before;
uniform vec3 eye_before;

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

const float NOWHERE = 1e6;  // how far away nothing is, in distances of the eye from where it was before
const float AROUND = 2.0;   // pixels across and up

// How far from the eye of now that is which was seen at `fragment` before.
float distance_at(vec2 fragment, out float samples) {
    ivec2 at = ivec2(clamp(fragment, vec2(0.0), size - 0.5));
    float opacity = texelFetch(seen_before, at, 0).a;
    vec4 sums = texelFetch(met_before, at, 0);
    samples = sums.y;
    if (opacity <= 0.0) return NOWHERE;
    return length(eye_before + sums.x / opacity * camera_direction(fragment, height, lens_before, axes_before) - eye);
}

void main() {
    vec3 d = camera_direction(gl_FragCoord.xy, height, lens, axes);
    vec2 from = gl_FragCoord.xy;
    float samples, depth = distance_at(from, samples);
#unroll i 4
    depth = min(depth, distance_at(from + AROUND * (2.0 * vec2(i & 1, i >> 1) - 1.0), samples));
#end
    from = on_raster(eye + depth * d, height, lens_before, axes_before, eye_before);
    depth = distance_at(from, samples);
    from = on_raster(eye + depth * d, height, lens_before, axes_before, eye_before);
    seen = textureLod(seen_before, from / size, 0.0);
    met = vec4(seen.a > 0.0 ? depth * seen.a : 0.0, samples, 0.0, 0.0);
}
