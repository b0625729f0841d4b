// The occupied cells themselves, as boxes with a pattern of grid lines: where a march takes samples.

#include "ray.glsl"
#include "occupancy.glsl"

uniform usampler3D cells;
uniform ivec3 cell_count;
uniform vec3 box_low;
uniform vec3 box_high;
uniform float stride;
uniform vec3 background;

uniform float height;
uniform vec4 lens;
uniform mat3 axes;
uniform vec3 eye;

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    vec3 d = camera_direction(gl_FragCoord.xy, height, lens, axes);
    vec2 range = box_range(eye, d, box_low, box_high);
    vec3 to_cells = vec3(cell_count) / (box_high - box_low);
    vec3 rate = slanted(d) * to_cells;
    Walk walk = Walk((eye - box_low) * to_cells, rate, 1.0 / rate, range.x, range.y, stride, 0.0);
    seen = vec4(background, 0.0);
    met = vec4(0.0);
    if (!to_occupied(walk, cells, cell_count)) return;

    // Back from the sample to the face through which the ray came in.
    vec3 inside = walk.start + sample_t(walk) * rate;
    vec3 cell = floor(inside);
    vec3 enter = (cell + vec3(lessThan(rate, vec3(0.0))) - walk.start) * walk.inverse;
    float t = max(max(enter.x, max(enter.y, enter.z)), range.x);
    vec3 local = abs(walk.start + t * rate - cell - 0.5);
    vec3 face = vec3(greaterThanEqual(enter, vec3(t)));
    vec3 across = mix(local, vec3(0.0), face);
    float line = smoothstep(0.40, 0.46, max(across.x, max(across.y, across.z)));
    float lit = dot(face, vec3(0.72, 0.84, 1.0));
    vec3 place = cell / vec3(cell_count);
    vec3 tint = mix(vec3(0.30, 0.46, 0.62), vec3(0.90, 0.74, 0.46), place);
    seen = vec4(tint * max(lit, 0.6) * mix(1.0, 0.6, line), 1.0);
    met = vec4(t, 1.0, 0.0, 0.0);
}
