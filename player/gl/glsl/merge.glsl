// Puts a picture into one that has depths: colours multiplied by opacity, and the mean depths of its rays.

#include "limits.glsl"

uniform sampler2D rgba;
uniform sampler2D sums;         // as march.glsl writes them with DEPTH_LIMIT
uniform sampler2D other_rgba;   // of the other group, where two make up a clip's picture, as the next
uniform sampler2D other_sums;
uniform float other_share;
uniform vec2 viewport;          // pixels
uniform vec2 origin;            // of the viewport on the screen, pixels
uniform vec3 eye;
uniform mat4 projection;        // from the world to places in the picture and depths
uniform float least_opacity;    // where there is less, nothing is written
uniform bool is_linear;         // the other picture holds linear light, else display values

layout(location = 0) out vec4 shown;

// How alike distances must be for rays to be mixed.
const float ALIKE = 1e-3;

vec3 linear_light(vec3 x) {
    return mix(x / 12.92, pow((x + 0.055) / 1.055, vec3(2.4)), vec3(greaterThan(x, vec3(0.04045))));
}

// The mean of the four rays around a place whose own limit is `limit`: those that could see as far count most, so that
// edges of what hides the picture stay sharp where rays are few. z: sum of weight times distance.
void mixed(
    sampler2D rays, sampler2D ray_sums, vec2 at, float limit, float share, inout vec4 colour, inout float depth
) {
    vec2 size = vec2(textureSize(rays, 0)), position = at * size - 0.5, f = fract(position);
    ivec2 last = ivec2(size) - 1, first = ivec2(floor(position));
    vec4 sum = vec4(0.0);
    float weights = 0.0, depths = 0.0;
    for (int i = 0; i < 4; ++i) {
        ivec2 corner = ivec2(i % 2, i / 2), ray = clamp(first + corner, ivec2(0), last);
        vec4 found = texelFetch(ray_sums, ray, 0);
        vec2 near = mix(1.0 - f, f, vec2(corner));
        float weight = near.x * near.y / (ALIKE + abs(found.w - limit) / min(max(found.w, 1e-6), max(limit, 1e-6)));
        sum += weight * texelFetch(rays, ray, 0);
        depths += weight * found.x;
        weights += weight;
    }
    colour += share * sum / weights;
    depth += share * depths / weights;
}

void main() {
    vec2 at = (gl_FragCoord.xy - origin) / viewport;
    float limit = limit_at(at, eye), depth = 0.0;
    shown = vec4(0.0);
    mixed(rgba, sums, at, limit, 1.0 - other_share, shown, depth);
    if (other_share > 0.0) mixed(other_rgba, other_sums, at, limit, other_share, shown, depth);
    if (shown.a < least_opacity) discard;
    if (is_linear) shown.rgb = linear_light(shown.rgb / shown.a) * shown.a;
    vec3 seen = eye + depth / shown.a * normalize(place_of(at, 0.5) - eye);
    vec4 place = projection * vec4(seen, 1.0);
    gl_FragDepth = clamp(place.z / place.w, 0.0, 1.0);
}
