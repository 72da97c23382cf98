// The exponent of a Gaussian along the ray of a pixel (gaussian_rays.h), for composite.h:
//
//   sigma = q/(2 (lambda^2 + k q)),   q = a dx^2 + 2 b dx dy + c dy^2,   lambda = along + l_x dx + l_y dy
// With RAYS = 1 the chart is the image: dx and dy count from the centre, and along = 1. With RAYS = 2 the splat has
// axes, from which dx, dy and along follow by products with the direction of the pixel's ray.
//
// Gradients: with r = q/(lambda^2 + k q) and h = lambda/(lambda^2 + k q),
//   v_q = v_sigma h^2/2,   v_lambda = -v_sigma r h,   v_k = -v_sigma r^2/2.
// A shift of the centre in the chart changes dx and dy by -along.
#ifndef CLSPLAT_COMPOSITE_RAYS_H
#define CLSPLAT_COMPOSITE_RAYS_H

#include "power.h"

// The region of a splat as values from which its ranges follow, as in ellipse.h. inv_half_height is 0 for a box.
typedef struct {
    real x, y; // centre, px
    real half_height, inv_half_height, at_right, slope, half_sq;
} Outline;

// A splat: t = level + e/(lambda^2 - rest e), e = a dx^2 + b dx dy + c dy^2. Padded to whole quarters of a cache line.
#define HEAD        (RAYS == 2 ? 23 : 16)
#define SPLAT_REALS ((HEAD + CHANNELS + 3) / 4 * 4)
typedef struct {
#if RAYS == 2
    real axis0[3], axis1[3], axis2[3];
#else
    real x, y; // centre, px
#endif
    real a, b, c;          // px^-2
    real level;            // log2(opacity)
    real slope_x, slope_y; // px^-1
    real rest;             // 2 k/log2(e)
    Outline outline;
    real color[SPLAT_REALS - HEAD];
} Splat;

// Position of a ray in a splat's chart, px and 1.
typedef struct {
    REALV dx, dy, along;
} Offset;

#if RAYS == 1
// The pixel at (dx, dy) from the centre, px.
static inline Offset offset_at(const Splat *s, REALV dx, REALV dy) {
    const Offset o = {dx, dy, 1};
    return o;
}
#endif

// Factors of the gradients of an exponent.
typedef struct {
    REALV ratio, share; // r and h
} Bend;

// Smallest lambda that is drawn: the ray's point of the largest density is in front of the camera. The bound is above 0
// so that no quotient overflows.
#define LAMBDA_MIN ((real)1e-6)

static inline REALV splat_exponent(const Splat *s, const Offset *o, Bend *bend) {
    const REALV e = o->dx * (s->a * o->dx + s->b * o->dy) + s->c * o->dy * o->dy;
    const REALV lambda = o->along + s->slope_x * o->dx + s->slope_y * o->dy;
    const MASKV ahead = lambda > (REALV)LAMBDA_MIN;
    const REALV inv = 1 / (ahead ? lambda * lambda - s->rest * e : (REALV)1);
    bend->share = ahead ? lambda * inv : (REALV)0;
    bend->ratio = ahead ? (real)(-2 / LOG2_E) * e * inv : (REALV)0;
    return ahead ? s->level + e * inv : (REALV)(LOG2_ALPHA_MIN - 1);
}

static inline MASKV splat_seen(const Splat *s, REALV t) {
    return (t <= (REALV)(s->level + (real)EXPONENT_SLACK)) & (t >= (REALV)LOG2_ALPHA_MIN);
}

// Sums over pixels, from which all gradients of a splat follow (composite_splats.h).
typedef struct {
    REALV m, mx, my, mxx, mxy, myy, ml, mlx, mly, mk;
} Moments;

#define NO_MOMENTS                                                                                                   \
    { 0, 0, 0, 0, 0, 0, 0, 0, 0, 0 }

static inline void add_moments(const Offset *o, const Bend *bend, REALV v_sigma, Moments *m) {
    const REALV v_q = v_sigma * bend->share * bend->share, x = v_q * o->dx, y = v_q * o->dy;
    const REALV v_ratio = -v_sigma * bend->ratio, v_lambda = v_ratio * bend->share;
    m->m += v_sigma;
    m->mx += o->along * x;
    m->my += o->along * y;
    m->mxx += o->dx * x;
    m->mxy += o->dx * y;
    m->myy += o->dy * y;
    m->ml += o->along * v_lambda;
    m->mlx += o->dx * v_lambda;
    m->mly += o->dy * v_lambda;
    m->mk += (real)0.5 * v_ratio * bend->ratio;
}

// A record holds the sums of one splat and one tile: the moments, then those of weight v_image.
#define MOMENTS 10
#define RECORD  (MOMENTS + CHANNELS)
#define MOMENTS_OF(sums)                                                                                             \
    {                                                                                                                \
        (sums).m, (sums).mx, (sums).my, (sums).mxx, (sums).mxy, (sums).myy, (sums).ml, (sums).mlx, (sums).mly,       \
            (sums).mk                                                                                                \
    }

#endif
