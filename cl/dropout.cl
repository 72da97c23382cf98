// Stage dropout: drops random splats of an image, and makes the others more opaque.
//
//   A splat is dropped with probability r. The opacity of the others becomes o / (1 - r), so that its mean over the
//   draws is o                                            (Park et al. 2025, "DropGaussian", equation 4)
// The draws come from Philox (philox.h); its counter is the Gaussian's index and the iteration. See
// docs/stages/dropout.md; clsplat/reference/dropout.py is the twin.
//
// A splat beyond the depth `far` is neither dropped nor changed: it is the sky, without which training would explain its
// colour by haze in front of the scene.
//
// Mapping: one work-item per splat.
//
// Buffers, N splats: in depths[N]; in and out extents[N,2] px, 0 for dropped splats, opacities[N], v_opacities[N].
// A splat that is invisible, because it is too faint or too far outside, stays invisible: its gradients are small. The
// outline of a splat along rays does not grow in proportion: project.cl has computed it for the new opacity (`outlined`).
#include "common.h"
#include "ellipse.h"
#include "philox.h"

// Draws below `threshold` = r 2^32 are dropped; gain is 1 / (1 - r).
__kernel void dropout_fwd(const uint n, const uint2 key, const uint iteration, const uint threshold, const real gain,
                          const int outlined, const real far, __global const real *depths, __global real *extents,
                          __global real *opacities) {
    const size_t i = get_global_id(0);
    if (i >= n || !(extents[2 * i] > 0) || depths[i] > far)
        return;
    const real opacity = opacities[i];
    const bool kept = philox((uint4)((uint)i, iteration, 1, 0), key).x >= threshold;
    // Half widths are proportional to the square root of r2.
    const real growth = !kept ? 0 : outlined ? 1 : sqrt(ellipse_r2(gain * opacity) / ellipse_r2(opacity));
    store2(extents, i, growth * load2(extents, i));
    opacities[i] = kept ? gain * opacity : 0;
}

__kernel void dropout_bwd(const uint n, const real gain, const real far, __global const real *depths,
                          __global real *v_opacities) {
    const size_t i = get_global_id(0);
    if (i < n && !(depths[i] > far))
        v_opacities[i] *= gain;
}
