// Walking the sampling lattice s_k = near + (k + 1/2) stride through occupied cells only.
//
// A cell of the grid holds 0 where it is occupied, else the Chebyshev distance in cells to the nearest one that is (at
// most 255). All cells nearer than that are empty: a ray crosses a whole block of them in one step. The lattice stays.

struct Walk {
    vec3 start;    // where the ray begins, in cells; CONTRACTED: in half edges of the box from its middle
    vec3 rate;     // the same per unit of t; no component is 0
    vec3 inverse;  // 1 / rate
    float near;    // in s
    float far;
    float stride;
    float k;       // the next sample to look at
    float even;
};

Walk walk_of(vec3 eye, vec3 d, vec3 low, vec3 high, ivec3 count, float stride, float even) {
#if CONTRACTED
    vec3 half_edges = 0.5 * (high - low);
    vec3 rate = slanted(d) / half_edges;
    return Walk((eye - low) / half_edges - 1.0, rate, 1.0 / rate, 0.0, (2.0 - 1.0 / FAR) * even, stride, 0.0, even);
#else
    vec2 range = box_range(eye, d, low, high);
    vec3 box = high - low;
    vec3 rate = slanted(d) / box * vec3(count);
    return Walk((eye - low) / box * vec3(count), rate, 1.0 / rate, range.x, range.y, stride, 0.0, even);
#endif
}

float sample_s(Walk walk) {
    return walk.near + (walk.k + 0.5) * walk.stride;
}

// In cells.
vec3 position_at(Walk walk, float t, ivec3 count) {
    vec3 p = walk.start + t * walk.rate;
#if CONTRACTED
    p = (0.25 * contracted(p) + 0.5) * vec3(count);
#endif
    return p;
}

// How far, in t, a ray stays within the block that reaches `reach` cells from `cell` in both directions, it being at
// `position` in that cell, t along. In contracted space a bound from below.
float way_out(Walk walk, float t, vec3 position, vec3 cell, float reach, ivec3 count) {
    vec3 ahead = vec3(greaterThan(walk.rate, vec3(0.0)));
#if CONTRACTED
    vec3 edge = 4.0 / vec3(count);  // of a cell
    vec3 low = (cell + 1.0 - reach) * edge - 2.0, high = (cell + reach) * edge - 2.0;
    vec3 place = position * edge - 2.0, y = walk.start + t * walk.rate;
    float radius = largest(abs(y));
    if (radius < 1.0) {  // the way is straight as far as the box reaches
        vec3 leave = (mix(max(low, -1.0), min(high, 1.0), ahead) - y) * walk.inverse;
        return min(leave.x, min(leave.y, leave.z));
    }
    // |d contract / dt| <= v (4 r - 3) / r^2 <= 4/3 v, and with w_ij = y_i v_j - y_j v_i, constant along the ray, it is at
    // most (v + 2 w) / r^2 where r > 1. Until the way is `margin` long, r is no less than at a radius of place - margin.
    vec3 to_faces = min(place - low, high - place);
    float margin = max(min(to_faces.x, min(to_faces.y, to_faces.z)), 0.0);
    float speed = largest(abs(walk.rate)), turn = largest(abs(cross(walk.start, walk.rate)));
    float nearest = largest(abs(place)) - margin;
    float bound = 4.0 / 3.0 * speed;
    if (nearest > 1.0) bound = min(bound, (speed + 2.0 * turn) * (2.0 - nearest) * (2.0 - nearest));
    return margin / max(bound, 1e-30);  // 0 where rounding puts a place at infinity
#else
    vec3 corner = cell + mix(vec3(1.0 - reach), vec3(reach), ahead);
    vec3 leave = (corner - position) * walk.inverse;
    return min(leave.x, min(leave.y, leave.z));
#endif
}

// Move walk.k on to the first sample, from itself on, that lies in an occupied cell. False where there is none.
bool to_occupied(inout Walk walk, usampler3D cells, ivec3 count) {
    bool inside;
    uint free;
    do {
        float s = sample_s(walk), t = distance_of(s, walk.even);
        inside = s < walk.far;
        vec3 position = position_at(walk, t, count);
        ivec3 cell = clamp(ivec3(position), ivec3(0), count - 1);
        free = inside ? texelFetch(cells, cell, 0).r : 0u;
        if (free > 0u) {
            float free_t = way_out(walk, t, position, vec3(cell), float(free), count);
            float free_s = progress_of(t + free_t, walk.even) - progress_of(t, walk.even);
            // A hair less than the way out: landing one sample early costs a look-up, one late would lose a sample.
            walk.k += max(1.0, floor(free_s / walk.stride - 1e-3) + 1.0);
        }
    } while (free > 0u);
    return inside;
}
