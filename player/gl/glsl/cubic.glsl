// Colours between the pixels of a picture, by the cubic of Catmull and Rom (Computer Aided Geometric Design, 1974): it blurs less than a
// straight line between neighbours. Of the sixteen pixels around, the four at the corners hardly count, and are left out.

// What the pixels one before, at, one after and two after count for what is f of a pixel further on.
vec4 cubic_weights(float f) {
    return vec4(f * (f * (1.0 - 0.5 * f) - 0.5), 1.0 + f * f * (1.5 * f - 2.5), f * (0.5 + f * (2.0 - 1.5 * f)), f * f * (0.5 * f - 0.5));
}

// At `at` in [0, 1]^2; beyond the edge all is as on it. Where colours turn sharply, what comes out exceeds what there is.
vec3 cubic(sampler2D picture, vec2 at) {
    vec2 size = vec2(textureSize(picture, 0)), place = at * size - 0.5;
    ivec2 last = ivec2(size) - 1, first = ivec2(floor(place)), p = clamp(first - 1, ivec2(0), last), q = clamp(first, ivec2(0), last),
          r = clamp(first + 1, ivec2(0), last), s = clamp(first + 2, ivec2(0), last);
    vec4 x = cubic_weights(fract(place.x)), y = cubic_weights(fract(place.y));
    vec3 sum = y[0] * (x[1] * texelFetch(picture, ivec2(q.x, p.y), 0).rgb + x[2] * texelFetch(picture, ivec2(r.x, p.y), 0).rgb)
             + y[1] * (x[0] * texelFetch(picture, ivec2(p.x, q.y), 0).rgb + x[1] * texelFetch(picture, q, 0).rgb
                     + x[2] * texelFetch(picture, ivec2(r.x, q.y), 0).rgb + x[3] * texelFetch(picture, ivec2(s.x, q.y), 0).rgb)
             + y[2] * (x[0] * texelFetch(picture, ivec2(p.x, r.y), 0).rgb + x[1] * texelFetch(picture, ivec2(q.x, r.y), 0).rgb
                     + x[2] * texelFetch(picture, r, 0).rgb + x[3] * texelFetch(picture, ivec2(s.x, r.y), 0).rgb)
             + y[3] * (x[1] * texelFetch(picture, ivec2(q.x, s.y), 0).rgb + x[2] * texelFetch(picture, ivec2(r.x, s.y), 0).rgb);
    return sum / (1.0 - (x[0] + x[3]) * (y[0] + y[3]));
}
