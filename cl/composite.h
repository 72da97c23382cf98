// Alpha of one splat at one pixel and its vector-Jacobian product: the mathematics that both variants of the
// compositing stage share. REALV is real or a vector of reals (a row of pixels); MASKV what comparing two
// gives.
//
//   sigma = (a dx^2 + c dy^2)/2 + b dx dy,   alpha = min(ALPHA_MAX, opacity exp(-sigma))    (paper, equation
//   4) C = sum_i c_i alpha_i T_i,   T_i = prod_{j<i} (1 - alpha_j)                              (paper,
//   equation 3)
#ifndef CLSPLAT_COMPOSITE_H
#define CLSPLAT_COMPOSITE_H

#if !defined(REALV) || !defined(MASKV)
#error "define REALV and MASKV, the types of a group of pixels, before including composite.h"
#endif

#ifndef CHANNELS
#error "-DCHANNELS must give the number of colour channels, 1 or more"
#endif

typedef struct {
    real x, y;    // centre, px
    real a, b, c; // conic, px^-2
    real opacity;
    real color[CHANNELS];
} Splat;

inline Splat splat_load(uint g, const __global real *means2d, const __global real *conics,
                        const __global real *opacities, const __global real *colors) {
    Splat s;
    s.x = means2d[2 * g];
    s.y = means2d[2 * g + 1];
    s.a = conics[3 * g];
    s.b = conics[3 * g + 1];
    s.c = conics[3 * g + 2];
    s.opacity = opacities[g];
    for (int k = 0; k < CHANNELS; ++k)
        s.color[k] = colors[CHANNELS * g + k];
    return s;
}

// opacity exp(-sigma), not clamped; -1 where sigma < 0, which only rounding of a needle's conic brings about.
inline REALV splat_alpha(const Splat *s, REALV dx, real dy) {
    const REALV sigma = dx * ((real)0.5 * s->a * dx + s->b * dy) + (real)0.5 * s->c * dy * dy;
    const REALV alpha = s->opacity * exp(-sigma);
    return sigma >= 0 ? alpha : (REALV)-1;
}

// Gradient of sigma from that of the clamped alpha; alpha is splat_alpha's value. The clamp passes nothing.
inline REALV splat_alpha_vjp(REALV alpha, REALV v_alpha) {
    return alpha < (REALV)ALPHA_MAX ? -alpha * v_alpha : (REALV)0;
}

// Sums over pixels of v_sigma, v_sigma dx, ... from which every gradient of a splat follows.
typedef struct {
    real m0, mx, my, mxx, mxy, myy;
} Moments;

// A record: v_means2d[2], v_conics[3], v_opacities[1], v_colors[CHANNELS] of one splat from one tile.
#define RECORD (6 + CHANNELS)

inline void splat_record(const Splat *s, Moments m, const real *v_color, __global real *record) {
    record[0] = -(s->a * m.mx + s->b * m.my);
    record[1] = -(s->b * m.mx + s->c * m.my);
    record[2] = (real)0.5 * m.mxx;
    record[3] = m.mxy;
    record[4] = (real)0.5 * m.myy;
    record[5] = -m.m0 / s->opacity;
    for (int k = 0; k < CHANNELS; ++k)
        record[6 + k] = v_color[k];
}

inline void splat_record_zero(__global real *record) {
    for (int k = 0; k < RECORD; ++k)
        record[k] = 0;
}

#endif
