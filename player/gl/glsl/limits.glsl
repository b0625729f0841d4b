// How far rays may see in a picture that has depths already, such as that of meshes.

uniform sampler2D limits;    // a depth buffer
uniform vec4 limits_part;    // corner and size of the picture in it, shares of it
uniform vec2 limits_reach;   // about a pixel where pixels have several samples, of which it holds one; else 0
uniform mat4 unprojection;   // from places in the picture, shares of its size, and depths to the world

vec3 place_of(vec2 at, float depth) {
    vec4 place = unprojection * vec4(at, depth, 1.0);
    return place.xyz / (abs(place.w) < 1e-12 ? 1e-12 : place.w);  // infinitely far: nearly so
}

// The distance from the eye to what is seen at a place in the picture; with several samples a pixel to the farthest of
// what is seen around it, and the test of depths hides what lies behind the nearer samples.
float limit_at(vec2 at, vec3 eye) {
    vec2 middle = limits_part.xy + at * limits_part.zw;
    float farthest = 0.0;
    for (int i = 0; i < 4; ++i) {
        vec2 corner = vec2(i % 2, i / 2) * 2.0 - 1.0;
        float depth = textureLod(limits, middle + corner * limits_reach, 0.0).r;
        farthest = max(farthest, distance(place_of(at, depth), eye));
    }
    return farthest;
}
