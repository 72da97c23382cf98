// Stage sweep: depths of a photo's pixels, by comparing it with other photos on planes of constant depth.
//
//   p_s ~ A_s (x, y, 1) + q b_s,   A_s = K_s R_s K^-1,  b_s = K_s t_s   (Collins 1996, "A space-sweep approach")
//   similarity = cov(a, b) / sqrt(max(var a, e) max(var b, e)) over a window of (2 RADIUS + 1)^2 pixels, where a is the
//   photo, b the other photo seen through the plane of inverse depth q, and e = VARIANCE_MIN
//   score(q) = mean of the two largest similarities over the sources: a source that something hides does not count
//   q = that of the largest score, refined by the parabola through it and its neighbours
// See docs/stages/sweep.md; clsplat/reference/sweep.py is the twin.
//
// Mapping: one work-item per number (sweep_pad), per number of each plane (sweep_warp), per LANES pixels of a row on
// each plane (sweep_similarity), and per pixel (sweep_best).
//
// Buffers, H x W pixels, S sources, D planes; rows have `stride` numbers, of which the first PAD and the last are 0:
//   in   photo[H,W], grey in [0, 1]; source[rows,columns] grey; maps[S,12], A (row-major) and b for positions in pixels,
//        with centres at +0.5; planes[D] inverse depths, ascending
//   out  padded[H,stride], the photo; warped[D,H,stride], grey, or OUTSIDE where the source does not show the position;
//        pairs[2,D,H,W], the two largest similarities so far, -1 where the window leaves the photo or the source, or
//        the photo is flat; inverse[H,W]; scores[H,W], -1 where the best plane is the first or the last one
// -DRADIUS        half of the window, px, less than PAD
// -DVARIANCE_MIN  least variance of the photo in a window, and e
// -DLANES=1|8     pixels per work-item of sweep_similarity
#include "common.h"

#if !defined(RADIUS) || !defined(VARIANCE_MIN) || !defined(LANES)
#error "-DRADIUS, -DVARIANCE_MIN and -DLANES must be given, see the head of sweep.cl"
#endif
#define PAD 8
#if RADIUS < 1 || RADIUS >= PAD
#error "-DRADIUS must be 1 or more, and less than 8"
#endif
// Far above any grey: the sum over a window shows whether one of its pixels is outside.
#define OUTSIDE 10000

#if LANES == 8
typedef real8 reals;
typedef mask8 masks;
#define COLUMNS_FROM(x) ((reals)(0, 1, 2, 3, 4, 5, 6, 7) + (x))
#define ROOTS(x)        ROOT8(x)
#elif LANES == 1
typedef real reals;
typedef int masks;
#define COLUMNS_FROM(x) ((reals)(x))
#define ROOTS(x)        ROOT(x)
#else
#error "-DLANES must be 1 or 8"
#endif

// The vector at any address. PoCL 3.0 calls vload8 as a function, which doubles the time.
typedef struct __attribute__((packed)) {
    reals v;
} Vector;
#define LOAD(p) (((const __global Vector *)(p))->v)

__kernel void sweep_pad(const int width, const int stride, const __global real *photo, __global real *padded) {
    const int x = (int)get_global_id(0) - PAD, y = get_global_id(1);
    padded[y * stride + x + PAD] = x >= 0 && x < width ? photo[y * width + x] : 0;
}

__kernel void sweep_warp(const int width, const int height, const int stride, const int columns, const int rows,
                         const __global real *source, const uint s, const __global real *maps,
                         const __global real *planes, __global real *warped) {
    const int x = (int)get_global_id(0) - PAD, y = get_global_id(1);
    const size_t d = get_global_id(2);
    __global real *value = &warped[(d * height + y) * stride + x + PAD];
    if (x < 0 || x >= width) {
        *value = 0;
        return;
    }
    const __global real *m = maps + 12 * s;
    const real px = x + (real)0.5, py = y + (real)0.5, q = planes[d];
    const real z = m[6] * px + m[7] * py + m[8] + q * m[11];
    const real u = (m[0] * px + m[1] * py + m[2] + q * m[9]) / z - (real)0.5;
    const real v = (m[3] * px + m[4] * py + m[5] + q * m[10]) / z - (real)0.5;
    // Comparisons with NaN are false.
    if (!(z > 0 && u >= 0 && v >= 0 && u <= columns - 1 && v <= rows - 1)) {
        *value = OUTSIDE;
        return;
    }
    const int left = LESSER((int)u, columns - 2), top = LESSER((int)v, rows - 2);
    const real right = u - left, low = v - top;
    const __global real *corner = &source[top * columns + left];
    const real upper = corner[0] + right * (corner[1] - corner[0]);
    const real lower = corner[columns] + right * (corner[columns + 1] - corner[columns]);
    *value = upper + low * (lower - upper);
}

__kernel void sweep_similarity(const int width, const int height, const int stride, const uint s, const uint planes,
                               const __global real *padded, const __global real *warped, __global real *pairs) {
    const int x = LANES * get_global_id(0), y = get_global_id(1);
    const size_t d = get_global_id(2);
    reals similarity = -1;
    if (y >= RADIUS && y < height - RADIUS) {
        const __global real *a_rows = padded + y * stride + x + PAD;
        const __global real *b_rows = warped + (d * height + y) * stride + x + PAD;
        reals sum_a = 0, sum_b = 0, sum_aa = 0, sum_ab = 0, sum_bb = 0;
        _Pragma("unroll") for (int j = -RADIUS; j <= RADIUS; ++j) {
            _Pragma("unroll") for (int i = -RADIUS; i <= RADIUS; ++i) {
                const reals a = LOAD(a_rows + j * stride + i), b = LOAD(b_rows + j * stride + i);
                sum_a += a;
                sum_b += b;
                sum_aa += a * a;
                sum_ab += a * b;
                sum_bb += b * b;
            }
        }
        const real share = 1 / (real)((2 * RADIUS + 1) * (2 * RADIUS + 1));
        const reals mean_a = share * sum_a, mean_b = share * sum_b, least = (real)VARIANCE_MIN;
        const reals var_a = share * sum_aa - mean_a * mean_a, var_b = share * sum_bb - mean_b * mean_b;
        const reals root = ROOTS(GREATER(var_a, least) * GREATER(var_b, least));
        const reals column = COLUMNS_FROM((real)x);
        const masks known = (column >= (real)RADIUS) & (column < (real)(width - RADIUS)) & (var_a >= least) &
                            (sum_b < (reals)(real)(OUTSIDE / 2));
        similarity = known ? (share * sum_ab - mean_a * mean_b) / root : similarity;
    }
    __global real *row = &pairs[(d * height + y) * width + x];
    const size_t step = (size_t)planes * height * width;
    for (int lane = 0; lane < LANES && x + lane < width; ++lane) {
        const real value = ((const real *)&similarity)[lane];
        const real first = s ? row[lane] : -1, second = s ? row[step + lane] : -1;
        row[lane] = GREATER(first, value);
        row[step + lane] = value > first ? first : GREATER(second, value);
    }
}

__kernel void sweep_best(const uint pixels, const uint count, const __global real *pairs, const __global real *planes,
                         __global real *inverse, __global real *scores) {
    const size_t i = get_global_id(0);
    if (i >= pixels)
        return;
    const __global real *first = pairs + i, *second = first + (size_t)count * pixels;
    uint best = 0;
    real most = (real)0.5 * (first[0] + second[0]), before = most, after = most, last = most;
    for (uint d = 1; d < count; ++d) {
        const size_t at = d * (size_t)pixels;
        const real score = (real)0.5 * (first[at] + second[at]);
        after = d == best + 1 ? score : after;
        if (score > most) {
            before = last;
            most = score;
            best = d;
        }
        last = score;
    }
    const bool inner = best > 0 && best < count - 1;
    const real bend = before - 2 * most + after;
    const real shift = inner && bend < 0 ? (real)0.5 * (before - after) / bend : 0;
    const uint lower = inner && shift < 0 ? best - 1 : best;
    inverse[i] = inner ? planes[best] + shift * (planes[lower + 1] - planes[lower]) : planes[best];
    scores[i] = inner ? most : -1;
}
