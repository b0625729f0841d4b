// The explicit decoder: log density and colour are linear in the features; the view direction picks the colour's basis.

const float LOG_DENSITY_LIMIT = 20.0;  // as in kpc.format.scene

// alpha = 1 - exp(-sigma tau); `tau` is step / extent, times what the step counts in contracted space.
float alpha_of(float log_density, float tau) {
    return 1.0 - exp(-exp(clamp(log_density, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)) * tau);
}

vec3 sigmoid(vec3 x) {
    return 1.0 / (1.0 + exp(-x));
}
