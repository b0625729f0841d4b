// Colours between the pixels of a picture, by the cubic of Catmull and Rom (Computer Aided Geometric Design, 1974): it
// blurs less than linear interpolation. Of the sixteen pixels around, the four at the corners hardly count and are
// left out.

// The weights of the pixels one before, at, one after and two after a point that is f of a pixel further on.
vec4 cubic_weights(float f) {
    return vec4(f * (f * (1.0 - 0.5 * f) - 0.5), 1.0 + f * f * (1.5 * f - 2.5),
                f * (0.5 + f * (2.0 - 1.5 * f)), f * f * (0.5 * f - 0.5));
}

vec3 pixel(sampler2D picture, int x, int y) {
    return texelFetch(picture, ivec2(x, y), 0).rgb;
}

// At `at` in [0, 1]^2; beyond the edge all is as on it. Where colours turn sharply, the result overshoots.
vec3 cubic(sampler2D picture, vec2 at) {
    vec2 size = vec2(textureSize(picture, 0)), position = at * size - 0.5;
    ivec2 last = ivec2(size) - 1, first = ivec2(floor(position));
    ivec2 p = clamp(first - 1, ivec2(0), last), q = clamp(first, ivec2(0), last);
    ivec2 r = clamp(first + 1, ivec2(0), last), s = clamp(first + 2, ivec2(0), last);
    vec4 x = cubic_weights(fract(position.x)), y = cubic_weights(fract(position.y));
    vec3 sum = y[0] * (x[1] * pixel(picture, q.x, p.y) + x[2] * pixel(picture, r.x, p.y))
             + y[1] * (x[0] * pixel(picture, p.x, q.y) + x[1] * pixel(picture, q.x, q.y)
                     + x[2] * pixel(picture, r.x, q.y) + x[3] * pixel(picture, s.x, q.y))
             + y[2] * (x[0] * pixel(picture, p.x, r.y) + x[1] * pixel(picture, q.x, r.y)
                     + x[2] * pixel(picture, r.x, r.y) + x[3] * pixel(picture, s.x, r.y))
             + y[3] * (x[1] * pixel(picture, q.x, s.y) + x[2] * pixel(picture, r.x, s.y));
    return sum / (1.0 - (x[0] + x[3]) * (y[0] + y[3]));
}
