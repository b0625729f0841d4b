// A point for each probe.

#include "probes.glsl"
#include "tiles.glsl"

uniform sampler2D seen_probes;  // as in tiles.glsl
uniform sampler2D met_probes;
uniform vec2 raster;            // of probes
uniform vec2 size;              // of the picture, pixels
uniform int turn;

out vec4 probe_seen;
out vec4 probe_met;

void main() {
    vec2 blocks = ceil(size / BLOCK), block = vec2(gl_VertexID % int(blocks.x), gl_VertexID / int(blocks.x));
    vec2 at = (texel_of(block) + 0.5) / raster;
    probe_seen = textureLod(seen_probes, at, 0.0);
    probe_met = textureLod(met_probes, at, 0.0);
    gl_Position = vec4(2.0 * (probe_of(block, turn, size) + 0.5) / size - 1.0, 0.0, 1.0);
    gl_PointSize = 1.0;
}
