// The region in which a splat is visible: a dx^2 + 2 b dx dy + c dy^2 <= r2 around its centre, with the conic
// (a, b, c) and r2 = 2 ln(opacity / ALPHA_MIN), where alpha = opacity exp(-sigma) falls to ALPHA_MIN. If the conic is 0,
// the region is the box of the splat's extents.
#ifndef CLSPLAT_ELLIPSE_H
#define CLSPLAT_ELLIPSE_H

#include "lanes.h"

#ifdef USE_DOUBLE
#define REAL8_OF(x)   IN_HALVES(real8, convert_double4, x)
#define MASK8_OF(x)   IN_HALVES(mask8, convert_long4, x)
#define FMA8(a, b, c) ((real8)(fma((a).lo, (b).lo, (c).lo), fma((a).hi, (b).hi, (c).hi)))
#else
#define REAL8_OF    convert_float8
#define MASK8_OF(x) (x)
#define FMA8        fma
#endif

// r2 in the unit of 2 sigma, including EXTENT_SLACK (clsplat/constants.py). If it is not positive, the splat is
// invisible.
static inline reals ellipse_r2(reals opacity) {
    const reals zero = 0;
    return opacity > (reals)ALPHA_MIN
               ? (real)(2 / LOG2_E) * (LOGARITHM(opacity) - (real)LOG2_ALPHA_MIN) + 2 * EXTENT_SLACK
               : zero;
}

// r2 of eight splats. On CPUs a vector logarithm is faster than a scalar one.
static inline real8 ellipse_r2_8(real8 opacity) {
    return opacity > (real8)ALPHA_MIN ? 2 * (OF8(log, opacity / ALPHA_MIN) + EXTENT_SLACK) : (real8)0;
}

// Precomputed values of a splat's ellipse from which its ranges follow.
typedef struct {
    real x, y;                         // centre, px; the other values are relative to it
    real half_height, inv_half_height; // the first is 0 if the splat is invisible, the second if the region is a box
    real at_right;                     // y of the rightmost point; that of the leftmost is -at_right
    real slope, half_sq;               // x of a chord's middle over y; square of half the chord at y = 0
    real unused;
} Ellipse;

static inline Ellipse ellipse_of(real2 centre, real3 conic, real r2, real2 extent) {
    Ellipse e = {centre.x, centre.y, 0, 0, 0, 0, 0, 0};
    if (extent.x > 0) {
        e.half_height = extent.y;
        e.half_sq = extent.x * extent.x;
    }
    if (extent.x > 0 && conic.x > 0) {
        e.inv_half_height = 1 / extent.y;
        e.at_right = -conic.y / conic.z * extent.x;
        e.slope = -conic.y / conic.x;
        e.half_sq = r2 / conic.x;
    }
    return e;
}

// Exact range x_min <= x <= x_max over the part of the ellipse with lo <= y <= hi, for eight bands. A lane of the
// result is true if the ellipse meets the band; otherwise its range is undefined. The leftmost and rightmost points
// lie at y = -+at_right. Within the band, an extreme lies there or at the nearer border (Hanson et al. 2024,
// "Speedy-Splat", AccuTile). With half_height^2 = r2 a/(a c - b^2), the determinant of the conic, which cancels for
// needles, is not needed. Sums of products are written as fma, so that the compiler cannot contract them in one place
// only: the same call gives the same bits wherever it is inlined.
static inline mask8 ellipse_ranges8(const Ellipse *e, real8 lo, real8 hi, real8 *x_min, real8 *x_max) {
    const real8 bottom = -e->half_height, top = e->half_height, zero = 0;
    lo = GREATER(lo, bottom);
    hi = LESSER(hi, top);
    real8 left = -e->at_right, right = e->at_right;
    left = GREATER(left, lo);
    left = LESSER(left, hi);
    right = GREATER(right, lo);
    right = LESSER(right, hi);
    const real8 t_left = left * e->inv_half_height, t_right = right * e->inv_half_height;
    const real8 one = 1, slope = e->slope;
    const real8 rest_left = FMA8(-t_left, t_left, one), rest_right = FMA8(-t_right, t_right, one);
    const real8 sq_left = e->half_sq * GREATER(rest_left, zero), sq_right = e->half_sq * GREATER(rest_right, zero);
    *x_min = FMA8(slope, left, -OF8(sqrt, sq_left));
    *x_max = FMA8(slope, right, OF8(sqrt, sq_right));
    return lo <= hi;
}

// Indices [first, last] of the pixels in [0, size) whose centres lie in [lo, hi]. If there are none, first > last.
static inline int2 pixels_between(real lo, real hi, int size) {
    // Reals are clamped before the conversion: converting a real beyond the range of int is undefined.
    const int first = (int)ceil(clamp(lo - (real)0.5, (real)0, (real)size));
    const int last = (int)floor(clamp(hi - (real)0.5, (real)-1, (real)(size - 1)));
    return (int2)(first, last);
}

// The same for eight intervals, without calls to ceil and floor.
static inline void pixels_between8(real8 lo, real8 hi, int size, int8 *first, int8 *last) {
    const real8 zero = 0, end = size;
    lo -= (real)0.5;
    hi -= (real)0.5;
    lo = CLAMP(lo, zero, end);
    hi = CLAMP(hi, zero - 1, end - 1);
    // Truncate, then correct the result: a vector comparison is -1 where it is true.
    *first = TO_INT8(lo);
    const mask8 above = REAL8_OF(*first) < lo;
    *first -= TO_INT8(above);
    *last = TO_INT8(hi);
    const mask8 below = REAL8_OF(*last) > hi;
    *last += TO_INT8(below);
}

#endif
