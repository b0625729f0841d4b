// A point for each square of the raster of probes that has a block within `bounds`.

#include "probes.glsl"
#include "tiles.glsl"

uniform vec2 size;    // of the picture, pixels
uniform vec2 raster;  // of probes
uniform vec4 bounds;  // left, bottom, right, top: of the blocks whose probes are to be drawn

void main() {
    int across = int(ceil(ceil(size.x / BLOCK) / float(SQUARE)));
    vec2 first = float(SQUARE) * vec2(gl_VertexID % across, gl_VertexID / across);
    bool within = all(lessThan(first, bounds.zw)) && all(greaterThan(first + float(SQUARE), bounds.xy));
    vec2 middle = texel_of(first) + 0.5 * float(SQUARE);
    gl_Position = vec4(within ? 2.0 * middle / raster - 1.0 : vec2(2.0), 0.0, 1.0);
    gl_PointSize = float(SQUARE);
}
