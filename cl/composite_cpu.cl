// Stage composite, variant for CPUs: splats to pixels, front to back, and gradients back.
//
//   image = sum_i colour_i alpha_i T_i + T_end background,  alpha = 1 - T_end   (Kerbl et al. 2023, equation 3)
// A pixel skips pairs with alpha < ALPHA_MIN and stops before T would fall to TRANSMITTANCE_MIN or below.
// composite.h holds the mathematics, composite_gpu.cl the variant for GPUs, clsplat/reference/composite.py
// the twin.
//
// Mapping: one work-item per tile, which keeps the tile's pixels in private memory (they stay in the L1
// cache), takes its splats in depth order and walks the rows that the splat's ellipse meets inside the tile;
// a row of TILE pixels is one vector.
//
// How does the backward pass work? It replays the forward pass front to back. With u_i = colour_i . v_image
// and S the part of sum_i u_i alpha_i T_i + T_end (background . v_image - v_alpha) that lies behind splat i,
//   v_alpha_i = T_i u_i - S_i / (1 - alpha_i);
// S starts as image . v_image - T_end v_alpha and loses one term per splat, so nothing is saved but the
// image, and no transmittance is divided back. Within a tile each gradient of a splat follows from three sums
// over rows of the gradient of sigma and one per colour, kept as vectors over columns. A splat's record of
// each tile goes to its slot of the unsorted list, where the records of a splat are neighbours; composite_sum
// adds them in a fixed order: no atomics.
//
// Buffers: N splats as in project.cl, M intersections and T tiles as in bin.cl, C = CHANNELS
//   in   gauss_ids[M], tile_ranges[T,2], background[C], slots[M]
//   out  image[H,W,C], alpha[H,W]; backward: records[M,6+C], v_means2d[N,2], v_conics[N,3], v_opacities[N],
//   v_colors[N,C]
// -DTILE=8|16   edge of a tile, px: the width of the vectors
// -DCHANNELS    colour channels, 1 or more
#include "common.h"
#include "ellipse.h"

#if TILE != 8 && TILE != 16
#error "-DTILE must be 8 or 16: a row of a tile is one vector"
#endif
#define REALV CONCATENATE(real, TILE)
#define MASKV CONCATENATE(mask, TILE)
#include "composite.h"

#if TILE == 16
#define COLUMNS ((real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#else
#define COLUMNS ((real8)(0, 1, 2, 3, 4, 5, 6, 7))
#endif

static inline real sum8(real8 v) {
    const real4 a = v.lo + v.hi;
    const real2 b = a.lo + a.hi;
    return b.x + b.y;
}

static inline real sum_row(REALV v) {
#if TILE == 16
    return sum8(v.lo + v.hi);
#else
    return sum8(v);
#endif
}

// Rows [first, last] of the tile with origin (x0, y0) and `rows` rows in which splat g may be visible.
static inline int2 visible_rows(const Splat *s, real2 extent, int x0, int y0, int rows) {
    const real lo = x0 + (real)0.5 - s->x;
    const real2 range =
        ellipse_range((real3)(s->c, s->b, s->a), ellipse_r2(s->opacity), extent.yx, lo, lo + TILE - 1);
    return range.x > range.y ? (int2)(1, 0) : pixels_between(s->y - y0 + range.x, s->y - y0 + range.y, rows);
}

// Bit r is set while row r has a live pixel.
static inline uint live_rows(const MASKV *live) {
    uint rows = 0;
    for (int r = 0; r < TILE; ++r)
        rows |= any(live[r]) ? 1u << r : 0;
    return rows;
}

// Splats between two looks at which rows are finished: a look costs about as much as one row of one splat.
#define LOOK_EVERY 16

__kernel void composite_fwd(const int width, const int height, const __global real *means2d,
                            const __global real *conics, const __global real *extents, const __global real *opacities,
                            const __global real *colors, const __global uint *gauss_ids,
                            const __global uint *tile_ranges, const __global real *background, __global real *image,
                            __global real *alpha_image) {
    const uint t = get_global_id(0);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = t % tiles_x * TILE, y0 = t / tiles_x * TILE;
    const int rows = min(TILE, height - y0), columns = min(TILE, width - x0);

    REALV transmittance[TILE], sums[TILE][CHANNELS];
    MASKV live[TILE];
    for (int r = 0; r < TILE; ++r) {
        transmittance[r] = 1;
        live[r] = COLUMNS < (REALV)(r < rows ? columns : 0);
        for (int k = 0; k < CHANNELS; ++k)
            sums[r][k] = 0;
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
    uint unfinished = live_rows(live);
    for (uint i = begin; i < end && unfinished; ++i) {
        const uint g = gauss_ids[i];
        const Splat s = splat_load(g, means2d, conics, opacities, colors);
        const int2 span = visible_rows(&s, vload2(g, extents), x0, y0, rows);
        const REALV dx = COLUMNS + (x0 + (real)0.5 - s.x);
        for (int r = span.x; r <= span.y; ++r) {
            if (!(unfinished >> r & 1))
                continue;
            REALV alpha;
            const REALV weight = splat_over(&s, dx, y0 + r + (real)0.5 - s.y, &transmittance[r], &live[r], &alpha);
            for (int k = 0; k < CHANNELS; ++k)
                sums[r][k] += weight * s.color[k];
        }
        if ((i - begin) % LOOK_EVERY == LOOK_EVERY - 1)
            unfinished = live_rows(live);
    }

    for (int r = 0; r < rows; ++r) {
        const size_t first = (size_t)(y0 + r) * width + x0;
        for (int x = 0; x < columns; ++x) {
            const real left = ((const real *)&transmittance[r])[x];
            for (int k = 0; k < CHANNELS; ++k)
                image[CHANNELS * (first + x) + k] = ((const real *)&sums[r][k])[x] + left * background[k];
            alpha_image[first + x] = 1 - left;
        }
    }
}

__kernel void composite_bwd(const int width, const int height, const __global real *means2d,
                            const __global real *conics, const __global real *extents, const __global real *opacities,
                            const __global real *colors, const __global uint *gauss_ids,
                            const __global uint *tile_ranges, const __global uint *slots, const __global real *image,
                            const __global real *alpha_image, const __global real *v_image,
                            const __global real *v_alpha_image, __global real *records) {
    const uint t = get_global_id(0);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = t % tiles_x * TILE, y0 = t / tiles_x * TILE;
    const int rows = min(TILE, height - y0), columns = min(TILE, width - x0);

    REALV transmittance[TILE], behind[TILE], v_pixels[TILE][CHANNELS];
    MASKV live[TILE];
    for (int r = 0; r < TILE; ++r) {
        transmittance[r] = 1;
        behind[r] = 0;
        live[r] = COLUMNS < (REALV)(r < rows ? columns : 0);
        for (int k = 0; k < CHANNELS; ++k)
            v_pixels[r][k] = 0;
    }
    for (int r = 0; r < rows; ++r) {
        const size_t first = (size_t)(y0 + r) * width + x0;
        for (int x = 0; x < columns; ++x) {
            real sum = (alpha_image[first + x] - 1) * v_alpha_image[first + x];
            for (int k = 0; k < CHANNELS; ++k) {
                const real v = v_image[CHANNELS * (first + x) + k];
                sum += image[CHANNELS * (first + x) + k] * v;
                ((real *)&v_pixels[r][k])[x] = v;
            }
            ((real *)&behind[r])[x] = sum;
        }
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
    uint unfinished = live_rows(live);
    uint i = begin;
    for (; i < end && unfinished; ++i) {
        const uint g = gauss_ids[i];
        const Splat s = splat_load(g, means2d, conics, opacities, colors);
        const int2 span = visible_rows(&s, vload2(g, extents), x0, y0, rows);
        const REALV dx = COLUMNS + (x0 + (real)0.5 - s.x);
        REALV sum = 0, sum_dy = 0, sum_dy2 = 0, v_colors[CHANNELS];
        for (int k = 0; k < CHANNELS; ++k)
            v_colors[k] = 0;
        for (int r = span.x; r <= span.y; ++r) {
            if (!(unfinished >> r & 1))
                continue;
            const real dy = y0 + r + (real)0.5 - s.y;
            const REALV before = transmittance[r];
            REALV alpha;
            const REALV weight = splat_over(&s, dx, dy, &transmittance[r], &live[r], &alpha);
            REALV u = 0;
            for (int k = 0; k < CHANNELS; ++k) {
                u += s.color[k] * v_pixels[r][k];
                v_colors[k] += weight * v_pixels[r][k];
            }
            const REALV v_sigma = splat_over_vjp(alpha, weight, before, u, &behind[r]);
            sum += v_sigma;
            sum_dy += dy * v_sigma;
            sum_dy2 += dy * dy * v_sigma;
        }
        const REALV sum_dx = dx * sum;
        const Moments m = {sum_row(sum),         sum_row(sum_dx),      sum_row(sum_dy),
                           sum_row(dx * sum_dx), sum_row(dx * sum_dy), sum_row(sum_dy2)};
        real v_color[CHANNELS];
        for (int k = 0; k < CHANNELS; ++k)
            v_color[k] = sum_row(v_colors[k]);
        splat_record(&s, m, v_color, records + (size_t)RECORD * slots[i]);
        if ((i - begin) % LOOK_EVERY == LOOK_EVERY - 1)
            unfinished = live_rows(live);
    }
    for (; i < end; ++i)
        splat_record_zero(records + (size_t)RECORD * slots[i]);
}

#include "composite_sum.h"
