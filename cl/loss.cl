// Stage loss: (1 - lambda) L1 + lambda (1 - SSIM) of an image and a photo, and its gradient.
//
//   SSIM = (2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sxx + syy + C2))   (Wang et al. 2004, equation 13)
// with Gaussian-weighted moments over an 11x11 window, zero padding and population variances. Both terms are means
// over all pixels and channels (Kerbl et al. 2023, equation 7). A mask weights both image and photo before either
// term. docs/stages/loss.md derives the gradient; clsplat/reference/loss.py is the twin.
//
// The window is separable. A row of interleaved channels has 3 W values, in which the taps of the window are 3 apart,
// so that adjacent values form a vector regardless of their channels. A work-item goes down the rows of its band. It
// blurs each along the row, and keeps the blurred rows that the window spans in a ring, from which it blurs along
// columns. So the moments stay in private memory.
//   loss_ssim  blurs four moments of image x and photo y: mx, my, E[xx + yy] (SSIM only needs the sum of the
//              variances), E[xy]; writes the derivatives of SSIM by mx, E[xx], E[xy], and parts of the loss
//   loss_sum   adds up the parts
//   loss_grad  blurs the derivatives (the symmetric window is its own adjoint), and combines them to v_image
// Mapping: loss_ssim and loss_grad have one work-item for VECTORS adjacent vectors of LANES values in a band of `band`
// rows. Together they cover each row, MARGIN values before it, and at least MARGIN values after it. loss_sum is one
// work-group. Sums have a fixed order: within a work-item, then in a work-group (as a tree), then in loss_sum.
//
// Buffers: image[H,W,3], photo[H,W,3] u8, mask[H,W] u8 (0 or 1; not read if masked is 0), v_image[H,W,3];
//   derivatives[H,3,pitch], whose rows begin with the margin; loss_ssim fills the margins with zeros, so that
//   loss_grad needs no bounds checks; parts, one per work-group of loss_ssim; loss[1].
// -DSSIM_C1, -DSSIM_C2     stabilisers
// -DSSIM_TAPS=w0,w1,..     the 2 RADIUS + 1 weights of the window
// -DRADIUS                 half width of the window, px, 1 or more
// -DLANES=1|16             values per vector: 16 on CPUs; 1 on GPUs, so that work-items access adjacent values
// -DVECTORS                vectors per work-item; 1 if LANES is 1
// -DGROUP                  size of the largest work-group; sizes are powers of two
#include "common.h"

#if !defined(SSIM_C1) || !defined(SSIM_C2) || !defined(SSIM_TAPS) || !defined(RADIUS)
#error "-DSSIM_C1, -DSSIM_C2, -DSSIM_TAPS and -DRADIUS must be given"
#endif
#if RADIUS < 1
#error "-DRADIUS must be 1 or more"
#endif
#if LANES != 1 && LANES != 16
#error "-DLANES must be 1 or 16"
#endif
#if !defined(VECTORS) || VECTORS < 1 || (LANES == 1 && VECTORS != 1)
#error "-DVECTORS must be 1 or more, and 1 where -DLANES is"
#endif
#if !defined(GROUP) || GROUP < 1
#error "-DGROUP must be 1 or more"
#endif

#define WINDOW (2 * RADIUS + 1)

// A work-item loads FETCHED values of each row, STEP apart. Those for tap k of its first vector begin at TAP(k).
#if LANES == 1
typedef real reals;
#define INDICES          0
#define MARGIN           (3 * RADIUS)
#define STEP             3
#define FETCHED          WINDOW
#define TAP(k)           (k)
#define VECTOR(space, p) (*(p))
#else
typedef real16 reals;
#define INDICES          ((real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define MARGIN           ((3 * RADIUS + LANES - 1) / LANES * LANES)
#define STEP             1
#define FETCHED          (VECTORS * LANES + 2 * MARGIN)
#define TAP(k)           (MARGIN + 3 * ((k)-RADIUS))

// The vector at any address. PoCL 3.0 calls vload16 and vstore16 as functions, which doubles the time of loss_grad.
typedef struct __attribute__((packed)) {
    reals v;
} Vector;
typedef struct __attribute__((packed)) {
    uchar16 v;
} Bytes;
#define VECTOR(space, p) (((space Vector *)(p))->v)

static inline reals load_photo(const __global uchar *photo) {
    const uchar16 bytes = ((const __global Bytes *)photo)->v;
#ifdef USE_DOUBLE
    return OF16(convert_double4, bytes) * (1 / (real)255);
#else
    return OF16(convert_float8, bytes) * (1 / (real)255);
#endif
}
#endif

__constant real taps[WINDOW] = {SSIM_TAPS};
// Beginning with entry 2 RADIUS - newest, the taps in the order of their rows in a ring.
__constant real turned_taps[2 * WINDOW] = {SSIM_TAPS, SSIM_TAPS};

static inline real sum_lanes(reals v) {
#if LANES == 1
    return v;
#else
    const real8 a = v.lo + v.hi;
    const real4 b = a.lo + a.hi;
    const real2 c = b.lo + b.hi;
    return c.x + c.y;
#endif
}

// The sum over the work-group, for its first work-item.
static inline real sum_group(real value, __local real *sums) {
    const int i = get_local_id(0);
    sums[i] = value;
    for (int n = get_local_size(0) / 2; n > 0; n /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (i < n)
            sums[i] += sums[i + n];
    }
    return sums[i];
}

// Image and photo in column c of a row of `length` values that begins at `begin`: masked, and 0 outside of the image.
static inline void fetch_value(int length, size_t begin, int c, const __global real *image,
                               const __global uchar *photo, int masked, const __global uchar *mask, real *x,
                               real *y) {
    const bool counts = c >= 0 && c < length && !(masked && mask[(begin + c) / 3] == 0);
    *x = counts ? image[begin + c] : 0;
    *y = counts ? photo[begin + c] * (1 / (real)255) : 0;
}

// The same for LANES columns, beginning with `column`. A loop over one lane would keep Intel's compiler from holding
// x and y in registers.
static inline void fetch(int length, int row, int column, const __global real *image, const __global uchar *photo,
                         int masked, const __global uchar *mask, real *x, real *y) {
    const size_t begin = (size_t)row * length;
#if LANES == 1
    fetch_value(length, begin, column, image, photo, masked, mask, x, y);
#else
    if (column >= 0 && column + LANES <= length && !masked) {
        // Of the next row: processors do not foresee reads in another page.
        FETCH_TO_READ(image + begin + length + column);
        FETCH_TO_READ(photo + begin + length + column);
        VECTOR(__private, x) = VECTOR(const __global, image + begin + column);
        VECTOR(__private, y) = load_photo(photo + begin + column);
        return;
    }
    for (int k = 0; k < LANES; ++k)
        fetch_value(length, begin, column + k, image, photo, masked, mask, x + k, y + k);
#endif
}

typedef struct {
    reals mx, my, square, xy; // square: E[xx + yy]
} Moments;

static inline Moments blur_row(const real *x, const real *y) {
    Moments m = {0, 0, 0, 0};
#pragma unroll
    for (int k = 0; k < WINDOW; ++k) {
        const reals a = VECTOR(const, x + TAP(k)), b = VECTOR(const, y + TAP(k));
        const reals wa = taps[k] * a, wb = taps[k] * b;
        m.mx += wa;
        m.my += wb;
        m.square += wa * a + wb * b;
        m.xy += wa * b;
    }
    return m;
}

static inline Moments blur_columns(const Moments *ring, int newest) {
    Moments m = {0, 0, 0, 0};
#pragma unroll
    for (int k = 0; k < WINDOW; ++k) {
        const real w = turned_taps[2 * RADIUS - newest + k];
        m.mx += w * ring[k].mx;
        m.my += w * ring[k].my;
        m.square += w * ring[k].square;
        m.xy += w * ring[k].xy;
    }
    return m;
}

typedef struct {
    reals mx, xx, xy;
} Derivatives;

// The rings hold the last WINDOW rows. On a CPU, the newest row takes the place of the oldest one. On a GPU, the rows
// move instead, and the newest is the last one: indices that are not constants would keep a ring out of the registers.
#if LANES == 1
#define NEWEST       (WINDOW - 1)
#define NEXT(newest) (newest)
#else
#define NEWEST       0
#define NEXT(newest) ((newest + 1) % WINDOW)
#endif

// Returns 1 - SSIM.
static inline reals differentiate(Moments m, Derivatives *d) {
    const reals a1 = 2 * m.mx * m.my + SSIM_C1, a2 = 2 * (m.xy - m.mx * m.my) + SSIM_C2;
    const reals b1 = m.mx * m.mx + m.my * m.my + SSIM_C1, b2 = m.square - m.mx * m.mx - m.my * m.my + SSIM_C2;
    const reals inv_b = 1 / (b1 * b2), ssim = a1 * a2 * inv_b;
    d->mx = 2 * inv_b * (m.my * (a2 - a1) - m.mx * ssim * (b2 - b1));
    d->xx = -ssim * b1 * inv_b;
    d->xy = 2 * a1 * inv_b;
    return 1 - ssim;
}

// 0 in lanes outside of the image.
static inline reals inside(int length, int column, reals v) {
    const reals columns = INDICES + (reals)column;
    return columns >= 0 && columns < (reals)length ? v : (reals)0;
}

// l1_weight and ssim_weight are (1 - lambda) and lambda over the number of values, 3 W H.
__kernel void loss_ssim(const int width, const int height, const int band, const real l1_weight,
                        const real ssim_weight, const __global real *image, const __global uchar *photo,
                        const int masked, const __global uchar *mask, __global real *derivatives,
                        __global real *parts) {
    const int length = 3 * width, column = (int)get_global_id(0) * VECTORS * LANES - MARGIN;
    const int begin = get_global_id(1) * band, end = min(begin + band, height);
    const size_t pitch = get_global_size(0) * VECTORS * LANES;
    const int vectors = min(VECTORS, (length + MARGIN - column + LANES - 1) / LANES);
    reals l1 = 0, dissimilarity = 0;
    const Moments none = {0, 0, 0, 0};
    Moments ring[VECTORS][WINDOW];
    real x[FETCHED], y[FETCHED];
#if LANES == 1
#pragma unroll
    for (int k = 0; k < WINDOW; ++k)
        ring[0][k] = none;
#endif
    for (int row = begin - RADIUS, newest = NEWEST; row < end + RADIUS; ++row, newest = NEXT(newest)) {
        const bool exists = row >= 0 && row < height;
#if LANES == 1
#pragma unroll
        for (int i = 0; i < FETCHED; ++i) {
            x[i] = y[i] = 0;
            if (exists)
                fetch(length, row, column + STEP * (i - TAP(RADIUS)), image, photo, masked, mask, x + i, y + i);
        }
#pragma unroll
        for (int k = 0; k < WINDOW - 1; ++k)
            ring[0][k] = ring[0][k + 1];
#else
        for (int i = 0; exists && i < FETCHED - (VECTORS - vectors) * LANES; i += LANES)
            fetch(length, row, column - STEP * TAP(RADIUS) + STEP * i, image, photo, masked, mask, x + i, y + i);
#endif
        for (int v = 0; v < vectors; ++v) {
            ring[v][newest] = exists ? blur_row(x + v * LANES, y + v * LANES) : none;
            const int c = column + v * LANES, centre = TAP(RADIUS) + v * LANES;
            if (row >= begin && row < end) {
                const reals difference = VECTOR(const, x + centre) - VECTOR(const, y + centre);
                l1 += difference < 0 ? -difference : difference; // both are 0 outside of the image
            }
            if (row - RADIUS < begin)
                continue;
            Derivatives d;
            dissimilarity += inside(length, c, differentiate(blur_columns(ring[v], newest), &d));
            __global real *out = derivatives + (size_t)(row - RADIUS) * 3 * pitch + MARGIN + c;
            VECTOR(__global, out) = inside(length, c, d.mx);
            VECTOR(__global, out + pitch) = inside(length, c, d.xx);
            VECTOR(__global, out + 2 * pitch) = inside(length, c, d.xy);
        }
    }

    __local real sums[GROUP];
    const real part = sum_group(l1_weight * sum_lanes(l1) + ssim_weight * sum_lanes(dissimilarity), sums);
    if (get_local_id(0) == 0)
        parts[get_group_id(1) * get_num_groups(0) + get_group_id(0)] = part;
}

__kernel void loss_sum(const uint count, const __global real *parts, __global real *loss) {
    __local real sums[GROUP];
    real sum = 0;
    for (uint i = get_local_id(0); i < count; i += get_local_size(0))
        sum += parts[i];
    sum = sum_group(sum, sums);
    if (get_local_id(0) == 0)
        loss[0] = sum;
}

__kernel void loss_grad(const int width, const int height, const int band, const real l1_weight,
                        const real ssim_weight, const __global real *image, const __global uchar *photo,
                        const int masked, const __global uchar *mask, const __global real *derivatives,
                        __global real *v_image) {
    const int length = 3 * width, column = (int)get_global_id(0) * VECTORS * LANES - MARGIN;
    const int begin = get_global_id(1) * band, end = min(begin + band, height);
    const size_t pitch = get_global_size(0) * VECTORS * LANES;
    Derivatives ring[VECTORS][WINDOW];
#if LANES == 1
#pragma unroll
    for (int k = 0; k < WINDOW; ++k)
        ring[0][k] = (Derivatives){0, 0, 0};
#endif
    for (int row = begin - RADIUS, newest = NEWEST; row < end + RADIUS; ++row, newest = NEXT(newest)) {
#if LANES == 1
#pragma unroll
        for (int k = 0; k < WINDOW - 1; ++k)
            ring[0][k] = ring[0][k + 1];
#endif
        for (int v = 0; v < VECTORS; ++v) {
            const int c = column + v * LANES;
            if (c < 0 || c >= length)
                continue;
            Derivatives d = {0, 0, 0};
            if (row >= 0 && row < height) {
                const __global real *in = derivatives + (size_t)row * 3 * pitch + MARGIN + c;
                for (int next = 3; next < 6; ++next)
                    FETCH_TO_READ(in + next * pitch);
#pragma unroll
                for (int k = 0; k < WINDOW; ++k) {
                    const int tap = 3 * (k - RADIUS);
                    d.mx += taps[k] * VECTOR(const __global, in + tap);
                    d.xx += taps[k] * VECTOR(const __global, in + pitch + tap);
                    d.xy += taps[k] * VECTOR(const __global, in + 2 * pitch + tap);
                }
            }
            ring[v][newest] = d;
            const int here = row - RADIUS;
            if (here < begin)
                continue;

            Derivatives g = {0, 0, 0};
#pragma unroll
            for (int k = 0; k < WINDOW; ++k) {
                const real w = turned_taps[2 * RADIUS - newest + k];
                g.mx += w * ring[v][k].mx;
                g.xx += w * ring[v][k].xx;
                g.xy += w * ring[v][k].xy;
            }
            real x[LANES], y[LANES];
            fetch(length, here, c, image, photo, masked, mask, x, y);
            const reals a = VECTOR(const, x), b = VECTOR(const, y);
            const reals v_l1 = a > b ? (reals)l1_weight : a < b ? (reals)-l1_weight : (reals)0;
            const reals v_ssim = g.mx + 2 * a * g.xx + b * g.xy;
            const reals value = v_l1 - ssim_weight * v_ssim;
            const size_t i = (size_t)here * length + c;
            if (c + LANES <= length && !masked)
                VECTOR(__global, v_image + i) = value;
            else
                for (int k = 0; k < min(LANES, length - c); ++k)
                    v_image[i + k] = masked && mask[(i + k) / 3] == 0 ? 0 : ((const real *)&value)[k];
        }
    }
}
