// What grids with nodes at all corners and faces of [0, 1]^3 hold in between.

// `count`: nodes along x, y, z. Twin: kpc.format.motion.moved, for displacements.
vec4 at_nodes(sampler3D grid, vec3 count, vec3 u) {
    return textureLod(grid, (u * (count - 1.0) + 0.5) / count, 0.0);
}
