// Adam on 16 parameters at once (Kingma and Ba 2015, algorithm 1):
//   m <- beta1 m + (1 - beta1) g,  v <- beta2 v + (1 - beta2) g^2
//   p <- p - rate (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + eps)
#ifndef CLSPLAT_ADAM_H
#define CLSPLAT_ADAM_H

#include "structs.h"

// rates are divided by 1 - beta1^t already.
static inline real16 adam_update(const Adam *adam, real16 rates, real16 p, real16 g, real16 *m, real16 *v) {
    *m = adam->keep1 * *m + adam->take1 * g;
    *v = adam->keep2 * *v + adam->take2 * (g * g);
    const real16 mean = *v * adam->inv_correction2;
    return p - rates * (*m / (OF16(sqrt, mean) + adam->eps));
}

// The same for `count` < 16 parameters that lie side by side; beyond them nothing is read or written.
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
