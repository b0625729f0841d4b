// Which blocks are to be marched whole: those whose probe differs from what was predicted there by more than the tolerance, or a
// neighbour's by more than twice as much.
//
// MOVED: 1 where the picture was predicted for a camera that has moved. Then blocks at the edge of what is seen against nothing are
// marched, too: that edge is never predicted to the pixel, and probes meet it too seldom.

#include "probes.glsl"
#include "tiles.glsl"

uniform sampler2D seen_probes;     // as in tiles.glsl
uniform sampler2D seen_predicted;  // of the whole picture
uniform vec2 raster;               // of probes
uniform vec2 size;                 // of the picture, pixels
uniform int turn;
uniform float tolerance;

const float EDGE = 0.1;  // between the opacities of four pixels each

layout(location = 0) out vec4 doubted;  // 1 or 0

void main() {
    vec2 blocks = ceil(size / BLOCK), here = floor(gl_FragCoord.xy), block;
    vec4 difference;
    float most = 0.0;
#unroll y 3
#unroll x 3
    block = clamp(here + vec2(x, y) - 1.0, vec2(0.0), blocks - 1.0);
    difference = abs(textureLod(seen_probes, (texel_of(block) + 0.5) / raster, 0.0)
                     - textureLod(seen_predicted, (probe_of(block, turn, size) + 0.5) / size, 0.0));
    most = max(most, (block == here ? 1.0 : 0.5) * max(max(difference.r, difference.g), max(difference.b, difference.a)));
#end
#end
#if MOVED
    float opacity, least = 1.0, greatest = 0.0;
#unroll y 3
#unroll x 3
    opacity = textureLod(seen_predicted, (BLOCK * here + 2.0 * vec2(x, y)) / size, 0.0).a;  // between four pixels
    least = min(least, opacity);
    greatest = max(greatest, opacity);
#end
#end
    if (greatest - least > EDGE) most = 1.0;
#endif
    doubted = vec4(most > tolerance ? 1.0 : 0.0);
}
