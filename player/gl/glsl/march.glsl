// The picture of a scene; normative text and a readable twin: kpc.player.cpu.reference.
//
// LAYERS_n, FIRST_n: of four channels, of scale n; FEATURES: all of them; BASIS: three times as many. HIDDEN is 0 where colour is the same from all sides. HYBRID: 1 where the
// decoder is the hybrid one, of layers of WIDTH and HIDDEN units. APPEARANCE: 1 where colours come in more than one appearance.
// ROWS: 1 where rows of time planes are multiplied in at every sample.
// CONTRACTED: 1 where the planes hold what lies outside the box, too. MOTION: 1 where places are displaced.
// NDC: 1 where all this is in device coordinates. DRAWN: how many scales count. SHARED: how many, from
// the coarsest on, are looked up once for two samples, in the middle between them; the next gives their slope.
// PIXELS: 0 all are marched; 1 the probes (probes.glsl), as in tiles.glsl; 2 blocks in doubt (blocks.glsl).
// COMPUTE: 1 for a compute shader (GL 4.3).

#include "ray.glsl"
#include "space.glsl"
#include "occupancy.glsl"
#include "motion.glsl"
#include "planes.glsl"
#include "decoder.glsl"
#include "probes.glsl"
#include "tiles.glsl"
#include "decoder_weights"  // constants: density_weight, density_bias, w1, w2, b2, ... (kpc.player.atlas), as the next
#include "plane_blocks"     // blocks, layer_widths, last_texels, layers, first_layers

const float TERMINATION = 1.0 / 1024.0;  // as in kpc.format.scene.scene

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

#if PIXELS
uniform vec2 size;                  // of the picture
uniform int turn;                   // of the probes
uniform sampler2D doubts;           // a texel a block, to be marched if more than
uniform float bearable;
#endif
uniform float height;
uniform vec4 lens;
uniform mat3 axes;
uniform vec3 eye;

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
#unroll i HIDDEN_4
    towards[i] = vec4(direction_hidden(e, 4 * i), direction_hidden(e, 4 * i + 1),
                      direction_hidden(e, 4 * i + 2), direction_hidden(e, 4 * i + 3));
#end
}
#elif HIDDEN
vec4 basis[BASIS];

void look_along(vec3 d) {
    mat3x4 e = encoded(d);
#unroll i BASIS
    basis[i] = b2[i];
#end
#unroll h HIDDEN
    float hidden_##h = max(direction_hidden(e, h), 0.0);
#unroll i BASIS
    basis[i] += hidden_##h * w2[i * HIDDEN + h];
#end
#end
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
    int at = 4 * i * FEATURES;
#unroll j FEATURES
    sum += vec4(dot(from_features[at + j], f[j]), dot(from_features[at + FEATURES + j], f[j]),
                dot(from_features[at + 2 * FEATURES + j], f[j]), dot(from_features[at + 3 * FEATURES + j], f[j]));
#end
    return sum;
}

// The logits of the colour, from the hidden layer of the density.
vec3 shade_of(vec4 h[WIDTH / 4]) {
    vec3 shade = b2[0].xyz;
    vec4 sum;
#unroll i HIDDEN_4
    sum = towards[i];
#unroll j WIDTH_4
    sum += vec4(dot(passed_on[i * WIDTH + j], h[j]), dot(passed_on[i * WIDTH + WIDTH / 4 + j], h[j]),
                dot(passed_on[i * WIDTH + WIDTH / 2 + j], h[j]), dot(passed_on[i * WIDTH + 3 * WIDTH / 4 + j], h[j]));
#end
    sum = activated(sum);
    shade += vec3(dot(w2[i], sum), dot(w2[HIDDEN / 4 + i], sum), dot(w2[HIDDEN / 2 + i], sum));
#end
    return shade;
}
#endif

#if HYBRID
// What a sample's features make of it: the logits of its colour, and in w the log of its density.
vec4 hybrid_logits_of(vec3 u, float trans, float thickness) {
    vec4 f[FEATURES];
#unroll scale SCALES
#unroll layer LAYERS_##scale
    f[FIRST_##scale + layer] = scale < DRAWN ? feature(u, scale, layer) : vec4(0.0);
#end
#end
    vec4 h[WIDTH / 4];
    float log_density = density_bias[0].x;
#unroll i WIDTH_4
    h[i] = activated(from_features_bias[i] + four_rows(i, f));
    log_density += dot(h[i], density_weight[i]);
#end
    vec3 shade = vec3(0.0);
    if (trans * alpha_of(log_density, thickness) > NEGLIGIBLE) shade = shade_of(h);
    return vec4(shade, log_density);
}
#else
// What a scale adds to the logits of the colour, and in w to the log of the density.
#unroll scale SCALES
vec4 logits_of_scale_##scale(vec3 u) {
    vec4 sum = vec4(0.0), f;
#unroll layer LAYERS_##scale
    f = feature(u, scale, layer);
    sum += vec4(dot(f, basis[FIRST_##scale + layer]), dot(f, basis[FEATURES + FIRST_##scale + layer]),
                dot(f, basis[2 * FEATURES + FIRST_##scale + layer]), dot(f, density_weight[FIRST_##scale + layer]));
#end
    return sum;
}
#end

// Of the scales from SHARED on.
vec4 logits_of(vec3 u) {
    vec4 sum = vec4(0.0);
#unroll scale SCALES
#if scale >= SHARED && scale < DRAWN
    sum += logits_of_scale_##scale(u);
#endif
#end
    return sum;
}

// Of those before.
vec4 shared_logits_of(vec3 u) {
    vec4 sum = vec4(vec3(0.0), density_bias[0].x);
#unroll scale SHARED
    sum += logits_of_scale_##scale(u);
#end
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

// seen: rgb and opacity; met: sum of weight t, samples.
void march(vec2 fragment, out vec4 seen, out vec4 met) {
#if PIXELS == 1
    fragment = probe_of(block_of(floor(fragment)), turn, size) + 0.5;
#endif
    Path path = path_of(eye, camera_direction(fragment, height, lens, axes), frame, near, baseline);
    Walk walk = walk_of(path.begin, path.way, box_low, box_high, cell_count, stride, even);
    Met sum = Met(vec3(0.0), 1.0, 0.0, 0.0);
    Place place;
    bool more = to_occupied(walk, cells, place);
#if HIDDEN
    if (more) look_along(path.way);
#endif
#if SHARED
    vec4 shared_before = vec4(0.0);
    float pair_k = -1.0;
#endif
    // Tested at its end: neighbouring rays run as one, and a test up front would cost them all one more body.
    do {
        if (more) {
            vec3 u = looked_up(place.u);
#if SHARED
            float next_s = sample_s(walk, walk.k + 1.0);
            Place next = place_at(walk, next_s);
            bool both = next_s < walk.far && free_around(cells, walk, cell_of(walk, next.u)) == 0u;
            vec3 next_u = looked_up(next.u);
            vec4 shared_logits = shared_logits_of(0.5 * (u + next_u));
            // How they go on from half a sample to the next, if the pair before was the one just before.
            vec4 slope = walk.k == pair_k ? 0.25 * (shared_logits - shared_before) : vec4(0.0);
            slope /= 1.0 + abs(slope);  // steep ones seldom go on
            shared_before = shared_logits;
            vec4 next_logits = shared_logits + slope + logits_of(next_u);
            add_sample(sum, shared_logits - slope + logits_of(u), thickness_at(walk, place), world_distance(path, place.t));
            if (both && sum.trans >= termination) {
                add_sample(sum, next_logits, thickness_at(walk, next), world_distance(path, next.t));
            }
            walk.k += 2.0;
            pair_k = walk.k;
#else
            float thickness = thickness_at(walk, place);
#if HYBRID
            vec4 logits = hybrid_logits_of(u, sum.trans, thickness);
#else
            vec4 logits = shared_logits_of(u) + logits_of(u);
#endif
            add_sample(sum, logits, thickness, world_distance(path, place.t));
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

#if COMPUTE
layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba32f) uniform writeonly image2D seen_picture;
layout(rg32f) uniform writeonly image2D met_picture;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, imageSize(seen_picture)))) return;
#if PIXELS == 2
    if (textureLod(doubts, (floor(vec2(at) / BLOCK) + 0.5) / ceil(size / BLOCK), 0.0).r <= bearable) return;
#endif
    vec4 seen, met;
    march(vec2(at) + 0.5, seen, met);
    imageStore(seen_picture, at, seen);
    imageStore(met_picture, at, met);
}
#else
layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    march(gl_FragCoord.xy, seen, met);
}
#endif
