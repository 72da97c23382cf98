// The region in which a splat is visible: a dx^2 + 2 b dx dy + c dy^2 <= r2 around its centre, with the conic
// (a, b, c) and r2 = 2 ln(opacity / ALPHA_MIN), where alpha = opacity exp(-sigma) falls to ALPHA_MIN. If the conic is 0,
// the region is the box of the splat's extents.
#ifndef CLSPLAT_ELLIPSE_H
#define CLSPLAT_ELLIPSE_H

#include "lanes.h"

#if LANES == 1
#define REALS_OF(x)  ((real)(x))
#define MASKS_OF(x)  (x)
#define FMA(a, b, c) fma(a, b, c)
#else
#define FMA(a, b, c) FMA8(a, b, c)
#ifdef USE_DOUBLE
#define REALS_OF(x) IN_HALVES(real8, convert_double4, x)
#define MASKS_OF(x) IN_HALVES(mask8, convert_long4, x)
#else
#define REALS_OF(x) convert_float8(x)
#define MASKS_OF(x) (x)
#endif
#endif

// r2 in the unit of 2 sigma, including EXTENT_SLACK (clsplat/constants.py). If it is not positive, the splat is
// invisible.
static inline reals ellipse_r2(reals opacity) {
    const reals zero = 0;
    return opacity > (reals)ALPHA_MIN
               ? (real)(2 / LOG2_E) * (LOGARITHM(opacity) - (real)LOG2_ALPHA_MIN) + 2 * EXTENT_SLACK
               : zero;
}

// Precomputed values of the ellipses of splats in lanes, from which their ranges follow.
typedef struct {
    reals x, y;                         // centre, px; the other values are relative to it
    reals half_height, inv_half_height; // the first is 0 if the splat is invisible, the second if the region is a box
    reals at_right;                     // y of the rightmost point; that of the leftmost is -at_right
    reals slope, half_sq;               // x of a chord's middle over y; square of half the chord at y = 0
} Ellipses;

static inline Ellipses ellipses_of(reals2 centre, reals3 conic, reals opacity, reals2 extent) {
    const reals zero = 0;
    const masks visible = extent.x > zero, curved = visible & (conic.x > zero);
    // As ellipse_r2, with the driver's logarithm.
    const reals r2 = opacity > (reals)ALPHA_MIN ? 2 * (OF_LANES(log, opacity / ALPHA_MIN) + EXTENT_SLACK) : zero;
    const Ellipses e = {
        centre.x,
        centre.y,
        visible ? extent.y : zero,
        curved ? 1 / extent.y : zero,
        curved ? -conic.y / conic.z * extent.x : zero,
        curved ? -conic.y / conic.x : zero,
        curved ? r2 / conic.x : extent.x * extent.x,
    };
    return e;
}

// Exact range x_min <= x <= x_max over the part of an ellipse with lo <= y <= hi. A lane of the result is true if the
// ellipse meets this band; otherwise its range is undefined. The leftmost and rightmost points lie at y = -+at_right.
// Within the band, an extreme lies there or at the nearer border (Hanson et al. 2024, "Speedy-Splat", AccuTile). With
// half_height^2 = r2 a/(a c - b^2), the determinant of the conic, which cancels for needles, is not needed. Sums of
// products are written as fma, so that the compiler cannot contract them in one place only: the same call gives the
// same bits wherever it is inlined.
static inline masks ellipse_ranges(const Ellipses *e, reals lo, reals hi, reals *x_min, reals *x_max) {
    const reals bottom = -e->half_height, top = e->half_height, zero = 0, one = 1;
    lo = GREATER(lo, bottom);
    hi = LESSER(hi, top);
    reals left = -e->at_right, right = e->at_right;
    left = GREATER(left, lo);
    left = LESSER(left, hi);
    right = GREATER(right, lo);
    right = LESSER(right, hi);
    const reals t_left = left * e->inv_half_height, t_right = right * e->inv_half_height;
    const reals rest_left = FMA(-t_left, t_left, one), rest_right = FMA(-t_right, t_right, one);
    const reals sq_left = e->half_sq * GREATER(rest_left, zero), sq_right = e->half_sq * GREATER(rest_right, zero);
    *x_min = FMA(e->slope, left, -ROOTS(sq_left));
    *x_max = FMA(e->slope, right, ROOTS(sq_right));
    return lo <= hi;
}

// Indices [first, last] of the pixels in [0, size) whose centres lie in [lo, hi]. If there are none, first > last.
static inline void pixels_between(reals lo, reals hi, int size, ints *first, ints *last) {
    // Reals are clamped before the conversion: converting a real beyond the range of int is undefined.
    const reals zero = 0, end = size;
    lo -= (real)0.5;
    hi -= (real)0.5;
    lo = CLAMP(lo, zero, end);
    hi = CLAMP(hi, zero - 1, end - 1);
#if LANES == 1
    *first = (int)ceil(lo);
    *last = (int)floor(hi);
#else
    // Without calls to ceil and floor: truncate, then correct the result. A vector comparison is -1 where it is true.
    *first = TO_INTS(lo);
    const masks above = REALS_OF(*first) < lo;
    *first -= TO_INTS(above);
    *last = TO_INTS(hi);
    const masks below = REALS_OF(*last) > hi;
    *last += TO_INTS(below);
#endif
}

#endif
