// Stage rays: colours of rays through a field of densities and colours, composited at samples, and their gradients.
//
//   C = sum_i T_i (1 - exp(-sigma_i delta_i)) c_i + T_end background,  T_i = prod_{j < i} exp(-sigma_j delta_j)
//                                                         (Max 1995, "Optical models"; Mildenhall et al. 2020, eq. 3)
//   B_i, the colour behind sample i:  B_last = background,  B_{i-1} = alpha_i c_i + (1 - alpha_i) B_i
//   v_c_i = T_i alpha_i v_C,  v_sigma_i = delta_i T_{i+1} v_C . (c_i - B_i)
// A ray ends before the first sample with T_i <= TRANSMITTANCE_MIN. Samples behind its end have no gradient.
// See docs/stages/rays.md; clsplat/reference/rays.py is the twin.
//
// Mapping: one work-item per ray. The backward kernel goes from the last sample to the first, and subtracts nothing
// from sums over the ray.
//
// Buffers, R rays, S samples: in background[R,3], or [1,3] of all rays without `separate`; sigmas[S] 1/length,
//   colors[S,3], deltas[S] length, first[R+1] u32: ray r has the samples first[r] to first[r + 1], front to back; out
//   rgb[R,3], transmittances[S] (T_i, 0 behind the end), behind[R] (T_end). Backward: in v_rgb[R,3]; out v_sigmas[S],
//   v_colors[S,3].
#include "common.h"

__kernel void rays_fwd(const uint rays, const uint separate, const __global real *background,
                       const __global real *sigmas, const __global real *colors, const __global real *deltas,
                       const __global uint *first, __global real *rgb, __global real *transmittances,
                       __global real *behind) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    real3 color = 0;
    real transmittance = 1;
    uint i = first[r];
    const uint end = first[r + 1];
    for (; i < end && transmittance > (real)TRANSMITTANCE_MIN; ++i) {
        transmittances[i] = transmittance;
        const real depth = sigmas[i] * deltas[i];
        color += transmittance * -expm1(-depth) * load3(colors, i);
        transmittance *= exp(-depth);
    }
    for (; i < end; ++i)
        transmittances[i] = 0;
    store3(rgb, r, color + transmittance * load3(background, separate ? r : 0));
    behind[r] = transmittance;
}

__kernel void rays_bwd(const uint rays, const uint separate, const __global real *background,
                       const __global real *sigmas, const __global real *colors, const __global real *deltas,
                       const __global uint *first, const __global real *transmittances, const __global real *v_rgb,
                       __global real *v_sigmas, __global real *v_colors) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    const real3 v = load3(v_rgb, r);
    real3 seen = load3(background, separate ? r : 0); // behind sample i
    for (uint i = first[r + 1]; i-- > first[r];) {
        const real depth = sigmas[i] * deltas[i], transmittance = transmittances[i];
        const real3 color = load3(colors, i);
        const real alpha = -expm1(-depth), onward = exp(-depth);
        store3(v_colors, i, transmittance * alpha * v);
        v_sigmas[i] = deltas[i] * transmittance * onward * dot(v, color - seen);
        if (transmittance > 0)
            seen = alpha * color + onward * seen;
    }
}
