// The picture of a scene; normative text and a readable twin: kpc.player.reference.
//
// SCALES, LAYERS (of four channels), HIDDEN: its shape; HIDDEN is 0 where colour is the same from all sides. HYBRID: 1 where the
// decoder is the hybrid one, of layers of WIDTH and HIDDEN units. APPEARANCE: 1 where colours come in more than one appearance.
// ROWS: 1 where rows of time planes are multiplied in at every sample. REFINED: how much finer than the scene's the planes are
// along the row folded into them; 1 where none is.
// CONTRACTED: 1 where the planes hold what lies outside the box, too. MOTION: 1 where places are displaced.
// NDC: 1 where all this is in device coordinates. DRAWN: how many of the SCALES count.

#include "ray.glsl"
#include "space.glsl"
#include "occupancy.glsl"
#include "motion.glsl"
#include "planes.glsl"
#include "decoder.glsl"
#include "decoder_weights"  // constants: density_weight, density_bias, w1, w2, b2, ... (kpc.player.textures)

#define FEATURES (SCALES * LAYERS)
const float TERMINATION = 1.0 / 1024.0;  // as in kpc.format.scene

uniform sampler2D planes;
uniform sampler2D rows;
uniform usampler3D cells;
uniform sampler3D motion;
uniform vec2 planes_texel;          // 1 / size of the texture
uniform vec2 rows_texel;
uniform vec3 blocks[SCALES * 3];    // xy, xz, yz of each scale: where they begin, and the width of a layer
uniform vec3 resolution[SCALES];    // texels along x, y, z
uniform ivec3 cell_count;
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
    vec3 p = u * (resolution[scale] - 1.0);
    vec3 q = float(REFINED) * p;  // folded planes are finer along x, z and y
    vec3 xy = blocks[3 * scale], xz = blocks[3 * scale + 1], yz = blocks[3 * scale + 2];
    vec4 f = plane_layer(planes, planes_texel, xy.xy, xy.z, vec2(q.x, p.y), layer)
           * plane_layer(planes, planes_texel, xz.xy, xz.z, vec2(p.x, q.z), layer)
           * plane_layer(planes, planes_texel, yz.xy, yz.z, vec2(q.y, p.z), layer);
#if ROWS
    f *= row_layer(rows, rows_texel, p.x, 0, scale, layer)
       * row_layer(rows, rows_texel, p.y, 1, scale, layer)
       * row_layer(rows, rows_texel, p.z, 2, scale, layer);
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

void main() {
    Path path = path_of(eye, camera_direction(gl_FragCoord.xy, height, lens, axes), frame, near, baseline);
    Walk walk = walk_of(path.begin, path.way, box_low, box_high, cell_count, stride, even);

    vec3 rgb = vec3(0.0);
    float trans = 1.0;
    float depth = 0.0;
    float samples = 0.0;
    bool more = to_occupied(walk, cells, cell_count);
#if HIDDEN
    if (more) look_along(path.way);
#endif
    // Tested at its end: neighbouring rays run as one, and a test up front would cost them all one more body.
    do {
        if (more) {
            float t = distance_of(sample_s(walk), even);
#if CONTRACTED
            vec3 y = walk.start + t * walk.rate;
            vec3 u = 0.25 * contracted(y) + 0.5;
            float thickness = tau * stretch_of(y, t, even);
#else
            vec3 u = clamp((path.begin + t * path.way - box_low) / (box_high - box_low), 0.0, 1.0);
            float thickness = tau;
#endif
#if MOTION
            u = moved(motion, nodes, u);
#endif
            float log_density = density_bias[0].x;
            vec3 shade = vec3(0.0);
#if HYBRID
            vec4 f[FEATURES];
            for (int i = 0; i < FEATURES; ++i) f[i] = i < DRAWN * LAYERS ? feature(u, i / LAYERS, i % LAYERS) : vec4(0.0);
            vec4 h[WIDTH / 4];
            for (int i = 0; i < WIDTH / 4; ++i) {
                h[i] = activated(from_features_bias[i] + four_rows(i, f));
                log_density += dot(h[i], density_weight[i]);
            }
#else
            for (int scale = 0; scale < DRAWN; ++scale) {
                for (int layer = 0; layer < LAYERS; ++layer) {
                    int i = scale * LAYERS + layer;
                    vec4 f = feature(u, scale, layer);
                    log_density += dot(f, density_weight[i]);
                    shade += vec3(dot(f, basis[i]), dot(f, basis[FEATURES + i]), dot(f, basis[2 * FEATURES + i]));
                }
            }
#endif
            float weight = trans * alpha_of(log_density, thickness);
#if HYBRID
            if (weight > NEGLIGIBLE) shade = shade_of(h);
#endif
            rgb += weight * sigmoid(shade);
            depth += weight * world_distance(path, t);
            trans -= weight;
            samples += 1.0;
            walk.k += 1.0;
            more = trans >= termination;
        }
        more = more && to_occupied(walk, cells, cell_count);
    } while (more);

    if (trans < termination && termination > TERMINATION) {  // sooner than the format says: the rest is like what was met
        rgb /= 1.0 - trans;
        depth /= 1.0 - trans;
        trans = 0.0;
    }
    seen = vec4(rgb + trans * background, 1.0 - trans);
    met = vec4(depth, samples, 0.0, 0.0);
}
