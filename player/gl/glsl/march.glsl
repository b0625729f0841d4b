// The picture of a scene; normative text and a readable twin: kpc.player.cpu.reference.
//
// LAYERS_n, FIRST_n: layers of four channels of scale n, and the first among those of all; PART_n: 1 where it is not
// looked up outside its area. FEATURES: layers of all; BASIS: three times as many. HIDDEN: hidden units of the colour's
// direction layer, 0 for view-independent colour.
// HYBRID: 1 for the hybrid decoder, of layers of WIDTH and HIDDEN units. APPEARANCE: 1 where colours come in more than
// one appearance. ROWS: 1 where time rows are multiplied in at every sample. CONTRACTED: 1 where the planes hold what
// lies outside the box, too. MOTION: 1 where samples are displaced. NDC: 1 where all this is in normalised device
// coordinates. DEPTH_LIMIT: 1 where rays end at the depths of a picture that this one becomes part of. COMPUTE: 1 for a
// compute shader (GL 4.3). COUNTED: 1 where look-ups of cells are counted. WEIGHTS_IN_BLOCK: defined where the
// decoder's weights are no constants but in a uniform block, so that a loop over them makes a shorter shader.
// BASIS_IN_LOOP: defined where, besides, an array that is indexed in a loop is as fast as registers.

#include "ray.glsl"
#include "space.glsl"
#include "occupancy.glsl"
#include "motion.glsl"
#include "planes.glsl"
#include "decoder.glsl"
#include "follow.glsl"
#if DEPTH_LIMIT
#include "limits.glsl"
#endif
// Constants: density_weight, density_bias, w1, w2, b2, ... (kpc.player.gl.shader_constants), as the next.
#include "decoder_weights"
#include "plane_blocks"     // blocks, layer_widths, last_texels, first_layers

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
uniform vec3 areas[2 * SCALES];     // between which the features of each scale may be other than 0
uniform float stride;
uniform float uniform_distance;                 // CONTRACTED: how far along a ray samples are evenly spaced
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
uniform float width;  // of the raster, pixels; `height` is its height

// Which pixels are marched: all, the sample pixel of each block, or those of blocks that have changed (follow.glsl).
const int ALL = 0, SAMPLED = 1, CHANGED = 2;
uniform int marched;
uniform int turn;           // of the sample pixels
uniform sampler2D sampled;  // CHANGED: the sample pixels, one of each block, as marched before
uniform sampler2D changes;  // CHANGED: which blocks have changed
uniform sampler2D before;   // CHANGED: the picture that shows the others

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
#ifdef WEIGHTS_IN_BLOCK
    for (int h = 0; h < HIDDEN; h++) {
        float hidden = max(direction_hidden(e, h), 0.0);
#ifdef BASIS_IN_LOOP
        for (int i = 0; i < BASIS; i++) basis[i] += hidden * w2[i * HIDDEN + h];
#else
#unroll i BASIS
        basis[i] += hidden * w2[i * HIDDEN + h];
#end
#endif
    }
#else
#unroll h HIDDEN
    float hidden_##h = max(direction_hidden(e, h), 0.0);
#unroll i BASIS
    basis[i] += hidden_##h * w2[i * HIDDEN + h];
#end
#end
#endif
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

// Whether the features of a scale may be other than 0.
bool is_in_area(vec3 u, int scale) {
    return all(greaterThan(u, areas[2 * scale])) && all(lessThan(u, areas[2 * scale + 1]));
}

#if HYBRID
// A weight below which a sample's colour is not worked out but grey: 4096 of them are not off by more than half an
// 8-bit level.
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
    sum += vec4(dot(from_hidden[i * WIDTH + j], h[j]), dot(from_hidden[i * WIDTH + WIDTH / 4 + j], h[j]),
                dot(from_hidden[i * WIDTH + WIDTH / 2 + j], h[j]),
                dot(from_hidden[i * WIDTH + 3 * WIDTH / 4 + j], h[j]));
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
#if PART_##scale
#unroll layer LAYERS_##scale
    f[FIRST_##scale + layer] = vec4(0.0);
#end
    if (is_in_area(u, scale))
#endif
    {
#unroll layer LAYERS_##scale
        f[FIRST_##scale + layer] = feature(u, scale, layer);
#end
    }
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
// The logits of the colour, and in w the log of the density.
vec4 logits_of(vec3 u) {
    vec4 sum = vec4(vec3(0.0), density_bias[0].x), f;
#unroll scale SCALES
#if PART_##scale
    if (is_in_area(u, scale))
#endif
    {
#unroll layer LAYERS_##scale
        f = feature(u, scale, layer);
        sum += vec4(dot(f, basis[FIRST_##scale + layer]), dot(f, basis[FEATURES + FIRST_##scale + layer]),
                    dot(f, basis[2 * FEATURES + FIRST_##scale + layer]), dot(f, density_weight[FIRST_##scale + layer]));
#end
    }
#end
    return sum;
}
#endif

// The position in the planes of a sample at u: displaced where the scene has motion.
vec3 plane_position(vec3 u) {
    u = clamp(u, 0.0, 1.0);
#if MOTION
    u = displaced(motion, nodes, u);
#endif
    return u;
}

// The thickness of a step: its length over the longest edge of the box, times the density scale of contracted space.
float thickness_at(Walk walk, SamplePoint point) {
#if CONTRACTED
    return tau * density_scale(walk.start + point.t * walk.rate, point.t, uniform_distance);
#else
    return tau;
#endif
}

// The sums of a ray so far.
struct Sums {
    vec3 rgb;
    float trans;
    float depth;
    float samples;
};

void add_sample(inout Sums sums, vec4 logits, float thickness, float distance) {
    float weight = sums.trans * alpha_of(logits.w, thickness);
    sums.rgb += weight * sigmoid(logits.rgb);
    sums.depth += weight * distance;
    sums.trans -= weight;
    sums.samples += 1.0;
}

// rgba: colour and opacity; depth_samples: sum of weight times distance, number of samples and, COUNTED, of cells
// looked up; DEPTH_LIMIT: fourth, how far the ray could see.
void march(vec2 fragment, out vec4 rgba, out vec4 depth_samples) {
    Path path = path_of(eye, camera_direction(fragment, height, lens, axes), frame, near, baseline);
    Walk walk = walk_of(path.origin, path.direction, box_low, box_high, cell_count, stride, uniform_distance);
#if DEPTH_LIMIT
    float limit = limit_at(fragment / vec2(width, height), eye);
    walk.far = min(walk.far, parameter_of(path_distance(path, limit), uniform_distance));
#endif
    Sums sums = Sums(vec3(0.0), 1.0, 0.0, 0.0);
    SamplePoint point;
    bool more = to_occupied(walk, cells, point);
#if HIDDEN
    if (more) look_along(path.direction);
#endif
    // Tested at its end: neighbouring rays run as one, and a test up front would cost them all one more body.
    do {
        if (more) {
            vec3 u = plane_position(point.u);
            float thickness = thickness_at(walk, point);
#if HYBRID
            vec4 logits = hybrid_logits_of(u, sums.trans, thickness);
#else
            vec4 logits = logits_of(u);
#endif
            add_sample(sums, logits, thickness, world_distance(path, point.t));
            walk.k += 1.0;
            more = sums.trans >= termination;
        }
        more = more && to_occupied(walk, cells, point);
    } while (more);

    // Sooner than the format says: the remaining light gets the colour met so far.
    if (sums.trans < termination && termination > TERMINATION) {
        sums.rgb /= 1.0 - sums.trans;
        sums.depth /= 1.0 - sums.trans;
        sums.trans = 0.0;
    }
    rgba = vec4(sums.rgb + sums.trans * background, 1.0 - sums.trans);
    depth_samples = vec4(sums.depth, sums.samples, 0.0, 0.0);
#if COUNTED
    depth_samples.z = cell_look_ups;
#endif
#if DEPTH_LIMIT
    depth_samples.w = limit;
#endif
}

#if COMPUTE
layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba32f) uniform writeonly image2D rgba_picture;
layout(rg32f) uniform writeonly image2D sums_picture;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, imageSize(rgba_picture)))) return;
    vec4 rgba, sums;
    march(vec2(at) + 0.5, rgba, sums);
    imageStore(rgba_picture, at, rgba);
    imageStore(sums_picture, at, sums);
}
#else
layout(location = 0) out vec4 rgba;
layout(location = 1) out vec4 sums;

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), block = at / BLOCK, size = ivec2(width, height);
    bool is_sampled = marched == CHANGED && at == sample_pixel(block, turn, size);
    bool is_kept = marched == CHANGED && !is_sampled && texelFetch(changes, block, 0).r < 0.5;
    if (marched == SAMPLED) at = sample_pixel(at, turn, size);
    if (!is_sampled && !is_kept) {
        march(vec2(at) + 0.5, rgba, sums);
    } else {
        rgba = is_sampled ? texelFetch(sampled, block, 0) : texelFetch(before, at, 0);
        sums = vec4(0.0);
    }
}
#endif
