// Walking the sampling lattice s_k = near + (k + 1/2) stride through occupied cells only.
//
// A cell of the grid holds 0 where it is occupied, else the Chebyshev distance in cells to the nearest one that is (at
// most 255). All cells nearer than that are empty: a ray crosses a whole block of them in one step. The lattice stays.

struct Walk {
    // Where the ray begins, in [0, 1]^3 over the box; CONTRACTED: in half edges of the box from its middle.
    vec3 start;
    vec3 rate;     // the same per unit of t; no component is 0
    vec3 inverse;  // 1 / rate
    vec3 count;    // cells along x, y, z
    vec3 edge;     // of a cell, 1 / count
    float near;    // in s
    float far;
    float stride;
    float uniform_distance;
    float k;       // the sample it is at, or the next to look at
};

// Where the sample at s lies.
struct SamplePoint {
    float t;       // along the ray
    vec3 u;        // in [0, 1]^3 over what the planes cover
};

Walk walk_of(vec3 eye, vec3 d, vec3 low, vec3 high, vec3 count, float stride, float uniform_distance) {
#if CONTRACTED
    vec3 half_edges = 0.5 * (high - low);
    vec3 rate = slanted(d) / half_edges;
    vec3 start = (eye - low) / half_edges - 1.0;
    float far = (2.0 - 1.0 / FAR) * uniform_distance;
    return Walk(start, rate, 1.0 / rate, count, 1.0 / count, 0.0, far, stride, uniform_distance, 0.0);
#else
    vec2 range = box_range(eye, d, low, high);
    vec3 box = high - low;
    vec3 rate = slanted(d) / box;
    vec3 start = (eye - low) / box;
    return Walk(start, rate, 1.0 / rate, count, 1.0 / count, range.x, range.y, stride, uniform_distance, 0.0);
#endif
}

float sample_s(Walk walk, float k) {
    return walk.near + (k + 0.5) * walk.stride;
}

SamplePoint point_at(Walk walk, float s) {
    float t = distance_of(s, walk.uniform_distance);
    vec3 p = walk.start + t * walk.rate;
#if CONTRACTED
    p = 0.25 * contracted(p) + 0.5;
#endif
    return SamplePoint(t, p);
}

vec3 cell_of(Walk walk, vec3 u) {
    return clamp(floor(u * walk.count), vec3(0.0), walk.count - 1.0);
}

#if COUNTED
float cell_look_ups = 0.0;
#endif

// What a cell holds. By filter: much cheaper than texelFetch where a processor draws.
uint free_around(usampler3D cells, Walk walk, vec3 cell) {
#if COUNTED
    cell_look_ups += 1.0;
#endif
    return textureLod(cells, (cell + 0.5) * walk.edge, 0.0).r;
}

// How far, in t, a ray stays within the block that reaches `reach` cells from `cell` in both directions, it being at
// `point` in that cell. In contracted space a bound from below.
float way_out(Walk walk, SamplePoint point, vec3 cell, float reach) {
    vec3 ahead = vec3(greaterThan(walk.rate, vec3(0.0)));
    vec3 low = (cell + 1.0 - reach) * walk.edge, high = (cell + reach) * walk.edge;
#if CONTRACTED
    low = 4.0 * low - 2.0;
    high = 4.0 * high - 2.0;
    vec3 at = 4.0 * point.u - 2.0, y = walk.start + point.t * walk.rate;
    float radius = largest(abs(y));
    if (radius < 1.0) {  // the contracted ray is straight as far as the box reaches
        vec3 leave = (mix(max(low, -1.0), min(high, 1.0), ahead) - y) * walk.inverse;
        return min(leave.x, min(leave.y, leave.z));
    }
    // |d contract / dt| <= v (4 r - 3) / r^2 <= 4/3 v, and with w_ij = y_i v_j - y_j v_i, constant along the ray, it is
    // at most (v + 2 w) / r^2 where r > 1. Until the way is `margin` long, r is no less than at a radius of point -
    // margin.
    vec3 to_faces = min(at - low, high - at);
    float margin = max(min(to_faces.x, min(to_faces.y, to_faces.z)), 0.0);
    float speed = largest(abs(walk.rate)), turn = largest(abs(cross(walk.start, walk.rate)));
    float nearest = largest(abs(at)) - margin;
    float bound = 4.0 / 3.0 * speed;
    if (nearest > 1.0) bound = min(bound, (speed + 2.0 * turn) * (2.0 - nearest) * (2.0 - nearest));
    return margin / max(bound, 1e-30);  // 0 where rounding puts a point at infinity
#else
    vec3 leave = (mix(low, high, ahead) - point.u) * walk.inverse;
    return min(leave.x, min(leave.y, leave.z));
#endif
}

// Move walk.k on to the first sample, from itself on, that lies in an occupied cell, at `point`. False where there is
// none.
bool to_occupied(inout Walk walk, usampler3D cells, out SamplePoint point) {
    bool inside;
    uint free;
    do {
        float s = sample_s(walk, walk.k);
        point = point_at(walk, s);
        inside = s < walk.far;
        vec3 cell = cell_of(walk, point.u);
        free = inside ? free_around(cells, walk, cell) : 0u;
        if (free > 0u) {
            float free_t = way_out(walk, point, cell, float(free));
            float until_s = parameter_of(point.t + free_t, walk.uniform_distance);
            float free_s = until_s - parameter_of(point.t, walk.uniform_distance);
            // A hair less than the way out: landing one sample early costs a look-up, one late would lose a sample.
            walk.k += max(1.0, floor(free_s / walk.stride - 1e-3) + 1.0);
        }
    } while (free > 0u);
    return inside;
}
