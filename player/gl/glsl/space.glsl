// Where a ray's samples lie, in the world and in the planes; normative text and readable twin: kpc.format.scene.space.
//
// CONTRACTED: 1 where the planes hold what lies outside the box, too. `y` is a point in half edges of the box from its
// middle; `uniform_distance` is how far along a ray samples are evenly spaced. NDC: 1 where box and rays are in device
// coordinates.

const float FAR = 256.0;  // as in kpc.format.scene.space
const float FORWARD = 1e-4;
const float LEAST_DISPARITY = 1e-6;

float largest(vec3 v) {
    return max(v.x, max(v.y, v.z));
}

// The distance t along a ray of a sample at s.
float distance_of(float s, float uniform_distance) {
#if CONTRACTED
    return s <= uniform_distance ? s : uniform_distance / (2.0 - s / uniform_distance);
#else
    return s;
#endif
}

// s of t.
float parameter_of(float t, float uniform_distance) {
#if CONTRACTED
    return t <= uniform_distance ? t : uniform_distance * (2.0 - uniform_distance / t);
#else
    return t;
#endif
}

// In the cube [-2, 2]^3.
vec3 contracted(vec3 y) {
    float radius = max(largest(abs(y)), 1.0);
    return y * ((2.0 - 1.0 / radius) / radius);
}

// The density scale of a step at y, t along its ray.
float density_scale(vec3 y, float t, float uniform_distance) {
    float scale = max(t / uniform_distance, 1.0) / max(largest(abs(y)), 1.0);
    return scale * scale;
}

// A ray as it is marched: origin + s direction. In the world, unless NDC; then as kpc.format.scene.space.DeviceRays.
struct Path {
    vec3 origin;
    vec3 direction;
    float s_infinity;  // NDC: s at which it is infinitely far
    float t_start;     // NDC: distance in the world at s = 0
    float t_scale;     // NDC: dt/ds there, times s_infinity
};

// frame: the right, up and backward axes of the camera that stands for all, and where it is.
Path path_of(vec3 o, vec3 d, mat4x3 frame, float near, float baseline) {
#if NDC
    vec3 p = transpose(mat3(frame)) * (o - frame[3]);
    vec3 v = transpose(mat3(frame)) * d;
    if (v.z > -FORWARD) return Path(vec3(0.0, 0.0, -1.0), vec3(0.0, 0.0, -1.0), 1.0, 0.0, 0.0);
    float t_start = max((near + p.z) / -v.z, 0.0);
    p += t_start * v;
    vec3 origin = vec3(p.xy, baseline) / -p.z;
    vec3 direction = vec3(v.xy / -v.z - origin.xy, origin.z);
    float s_infinity = length(direction);
    origin.z = baseline / near - origin.z;
    return Path(origin, direction / s_infinity, s_infinity, t_start, p.z / v.z);
#else
    return Path(o, d, 0.0, 0.0, 0.0);
#endif
}

// The distance in the world of the point at t along a path.
float world_distance(Path path, float t) {
#if NDC
    float share = min(t / path.s_infinity, 1.0 - LEAST_DISPARITY);
    return path.t_start + path.t_scale * (share / (1.0 - share));
#else
    return t;
#endif
}

// t along a path of the point at a distance in the world: the inverse of world_distance.
float path_distance(Path path, float distance) {
#if NDC
    float ratio = max(distance - path.t_start, 0.0) / path.t_scale;
    return path.s_infinity * (1.0 - 1.0 / (1.0 + ratio));
#else
    return distance;
#endif
}
