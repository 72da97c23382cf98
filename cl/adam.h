// Adam on 16 parameters at once (Kingma and Ba 2015, algorithm 1):
//   m <- beta1 m + (1 - beta1) g,  v <- beta2 v + (1 - beta2) g^2
//   p <- p - rate (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + eps)
#ifndef CLSPLAT_ADAM_H
#define CLSPLAT_ADAM_H

#include "structs.h"

// Rates are already divided by 1 - beta1^t.
static inline real16 adam_update(const Adam *adam, real16 rates, real16 p, real16 g, real16 *m, real16 *v) {
    *m = adam->keep1 * *m + adam->take1 * g;
    *v = adam->keep2 * *v + adam->take2 * (g * g);
    const real16 mean = *v * adam->inv_correction2;
    return p - rates * (*m / (OF16(sqrt, mean) + adam->eps));
}

// Gradient by ln(scales) of max(-ln(erank - 1 + slack), 0), with erank = exp(entropy of s^2 / sum of s^2) (Hyung et
// al. 2024, "Effective rank analysis", equation 8): q_i = s_i^2 / sum has d q_i / d ln s_j = 2 q_i (delta_ij - q_j),
// hence d erank / d ln s_j = -2 erank q_j (ln q_j + entropy).
static inline real3 erank_vjp(real3 log_scales, real slack) {
    const real largest = GREATER(GREATER(log_scales.x, log_scales.y), log_scales.z);
    const real3 d = 2 * (log_scales - largest);
    real3 q = (real3)(exp(d.x), exp(d.y), exp(d.z));
    const real sum = q.x + q.y + q.z;
    q /= sum;
    const real3 log_q = d - log(sum);
    const real entropy = -(q.x * log_q.x + q.y * log_q.y + q.z * log_q.z);
    const real excess = expm1(entropy) + slack;
    // NaN fails this test, too.
    return excess < 1 ? 2 * exp(entropy) / excess * q * (log_q + entropy) : (real3)0;
}

// The same for `count` < 16 adjacent parameters. Nothing beyond them is read or written.
static inline void adam_update_some(const Adam *adam, real16 rates, int count, real16 g, __global real *parameters,
                                    __global real *first, __global real *second) {
    real16 p = 0, m = 0, v = 0;
    for (int i = 0; i < count; ++i) {
        ((real *)&p)[i] = parameters[i];
        ((real *)&m)[i] = first[i];
        ((real *)&v)[i] = second[i];
    }
    p = adam_update(adam, rates, p, g, &m, &v);
    for (int i = 0; i < count; ++i) {
        parameters[i] = ((const real *)&p)[i];
        first[i] = ((const real *)&m)[i];
        second[i] = ((const real *)&v)[i];
    }
}

#endif
