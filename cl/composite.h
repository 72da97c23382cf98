// One splat over a group of pixels and the gradients of that: the mathematics that both variants of the
// compositing stage share. REALV is real (one pixel) or a vector of reals (a row of pixels); MASKV what
// comparing two gives.
//
//   sigma = (a dx^2 + c dy^2)/2 + b dx dy,   alpha = min(ALPHA_MAX, opacity exp(-sigma))    (paper, equation 4)
//   C = sum_i c_i alpha_i T_i,   T_i = prod_{j<i} (1 - alpha_j)                             (paper, equation 3)
#ifndef CLSPLAT_COMPOSITE_H
#define CLSPLAT_COMPOSITE_H

#if !defined(REALV) || !defined(MASKV)
#error "define REALV and MASKV, the types of a group of pixels, before including composite.h"
#endif

#if !defined(CHANNELS) || CHANNELS < 1
#error "-DCHANNELS must give the number of colour channels, 1 or more"
#endif

typedef struct {
    real x, y;    // centre, px
    real a, b, c; // conic, px^-2
    real opacity;
    real color[CHANNELS];
} Splat;

static inline Splat splat_load(uint g, const __global real *means2d, const __global real *conics,
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
static inline REALV splat_alpha(const Splat *s, REALV dx, real dy) {
    const REALV sigma = dx * ((real)0.5 * s->a * dx + s->b * dy) + (real)0.5 * s->c * dy * dy;
    const REALV alpha = s->opacity * exp(-sigma);
    return sigma >= 0 ? alpha : (REALV)-1;
}

// Gradient of sigma from that of the clamped alpha; alpha is splat_alpha's value. The clamp passes nothing.
static inline REALV splat_alpha_vjp(REALV alpha, REALV v_alpha) {
    return alpha < (REALV)ALPHA_MAX ? -alpha * v_alpha : (REALV)0;
}

// Composites one splat over a group of pixels. Pixels of *live where T would fall too low leave it; *alpha is 0
// where the splat is not drawn and not clamped elsewhere; returns the weight alpha T. *transmittance goes from
// before to behind the splat. True is -1 in a vector's mask and 1 in a scalar's: only what is right for both
// stands here, and *live must be such a mask.
static inline REALV splat_over(const Splat *s, REALV dx, real dy, REALV *transmittance, MASKV *live, REALV *alpha) {
    const REALV raw = splat_alpha(s, dx, dy);
    const REALV clamped = raw < (REALV)ALPHA_MAX ? raw : (REALV)ALPHA_MAX;
    const REALV before = *transmittance, behind = before * (1 - clamped);
    const MASKV reached = *live & (raw >= (REALV)ALPHA_MIN);
    const MASKV drawn = reached & (behind > (REALV)TRANSMITTANCE_MIN);
    *live &= ~reached | drawn;
    *transmittance = drawn ? behind : before;
    *alpha = drawn ? raw : (REALV)0;
    return drawn ? clamped * before : (REALV)0;
}

// Gradient of sigma; alpha and weight as splat_over gave them, T as it was before the splat, u = colour . v_image.
// *behind goes from the sum of u alpha T over this splat and all behind it, the background included, to that
// without it.
static inline REALV splat_over_vjp(REALV alpha, REALV weight, REALV before, REALV u, REALV *behind) {
    *behind -= weight * u;
    // ALPHA_MAX < 1 bounds the quotient; where alpha is clamped its gradient is dropped anyway.
    const REALV clamped = alpha < (REALV)ALPHA_MAX ? alpha : (REALV)ALPHA_MAX;
    return splat_alpha_vjp(alpha, before * u - *behind / (1 - clamped));
}

// Sums over pixels of v_sigma, v_sigma dx, ... from which every gradient of a splat follows.
typedef struct {
    real m0, mx, my, mxx, mxy, myy;
} Moments;

// A record: v_means2d[2], v_conics[3], v_opacities[1], v_colors[CHANNELS] of one splat from one tile.
#define RECORD (6 + CHANNELS)

static inline void splat_record(const Splat *s, Moments m, const real *v_color, __global real *record) {
    record[0] = -(s->a * m.mx + s->b * m.my);
    record[1] = -(s->b * m.mx + s->c * m.my);
    record[2] = (real)0.5 * m.mxx;
    record[3] = m.mxy;
    record[4] = (real)0.5 * m.myy;
    record[5] = -m.m0 / s->opacity;
    for (int k = 0; k < CHANNELS; ++k)
        record[6 + k] = v_color[k];
}

static inline void splat_record_zero(__global real *record) {
    for (int k = 0; k < RECORD; ++k)
        record[k] = 0;
}

#endif
