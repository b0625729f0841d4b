// Walking the sampling lattice t_k = near + (k + 1/2) stride through occupied cells only.
//
// A cell of the grid holds 0 where it is occupied, else the Chebyshev distance in cells to the nearest one that is (at
// most 255). All cells nearer than that are empty: a ray crosses a whole block of them in one step. The lattice stays.

struct Walk {
    vec3 start;    // where the ray begins, in cells
    vec3 rate;     // cells per unit of t; no component is 0
    vec3 inverse;  // 1 / rate
    float near;
    float far;
    float stride;
    float k;       // the next sample to look at
};

float sample_t(Walk walk) {
    return walk.near + (walk.k + 0.5) * walk.stride;
}

// Move walk.k on to the first sample, from itself on, that lies in an occupied cell. False where there is none.
bool to_occupied(inout Walk walk, usampler3D cells, ivec3 count) {
    bool inside;
    uint free;
    do {
        float t = sample_t(walk);
        inside = t < walk.far;
        vec3 position = walk.start + t * walk.rate;
        ivec3 cell = clamp(ivec3(position), ivec3(0), count - 1);
        free = inside ? texelFetch(cells, cell, 0).r : 0u;
        if (free > 0u) {
            float reach = float(free);
            vec3 corner = vec3(cell) + vec3(
                walk.rate.x > 0.0 ? reach : 1.0 - reach,
                walk.rate.y > 0.0 ? reach : 1.0 - reach,
                walk.rate.z > 0.0 ? reach : 1.0 - reach);
            vec3 leave = (corner - position) * walk.inverse;
            float free_t = min(leave.x, min(leave.y, leave.z));
            // A hair less than the way out: landing one sample early costs a look-up, one late would lose a sample.
            walk.k += max(1.0, floor(free_t / walk.stride - 1e-3) + 1.0);
        }
    } while (free > 0u);
    return inside;
}
