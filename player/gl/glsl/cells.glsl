// The occupied cells, as boxes with a pattern of grid lines: where a march takes samples.

#include "ray.glsl"
#include "space.glsl"
#include "occupancy.glsl"

uniform usampler3D cells;
uniform vec3 cell_count;
uniform vec3 box_low;
uniform vec3 box_high;
uniform float stride;
uniform float uniform_distance;
uniform vec3 background;
uniform mat4x3 frame;
uniform float near;
uniform float baseline;

uniform float height;
uniform vec4 lens;
uniform mat3 axes;
uniform vec3 eye;

layout(location = 0) out vec4 rgba;
layout(location = 1) out vec4 sums;

void main() {
    Path path = path_of(eye, camera_direction(gl_FragCoord.xy, height, lens, axes), frame, near, baseline);
    Walk walk = walk_of(path.origin, path.direction, box_low, box_high, cell_count, stride, uniform_distance);
    rgba = vec4(background, 0.0);
    sums = vec4(0.0);
    SamplePoint point;
    if (!to_occupied(walk, cells, point)) return;

    float t = point.t;
    vec3 inside = point.u * cell_count;
    vec3 cell = floor(inside);
#if CONTRACTED
    // The ray is curved: take the face nearest to the sample for the one through which the ray came in.
    vec3 local = abs(inside - cell - 0.5);
    vec3 face = vec3(greaterThanEqual(local, vec3(largest(local))));
#else
    // Back from the sample to the face through which the ray came in.
    vec3 enter = ((cell + vec3(lessThan(walk.rate, vec3(0.0)))) * walk.edge - walk.start) * walk.inverse;
    t = max(largest(enter), walk.near);
    vec3 local = abs((walk.start + t * walk.rate) * cell_count - cell - 0.5);
    vec3 face = vec3(greaterThanEqual(enter, vec3(t)));
#endif
    vec3 across = mix(local, vec3(0.0), face);
    float line = smoothstep(0.40, 0.46, max(across.x, max(across.y, across.z)));
    float lit = dot(face, vec3(0.72, 0.84, 1.0));
    vec3 shade = cell * walk.edge;
    vec3 tint = mix(vec3(0.30, 0.46, 0.62), vec3(0.90, 0.74, 0.46), shade);
    rgba = vec4(tint * max(lit, 0.6) * mix(1.0, 0.6, line), 1.0);
    sums = vec4(world_distance(path, t), 1.0, 0.0, 0.0);
}
