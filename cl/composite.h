// Compositing one splat over a group of pixels, and its gradients: the mathematics that all variants of the stage
// composite share. REALV is real (one pixel) or a vector of reals (a block of pixels). MASKV is the result of
// comparing two of them, and MINUS_ABSOLUTE(x) is -|x|.
//
//   sigma = (a dx^2 + c dy^2)/2 + b dx dy,   alpha = min(ALPHA_MAX, opacity exp(-sigma))    (paper, equation 4)
//   C = sum_i c_i alpha_i T_i,   T_i = prod_{j<i} (1 - alpha_j)                             (paper, equation 3)
//
// With -DRAYS, sigma is that along the pixel's ray (composite_rays.h).
//
// Splats are packed for exponents of two: alpha = 2^t, t = log2(opacity) - sigma log2(e). A splat is visible where
// alpha >= ALPHA_MIN and sigma >= 0, which along rays rounding can violate. Both are tests of t.
#ifndef CLSPLAT_COMPOSITE_H
#define CLSPLAT_COMPOSITE_H

#if !defined(REALV) || !defined(MASKV) || !defined(MINUS_ABSOLUTE)
#error "define REALV and MASKV, the types of a group of pixels, and MINUS_ABSOLUTE before including composite.h"
#endif

#if !defined(CHANNELS) || CHANNELS < 1
#error "-DCHANNELS must give the number of colour channels, 1 or more"
#endif
#if !defined(RAYS) || RAYS < 0 || RAYS > 2
#error "-DRAYS must be 0, 1 or 2"
#endif

#if RAYS
#include "composite_rays.h"
#else

// A splat: t = level - u^2 - v^2, with u = u_x dx + u_y dy and v = v_y dy. The triangle of u_x, u_y and v_y is the
// Cholesky factor of the conic times log2(e)/2. So t takes two multiply-adds, no rounding makes it larger than `level`,
// and the large terms of a needle's conic do not cancel in each pixel. Padded to whole quarters of a cache line of 64
// bytes.
#define SPLAT_REALS ((8 + CHANNELS + 3) / 4 * 4)
typedef struct {
    real x, y;                  // centre, px
    real u_x, u_y, v_y;         // px^-1
    real level;                 // log2(opacity)
    real half_height, at_right; // extent along y, and y of the rightmost point from the centre, px
    real color[SPLAT_REALS - 8];
} Splat;

// Position of a pixel relative to the splat's centre, in the splat's own coordinates.
typedef struct {
    REALV u, v;
} Offset;

// The pixel at (dx, dy) from the centre, px.
static inline Offset offset_at(const Splat *s, REALV dx, REALV dy) {
    const Offset o = {s->u_x * dx + s->u_y * dy, s->v_y * dy};
    return o;
}

// Nothing, but what composite_rays.h needs for gradients. A struct has a member.
typedef struct {
    char unused;
} Bend;

// t of the splat at an offset from its centre.
static inline REALV splat_exponent(const Splat *s, const Offset *o, Bend *bend) {
    return s->level - o->u * o->u - o->v * o->v;
}

static inline MASKV splat_seen(const Splat *s, REALV t) {
    return t >= (REALV)LOG2_ALPHA_MIN;
}

// Sums over pixels of v_sigma, v_sigma u, ..., from which all gradients of a splat follow (composite_splats.h).
typedef struct {
    REALV m, mu, mv, muu, muv, mvv;
} Moments;

#define NO_MOMENTS                                                                                                   \
    { 0, 0, 0, 0, 0, 0 }

static inline void add_moments(const Offset *o, const Bend *bend, REALV v_sigma, Moments *m) {
    const REALV by_u = o->u * v_sigma, by_v = o->v * v_sigma;
    m->m += v_sigma;
    m->mu += by_u;
    m->mv += by_v;
    m->muu += o->u * by_u;
    m->muv += o->u * by_v;
    m->mvv += o->v * by_v;
}

// A record holds the sums of one splat and one tile: the moments, then those of weight v_image.
#define MOMENTS 6
#define RECORD  (MOMENTS + CHANNELS)
#define MOMENTS_OF(sums)                                                                                             \
    { (sums).m, (sums).mu, (sums).mv, (sums).muu, (sums).muv, (sums).mvv }
#endif

// The alpha of a splat from 2^t: clamped, and 0 where the splat is not visible.
static inline REALV splat_alpha(MASKV seen, REALV power) {
    const REALV clamped = LESSER(power, (REALV)ALPHA_MAX);
    return seen ? clamped : (REALV)0;
}

// Composites a splat over a group of pixels. A pixel whose transmittance would fall to `stop` or below is finished: its
// transmittance stays the same, and is stored negated from then on. (Other pixels have a transmittance above `stop`.)
// Returns the weight alpha T, which is 0 where the splat is not drawn. *live: the pixels that are not finished.
static inline REALV splat_over(REALV alpha, real stop, MASKV *live, REALV *transmittance) {
    const REALV before = *transmittance, weight = alpha * before, behind = before - weight;
    *live = behind > (REALV)stop;
    *transmittance = *live ? behind : MINUS_ABSOLUTE(before);
    return *live ? weight : (REALV)0;
}

// Gradient of sigma. alpha, live and weight are those of splat_over, and u = colour . v_image. On entry, *behind is
// the sum of u alpha T over this splat and all behind it, background included; on return it is the sum without this
// splat:
//   v_sigma = -alpha v_alpha = behind alpha/(1 - alpha) - u alpha T.
static inline REALV splat_over_vjp(REALV alpha, MASKV live, REALV weight, REALV u, REALV *behind) {
    const REALV part = weight * u;
    *behind -= part;
    // Clamped alpha has no gradient. ALPHA_MAX < 1 bounds the quotient.
    return (live & (alpha < (REALV)ALPHA_MAX)) ? *behind * (alpha / (1 - alpha)) - part : (REALV)0;
}

#endif
