// Stage observe: statistics of each Gaussian for densification, added up over iterations.
//
//   grad_sum += |(v_mean2d.x W/2, v_mean2d.y H/2)|,   seen += 1 if the Gaussian is visible
// The positional gradient is in normalised device coordinates, in which one unit is half of the image (Kerbl et al.
// 2023, section 5.2, and the original code). See docs/stages/observe.md; clsplat/reference/observe.py is the twin.
//
// Mapping: one work-item per Gaussian.
//
// Buffers, N Gaussians: in extents[N,2] px, v_means2d[N,2] px^-1; in and out grad_sum[N], seen[N] int
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
