// Stage sweep: depths of a photo's pixels, by comparing it with other photos on planes of constant depth.
//
//   p_s ~ A_s (x, y, 1) + q b_s,   A_s = K_s R_s K^-1,  b_s = K_s t_s   (Collins 1996, "A space-sweep approach")
//   similarity = cov(a, b) / sqrt(max(var a, e) max(var b, e)) over a window of (2 RADIUS + 1)^2 pixels, where a is the
//   photo, b the other photo seen through the plane of inverse depth q, and e = VARIANCE_MIN
//   score(q) = mean of the two largest similarities over the sources: a source that something hides does not count
//   q = that of the largest score, refined by the parabola through it and its neighbours
// See docs/stages/sweep.md; clsplat/reference/sweep.py is the twin.
//
// Mapping: one work-item per number (sweep_pad, sweep_windows), per number of each plane (sweep_warp), per LANES columns
// of ROWS rows on each plane (sweep_similarity), and per pixel (sweep_best). The sums of a row serve all windows that it
// is in.
//
// Buffers, H x W pixels, S sources, D planes; rows have `stride` numbers, of which the first PAD and the last are 0:
//   in   photo[H,W], grey in [0, 1]; source[rows,columns] grey; maps[S,12], A (row-major) and b for positions in pixels,
//        with centres at +0.5; planes[D] inverse depths, ascending
//   out  padded[H,stride], the photo; windows[2,H,stride], its mean and variance in the window around each pixel;
//        warped[D,H,stride], grey, or OUTSIDE where the source does not show the position;
//        pairs[2,D,H,W], the two largest similarities so far, -1 where the window leaves the photo or the source, or
//        the photo is flat; inverse[H,W]; scores[H,W], -1 where the best plane is the first or the last one
// -DRADIUS        half of the window, px, less than PAD
// -DVARIANCE_MIN  least variance of the photo in a window, and e
// -DLANES=1|8     columns per work-item of sweep_similarity
// -DROWS          rows per work-item of sweep_similarity
#include "common.h"

#if !defined(RADIUS) || !defined(VARIANCE_MIN) || !defined(LANES) || !defined(ROWS)
#error "-DRADIUS, -DVARIANCE_MIN, -DLANES and -DROWS must be given, see the head of sweep.cl"
#endif
#define PAD 8
#if RADIUS < 1 || RADIUS >= PAD
#error "-DRADIUS must be 1 or more, and less than 8"
#endif
#define WINDOW (2 * RADIUS + 1)
#define SHARE  (1 / (real)(WINDOW * WINDOW))
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
#define LOAD(p)     (((const __global Vector *)(p))->v)
#define STORE(p, x) (((__global Vector *)(p))->v = (x))
#define LANE(v, i)  (((real *)&(v))[i])

__kernel void sweep_pad(const int width, const int stride, const __global real *photo, __global real *padded) {
    const int x = (int)get_global_id(0) - PAD, y = get_global_id(1);
    padded[y * stride + x + PAD] = x >= 0 && x < width ? photo[y * width + x] : 0;
}

// Mean and variance of the photo in the windows, in planes of the size of `padded`.
__kernel void sweep_windows(const int width, const int height, const int stride, const __global real *padded,
                            __global real *windows) {
    const int x = (int)get_global_id(0), y = get_global_id(1);
    const size_t i = (size_t)y * stride + x;
    real sum = 0, squares = 0;
    if (x >= RADIUS && x < stride - RADIUS && y >= RADIUS && y < height - RADIUS) {
        for (int j = -RADIUS; j <= RADIUS; ++j) {
            for (int k = -RADIUS; k <= RADIUS; ++k) {
                const real a = padded[i + j * stride + k];
                sum += a;
                squares += a * a;
            }
        }
    }
    const real mean = SHARE * sum;
    windows[i] = mean;
    windows[(size_t)height * stride + i] = SHARE * squares - mean * mean;
}

__kernel void sweep_warp(const int width, const int height, const int stride, const int columns, const int rows,
                         const __global real *source, const uint s, const __global real *maps,
                         const __global real *planes, __global real *warped) {
    const int x = (int)(LANES * get_global_id(0)) - PAD, y = get_global_id(1);
    const size_t d = get_global_id(2);
    const __global real *m = maps + 12 * s;
    const reals column = COLUMNS_FROM((real)x), px = column + (real)0.5;
    const real py = y + (real)0.5, q = planes[d];
    const reals z = m[6] * px + (m[7] * py + m[8] + q * m[11]);
    const reals u = (m[0] * px + (m[1] * py + m[2] + q * m[9])) / z - (real)0.5;
    const reals v = (m[3] * px + (m[4] * py + m[5] + q * m[10])) / z - (real)0.5;
    // Comparisons with NaN are false.
    const masks shown =
        (z > (real)0) & (u >= (real)0) & (v >= (real)0) & (u <= (real)(columns - 1)) & (v <= (real)(rows - 1));
    const masks inside = (column >= (real)0) & (column < (real)width);
    const reals zero = 0, outside = OUTSIDE;
    const reals u_max = LESSER(shown ? u : zero, (reals)(real)(columns - 2));
    const reals v_max = LESSER(shown ? v : zero, (reals)(real)(rows - 2));
    reals right, low, c00, c01, c10, c11;
    for (int lane = 0; lane < LANES; ++lane) {
        const int left = LANE(u_max, lane), top = LANE(v_max, lane);
        const __global real *corner = &source[top * columns + left];
        LANE(right, lane) = LANE(u, lane) - left;
        LANE(low, lane) = LANE(v, lane) - top;
        LANE(c00, lane) = corner[0];
        LANE(c01, lane) = corner[1];
        LANE(c10, lane) = corner[columns];
        LANE(c11, lane) = corner[columns + 1];
    }
    const reals upper = c00 + right * (c01 - c00), lower = c10 + right * (c11 - c10);
    const reals value = shown ? upper + low * (lower - upper) : outside;
    STORE(&warped[(d * height + y) * stride + x + PAD], inside ? value : zero);
}

// Sums over the columns of a window, of one row of it.
typedef struct {
    reals b, ab, bb;
} Sums;

static inline Sums row_sums(const __global real *a_row, const __global real *b_row) {
    Sums sums = {0, 0, 0};
    _Pragma("unroll") for (int i = -RADIUS; i <= RADIUS; ++i) {
        const reals a = LOAD(a_row + i), b = LOAD(b_row + i);
        sums.b += b;
        sums.ab += a * b;
        sums.bb += b * b;
    }
    return sums;
}

__kernel void sweep_similarity(const int width, const int height, const int stride, const uint s, const uint planes,
                               const __global real *padded, const __global real *windows, const __global real *warped,
                               __global real *pairs) {
    const int x = LANES * get_global_id(0), begin = ROWS * get_global_id(1), end = LESSER(begin + ROWS, height);
    const size_t d = get_global_id(2), size = (size_t)height * stride, step = (size_t)planes * height * width;
    const reals column = COLUMNS_FROM((real)x), least = (real)VARIANCE_MIN;
    const masks columns = (column >= (real)RADIUS) & (column < (real)(width - RADIUS));
    const __global real *a = padded + x + PAD, *b = warped + d * size + x + PAD;
    Sums rows[WINDOW]; // of the last rows, row y at y % WINDOW
    for (int y = GREATER(begin - RADIUS, 0); y < LESSER(begin + RADIUS, height); ++y)
        rows[y % WINDOW] = row_sums(a + (size_t)y * stride, b + (size_t)y * stride);
    for (int y = begin; y < end; ++y) {
        const int next = y + RADIUS;
        if (next < height)
            rows[next % WINDOW] = row_sums(a + (size_t)next * stride, b + (size_t)next * stride);
        reals similarity = -1;
        if (y >= RADIUS && next < height) {
            reals sum_b = 0, sum_ab = 0, sum_bb = 0;
            _Pragma("unroll") for (int j = 0; j < WINDOW; ++j) {
                sum_b += rows[j].b;
                sum_ab += rows[j].ab;
                sum_bb += rows[j].bb;
            }
            const __global real *window = windows + (size_t)y * stride + x + PAD;
            const reals mean_a = LOAD(window), var_a = LOAD(window + size);
            const reals mean_b = SHARE * sum_b, var_b = SHARE * sum_bb - mean_b * mean_b;
            const reals root = ROOTS(GREATER(var_a, least) * GREATER(var_b, least));
            const masks known = columns & (var_a >= least) & (sum_b < (reals)(real)(OUTSIDE / 2));
            similarity = known ? (SHARE * sum_ab - mean_a * mean_b) / root : similarity;
        }
        __global real *row = &pairs[(d * height + y) * width + x];
        if (x + LANES <= width) {
            const reals first = s ? LOAD(row) : (reals)-1, second = s ? LOAD(row + step) : (reals)-1;
            STORE(row, GREATER(first, similarity));
            STORE(row + step, similarity > first ? first : GREATER(second, similarity));
        } else {
            for (int lane = 0; x + lane < width; ++lane) {
                const real value = LANE(similarity, lane);
                const real first = s ? row[lane] : -1, second = s ? row[step + lane] : -1;
                row[lane] = GREATER(first, value);
                row[step + lane] = value > first ? first : GREATER(second, value);
            }
        }
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
