// A picture of a march with several rays across a pixel: their mean.

uniform sampler2D seen_fine;
uniform sampler2D met_fine;
uniform int across;  // rays

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    ivec2 first = across * ivec2(gl_FragCoord.xy);
    seen = met = vec4(0.0);
    for (int i = 0; i < across * across; ++i) {
        ivec2 at = first + ivec2(i % across, i / across);
        seen += texelFetch(seen_fine, at, 0);
        met += texelFetch(met_fine, at, 0);
    }
    seen /= float(across * across);
    met /= float(across * across);
}
