// Where a ray's samples lie, and where in the planes; normative text and readable twin: kpc.format.scene.space.
//
// CONTRACTED: 1 where the planes hold what lies outside the box, too. `y` is a place in half edges of the box from its
// middle; `even` is how far along a ray the steps are even. NDC: 1 where box and rays are in device coordinates.

const float FAR = 256.0;  // as in kpc.format.scene.space
const float FORWARD = 1e-4;
const float LEAST_DISPARITY = 1e-6;

float largest(vec3 v) {
    return max(v.x, max(v.y, v.z));
}

// The distance t along a ray of a sample at s.
float distance_of(float s, float even) {
#if CONTRACTED
    return s <= even ? s : even / (2.0 - s / even);
#else
    return s;
#endif
}

// s of t.
float progress_of(float t, float even) {
#if CONTRACTED
    return t <= even ? t : even * (2.0 - even / t);
#else
    return t;
#endif
}

// In the cube [-2, 2]^3.
vec3 contracted(vec3 y) {
    float radius = max(largest(abs(y)), 1.0);
    return y * ((2.0 - 1.0 / radius) / radius);
}

// What a step at y, t along its ray, counts for the density.
float stretch_of(vec3 y, float t, float even) {
    float stretch = max(t / even, 1.0) / max(largest(abs(y)), 1.0);
    return stretch * stretch;
}

// A ray as it is marched: begin + s way. In the world, unless NDC.
struct Path {
    vec3 begin;
    vec3 way;
    float reach;  // NDC: s at which it is infinitely far
    float start;  // distance in the world at s = 0
    float pace;   // how fast that grows there, times reach
};

// frame: the right, up and backward axes of the camera that stands for all, and where it is.
Path path_of(vec3 o, vec3 d, mat4x3 frame, float near, float baseline) {
#if NDC
    vec3 p = transpose(mat3(frame)) * (o - frame[3]);
    vec3 v = transpose(mat3(frame)) * d;
    if (v.z > -FORWARD) return Path(vec3(0.0, 0.0, -1.0), vec3(0.0, 0.0, -1.0), 1.0, 0.0, 0.0);
    float start = max((near + p.z) / -v.z, 0.0);
    p += start * v;
    vec3 begin = vec3(p.xy, baseline) / -p.z;
    vec3 way = vec3(v.xy / -v.z - begin.xy, begin.z);
    float reach = length(way);
    return Path(vec3(begin.xy, baseline / near - begin.z), way / reach, reach, start, p.z / v.z);
#else
    return Path(o, d, 0.0, 0.0, 0.0);
#endif
}

// The distance in the world of what lies `t` along the path.
float world_distance(Path path, float t) {
#if NDC
    float share = min(t / path.reach, 1.0 - LEAST_DISPARITY);
    return path.start + path.pace * (share / (1.0 - share));
#else
    return t;
#endif
}
