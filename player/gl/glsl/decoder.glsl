// What the decoders share. In the explicit one, log density and colour are linear in the features, and the view
// direction picks the colour's basis; the hybrid one is a small MLP for each.

const float LOG_DENSITY_LIMIT = 20.0;  // as in kpc.format.scene.scene, as the next
const float ACTIVATION_LIMIT = 65504.0;

// alpha = 1 - exp(-sigma tau); `tau` is step / extent, times what the step counts in contracted space.
float alpha_of(float log_density, float tau) {
    float x = exp(clamp(log_density, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)) * tau;
    // The difference from 1 of the exponential of a small number is little more than its rounding.
    return x < 0.01 ? x * (1.0 - x * (0.5 - x / 6.0)) : 1.0 - exp(-x);
}

vec3 sigmoid(vec3 x) {
    return 1.0 / (1.0 + exp(-x));
}

// What a hidden layer of the hybrid decoder makes of its sums.
vec4 activated(vec4 x) {
    return clamp(x, 0.0, ACTIVATION_LIMIT);
}
