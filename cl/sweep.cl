// Stage sweep: depths of a photo's pixels, by comparing it with other photos on planes of constant depth.
//
//   p_s ~ A_s (x, y, 1) + q b_s,   A_s = K_s R_s K^-1,  b_s = K_s t_s   (Collins 1996, "A space-sweep approach")
//   similarity = cov(a, b) / sqrt(max(var a, e) max(var b, e)) over a window of (2 RADIUS + 1)^2 pixels, where a is the
//   photo, b the other photo seen through the plane of inverse depth q, and e = VARIANCE_MIN
//   score(q) = mean of the two largest similarities over the sources: a source that something hides does not count
//   q = that of the largest score, refined by the parabola through it and its neighbours
// See docs/stages/sweep.md; clsplat/reference/sweep.py is the twin.
//
// Mapping: one work-item per number (sweep_pad, sweep_windows), per LANES columns of a row (sweep_textured, sweep_warp),
// per LANES columns of ROWS rows on each plane (sweep_scores), and per pixel (sweep_best). The sums of a row serve all
// windows that it is in. Sources are resampled on a few planes at a time, `count` from plane `first` on, and compared
// before they leave the cache.
//
// Buffers, H x W pixels, S sources, D planes; rows have `stride` numbers, of which the first PAD and the last are 0:
//   in   photo[H,W], grey in [0, 1]; source[rows,columns] grey; maps[S,12], A (row-major) and b for positions in pixels,
//        with centres at +0.5; planes[D] inverse depths, ascending
//   out  padded[H,stride], the photo; windows[2,H,stride], its mean and variance in the window around each pixel;
//        textured[H,stride/LANES]; warped[S,count,H,stride], grey, or OUTSIDE where the source does not show the
//        position, undefined where nothing is textured;
//        scores[D,H,W], where similarities are -1 if the window leaves the photo or the source, or the photo is flat;
//        inverse[H,W]; largest[H,W], -1 where the best plane is the first or the last one
// -DRADIUS        half of the window, px, less than PAD
// -DVARIANCE_MIN  least variance of the photo in a window, and e
// -DLANES=1|8     columns per work-item
// -DROWS          rows per work-item of sweep_scores; with LANES=1 a multiple of the rows of a window
#include "common.h"

#if !defined(RADIUS) || !defined(VARIANCE_MIN) || !defined(LANES) || !defined(ROWS)
#error "-DRADIUS, -DVARIANCE_MIN, -DLANES and -DROWS must be given, see the head of sweep.cl"
#endif
#include "lanes.h"

#define PAD 8
#if RADIUS < 1 || RADIUS >= PAD
#error "-DRADIUS must be 1 or more, and less than 8"
#endif
#define WINDOW (2 * RADIUS + 1)
#define SHARE  (1 / (real)(WINDOW * WINDOW))
// Far above any grey: the sum over a window shows whether one of its pixels is outside.
#define OUTSIDE 10000

// Index of the sums of row `begin` + i: row y is at y % WINDOW. With LANES=1 loops are unrolled, and `begin` is a multiple
// of WINDOW: the indices are constants then, and the sums stay in registers.
#if LANES == 1
#if ROWS % WINDOW != 0
#error "-DROWS must be a multiple of the window for -DLANES=1"
#endif
#define PLACE(i) (((i) + WINDOW) % WINDOW)
#define UNROLLED _Pragma("unroll")
#else
#define PLACE(i) ((begin + (i)) % WINDOW)
#define UNROLLED
#endif

#if LANES == 8
typedef real16 Pairs;
#define LOAD(p)     load8(p)
#define STORE(p, x) store8(p, x)
#else
typedef real2 Pairs;
#define LOAD(p)     (*(p))
#define STORE(p, x) (*(p) = (x))
#endif

// A lane that may be written.
#define IN_LANE(v, lane) (((real *)&(v))[lane])

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

// Whether a window that is not flat has a pixel in LANES columns of a row. Other pixels need no comparison.
__kernel void sweep_textured(const int height, const int stride, const __global real *windows,
                             __global uchar *textured) {
    const int x = (int)(LANES * get_global_id(0)), y = get_global_id(1);
    const __global real *variances = windows + (size_t)height * stride;
    bool any = false;
    for (int row = GREATER(y - RADIUS, 0); row <= LESSER(y + RADIUS, height - 1); ++row)
        for (int column = GREATER(x - RADIUS, 0); column < LESSER(x + LANES + RADIUS, stride); ++column)
            any |= variances[(size_t)row * stride + column] >= (real)VARIANCE_MIN;
    textured[y * (stride / LANES) + get_global_id(0)] = any;
}

__kernel void sweep_warp(const int width, const int height, const int stride, const int columns, const int rows,
                         const __global real *source, const uint s, const __global real *maps,
                         const __global real *planes, const uint first, const uint count,
                         const __global uchar *textured, __global real *warped) {
    const int x = (int)(LANES * get_global_id(0)) - PAD, y = get_global_id(1);
    if (!textured[y * (stride / LANES) + get_global_id(0)])
        return;
    const __global real *m = maps + 12 * s;
    const reals column = LANE_NUMBERS + (real)x, px = column + (real)0.5, zero = 0, outside = OUTSIDE;
    const masks inside = (column >= (real)0) & (column < (real)width);
    const real py = y + (real)0.5;
    const reals u_0 = m[0] * px + (m[1] * py + m[2]), v_0 = m[3] * px + (m[4] * py + m[5]);
    const reals z_0 = m[6] * px + (m[7] * py + m[8]);
    for (uint d = 0; d < count; ++d) {
        const real q = planes[first + d];
        const reals z = z_0 + q * m[11];
        const reals u = (u_0 + q * m[9]) / z - (real)0.5, v = (v_0 + q * m[10]) / z - (real)0.5;
        // Comparisons with NaN are false.
        const masks shown =
            (z > (real)0) & (u >= (real)0) & (v >= (real)0) & (u <= (real)(columns - 1)) & (v <= (real)(rows - 1));
        const reals u_max = LESSER(shown ? u : zero, (reals)(real)(columns - 2));
        const reals v_max = LESSER(shown ? v : zero, (reals)(real)(rows - 2));
        reals right, low;
        Pairs uppers, lowers; // of neighbours in a row: gathering single numbers takes longer
        _Pragma("unroll") for (int lane = 0; lane < LANES; ++lane) {
            const int left = LANE(u_max, lane), top = LANE(v_max, lane);
            const __global real *corner = &source[top * columns + left];
            IN_LANE(right, lane) = LANE(u, lane) - left;
            IN_LANE(low, lane) = LANE(v, lane) - top;
            ((real2 *)&uppers)[lane] = load2(corner, 0);
            ((real2 *)&lowers)[lane] = load2(corner + columns, 0);
        }
        const reals upper = uppers.even + right * (uppers.odd - uppers.even);
        const reals lower = lowers.even + right * (lowers.odd - lowers.even);
        const reals value = shown ? upper + low * (lower - upper) : outside;
        STORE(&warped[((s * count + d) * height + y) * stride + x + PAD], inside ? value : zero);
    }
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

__kernel void sweep_scores(const int width, const int height, const int stride, const uint sources, const uint first,
                           const uint count, const __global real *padded, const __global real *windows,
                           const __global uchar *textured, const __global real *warped, __global real *scores) {
    const int x = LANES * get_global_id(0), begin = ROWS * get_global_id(1), end = LESSER(begin + ROWS, height);
    const size_t d = get_global_id(2), size = (size_t)height * stride;
    const reals column = LANE_NUMBERS + (real)x, least = (real)VARIANCE_MIN;
    const masks columns = (column >= (real)RADIUS) & (column < (real)(width - RADIUS));
    const __global real *a = padded + x + PAD;
    reals most[ROWS], second[ROWS]; // the two largest similarities so far
    UNROLLED for (int i = 0; i < ROWS; ++i) most[i] = second[i] = -1;
    bool any = false;
    for (int y = begin; y < end; ++y)
        any |= textured[(y * stride + x + PAD) / LANES];
    for (uint s = 0; any && s < sources; ++s) {
        const __global real *b = warped + (s * count + d) * size + x + PAD;
        Sums rows[WINDOW]; // of the last rows
        UNROLLED for (int i = -RADIUS; i < RADIUS; ++i) {
            const int y = begin + i;
            if (y >= 0 && y < height)
                rows[PLACE(i)] = row_sums(a + (size_t)y * stride, b + (size_t)y * stride);
        }
        UNROLLED for (int i = 0; i < ROWS; ++i) {
            const int y = begin + i, next = y + RADIUS;
            if (next >= height)
                break;
            rows[PLACE(i + RADIUS)] = row_sums(a + (size_t)next * stride, b + (size_t)next * stride);
            if (y < RADIUS)
                continue;
            reals sum_b = 0, sum_ab = 0, sum_bb = 0;
            _Pragma("unroll") for (int j = 0; j < WINDOW; ++j) {
                sum_b += rows[j].b;
                sum_ab += rows[j].ab;
                sum_bb += rows[j].bb;
            }
            const __global real *window = windows + (size_t)y * stride + x + PAD;
            const reals mean_a = LOAD(window), var_a = LOAD(window + size), none = -1;
            const reals mean_b = SHARE * sum_b, var_b = SHARE * sum_bb - mean_b * mean_b;
            const reals root = ROOTS(GREATER(var_a, least) * GREATER(var_b, least));
            const masks known = columns & (var_a >= least) & (sum_b < (reals)(real)(OUTSIDE / 2));
            const reals similarity = known ? (SHARE * sum_ab - mean_a * mean_b) / root : none;
            const reals previous = most[i];
            most[i] = GREATER(previous, similarity);
            second[i] = similarity > previous ? previous : GREATER(second[i], similarity);
        }
    }
    UNROLLED for (int i = 0; i < ROWS; ++i) {
        if (begin + i >= height)
            break;
        const reals score = (real)0.5 * (most[i] + second[i]);
        __global real *row = &scores[((first + d) * height + begin + i) * width + x];
        if (x + LANES <= width) {
            STORE(row, score);
        } else {
            for (int lane = 0; x + lane < width; ++lane)
                row[lane] = LANE(score, lane);
        }
    }
}

__kernel void sweep_best(const uint pixels, const uint count, const __global real *scores,
                         const __global real *planes, __global real *inverse, __global real *largest) {
    const size_t i = get_global_id(0);
    if (i >= pixels)
        return;
    uint best = 0;
    real most = scores[i], before = most, after = most, last = most;
    for (uint d = 1; d < count; ++d) {
        const real score = scores[d * (size_t)pixels + i];
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
    largest[i] = inner ? most : -1;
}
