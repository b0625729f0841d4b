// Which blocks of a picture are to be marched pixel by pixel, of which a march of fewer rays is there: those where colours bend by more
// than `most` from one of its rays to the next. Lines between rays miss by an eighth of an even bend; of an edge, by half of its
// height, which is its bend.

#include "probes.glsl"

uniform sampler2D seen_coarse;
uniform vec2 size;  // of the picture, pixels
uniform float most;

layout(location = 0) out vec4 doubted;  // 1 or 0

void main() {
    vec2 coarse = vec2(textureSize(seen_coarse, 0)), last = coarse - 1.0, at;
    vec4 here, bend;
    float found = 0.0;
#unroll i 4
    at = min(floor((BLOCK * floor(gl_FragCoord.xy) + 0.25 * BLOCK * (1.0 + 2.0 * vec2(i & 1, i >> 1))) / size * coarse), last);
    here = 2.0 * texelFetch(seen_coarse, ivec2(at), 0);
    bend = abs(texelFetch(seen_coarse, ivec2(max(at.x - 1.0, 0.0), at.y), 0) + texelFetch(seen_coarse, ivec2(min(at.x + 1.0, last.x), at.y), 0) - here)
         + abs(texelFetch(seen_coarse, ivec2(at.x, max(at.y - 1.0, 0.0)), 0) + texelFetch(seen_coarse, ivec2(at.x, min(at.y + 1.0, last.y)), 0) - here);
    found = max(found, max(max(bend.r, bend.g), max(bend.b, bend.a)));
#end
    doubted = vec4(found > most ? 1.0 : 0.0);
}
