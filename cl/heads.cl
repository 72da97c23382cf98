// Stage heads: from networks to densities and colours, and back.
//
//   inputs of the network of colours: 16 spherical harmonics of the ray's direction, then the 16 features of a sample
//   sigma = exp(feature 0), whose exponent is limited to +-EXPONENT_MAX;  c = 1 / (1 + exp(-outputs 0 to 2))
//                                                                                  (Müller et al. 2022, section 5.4)
// Plenoxels (Fridovich-Keil et al. 2022, section 3.1) has 1 + 3B features f of a sample, with the first B functions of
// the basis Y, 1 or 9 for degree 0 or 2:
//   sigma = density_scale max(f_0, 0);  c_k = max(1/2 + sum_b Y_b(direction) f_{1+Bk+b}, 0)
// NeRF and Mip-NeRF 360 have, with softplus(x) = log(1 + exp(x)) (Barron et al. 2021, appendix):
//   sigma = density_scale softplus(feature 0 - DENSITY_SHIFT);  c as above
// See docs/stages/heads.md; clsplat/reference/heads.py is the twin.
//
// Mapping: one work-item per sample.
//
// Buffers, R rays, S samples: in features[S,16], directions[R,3] of length 1, rays_of[S] u32, outputs[S,16]; out
//   inputs[S,32], sigmas[S], colors[S,3]. Backward: in v_sigmas[S], v_colors[S,3], v_inputs[S,32]; out v_outputs[S,16],
//   v_features[S,16]. Of Plenoxels: in features[S,1+3B]; out v_features[S,1+3B].
//   With a softplus: in features[S,W], outputs[S,V]; in and out v_features[S,W], to which the gradient is added.
// -DEXPONENT_MAX    largest exponent of a density
// -DDENSITY_SHIFT   as above
#include "common.h"
#include "sh.h"

#ifndef EXPONENT_MAX
#error "-DEXPONENT_MAX, the largest exponent of a density, must be given"
#endif
#ifndef DENSITY_SHIFT
#error "-DDENSITY_SHIFT, which is subtracted before the softplus of a density, must be given"
#endif

__kernel void heads_join(const uint samples, const __global real *features, const __global real *directions,
                         const __global uint *rays_of, __global real *inputs) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    const real3 d = load3(directions, rays_of[s]);
    const reals3 direction = {d.x, d.y, d.z};
    reals basis[16];
    sh_basis(direction, 3, basis);
    for (int k = 0; k < 16; ++k) {
        inputs[32 * s + k] = basis[k];
        inputs[32 * s + 16 + k] = features[16 * s + k];
    }
}

__kernel void heads_fwd(const uint samples, const __global real *features, const __global real *outputs,
                        __global real *sigmas, __global real *colors) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    const real exponent = features[16 * s];
    sigmas[s] = exp(CLAMP(exponent, (real)-EXPONENT_MAX, (real)EXPONENT_MAX));
    for (int k = 0; k < 3; ++k)
        colors[3 * s + k] = 1 / (1 + exp(-outputs[16 * s + k]));
}

__kernel void heads_bwd(const uint samples, const __global real *colors, const __global real *v_colors,
                        __global real *v_outputs) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    for (int k = 0; k < 16; ++k) {
        const real c = k < 3 ? colors[3 * s + k] : 0;
        v_outputs[16 * s + k] = k < 3 ? v_colors[3 * s + k] * c * (1 - c) : 0;
    }
}

__kernel void heads_join_bwd(const uint samples, const __global real *v_inputs, const __global real *features,
                             const __global real *sigmas, const __global real *v_sigmas, __global real *v_features) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    for (int k = 0; k < 16; ++k)
        v_features[16 * s + k] = v_inputs[32 * s + 16 + k];
    if (ABSOLUTE(features[16 * s]) < EXPONENT_MAX)
        v_features[16 * s] += v_sigmas[s] * sigmas[s];
}

static inline void sh_at(const __global real *directions, uint ray, uint bands, reals *basis) {
    const real3 d = load3(directions, ray);
    const reals3 direction = {d.x, d.y, d.z};
    sh_basis(direction, bands == 1 ? 0 : 2, basis);
}

static inline real sh_color(const reals *basis, uint bands, const __global real *coefficients) {
    real color = (real)0.5;
    for (uint b = 0; b < bands; ++b)
        color += basis[b] * coefficients[b];
    return color;
}

__kernel void heads_sh_fwd(const uint samples, const uint bands, const real density_scale,
                           const __global real *features, const __global real *directions,
                           const __global uint *rays_of, __global real *sigmas, __global real *colors) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    reals basis[9];
    sh_at(directions, rays_of[s], bands, basis);
    const __global real *own = features + s * (1 + 3 * bands);
    sigmas[s] = density_scale * GREATER(own[0], (real)0);
    for (int k = 0; k < 3; ++k) {
        const real color = sh_color(basis, bands, own + 1 + bands * k);
        colors[3 * s + k] = GREATER(color, (real)0);
    }
}

__kernel void heads_sh_bwd(const uint samples, const uint bands, const real density_scale,
                           const __global real *features, const __global real *directions,
                           const __global uint *rays_of, const __global real *v_sigmas, const __global real *v_colors,
                           __global real *v_features) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    reals basis[9];
    sh_at(directions, rays_of[s], bands, basis);
    const __global real *own = features + s * (1 + 3 * bands);
    __global real *v_own = v_features + s * (1 + 3 * bands);
    v_own[0] = own[0] > 0 ? density_scale * v_sigmas[s] : 0;
    for (int k = 0; k < 3; ++k) {
        const real v = sh_color(basis, bands, own + 1 + bands * k) > 0 ? v_colors[3 * s + k] : 0;
        for (uint b = 0; b < bands; ++b)
            v_own[1 + bands * k + b] = v * basis[b];
    }
}

__kernel void heads_soft_fwd(const uint samples, const uint width, const uint outputs_width, const real density_scale,
                             const __global real *features, const __global real *outputs, __global real *sigmas,
                             __global real *colors) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    const real x = features[s * width] - DENSITY_SHIFT;
    sigmas[s] = density_scale * (GREATER(x, (real)0) + log1p(exp(-ABSOLUTE(x))));
    for (int k = 0; k < 3; ++k)
        colors[3 * s + k] = 1 / (1 + exp(-outputs[s * outputs_width + k]));
}

__kernel void heads_soft_bwd(const uint samples, const uint width, const real density_scale,
                             const __global real *features, const __global real *v_sigmas,
                             __global real *v_features) {
    const size_t s = get_global_id(0);
    if (s < samples)
        v_features[s * width] += v_sigmas[s] * density_scale / (1 + exp(DENSITY_SHIFT - features[s * width]));
}
