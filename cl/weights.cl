// Stage weights: the weights of the samples of rays in their colours.
//
//   w_i = T_i (1 - exp(-sigma_i delta_i)),  T_i = prod_{j < i} exp(-sigma_j delta_j)   (Mildenhall et al. 2020, eq. 5)
//   v_sigma_i = delta_i (T_{i+1} v_w_i - sum_{j > i} w_j v_w_j)
// See docs/stages/weights.md; clsplat/reference/weights.py is the twin.
//
// Mapping: one work-item per ray. The backward kernel adds the first term from the first sample on, the sum from the last.
//
// Buffers, R rays of N samples: in sigmas[R N] 1/length, deltas[R N] length; out weights[R N]. Backward: in
//   v_weights[R N]; in and out v_sigmas[R N], to which the gradient is added.
#include "common.h"

__kernel void weights_fwd(const uint rays, const uint count, const __global real *sigmas, const __global real *deltas,
                          __global real *weights) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    real depth = 0;
    for (size_t i = r * count; i < (r + 1) * count; ++i) {
        const real own = sigmas[i] * deltas[i];
        weights[i] = exp(-depth) * -expm1(-own);
        depth += own;
    }
}

__kernel void weights_bwd(const uint rays, const uint count, const __global real *sigmas, const __global real *deltas,
                          const __global real *weights, const __global real *v_weights, __global real *v_sigmas) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    real depth = 0, behind = 0;
    for (size_t i = r * count; i < (r + 1) * count; ++i) {
        depth += sigmas[i] * deltas[i];
        v_sigmas[i] += deltas[i] * exp(-depth) * v_weights[i];
    }
    for (size_t i = (r + 1) * count; i-- > r * count;) {
        v_sigmas[i] -= deltas[i] * behind;
        behind += weights[i] * v_weights[i];
    }
}
