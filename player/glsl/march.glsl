// The picture of a scene; normative text and a readable twin: kpc.player.reference.
//
// FEATURES: layers of four channels of all scales. HIDDEN is 0 where colour is the same from all sides. HYBRID: 1 where the
// decoder is the hybrid one, of layers of WIDTH and HIDDEN units. APPEARANCE: 1 where colours come in more than one appearance.
// ROWS: 1 where rows of time planes are multiplied in at every sample.
// CONTRACTED: 1 where the planes hold what lies outside the box, too. MOTION: 1 where places are displaced.
// NDC: 1 where all this is in device coordinates. DRAWN: how many scales count. PAIRED: 1 where
// samples are taken in pairs, for each of which the scales but the finest are looked up once, in its middle.

#include "ray.glsl"
#include "space.glsl"
#include "occupancy.glsl"
#include "motion.glsl"
#include "planes.glsl"
#include "decoder.glsl"
#include "decoder_weights"  // constants: density_weight, density_bias, w1, w2, b2, ... (kpc.player.textures), as the next
#include "plane_blocks"     // blocks, layer_widths, last_texels, layers, first_layers

const float TERMINATION = 1.0 / 1024.0;  // as in kpc.format.scene

uniform sampler2D planes;
uniform sampler2D rows;
uniform usampler3D cells;
uniform sampler3D motion;
uniform vec2 rows_texel;            // 1 / size of the texture
uniform vec3 cell_count;
uniform vec3 nodes;                 // MOTION: of its grid along x, y, z
uniform vec3 box_low;
uniform vec3 box_high;
uniform vec3 background;
uniform float stride;
uniform float even;                 // CONTRACTED: how far steps are even
uniform mat4x3 frame;               // NDC: of its camera
uniform float near;                 // NDC
uniform float baseline;             // NDC
uniform float tau;                  // stride / longest edge of the box
uniform float termination;          // a ray ends once its transmittance is less
#if HIDDEN && APPEARANCE
uniform vec4 appearance[(HIDDEN + 3) / 4];  // the code to show, padded
#endif

uniform float height;
uniform vec4 lens;
uniform mat3 axes;
uniform vec3 eye;

layout(location = 0) out vec4 seen;     // rgb and opacity
layout(location = 1) out vec4 met;      // sum of weight t, samples

#if HIDDEN
// e of a direction, in three parts: x y z xx, yy zz xy yz, zx 1; the last is for b1.
mat3x4 encoded(vec3 d) {
    return mat3x4(d, d.x * d.x, d.y * d.y, d.z * d.z, d.x * d.y, d.y * d.z, d.z * d.x, 1.0, 0.0, 0.0);
}

// One number of w1 e + b1 + code.
float direction_hidden(mat3x4 e, int h) {
    float sum = dot(w1[3 * h], e[0]) + dot(w1[3 * h + 1], e[1]) + dot(w1[3 * h + 2], e[2]);
#if APPEARANCE
    sum += appearance[h / 4][h % 4];
#endif
    return sum;
}
#endif

#if HYBRID
vec4 towards[HIDDEN / 4];  // w1 e + b1 + code of the ray

void look_along(vec3 d) {
    mat3x4 e = encoded(d);
    for (int i = 0; i < HIDDEN / 4; ++i) {
        towards[i] = vec4(direction_hidden(e, 4 * i), direction_hidden(e, 4 * i + 1),
                          direction_hidden(e, 4 * i + 2), direction_hidden(e, 4 * i + 3));
    }
}
#elif HIDDEN
vec4 basis[3 * FEATURES];

void look_along(vec3 d) {
    mat3x4 e = encoded(d);
    float hidden[HIDDEN];
    for (int h = 0; h < HIDDEN; ++h) hidden[h] = max(direction_hidden(e, h), 0.0);
    for (int i = 0; i < 3 * FEATURES; ++i) {
        vec4 sum = b2[i];
        for (int h = 0; h < HIDDEN; ++h) sum += hidden[h] * w2[i * HIDDEN + h];
        basis[i] = sum;
    }
}
#else
#define basis b2
#endif

vec4 feature(vec3 u, int scale, int layer) {
    int xy = 3 * scale, xz = xy + 1, yz = xy + 2;
    vec4 f = plane_layer(planes, blocks[xy], layer_widths[xy], u.xy, layer)
           * plane_layer(planes, blocks[xz], layer_widths[xz], u.xz, layer)
           * plane_layer(planes, blocks[yz], layer_widths[yz], u.yz, layer);
#if ROWS
    vec3 p = u * last_texels[scale].xyz;
    int line = first_layers[scale] + layer;
    f *= row_layer(rows, rows_texel, p.x, line)
       * row_layer(rows, rows_texel, p.y, line + FEATURES)
       * row_layer(rows, rows_texel, p.z, line + 2 * FEATURES);
#endif
    return f;
}

#if HYBRID
// A weight below which a sample's colour is not worked out but grey: 4096 of them are not off by more than half an 8-bit level.
const float NEGLIGIBLE = 4e-7;

// Four numbers of v f.
vec4 four_rows(int i, vec4 f[FEATURES]) {
    vec4 sum = vec4(0.0);
    for (int j = 0; j < FEATURES; ++j) {
        int at = 4 * i * FEATURES + j;
        sum += vec4(dot(from_features[at], f[j]), dot(from_features[at + FEATURES], f[j]),
                    dot(from_features[at + 2 * FEATURES], f[j]), dot(from_features[at + 3 * FEATURES], f[j]));
    }
    return sum;
}

// The logits of the colour, from the hidden layer of the density.
vec3 shade_of(vec4 h[WIDTH / 4]) {
    vec3 shade = b2[0].xyz;
    for (int i = 0; i < HIDDEN / 4; ++i) {
        vec4 sum = towards[i];
        for (int j = 0; j < WIDTH / 4; ++j) {
            int at = i * WIDTH + j;
            sum += vec4(dot(passed_on[at], h[j]), dot(passed_on[at + WIDTH / 4], h[j]),
                        dot(passed_on[at + WIDTH / 2], h[j]), dot(passed_on[at + 3 * WIDTH / 4], h[j]));
        }
        sum = activated(sum);
        shade += vec3(dot(w2[i], sum), dot(w2[HIDDEN / 4 + i], sum), dot(w2[HIDDEN / 2 + i], sum));
    }
    return shade;
}
#endif

#if HYBRID
// What a sample's features make of it: the logits of its colour, and in w the log of its density.
vec4 logits_of(vec3 u, float trans, float thickness) {
    vec4 f[FEATURES];
    for (int scale = 0; scale < SCALES; ++scale) {
        for (int layer = 0; layer < layers[scale]; ++layer) {
            f[first_layers[scale] + layer] = scale < DRAWN ? feature(u, scale, layer) : vec4(0.0);
        }
    }
    vec4 h[WIDTH / 4];
    float log_density = density_bias[0].x;
    for (int i = 0; i < WIDTH / 4; ++i) {
        h[i] = activated(from_features_bias[i] + four_rows(i, f));
        log_density += dot(h[i], density_weight[i]);
    }
    vec3 shade = vec3(0.0);
    if (trans * alpha_of(log_density, thickness) > NEGLIGIBLE) shade = shade_of(h);
    return vec4(shade, log_density);
}
#else
// What a scale adds to the logits of the colour, and in w to the log of the density.
vec4 logits_of_scale(vec3 u, int scale) {
    vec4 sum = vec4(0.0);
    for (int layer = 0; layer < layers[scale]; ++layer) {
        int i = first_layers[scale] + layer;
        vec4 f = feature(u, scale, layer);
        sum += vec4(dot(f, basis[i]), dot(f, basis[FEATURES + i]), dot(f, basis[2 * FEATURES + i]), dot(f, density_weight[i]));
    }
    return sum;
}

vec4 logits_of(vec3 u, float trans, float thickness) {
    vec4 sum = vec4(vec3(0.0), density_bias[0].x);
    for (int scale = 0; scale < DRAWN; ++scale) sum += logits_of_scale(u, scale);
    return sum;
}
#endif

// Where in the planes to look for what is at a place.
vec3 looked_up(vec3 u) {
    u = clamp(u, 0.0, 1.0);
#if MOTION
    u = moved(motion, nodes, u);
#endif
    return u;
}

// What a step at a place counts for the density.
float thickness_at(Walk walk, Place place) {
#if CONTRACTED
    return tau * stretch_of(walk.start + place.t * walk.rate, place.t, even);
#else
    return tau;
#endif
}

// What a ray has met so far.
struct Met {
    vec3 rgb;
    float trans;
    float depth;
    float samples;
};

void add_sample(inout Met sum, vec4 logits, float thickness, float distance) {
    float weight = sum.trans * alpha_of(logits.w, thickness);
    sum.rgb += weight * sigmoid(logits.rgb);
    sum.depth += weight * distance;
    sum.trans -= weight;
    sum.samples += 1.0;
}

void main() {
    Path path = path_of(eye, camera_direction(gl_FragCoord.xy, height, lens, axes), frame, near, baseline);
    Walk walk = walk_of(path.begin, path.way, box_low, box_high, cell_count, stride, even);
    Met sum = Met(vec3(0.0), 1.0, 0.0, 0.0);
    Place place;
    bool more = to_occupied(walk, cells, place);
#if HIDDEN
    if (more) look_along(path.way);
#endif
#if PAIRED
    vec4 before = vec4(0.0);
    float pair_k = -1.0;
#endif
    // Tested at its end: neighbouring rays run as one, and a test up front would cost them all one more body.
    do {
        if (more) {
            vec3 u = looked_up(place.u);
#if PAIRED
            float next_s = sample_s(walk, walk.k + 1.0);
            Place next = place_at(walk, next_s);
            bool both = next_s < walk.far && free_around(cells, walk, cell_of(walk, next.u)) == 0u;
            vec3 next_u = looked_up(next.u);
            vec3 middle = 0.5 * (u + next_u);
            vec4 coarse = vec4(vec3(0.0), density_bias[0].x);
            for (int scale = 0; scale < DRAWN - 1; ++scale) coarse += logits_of_scale(middle, scale);
            // Two samples on from the pair before, if that is where it was.
            vec4 slope = walk.k == pair_k ? 0.25 * (coarse - before) : vec4(0.0);
            before = coarse;
            vec4 next_logits = coarse + slope + logits_of_scale(next_u, DRAWN - 1);
            add_sample(sum, coarse - slope + logits_of_scale(u, DRAWN - 1), thickness_at(walk, place), world_distance(path, place.t));
            if (both && sum.trans >= termination) {
                add_sample(sum, next_logits, thickness_at(walk, next), world_distance(path, next.t));
            }
            walk.k += 2.0;
            pair_k = walk.k;
#else
            float thickness = thickness_at(walk, place);
            add_sample(sum, logits_of(u, sum.trans, thickness), thickness, world_distance(path, place.t));
            walk.k += 1.0;
#endif
            more = sum.trans >= termination;
        }
        more = more && to_occupied(walk, cells, place);
    } while (more);

    if (sum.trans < termination && termination > TERMINATION) {  // sooner than the format says: the rest is like what was met
        sum.rgb /= 1.0 - sum.trans;
        sum.depth /= 1.0 - sum.trans;
        sum.trans = 0.0;
    }
    seen = vec4(sum.rgb + sum.trans * background, 1.0 - sum.trans);
    met = vec4(sum.depth, sum.samples, 0.0, 0.0);
}
