// A whole picture out of the half of its pixels that were marched now, like the squares of one colour of a chessboard.
//
// The others are what was there before, seen from where the camera was then, changed as much as their four neighbours have
// changed since, all of which were marched now. Where those have changed, something came or went: then they are kept within what
// the neighbours show; where those have changed much, they lie between them, rather between the two that are more alike.
//
// STILL: 1 where the camera is where it was.

#include "ray.glsl"

uniform sampler2D seen_now;     // of half the width; row y holds the pixels x with x + y + parity even
uniform sampler2D met_now;
uniform sampler2D seen_before;  // the whole picture before
uniform sampler2D met_before;
uniform vec2 size;              // of the whole
uniform float parity;
uniform bool afresh;            // the picture before holds the other half as it is to be

uniform float height;
uniform vec4 lens;
uniform mat3 axes;
uniform vec3 eye;
uniform vec4 lens_before;
uniform mat3 axes_before;
uniform vec3 eye_before;

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

// Greatest changes of a neighbour: between the first and the second, pixels come to be kept within them; between the third and the
// fourth, to be made of them. Of soldier, room and liam, playing, these give 41.7, 49.3 and 54.0 dB to pictures marched whole.
const vec4 CHANGES = vec4(1.0 / 64.0, 1.0 / 8.0, 1.0 / 16.0, 1.0 / 2.0);
const float NOWHERE = 1e6;  // how far away nothing is, in distances of the eye from where it was before

vec2 in_half(vec2 pixel) {
    return (vec2(floor(0.5 * pixel.x), pixel.y) + 0.5) / vec2(ceil(0.5 * size.x), size.y);
}

// What was seen before at the place that is now at the middle of `pixel`, `depth` away.
vec4 before_at(vec2 pixel, float depth) {
#if STILL
    return texelFetch(seen_before, ivec2(clamp(pixel, vec2(0.0), size - 1.0)), 0);
#else
    vec3 p = eye + depth * camera_direction(pixel + 0.5, height, lens, axes);
    return textureLod(seen_before, on_raster(p, height, lens_before, axes_before, eye_before) / size, 0.0);
#endif
}

// The pixel one way; where that leaves the picture, the other way.
vec2 beside(vec2 pixel, vec2 way) {
    vec2 other = pixel + way;
    return any(lessThan(other, vec2(0.0))) || any(greaterThanEqual(other, size)) ? pixel - way : other;
}

void main() {
    vec2 pixel = floor(gl_FragCoord.xy);
    vec4 own = textureLod(seen_now, in_half(pixel), 0.0), own_met = textureLod(met_now, in_half(pixel), 0.0);
    bool marched = mod(pixel.x + pixel.y + parity, 2.0) < 0.5;

    vec4 sum = vec4(0.0), sum_met = vec4(0.0), low = vec4(1e9), high = vec4(-1e9), change = vec4(0.0);
    vec2 across = size.x > 1.0 ? vec2(1.0, 0.0) : vec2(0.0, 1.0), up = size.y > 1.0 ? vec2(0.0, 1.0) : vec2(1.0, 0.0);
    vec2 at_0 = beside(pixel, across), at_1 = beside(pixel, -across), at_2 = beside(pixel, up), at_3 = beside(pixel, -up);
    float most = 0.0;
    vec4 now_met, difference;
#unroll i 4
    vec4 now_##i = textureLod(seen_now, in_half(at_##i), 0.0);
    now_met = textureLod(met_now, in_half(at_##i), 0.0);
    difference = now_##i - before_at(at_##i, now_##i.a > 0.0 ? now_met.x / now_##i.a : NOWHERE);
    sum += 0.25 * now_##i;
    sum_met += 0.25 * now_met;
    low = min(low, now_##i);
    high = max(high, now_##i);
    change += 0.25 * difference;
    most = max(most, max(max(abs(difference.r), abs(difference.g)), max(abs(difference.b), abs(difference.a))));
#end
    vec4 follows = before_at(pixel, sum.a > 0.0 ? sum_met.x / sum.a : NOWHERE) + change;
    follows = mix(follows, clamp(follows, low, high), smoothstep(CHANGES.x, CHANGES.y, most));
    float unlike_across = dot(abs(now_0 - now_1), vec4(1.0)) + 1e-3, unlike_up = dot(abs(now_2 - now_3), vec4(1.0)) + 1e-3;
    vec4 between = mix(0.5 * (now_0 + now_1), 0.5 * (now_2 + now_3), unlike_across / (unlike_across + unlike_up));
    follows = mix(follows, between, smoothstep(CHANGES.z, CHANGES.w, most));
    vec2 here = (pixel + 0.5) / size;
    seen = marched ? own : afresh ? textureLod(seen_before, here, 0.0) : clamp(follows, 0.0, 1.0);
    // Sum of weight t: at the mean depth of the neighbours.
    vec4 met_between = vec4(sum.a > 0.0 ? sum_met.x / sum.a * seen.a : 0.0, sum_met.y, 0.0, 0.0);
    met = marched ? own_met : afresh ? textureLod(met_before, here, 0.0) : met_between;
}
