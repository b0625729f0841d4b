// Which pixels are probes: one of each block, all of them by turns, those that come next to each other far apart. Neighbouring
// blocks are out of step, so that no pattern stands out, and an edge does not slip through between them.

const float BLOCK = 4.0;  // pixels a side

// The probe of a block of a picture of `size` pixels.
vec2 probe_of(vec2 block, int turn, vec2 size) {
    int k = (turn + 3 * int(block.x) + 5 * int(block.y)) & 15;
    ivec2 half_block = ivec2(k ^ (k >> 1), k) & 1, rest = ivec2((k >> 2) ^ (k >> 3), k >> 2) & 1;
    return min(BLOCK * block + vec2(2 * half_block + rest), size - 1.0);
}
