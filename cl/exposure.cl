// Stage exposure: an affine map of an image's colours, and gradients back.
//
//   y = A x + b per pixel   (Rematas et al. 2022, "Urban radiance fields", section 3.2; Kerbl et al. 2024, "A hierarchical
//                            3D Gaussian representation", has the same 3x4 matrix per photo)
//   v_x = A^T v_y,  v_A = sum of v_y x^T,  v_b = sum of v_y
// docs/stages/exposure.md; clsplat/reference/exposure.py is the twin.
//
// Mapping: exposure_fwd has one work-item per pixel. In exposure_bwd work-item i has the pixels i first, i first + step,
// ..., `count` of them at most: neighbours on a CPU (step 1), on a GPU as far apart as there are work-items, so that
// those touch neighbours together. Sums have a fixed order: within a work-item, then over `parts`, on the host.
//
// Buffers, P pixels: in image[P,3] (x); out adjusted[P,3] (y); in and out v_image[P,3], v_y before and v_x after;
//   out parts[work-items,12], the gradient of (A, b) row by row.
// affine holds the rows of (A, b), four values each, and four that are not read.
#include "common.h"

__kernel void exposure_fwd(const uint pixels, const real16 affine, const __global real *image,
                           __global real *adjusted) {
    const size_t i = get_global_id(0);
    if (i >= pixels)
        return;
    const real3 x = load3(image, i);
    store3(adjusted, i, affine.s048 * x.x + affine.s159 * x.y + affine.s26a * x.z + affine.s37b);
}

__kernel void exposure_bwd(const uint pixels, const uint items, const uint first, const uint step, const uint count,
                           const real16 affine, const __global real *image, __global real *v_image,
                           __global real *parts) {
    const size_t item = get_global_id(0);
    if (item >= items)
        return;
    real3 by_x = 0, by_y = 0, by_z = 0, by_1 = 0; // columns of the gradient of (A, b)
    size_t i = item * first;
    for (uint k = 0; k < count && i < pixels; ++k, i += step) {
        const real3 x = load3(image, i), v = load3(v_image, i);
        by_x += v * x.x;
        by_y += v * x.y;
        by_z += v * x.z;
        by_1 += v;
        store3(v_image, i, affine.s012 * v.x + affine.s456 * v.y + affine.s89a * v.z);
    }
    for (int row = 0; row < 3; ++row)
        store4(parts, 3 * item + row,
               (real4)(((const real *)&by_x)[row], ((const real *)&by_y)[row], ((const real *)&by_z)[row],
                       ((const real *)&by_1)[row]));
}
