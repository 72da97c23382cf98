// Powers of two and logarithms to base two. In single precision they replace exp2 and log2, which are calls on drivers
// that do not inline them (common.h), and take twice as long on drivers that do.
#ifndef CLSPLAT_POWER_H
#define CLSPLAT_POWER_H

#define LOG2_E 1.4426950408889634

// DEFINE_POWER(N) defines powerN on vectors of N, and without N power on reals: 2^t for POWER_MIN <= t <= POWER_MAX. The result at POWER_MAX is
// infinity; beyond these limits it is undefined. In single precision, 2^(t - round(t)) is the polynomial of degree 5
// with the smallest maximal relative error, 7.5e-8, and round(t) is added to the exponent. Adding 1.5 * 2^23 to t
// leaves round(t) in the last bits.
#ifdef USE_DOUBLE
#define POWER_MIN -1022
#define POWER_MAX 1024
#define DEFINE_POWER(N)                                                                                              \
    static inline real##N power##N(real##N t) {                                                                      \
        return OF##N(exp2, t);                                                                                       \
    }
#else
#define POWER_MIN -126
#define POWER_MAX 128
#define DEFINE_POWER(N)                                                                                              \
    static inline real##N power##N(real##N t) {                                                                      \
        const real##N shifted = t + (real##N)12582912;                                                               \
        const real##N f = t - (shifted - (real##N)12582912);                                                         \
        real##N p = (real##N)1.3276472e-3;                                                                           \
        p = p * f + (real##N)9.6755413e-3;                                                                           \
        p = p * f + (real##N)5.5507133e-2;                                                                           \
        p = p * f + (real##N)2.4022120e-1;                                                                           \
        p = p * f + (real##N)6.9314697e-1;                                                                           \
        p = p * f + 1;                                                                                               \
        return as_float##N(as_int##N(p) + (as_int##N(shifted) << 23));                                               \
    }
#endif

// DEFINE_LOGARITHM(N) defines logarithmN on vectors of N: log2(x) for normal x > 0; otherwise undefined. In single
// precision, x = 2^e m with m from sqrt(1/2) to sqrt(2), and ln m = 2 (s + s^3/3 + s^5/5 + ...) with s = (m - 1)/(m + 1).
// The first omitted term is below 2e-9. Adding e to the bits of 1.5 * 2^23 converts it to a real.
#ifdef USE_DOUBLE
#define DEFINE_LOGARITHM(N)                                                                                          \
    static inline real##N logarithm##N(real##N x) {                                                                  \
        return OF##N(log2, x);                                                                                       \
    }
#else
#define DEFINE_LOGARITHM(N)                                                                                          \
    static inline real##N logarithm##N(real##N x) {                                                                  \
        const int##N bits = as_int##N(x), e = (bits - 0x3f3504f3) >> 23; /* the bits of sqrt(1/2) */                 \
        const real##N m = as_float##N(bits - (e << 23)), s = (m - 1) / (m + 1), s2 = s * s;                          \
        real##N p = (real##N)(1.0 / 9);                                                                              \
        p = p * s2 + (real##N)(1.0 / 7);                                                                             \
        p = p * s2 + (real##N)(1.0 / 5);                                                                             \
        p = p * s2 + (real##N)(1.0 / 3);                                                                             \
        p = p * s2 + 1;                                                                                              \
        return (as_float##N(e + 0x4b400000) - (real##N)12582912) + (real##N)(2 * LOG2_E) * s * p;                    \
    }
#endif
DEFINE_LOGARITHM()

#endif
