// Blocks of pixels that splats meet, for one band of pixel rows at a time. REALV holds one number per splat, MASKV the
// result of a comparison, and SQRTV is the square root of a REALV.
#ifndef CLSPLAT_COMPOSITE_BANDS_H
#define CLSPLAT_COMPOSITE_BANDS_H

// Outlines of splats (ellipse.h).
typedef struct {
    REALV x, y; // centre, from the tile's corner, px
    REALV half_height, inv_half_height, at_right, slope, half_sq;
} BandOutline;

#if !RAYS
// Outlines of splats with these numbers of Splat; (x, y) counts from the tile's corner.
static inline BandOutline band_outline(REALV x, REALV y, REALV half_height, REALV at_right, REALV u_x, REALV u_y,
                                       REALV level) {
    const REALV inv = 1 / u_x;
    const BandOutline o = {x,
                           y,
                           half_height,
                           1 / half_height,
                           at_right,
                           -u_y * inv,
                           (level - (real)(LOG2_ALPHA_MIN - LOG2_E * EXTENT_SLACK)) * inv * inv};
    return o;
}
#endif

// The numbers [begin, end) of the blocks of `width` pixels, of `count` in a row, that splats meet in the pixel rows
// from `first` to `last` of the tile. Equal for splats that meet none.
static inline void blocks_in_band(const BandOutline *o, int first, int last, int width, int count, REALV *begin,
                                  REALV *end) {
    const REALV zero = 0, limit = count, right = o->at_right, left = -right;
    const REALV top = (first + (real)0.5) - o->y, bottom = top + (last - first);
    const REALV at_left = CLAMP(left, top, bottom), at_right = CLAMP(right, top, bottom);
    const REALV t_left = at_left * o->inv_half_height, t_right = at_right * o->inv_half_height;
    const REALV sq_left = o->half_sq * GREATER(1 - t_left * t_left, zero);
    const REALV sq_right = o->half_sq * GREATER(1 - t_right * t_right, zero);
    const REALV x_min = o->x + o->slope * at_left - SQRTV(sq_left);
    const REALV x_max = o->x + o->slope * at_right + SQRTV(sq_right);
    const MASKV met = (top <= o->half_height) & (bottom >= -o->half_height) & (x_min <= x_max);
    // Block i has pixels from width i + 0.5 to width (i + 1) - 0.5. Comparisons with NaN are false.
    const REALV from = (x_min + (real)0.5) / width, to = (x_max + (width - (real)0.5)) / width;
    *begin = LESSER(GREATER(from, zero), limit);
    *end = met ? LESSER(GREATER(to, zero), limit) : *begin;
}

#endif
