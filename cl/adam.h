// Adam (Kingma and Ba 2015, algorithm 1):
//   m <- beta1 m + (1 - beta1) g,  v <- beta2 v + (1 - beta2) g^2
//   p <- p - rate (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + eps)
#ifndef CLSPLAT_ADAM_H
#define CLSPLAT_ADAM_H

#include "structs.h"

// DEFINE_ADAM(N) defines adam_updateN on vectors of N, and without N adam_update on reals. Rates are already divided by
// 1 - beta1^t.
#define DEFINE_ADAM(N)                                                                                               \
    static inline real##N adam_update##N(const Adam *adam, real##N rates, real##N p, real##N g, real##N *m,          \
                                         real##N *v) {                                                               \
        *m = adam->keep1 * *m + adam->take1 * g;                                                                     \
        *v = adam->keep2 * *v + adam->take2 * (g * g);                                                               \
        const real##N mean = *v * adam->inv_correction2;                                                             \
        return p - rates * (*m / (ROOT##N(mean) + adam->eps));                                                       \
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

#endif
