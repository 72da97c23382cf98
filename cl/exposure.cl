// Stage exposure: a photo's map of an image's colours, and its gradients.
//
//   y = A x + b per pixel   (Rematas et al. 2022, "Urban radiance fields", section 3.2; Kerbl et al. 2024, "A
//                            hierarchical 3D Gaussian representation", has the same 3x4 matrix per photo)
//   with RESPONSE   y = A x + b + c x (1 - x) + f r^2 x,   c, f per channel, r = 1 in the corners, 0 in the middle
//                            (a curve of the camera's response and the vignetting of its lens, each to first order)
//   v_x = A^T v_y,  v_A = sum of v_y x^T,  v_b = sum of v_y,  v_c = sum of v_y x (1 - x),  v_f = sum of v_y r^2 x
// A camera clips: y is clamped to at most 1 where the photo is 255, and to at least 0 where it is 0. There v_y is 0.
// See docs/stages/exposure.md; clsplat/reference/exposure.py is the twin.
//
// Mapping: exposure_fwd has one work-item per pixel. In exposure_bwd, work-item i has at most `count` pixels: i first,
// i first + step, and so on. On a CPU they are adjacent (step 1). On a GPU, step is the number of work-items, so that
// adjacent work-items access adjacent pixels. Sums have a fixed order: within a work-item, then over `parts`, on the
// host.
//
// Buffers, P pixels: in image[P,3] (x), photo[P,3] uchar; out adjusted[P,3] (y); in and out v_image[P,3], first v_y,
//   then v_x; out parts[work-items,12], the gradient of (A, b) row by row, with RESPONSE parts[work-items,18], followed
//   by those of c and f.
// affine holds the rows of (A, b), four values each, and four unused values; response holds c and f, three values each,
// and two unused ones.
// -DRESPONSE=0|1  1: with c and f; the kernels take `response`, and the width and height of the image
#include "common.h"

#if !defined(RESPONSE) || RESPONSE & ~1
#error "-DRESPONSE must be 0 or 1"
#endif

#if RESPONSE
#define ARGUMENTS , const real8 response, const int width, const int height
#define SUMS      18

static inline real squared_radius(const size_t i, const int width, const int height) {
    const real2 size = (real2)(width, height), at = 2 * (real2)(i % width, i / width) + 1 - size;
    return (at.x * at.x + at.y * at.y) / (size.x * size.x + size.y * size.y);
}

static inline real3 bent(const real8 response, const real r2, const real3 x) {
    return response.s012 * x * (1 - x) + response.s345 * r2 * x;
}
#define BENT(i, x) bent(response, squared_radius(i, width, height), x)
#else
#define ARGUMENTS
#define SUMS       12
#define BENT(i, x) 0
#endif

static inline real3 mapped(const real16 affine, const real3 x) {
    return affine.s048 * x.x + affine.s159 * x.y + affine.s26a * x.z + affine.s37b;
}

// True if a channel lies beyond the limit at which the camera has clipped the photo.
static inline int beyond(const real y, const uchar photo) {
    return (photo == 255 && y > 1) || (photo == 0 && y < 0);
}

__kernel void exposure_fwd(const uint pixels, const real16 affine, const __global real *image,
                           const __global uchar *photo, __global real *adjusted ARGUMENTS) {
    const size_t i = get_global_id(0);
    if (i >= pixels)
        return;
    const real3 x = load3(image, i);
    real3 y = mapped(affine, x) + BENT(i, x);
    const uchar3 seen = vload3(i, photo);
    y.x = beyond(y.x, seen.x) ? clamp(y.x, (real)0, (real)1) : y.x;
    y.y = beyond(y.y, seen.y) ? clamp(y.y, (real)0, (real)1) : y.y;
    y.z = beyond(y.z, seen.z) ? clamp(y.z, (real)0, (real)1) : y.z;
    store3(adjusted, i, y);
}

__kernel void exposure_bwd(const uint pixels, const uint items, const uint first, const uint step, const uint count,
                           const real16 affine, const __global real *image, const __global uchar *photo,
                           __global real *v_image, __global real *parts ARGUMENTS) {
    const size_t item = get_global_id(0);
    if (item >= items)
        return;
    real3 by_x = 0, by_y = 0, by_z = 0, by_1 = 0; // columns of the gradient of (A, b)
#if RESPONSE
    real3 by_curve = 0, by_falloff = 0;
#endif
    size_t i = item * first;
    for (uint k = 0; k < count && i < pixels; ++k, i += step) {
        const real3 x = load3(image, i), y = mapped(affine, x) + BENT(i, x);
        const uchar3 seen = vload3(i, photo);
        real3 v = load3(v_image, i);
        v.x = beyond(y.x, seen.x) ? 0 : v.x;
        v.y = beyond(y.y, seen.y) ? 0 : v.y;
        v.z = beyond(y.z, seen.z) ? 0 : v.z;
        by_x += v * x.x;
        by_y += v * x.y;
        by_z += v * x.z;
        by_1 += v;
        real3 v_x = affine.s012 * v.x + affine.s456 * v.y + affine.s89a * v.z;
#if RESPONSE
        const real r2 = squared_radius(i, width, height);
        by_curve += v * x * (1 - x);
        by_falloff += v * r2 * x;
        v_x += v * (response.s012 * (1 - 2 * x) + response.s345 * r2);
#endif
        store3(v_image, i, v_x);
    }
    parts += SUMS * item;
    for (int row = 0; row < 3; ++row)
        store4(parts, row,
               (real4)(((const real *)&by_x)[row], ((const real *)&by_y)[row], ((const real *)&by_z)[row],
                       ((const real *)&by_1)[row]));
#if RESPONSE
    store3(parts, 4, by_curve);
    store3(parts, 5, by_falloff);
#endif
}
