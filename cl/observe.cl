// Stage observe: statistics of each Gaussian for densification, added up over iterations or photos.
//
// observe
//   grad_sum += |(v_mean2d.x W/2, v_mean2d.y H/2)|,   seen += 1 if the Gaussian is visible
// The positional gradient is in normalised device coordinates, in which one unit is half of the image (Kerbl et al.
// 2023, section 5.2, and the original code).
//
// add_column
//   sums[0] + sums[1] += factor values[column]
// sums[1] collects the rounding errors of sums[0], which the exact sum of two numbers yields (Knuth, "The art of
// computer programming", volume 2, section 4.2.2, theorem B). Both together have twice the digits of a real.
// See docs/stages/observe.md; clsplat/reference/observe.py is the twin.
//
// Mapping: one work-item per Gaussian.
//
// Buffers, N Gaussians: in extents[N,2] px, v_means2d[N,2] px^-1; in and out grad_sum[N], seen[N] int
//   in values[N,width]; in and out sums[N,2]
#include "common.h"

__kernel void observe(const uint n, const real2 half_size, const __global real *extents,
                      const __global real *v_means2d, __global real *grad_sum, __global int *seen) {
    const size_t i = get_global_id(0);
    if (i >= n || !(extents[2 * i] > 0))
        return;
    const real2 v = half_size * load2(v_means2d, i);
    grad_sum[i] += sqrt(v.x * v.x + v.y * v.y);
    seen[i] += 1;
}

__kernel void add_column(const uint n, const uint width, const uint column, const real factor,
                         const __global real *values, __global real *sums) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const real before = sums[2 * i], value = factor * values[i * width + column];
    const real sum = before + value, added = sum - before;
    sums[2 * i] = sum;
    sums[2 * i + 1] += (before - (sum - added)) + (value - added);
}
