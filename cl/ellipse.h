// The region in which a splat is visible: a dx^2 + 2 b dx dy + c dy^2 <= r2 around its centre, with the conic
// (a, b, c) and r2 = 2 ln(opacity / ALPHA_MIN), where alpha = opacity exp(-sigma) falls to ALPHA_MIN.
#ifndef CLSPLAT_ELLIPSE_H
#define CLSPLAT_ELLIPSE_H

// r2 in the unit of 2 sigma, the slack of clsplat/constants.py included; not positive: the splat is
// invisible.
static inline real ellipse_r2(real opacity) {
    return opacity > ALPHA_MIN ? 2 * (log(opacity / ALPHA_MIN) + EXTENT_SLACK) : 0;
}

// Exact range [range.x, range.y] of dx over the part of the ellipse with lo <= dy <= hi; range.x > range.y:
// empty. ex, ey are its half width and half height. The range of dy for given dx follows by exchanging a and
// c, ex and ey. The leftmost and rightmost points lie at dy = +-(b/c) ex; within the band an extreme is
// attained there or at the nearer border (Hanson et al. 2024, "Speedy-Splat", AccuTile). With ey^2 = r2 a/(a
// c - b^2) the determinant of the conic, which cancels for needles, is not needed.
static inline real2 ellipse_range(real3 conic, real r2, real2 extent, real lo, real hi) {
    const real a = conic.x, b = conic.y, c = conic.z;
    lo = fmax(lo, -extent.y);
    hi = fmin(hi, extent.y);
    if (!(lo <= hi))
        return (real2)(1, 0);
    const real at_right = -b / c * extent.x;
    const real right = clamp(at_right, lo, hi);
    const real left = clamp(-at_right, lo, hi);
    const real t_left = left / extent.y, t_right = right / extent.y;
    const real x_min = (-b * left - sqrt(a * r2 * fmax(1 - t_left * t_left, (real)0))) / a;
    const real x_max = (-b * right + sqrt(a * r2 * fmax(1 - t_right * t_right, (real)0))) / a;
    return (real2)(x_min, x_max);
}

// Indices [first, last] of the pixels in [0, size) whose centres lie in [lo, hi]; first > last: none.
static inline int2 pixels_between(real lo, real hi, int size) {
    // Clamped as reals: converting a real beyond int's range is undefined.
    const int first = (int)ceil(clamp(lo - (real)0.5, (real)0, (real)size));
    const int last = (int)floor(clamp(hi - (real)0.5, (real)-1, (real)(size - 1)));
    return (int2)(first, last);
}

#endif
