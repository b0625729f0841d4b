// Puts probes where they belong in their picture.

in vec4 probe_seen;
in vec4 probe_met;

layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 met;

void main() {
    seen = probe_seen;
    met = probe_met;
}
