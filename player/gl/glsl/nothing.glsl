// What rays see that meet nothing.

uniform vec3 background;

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    seen = vec4(background, 0.0);
    met = vec4(0.0);
}
