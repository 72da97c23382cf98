// Stage filter: Mip-Splatting's 3D smoothing filter. It widens Gaussians to the resolution of the training cameras.
//
//   Sigma' = Sigma + f^2 I,  opacity' = opacity sqrt(det Sigma / det Sigma'),  f^2 = FILTER_VARIANCE h^2
// h is the smallest size of a pixel at the Gaussian, in world units, over all cameras that see it. The maximum of
// focal/depth is the highest rate at which the photos sample it (Yu et al. 2024, equations 6 to 9). Since f^2 I
// commutes with the rotation, only scales and opacity change:
//   scale'^2 = scale^2 + f^2,  opacity' = opacity prod scale/scale'.
// See docs/stages/filter.md; clsplat/reference/filter.py is the twin.
//
// Mapping: one work-item per Gaussian.
//
// Buffers, N Gaussians: means[N,3] world, log_scales[N,3] ln(world), logit_opacities[N]
//   pixel_sizes     in and out pixels[N] world, the smallest so far; one camera per launch
//   filter_fwd      in pixels[N]; out filtered_log_scales[N,3], filtered_logit_opacities[N]
//   filter_bwd      in pixels[N]; in and out v_log_scales[N,3], v_logit_opacities[N]: first the gradients with respect
//                   to the outputs of filter_fwd, then those with respect to its inputs
// -DFILTER_VARIANCE  variance of the filter, in squared sizes of a pixel
// -DLENS=PINHOLE|ORTHOGRAPHIC|FISHEYE|EQUIRECTANGULAR  camera model (lens.h)
#include "common.h"
#include "lens.h"

#ifndef FILTER_VARIANCE
#error "-DFILTER_VARIANCE must give the variance of the filter, in squared sizes of a pixel"
#endif

DEFINE_POWER(4)

__kernel void pixel_sizes(const uint n, const Camera camera, const __global real *means, __global real *pixels) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const real3 mean = load3(means, i);
    const reals3 p = camera_point(&camera, vector3(mean.x, mean.y, mean.z));
    if (!lens_sees(&camera, p))
        return;
    const reals2 centre = lens_centre(&camera, p);
    const real margin_x = (real)(0.5 * FRUSTUM_MARGIN) * camera.width,
               margin_y = (real)(0.5 * FRUSTUM_MARGIN) * camera.height;
    if (centre.x >= -margin_x && centre.x <= camera.width + margin_x && centre.y >= -margin_y &&
        centre.y <= camera.height + margin_y)
        pixels[i] = LESSER(pixels[i], lens_reach(&camera, p) / GREATER(camera.fx, camera.fy));
}

// 2^t, clamped to finite positive values; NaN stays NaN.
static inline real4 bounded_power(real4 t) {
    return t == t ? power4(CLAMP(t, (real4)POWER_MIN, (real4)(POWER_MAX - 1))) : t;
}

// A filtered Gaussian. Logarithms to base two prevent overflow: scale'^2 = scale^2 (1 + 2^excess).
typedef struct {
    real3 log_scales, kept; // ln(scale'), scale^2/scale'^2
    real log2_factor, loss; // log2 of the factor on the opacity, and 1 minus the factor
    real odds;              // 1/opacity - 1 of the unfiltered opacity
} Filtered;

static inline Filtered filtered(real3 log_scales, real logit, real pixel) {
    Filtered f;
    const real3 log2_scales = (real)LOG2_E * log_scales, log2_filter = logarithm(pixel * sqrt((real)FILTER_VARIANCE));
    const real3 excess = 2 * (log2_filter - log2_scales), zero = 0, most = POWER_MAX;
    const real4 e = bounded_power((real4)(-ABSOLUTE(excess), -(real)LOG2_E * logit));
    const real3 rest = (real)0.5 * (real3)(logarithm(1 + e.x), logarithm(1 + e.y), logarithm(1 + e.z));
    f.log_scales = (GREATER(log2_scales, log2_filter) + (excess == excess ? rest : excess)) / (real)LOG2_E;
    f.kept = (excess > 0 ? e.xyz : (real3)1) / (1 + e.xyz);
    const real3 shrinkage = (real)0.5 * CLAMP(excess, zero, most) + rest;
    f.log2_factor = -(shrinkage.x + shrinkage.y + shrinkage.z);
    f.loss = 1 - bounded_power((real4)f.log2_factor).x;
    f.odds = e.w;
    return f;
}

__kernel void filter_fwd(const uint n, const __global real *pixels, const __global real *log_scales,
                         const __global real *logit_opacities, __global real *filtered_log_scales,
                         __global real *filtered_logit_opacities) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const real3 before = load3(log_scales, i);
    const real logit = logit_opacities[i];
    const bool filters = pixels[i] > 0;
    const Filtered f = filtered(before, logit, filters ? pixels[i] : 1);
    store3(filtered_log_scales, i, filters ? f.log_scales : before);
    // opacity' = factor/(1 + odds), so that 1/opacity' - 1 = (odds + loss)/factor
    const bool finite = FINITE(logit);
    filtered_logit_opacities[i] =
        filters && finite ? (f.log2_factor - logarithm(f.odds + f.loss)) / (real)LOG2_E : logit;
}

__kernel void filter_bwd(const uint n, const __global real *pixels, const __global real *log_scales,
                         const __global real *logit_opacities, __global real *v_log_scales,
                         __global real *v_logit_opacities) {
    const size_t i = get_global_id(0);
    if (i >= n || !(pixels[i] > 0))
        return;
    const Filtered f = filtered(load3(log_scales, i), logit_opacities[i], pixels[i]);
    // d logit'/d ln(factor) = 1/(1 - opacity'), d ln(factor)/d log_scale = 1 - kept
    const real v_logit = v_logit_opacities[i], inv_rest = v_logit / (f.odds + f.loss);
    const real3 v = load3(v_log_scales, i) * f.kept + (f.odds + 1) * inv_rest * (1 - f.kept);
    store3(v_log_scales, i, v_logit == 0 ? load3(v_log_scales, i) * f.kept : v);
    v_logit_opacities[i] = f.odds * inv_rest;
}
