// Stage disparity: composites inverse depths, and compares them with those of a depth map.
//
//   d = sum of w_i / z_i per pixel, with the weights w_i = alpha_i T_i of compositing
//   loss = weight * sum of |d - t| over the pixels with t > 0   (Kerbl et al. 2024, "A hierarchical 3D Gaussian
//                                                                representation"; original code)
//   v_d = weight * sign(d - t),   v_z = -v_color / z^2 for the fourth channel of a splat's colour
// See docs/stages/disparity.md; clsplat/reference/disparity.py is the twin.
//
// Mapping: one work-item per splat, or per pixel. In disparity_loss, work-item i has at most `count` pixels: i first,
// i first + step, and so on: adjacent on a CPU, and on a GPU separated by the number of work-items. Sums have a fixed
// order: within a work-item, then over `parts`, on the host.
//
// Buffers, N splats, P pixels:
//   in      depths[N] world units, 0 for an invisible splat; target[P], t in 1/world units, 0 where it is unknown;
//           image[P,4] (RGB, then d); v_rgb[P,3]
//   in, out colors[N,4], whose fourth channel becomes 1/z; v_colors[N,4], whose fourth channel becomes v_z
//   out     rgb[P,3]; parts[work-items], sums of |d - t|; v_image[P,4] (v_rgb, then v_d)
#include "common.h"

__kernel void disparity_fwd(const uint n, const __global real *depths, __global real *colors) {
    const size_t i = get_global_id(0);
    if (i < n)
        colors[4 * i + 3] = depths[i] > 0 ? 1 / depths[i] : 0;
}

__kernel void disparity_bwd(const uint n, const __global real *depths, __global real *v_colors) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const real inverse = depths[i] > 0 ? 1 / depths[i] : 0;
    v_colors[4 * i + 3] *= -inverse * inverse;
}

__kernel void disparity_loss(const uint pixels, const uint items, const uint first, const uint step, const uint count,
                             const __global real *image, const __global real *target, __global real *rgb,
                             __global real *parts) {
    const size_t item = get_global_id(0);
    if (item >= items)
        return;
    real sum = 0;
    size_t i = item * first;
    for (uint k = 0; k < count && i < pixels; ++k, i += step) {
        store3(rgb, i, (real3)(image[4 * i], image[4 * i + 1], image[4 * i + 2]));
        sum += target[i] > 0 ? ABSOLUTE(image[4 * i + 3] - target[i]) : 0;
    }
    parts[item] = sum;
}

__kernel void disparity_grad(const uint pixels, const real weight, const __global real *image,
                             const __global real *target, const __global real *v_rgb, __global real *v_image) {
    const size_t i = get_global_id(0);
    if (i >= pixels)
        return;
    const real off = image[4 * i + 3] - target[i];
    const real v = off > 0 ? weight : off < 0 ? -weight : 0;
    for (int k = 0; k < 3; ++k)
        v_image[4 * i + k] = v_rgb[3 * i + k];
    v_image[4 * i + 3] = target[i] > 0 ? v : 0;
}
