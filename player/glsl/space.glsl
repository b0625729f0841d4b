// Where a ray's samples lie, and where in the planes; normative text and readable twin: kpc.format.space.
//
// CONTRACTED: 1 where the planes hold what lies outside the box, too. `y` is a place in half edges of the box from its
// middle; `even` is how far along a ray the steps are even.

const float FAR = 256.0;  // as in kpc.format.space

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
