// Stage adam: one step of Adam on an array of parameters, in place.
//
//   m <- beta1 m + (1 - beta1) g,  v <- beta2 v + (1 - beta2) g^2
//   p <- p - rate (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + eps)         (Kingma and Ba 2015, algorithm 1)
// The host passes rate / (1 - beta1^t), 1 / (1 - beta2^t), keep = (beta1, beta2) and take = 1 - keep: differences from 1
// belong in double precision.
//
// Mapping: one work-item per run of `width` values, the runs `stride` values apart; values between the end of a run and
// the next one are left alone. The first `split` values of a run have a rate of their own. So a row of spherical
// harmonics is a run that ends with the trained bands and starts with degree 0; any other array is cut into runs of
// equal length, long on a CPU (its inner loops are vectors) and of one value on a GPU (neighbours touch neighbours).
//
// Buffers, `total` values each: in gradients; in and out parameters, first (m), second (v).
#include "common.h"

static inline void adam_values(size_t begin, size_t end, real rate, real inv_correction2, real2 keep, real2 take,
                               real eps, const __global real *gradients, __global real *parameters,
                               __global real *first, __global real *second) {
    for (size_t i = begin; i < end; ++i) {
        const real g = gradients[i];
        const real m = keep.x * first[i] + take.x * g;
        const real v = keep.y * second[i] + take.y * (g * g);
        first[i] = m;
        second[i] = v;
        parameters[i] -= rate * (m / (sqrt(v * inv_correction2) + eps));
    }
}

__kernel void adam_step(const uint total, const uint stride, const uint width, const uint split,
                        const real split_rate, const real rate, const real inv_correction2, const real2 keep,
                        const real2 take, const real eps, const __global real *gradients,
                        __global real *restrict parameters, __global real *restrict first,
                        __global real *restrict second) {
    const size_t begin = get_global_id(0) * stride;
    if (begin >= total)
        return;
    const size_t middle = min(begin + split, (size_t)total), end = min(begin + width, (size_t)total);
    adam_values(begin, middle, split_rate, inv_correction2, keep, take, eps, gradients, parameters, first, second);
    adam_values(middle, end, rate, inv_correction2, keep, take, eps, gradients, parameters, first, second);
}
