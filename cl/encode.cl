// Stage encode: inputs of networks, from points, directions and the results of other networks.
//
//   points x: x, then sin(2^k pi x) and cos(2^k pi x) for k = 0 ... LEVELS - 1 (Mildenhall et al. 2020, equation 4),
//   then 1, which gives the first layer of a network an offset, then zeros up to a multiple of 16
//   joined: the features of a sample, or max(features, 0), then an encoding
// See docs/stages/encode.md; clsplat/reference/encode.py is the twin.
//
// Mapping: one work-item per row. Sines and cosines of doubled angles follow from those before: sin 2a = 2 sin a cos a,
// cos 2a = 1 - 2 sin^2 a. The error doubles as the angle does, as would that of an angle that is rounded.
//
// Buffers, S rows, W features, E numbers of an encoding: in points[S,3]; out encoded[S,E]. Joined: in features[S,W],
//   rows[S / per, E]: an encoding for `per` samples each; out joined[S,W+E]. Backward: in v_joined[S,W+E]; out
//   v_features[S,W].
#include "common.h"

__kernel void encode_points(const uint count, const uint levels, const uint width, const __global real *points,
                            __global real *encoded) {
    const size_t s = get_global_id(0);
    if (s >= count)
        return;
    __global real *own = encoded + s * width;
    for (uint axis = 0; axis < 3; ++axis) {
        const real x = points[3 * s + axis];
        real sine = sinpi(x), cosine = cospi(x);
        own[axis] = x;
        for (uint k = 0; k < levels; ++k) {
            own[3 + 6 * k + axis] = sine;
            own[6 + 6 * k + axis] = cosine;
            const real doubled = 2 * sine * cosine;
            cosine = 1 - 2 * sine * sine;
            sine = doubled;
        }
    }
    for (uint i = 3 + 6 * levels; i < width; ++i)
        own[i] = i == 3 + 6 * levels;
}

__kernel void encode_join(const uint count, const uint wide, const uint width, const uint per, const uint rectify,
                          const __global real *features, const __global real *rows, __global real *joined) {
    const size_t s = get_global_id(0);
    if (s >= count)
        return;
    __global real *own = joined + s * (wide + width);
    for (uint i = 0; i < wide; ++i) {
        const real x = features[s * wide + i];
        own[i] = rectify ? GREATER(x, (real)0) : x;
    }
    for (uint i = 0; i < width; ++i)
        own[wide + i] = rows[s / per * width + i];
}

__kernel void encode_join_bwd(const uint count, const uint wide, const uint width, const uint rectify,
                              const __global real *features, const __global real *v_joined,
                              __global real *v_features) {
    const size_t s = get_global_id(0);
    if (s >= count)
        return;
    for (uint i = 0; i < wide; ++i) {
        const real v = v_joined[s * (wide + width) + i];
        v_features[s * wide + i] = rectify && !(features[s * wide + i] > 0) ? 0 : v;
    }
}
