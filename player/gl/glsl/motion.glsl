// Displacement of positions in the planes; normative text and readable twin: kpc.format.scene.motion.displace.
//
// `motion` holds the displacements at one time, `nodes` of them along x, y and z, corner-aligned.

vec3 displaced(sampler3D motion, vec3 nodes, vec3 u) {
    return clamp(u + textureLod(motion, (u * (nodes - 1.0) + 0.5) / nodes, 0.0).xyz, 0.0, 1.0);
}
