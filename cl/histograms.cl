// Stage histograms: the losses of Mip-NeRF 360 on the weights of a ray's intervals.
//
//   interlevel: sum_i max(w_i - b_i, 0)^2 / (w_i + INTERLEVEL_EPS), with b_i the sum of the outer weights of all outer
//     intervals that overlap interval i (Barron et al. 2022, equations 12 and 13). Gradients are those of the outer
//     weights alone: v_outer_j = -2 sum_{i overlaps j} max(w_i - b_i, 0) / (w_i + INTERLEVEL_EPS)
//   distortion: sum_ij w_i w_j |m_i - m_j| + (1/3) sum_i w_i^2 l_i, with the middles m and the lengths l of intervals
//     (Barron et al. 2022, equation 15):  v_w_i = 2 sum_j w_j |m_i - m_j| + (2/3) w_i l_i
// See docs/stages/histograms.md; clsplat/reference/histograms.py is the twin.
//
// Mapping: one work-item per ray. Edges ascend, so the overlapping intervals of the next interval are found from those
// of the last, and sum_j w_j |m_i - m_j| follows from sums over the intervals before and behind i.
//
// Buffers, R rays of N intervals and M outer ones: in edges[R,N+1] ascending, weights[R N], outer_edges[R,M+1],
//   outer_weights[R M]; out losses[R], v_outer[R M] or v_weights[R N], which are multiplied by `scale`.
// -DINTERLEVEL_EPS   as above
#include "common.h"

#ifndef INTERLEVEL_EPS
#error "-DINTERLEVEL_EPS, the constant in the denominator of the interlevel loss, must be given"
#endif

__kernel void histograms_interlevel(const uint rays, const uint count, const uint outer_count, const real scale,
                                    const __global real *edges, const __global real *weights,
                                    const __global real *outer_edges, const __global real *outer_weights,
                                    __global real *losses, __global real *v_outer) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    edges += r * (count + 1), weights += r * count;
    outer_edges += r * (outer_count + 1), outer_weights += r * outer_count, v_outer += r * outer_count;
    for (uint j = 0; j < outer_count; ++j)
        v_outer[j] = 0;
    real loss = 0;
    uint first = 0;
    for (uint i = 0; i < count; ++i) {
        while (first < outer_count && outer_edges[first + 1] <= edges[i])
            ++first;
        real bound = 0;
        for (uint j = first; j < outer_count && outer_edges[j] < edges[i + 1]; ++j)
            bound += outer_weights[j];
        const real excess = GREATER(weights[i] - bound, (real)0), ratio = excess / (weights[i] + INTERLEVEL_EPS);
        loss += excess * ratio;
        for (uint j = first; j < outer_count && outer_edges[j] < edges[i + 1]; ++j)
            v_outer[j] -= 2 * scale * ratio;
    }
    losses[r] = loss;
}

__kernel void histograms_distortion(const uint rays, const uint count, const real scale, const __global real *edges,
                                    const __global real *weights, __global real *losses, __global real *v_weights) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    edges += r * (count + 1), weights += r * count, v_weights += r * count;
    // Distances of middles from those before: sum_{j < i} w_j (m_i - m_j), then the same from behind.
    real sum = 0, pull = 0;
    for (uint i = 0; i < count; ++i) {
        v_weights[i] = pull;
        sum += weights[i];
        if (i + 1 < count)
            pull += sum * (edges[i + 2] - edges[i]) / 2;
    }
    real loss = 0;
    sum = pull = 0;
    for (uint i = count; i-- > 0;) {
        const real own = weights[i] * (edges[i + 1] - edges[i]) / 3, apart = v_weights[i] + pull;
        loss += weights[i] * (apart + own);
        v_weights[i] = 2 * scale * (apart + own);
        sum += weights[i];
        if (i > 0)
            pull += sum * (edges[i + 1] - edges[i - 1]) / 2;
    }
    losses[r] = loss;
}
