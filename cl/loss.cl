// Stage loss: (1 - lambda) L1 + lambda (1 - SSIM) of an image against a photo, and its gradient.
//
//   SSIM = (2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sxx + syy + C2))   (Wang et al. 2004, equation 13)
// with Gaussian-weighted moments over an 11x11 window, zero padding and population variances; both terms are
// means over all pixels and channels (Kerbl et al. 2023, equation 7). A mask weights image and photo alike
// before either term. docs/stages/loss.md derives the gradient; clsplat/reference/loss.py is the twin.
//
// How does it work? The window is separable. Planes with margins of zeros wide enough for the window need no
// borders.
//   loss_planes      image and photo, masked, to planes
//   loss_blur_rows   the five moments x, y, xx, yy, xy blurred along rows
//   loss_ssim        the same along columns; SSIM's sum; its derivatives by mx, E[xx] and E[xy]
//   loss_blur_rows3  the derivatives blurred along rows (the window is symmetric: its own adjoint)
//   loss_grad        the same along columns, combined to v_image; L1's sum
// Mapping: one work-item per pixel (loss_planes) or per segment (the others): SEGMENT neighbouring pixels of a row,
// one vector.
//
// Buffers: image[H,W,3], photo[H,W,3] u8, mask[H,W] u8 (0 or 1; not read where masked is 0), v_image[H,W,3];
//   a plane is [3, HEIGHT + 2 RADIUS, pitch] with its pixel (0, 0) at row RADIUS, column SEGMENT;
//   x, y: one plane; moments: five, derivatives: three, blurred: three; ssim_sums, l1_sums[3, H, segments].
// -DSSIM_C1, -DSSIM_C2     stabilisers
// -DSSIM_TAPS=w0,w1,..     the 2 RADIUS + 1 weights of the window
// -DRADIUS                 half width of the window, px, at most SEGMENT
#include "common.h"

#if !defined(SSIM_C1) || !defined(SSIM_C2) || !defined(SSIM_TAPS) || !defined(RADIUS)
#error "-DSSIM_C1, -DSSIM_C2, -DSSIM_TAPS and -DRADIUS must be given"
#endif

#define SEGMENT 16
#if RADIUS < 0 || RADIUS > SEGMENT
#error "-DRADIUS must be 0 to 16, the margin of a plane"
#endif

__constant real taps[2 * RADIUS + 1] = {SSIM_TAPS};

typedef struct {
    int width, height, pitch;
    size_t plane; // reals in three channels
} Layout;

static inline Layout layout_of(int width, int height) {
    Layout l = {width, height, (width + SEGMENT - 1) / SEGMENT * SEGMENT + 2 * SEGMENT, 0};
    l.plane = (size_t)3 * (height + 2 * RADIUS) * l.pitch;
    return l;
}

static inline size_t plane_index(Layout l, int channel, int row, int column) {
    return ((size_t)channel * (l.height + 2 * RADIUS) + row + RADIUS) * l.pitch + SEGMENT + column;
}

__kernel void loss_planes(const int width, const int height, const __global real *image, const __global uchar *photo,
                          const int masked, const __global uchar *mask, __global real *x, __global real *y) {
    const int column = get_global_id(0), row = get_global_id(1);
    const Layout l = layout_of(width, height);
    const size_t pixel = (size_t)row * width + column;
    const real weight = masked ? mask[pixel] : 1;
    for (int c = 0; c < 3; ++c) {
        const size_t i = plane_index(l, c, row, column);
        x[i] = weight * image[3 * pixel + c];
        y[i] = weight * photo[3 * pixel + c] / 255;
    }
}

// Columns beyond the image, inside the last segment, are written too: they must be 0 where a later pass reads
// them.
static inline real16 inside(Layout l, int column, real16 value) {
    const real16 columns = (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) + (real)column;
    return columns < (real16)l.width ? value : (real16)0;
}

__kernel void loss_blur_rows(const int width, const int height, const __global real *x, const __global real *y,
                             __global real *moments) {
    const int column = get_global_id(0) * SEGMENT, row = get_global_id(1), channel = get_global_id(2);
    const Layout l = layout_of(width, height);
    const size_t i = plane_index(l, channel, row, column);
    real16 mx = 0, my = 0, xx = 0, yy = 0, xy = 0;
    for (int k = 0; k <= 2 * RADIUS; ++k) {
        const real16 a = vload16(0, x + i + k - RADIUS), b = vload16(0, y + i + k - RADIUS);
        const real16 wa = taps[k] * a, wb = taps[k] * b;
        mx += wa;
        my += wb;
        xx += wa * a;
        yy += wb * b;
        xy += wa * b;
    }
    vstore16(mx, 0, moments + i);
    vstore16(my, 0, moments + l.plane + i);
    vstore16(xx, 0, moments + 2 * l.plane + i);
    vstore16(yy, 0, moments + 3 * l.plane + i);
    vstore16(xy, 0, moments + 4 * l.plane + i);
}

static inline real16 blur_columns(Layout l, const __global real *plane, size_t i) {
    real16 sum = 0;
    for (int k = 0; k <= 2 * RADIUS; ++k)
        sum += taps[k] * vload16(0, plane + i + (k - RADIUS) * l.pitch);
    return sum;
}

static inline real sum16(real16 v) {
    const real8 a = v.lo + v.hi;
    const real4 b = a.lo + a.hi;
    const real2 c = b.lo + b.hi;
    return c.x + c.y;
}

__kernel void loss_ssim(const int width, const int height, const __global real *moments, __global real *derivatives,
                        __global real *ssim_sums) {
    const int column = get_global_id(0) * SEGMENT, row = get_global_id(1), channel = get_global_id(2);
    const Layout l = layout_of(width, height);
    const size_t i = plane_index(l, channel, row, column);
    const real16 mx = blur_columns(l, moments, i), my = blur_columns(l, moments + l.plane, i);
    const real16 exx = blur_columns(l, moments + 2 * l.plane, i), eyy = blur_columns(l, moments + 3 * l.plane, i);
    const real16 exy = blur_columns(l, moments + 4 * l.plane, i);

    const real16 a1 = 2 * mx * my + SSIM_C1, a2 = 2 * (exy - mx * my) + SSIM_C2;
    const real16 b1 = mx * mx + my * my + SSIM_C1, b2 = exx - mx * mx + eyy - my * my + SSIM_C2;
    const real16 inv_b = 1 / (b1 * b2), ssim = a1 * a2 * inv_b;
    const real16 by_mx = 2 * my * (a2 - a1) * inv_b - 2 * mx * ssim * (1 / b1 - 1 / b2);
    vstore16(inside(l, column, by_mx), 0, derivatives + i);
    vstore16(inside(l, column, -ssim / b2), 0, derivatives + l.plane + i);
    vstore16(inside(l, column, 2 * a1 * inv_b), 0, derivatives + 2 * l.plane + i);
    ssim_sums[(channel * height + row) * get_global_size(0) + get_global_id(0)] = sum16(inside(l, column, ssim));
}

__kernel void loss_blur_rows3(const int width, const int height, const __global real *derivatives,
                              __global real *blurred) {
    const int column = get_global_id(0) * SEGMENT, row = get_global_id(1), channel = get_global_id(2);
    const Layout l = layout_of(width, height);
    for (int plane = 0; plane < 3; ++plane) {
        const size_t i = plane * l.plane + plane_index(l, channel, row, column);
        real16 sum = 0;
        for (int k = 0; k <= 2 * RADIUS; ++k)
            sum += taps[k] * vload16(0, derivatives + i + k - RADIUS);
        vstore16(sum, 0, blurred + i);
    }
}

// l1_weight and ssim_weight are (1 - lambda) and lambda over the number of values, 3 W H.
__kernel void loss_grad(const int width, const int height, const real l1_weight, const real ssim_weight,
                        const int masked, const __global uchar *mask, const __global real *x, const __global real *y,
                        const __global real *blurred, __global real *v_image, __global real *l1_sums) {
    const int column = get_global_id(0) * SEGMENT, row = get_global_id(1), channel = get_global_id(2);
    const Layout l = layout_of(width, height);
    const size_t i = plane_index(l, channel, row, column);
    const real16 a = vload16(0, x + i), b = vload16(0, y + i);
    const real16 v_ssim = blur_columns(l, blurred, i) + 2 * a * blur_columns(l, blurred + l.plane, i) +
                          b * blur_columns(l, blurred + 2 * l.plane, i);
    const real16 v = l1_weight * sign(a - b) - ssim_weight * v_ssim;
    l1_sums[(channel * height + row) * get_global_size(0) + get_global_id(0)] = sum16(fabs(a - b));
    const size_t first = (size_t)row * width + column;
    for (int k = 0; k < min(SEGMENT, width - column); ++k) {
        const real weight = masked ? mask[first + k] : 1;
        v_image[3 * (first + k) + channel] = weight * ((const real *)&v)[k];
    }
}
