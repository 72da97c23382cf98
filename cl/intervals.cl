// Stage intervals: samples in intervals of rays, and new intervals where samples had weight.
//
//   A ray is divided at edges s, at the distances t (spans.h).
//   CONTRACTED=0: points 2 x - 1 of x = o + t d
//   CONTRACTED=1: points x/2 of x = o + t d, and of (2 - 1/|x|) x/|x| where |x| > 1
//                                                                            (Barron et al. 2022, equation 10)
//   intervals_along: one sample in each interval, at t_i + offset (t_{i+1} - t_i), which stands for t_{i+1} - t_i
//   intervals_resample: the distribution of s is (w_i + padding)^power in interval i; the draws are
//                 s = CDF^{-1}((j + draw_j) / M) (Mildenhall et al. 2020, section 5.2)
// See docs/stages/intervals.md; clsplat/reference/intervals.py is the twin.
//
// Mapping: one work-item per ray. Draws are in ascending order, so one pass over the intervals places them all.
//
// Buffers, R rays of N intervals, M draws: in origins[R,3], directions[R,3] of length 1, edges[R,N+1] ascending,
//   offsets[R,N] in [0, 1); out points[R N,3], deltas[R N]. Resampling: in weights[R N], draws[R,M] in [0, 1); out
//   result[R,M], or with `keep` the draws and the edges, result[R,N+1+M], ascending.
// -DCONTRACTED=0|1   as above
#include "spans.h"

static inline real3 point_at(real3 origin, real3 direction, real t) {
    const real3 x = origin + t * direction;
#if CONTRACTED
    const real norm = sqrt(dot(x, x));
    return (real)0.5 * (norm > 1 ? (2 - 1 / norm) / norm * x : x);
#else
    return 2 * x - 1;
#endif
}

__kernel void intervals_along(const uint rays, const uint count, const real near, const real far,
                              const __global real *origins, const __global real *directions,
                              const __global real *edges, const __global real *offsets, __global real *points,
                              __global real *deltas) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    const real3 origin = load3(origins, r), direction = load3(directions, r);
    const real2 ends = ends_of(origin, direction, near, far);
    real begin = distance_at(edges[r * (count + 1)], ends);
    for (uint i = 0; i < count; ++i) {
        const real end = distance_at(edges[r * (count + 1) + i + 1], ends);
        const size_t s = r * count + i;
        deltas[s] = end - begin;
        store3(points, s, point_at(origin, direction, begin + offsets[s] * (end - begin)));
        begin = end;
    }
}

static inline real raised(real weight, real padding, real power) {
    return power == 1 ? weight + padding : pow(weight + padding, power);
}

__kernel void intervals_resample(const uint rays, const uint count, const uint draw_count, const uint keep,
                                 const real padding, const real power, const __global real *edges,
                                 const __global real *weights, const __global real *draws, __global real *result) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    edges += r * (count + 1), weights += r * count, draws += r * draw_count;
    result += r * (draw_count + (keep ? count + 1 : 0));
    real total = 0;
    for (uint i = 0; i < count; ++i)
        total += raised(weights[i], padding, power);
    real before = 0;
    uint j = 0, place = 0;
    for (uint i = 0; i < count; ++i) {
        const real begin = edges[i], end = edges[i + 1], share = raised(weights[i], padding, power);
        if (keep)
            result[place++] = begin;
        for (; j < draw_count; ++j) {
            const real wanted = (j + draws[j]) / draw_count * total - before;
            if (wanted >= share && i + 1 < count)
                break;
            const real s = begin + wanted / share * (end - begin);
            result[place++] = CLAMP(s, begin, end);
        }
        before += share;
    }
    if (keep)
        result[place] = edges[count];
}
