// Pictures that follow the one before, while the camera rests. For each picture one sample pixel of every block of
// BLOCK x BLOCK pixels is marched, all sixteen by turns; the other pixels of a block only if the sample pixel shows that
// the block has changed. The twin of kpc.player.cpu.reprojection.

const int BLOCK = 4;

// The sample pixel of a block in a picture of a size. Bits are mixed so that those of neighbouring turns, and of
// neighbouring blocks, lie far apart.
ivec2 sample_pixel(ivec2 block, int turn, ivec2 size) {
    int k = (turn + 3 * block.x + 5 * block.y) & 15;
    int x = 2 * ((k ^ (k >> 1)) & 1) + (((k >> 2) ^ (k >> 3)) & 1);
    int y = 2 * (k & 1) + ((k >> 2) & 1);
    return min(BLOCK * block + ivec2(x, y), size - 1);
}
