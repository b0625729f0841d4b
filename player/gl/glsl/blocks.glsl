// A square for each block in doubt, as a point: what is not drawn costs nothing, while a fragment that is discarded is marched by a
// step where neighbours run as one.

#include "probes.glsl"

uniform sampler2D doubts;  // a texel a block, in doubt if more than
uniform float bearable;
uniform vec2 size;         // of the picture, pixels

void main() {
    vec2 blocks = ceil(size / BLOCK), block = vec2(gl_VertexID % int(blocks.x), gl_VertexID / int(blocks.x));
    bool doubted = textureLod(doubts, (block + 0.5) / blocks, 0.0).r > bearable;
    // What has its middle outside is not drawn at all: at far edges, squares are moved back into the picture.
    vec2 middle = min(BLOCK * (block + 0.5), max(size - 0.5 * BLOCK, 0.5 * size));
    gl_Position = vec4(doubted ? 2.0 * middle / size - 1.0 : vec2(2.0), 0.0, 1.0);
    gl_PointSize = BLOCK;
}
