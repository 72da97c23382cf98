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
// sigma >= 0, which only the rounding of a needle's conic violates, and alpha >= ALPHA_MIN. Both are tests of t.
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

// A splat: t = level + a dx^2 + b dx dy + c dy^2. Padded to whole quarters of a cache line of 64 bytes.
#define SPLAT_REALS ((8 + CHANNELS + 3) / 4 * 4)
typedef struct {
    real x, y;                  // centre, px
    real a, b, c;               // px^-2
    real level;                 // log2(opacity)
    real half_height, at_right; // extent along y, and y of the rightmost point from the centre, px
    real color[SPLAT_REALS - 8];
} Splat;

// Position of a pixel relative to the splat's centre, px.
typedef struct {
    REALV dx, dy;
} Offset;

// Nothing, but what composite_rays.h needs for gradients. A struct has a member.
typedef struct {
    char unused;
} Bend;

// t of the splat at an offset from its centre.
static inline REALV splat_exponent(const Splat *s, const Offset *o, Bend *bend) {
    return o->dx * (s->a * o->dx + s->b * o->dy) + (s->c * o->dy * o->dy + s->level);
}

// Sums over pixels of v_sigma, v_sigma dx, ..., from which all gradients of a splat follow (composite_splats.h).
typedef struct {
    REALV m, mx, my, mxx, mxy, myy;
} Moments;

#define NO_MOMENTS                                                                                                   \
    { 0, 0, 0, 0, 0, 0 }

static inline void add_moments(const Offset *o, const Bend *bend, REALV v_sigma, Moments *m) {
    const REALV x_sigma = o->dx * v_sigma, y_sigma = o->dy * v_sigma;
    m->m += v_sigma;
    m->mx += x_sigma;
    m->my += y_sigma;
    m->mxx += o->dx * x_sigma;
    m->mxy += o->dx * y_sigma;
    m->myy += o->dy * y_sigma;
}

// A record holds the sums of one splat and one tile: the moments, then those of weight v_image.
#define MOMENTS 6
#define RECORD  (MOMENTS + CHANNELS)
#define MOMENTS_OF(sums)                                                                                             \
    { (sums).m, (sums).mx, (sums).my, (sums).mxx, (sums).mxy, (sums).myy }
#endif

static inline MASKV splat_seen(const Splat *s, REALV t) {
    return (t <= (REALV)(s->level + (real)EXPONENT_SLACK)) & (t >= (REALV)LOG2_ALPHA_MIN);
}

// Composites a splat over a group of pixels. alpha is clamped, and set to 0 where the splat is not visible. A pixel
// whose transmittance would fall to `stop` or below is finished: its transmittance stays the same, and is stored
// negated from then on. (Other pixels have a transmittance above `stop`.) Returns the weight alpha T, which is 0
// where the splat is not drawn. *live: the pixels that are not finished.
static inline REALV splat_over(MASKV seen, real stop, REALV *alpha, MASKV *live, REALV *transmittance) {
    const REALV clamped = LESSER(*alpha, (REALV)ALPHA_MAX), before = *transmittance;
    *alpha = seen ? clamped : (REALV)0;
    const REALV weight = *alpha * before, behind = before - weight;
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
