// The mean of several rays across each pixel.

uniform sampler2D rgba_rays;
uniform sampler2D sums_rays;
uniform int rays_across;

layout(location = 0) out vec4 rgba;
layout(location = 1) out vec4 sums;

void main() {
    ivec2 first = rays_across * ivec2(gl_FragCoord.xy);
    rgba = sums = vec4(0.0);
    for (int i = 0; i < rays_across * rays_across; ++i) {
        ivec2 at = first + ivec2(i % rays_across, i / rays_across);
        rgba += texelFetch(rgba_rays, at, 0);
        sums += texelFetch(sums_rays, at, 0);
    }
    rgba /= float(rays_across * rays_across);
    sums /= float(rays_across * rays_across);
}
