// Rays of a pinhole camera and the box. World right-handed, the camera looks along -z; row 0 of the picture is on top,
// fragment row 0 at the bottom.

const float PARALLEL = 1e-12;  // as in kpc.player.cpu.reference

// lens: fl_x, fl_y, cx, cy in pixels. axes: the camera's right, up and backward in the world.
vec3 camera_direction(vec2 fragment, float height, vec4 lens, mat3 axes) {
    vec2 pixel = vec2(fragment.x, height - fragment.y);
    return normalize(axes * vec3((pixel.x - lens.z) / lens.x, (lens.w - pixel.y) / lens.y, -1.0));
}

float slanted(float x) {
    return abs(x) >= PARALLEL ? x : x < 0.0 ? -PARALLEL : PARALLEL;
}

// A direction none of whose components is 0.
vec3 slanted(vec3 d) {
    return vec3(slanted(d.x), slanted(d.y), slanted(d.z));
}

// Where o + t d is inside the box: (near, far), near >= 0; far <= near where it misses.
vec2 box_range(vec3 o, vec3 d, vec3 low, vec3 high) {
    vec3 inverse = 1.0 / slanted(d);
    vec3 t0 = (low - o) * inverse;
    vec3 t1 = (high - o) * inverse;
    vec3 enter = min(t0, t1);
    vec3 leave = max(t0, t1);
    return vec2(max(max(enter.x, max(enter.y, enter.z)), 0.0), min(leave.x, min(leave.y, leave.z)));
}
