// Stage frustums: integrated encodings of the conical frustums between the edges of a ray's intervals.
//
//   A pixel's cone has the radius t rho at the distance t. The frustum from t_0 to t_1 is taken for a Gaussian
//   (Barron et al. 2021, equations 7 and 8), with m = (t_0 + t_1)/2, h = (t_1 - t_0)/2, q = 3 m^2 + h^2:
//     mean o + (m + 2 m h^2 / q) d,  variance along d: h^2/3 - (4/15) h^4 (12 m^2 - h^2)/q^2,
//     across: rho^2 (m^2/4 + 5 h^2/12 - (4/15) h^4/q)
//   It is moved to field coordinates x by y = 2 x - 1 (CONTRACTED=0), or y = contract(x) and its derivative J, which
//   with g(n) = 2/n - 1/n^2 is g I + (1/n^2 - g) x x^T/n^2 beyond |x| = n > 1 (Barron et al. 2022, equations 9, 10).
//   For each of 21 axes b: mean mu = b . y, variance v = (J b)^T cov (J b), and for k = 0 ... levels - 1 the features
//     exp(-4^k v / 2) sin(2^k mu) and exp(-4^k v / 2) cos(2^k mu)   (Barron et al. 2022, supplement: off-axis features)
//   then 1, and zeros up to a multiple of 16.
// See docs/stages/frustums.md; clsplat/reference/frustums.py is the twin.
//
// Mapping: one work-item per interval, which takes LANES axes at once. Sines of doubled angles follow from those before,
// as in encode.cl.
//
// Buffers, R rays of N intervals, A axes, E features: in origins[R,3], directions[R,3] of length 1, radii[R] (rho),
//   edges[R,N+1] ascending, axes[A,3] of length 1; out encoded[R N,E], deltas[R N] (t_1 - t_0).
// -DCONTRACTED=0|1   as above
// -DLANES=1|8        8 on CPUs (lanes.h)
#ifndef LANES
#error "-DLANES, the number of axes that a work-item takes at once, must be given"
#endif
#include "spans.h"

#include "lanes.h"

#define NEGLIGIBLE 87 // 2^-87 < 1e-26, below the rounding of a double: this and all later frequencies are 0

static inline reals dots(reals3 a, real3 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

__kernel void frustums_encode(const uint samples, const uint count, const uint axis_count, const uint levels,
                              const uint width, const real near, const real far, const __global real *origins,
                              const __global real *directions, const __global real *radii, const __global real *edges,
                              const __global real *axes, __global real *encoded, __global real *deltas) {
    const size_t s = get_global_id(0);
    if (s >= samples)
        return;
    const size_t r = s / count;
    const real3 origin = load3(origins, r), direction = load3(directions, r);
    const real2 ends = ends_of(origin, direction, near, far);
    const size_t edge = r * (count + 1) + s % count;
    const real begin = distance_at(edges[edge], ends), end = distance_at(edges[edge + 1], ends);
    deltas[s] = end - begin;
    const real middle = (begin + end) / 2, half_length = (end - begin) / 2, square = half_length * half_length;
    // A ray may begin at a distance of 0 and have intervals without length.
    const real q = GREATER(3 * middle * middle + square, (real)1e-30);
    const real mean = middle + 2 * middle * square / q;
    const real ratio = square / q;
    const real along = square / 3 - 4 * (12 * middle * middle - square) * ratio * ratio / 15;
    const real across = radii[r] * radii[r] * (middle * middle / 4 + 5 * square / 12 - 4 * square * ratio / 15);
    const real3 x = origin + mean * direction;
#if CONTRACTED
    const real norm = sqrt(dot(x, x)), inverse = norm > 1 ? 1 / norm : 1;
    const real shrunk = norm > 1 ? (2 - inverse) * inverse : 1, radial = inverse * inverse - shrunk;
    const real3 unit = inverse * x, y = shrunk * x;
#else
    const real3 y = 2 * x - 1;
#endif
    __global real *own = encoded + s * width;
    for (uint a = 0; a < axis_count; a += LANES) {
        const reals3 axis = load_vectors3(axes, a, axis_count);
#if CONTRACTED
        const reals bend = norm > 1 ? radial * dots(axis, unit) : 0;
        const reals3 turned = {shrunk * axis.x + bend * unit.x, shrunk * axis.y + bend * unit.y,
                               shrunk * axis.z + bend * unit.z};
#else
        const reals3 turned = {2 * axis.x, 2 * axis.y, 2 * axis.z};
#endif
        const reals forward = dots(turned, direction), square_forward = forward * forward;
        const reals aside = turned.x * turned.x + turned.y * turned.y + turned.z * turned.z - square_forward;
        const reals mu = dots(axis, y);
        reals sine = OF_LANES(sin, mu), cosine = OF_LANES(cos, mu);
        // Half of the variance, in powers of two.
        reals exponent = (real)(LOG2_E / 2) * (along * square_forward + across * GREATER(aside, (reals)0));
        for (uint k = 0; k < levels; ++k) {
            const reals faded = POWER(GREATER(-exponent, (reals)POWER_MIN));
            const reals kept = exponent < NEGLIGIBLE ? faded : (reals)0;
            const reals2 wave = {kept * sine, kept * cosine};
            store_vectors2(own + (size_t)2 * k * axis_count, a, axis_count, wave);
            const reals doubled = 2 * sine * cosine;
            cosine = 1 - 2 * sine * sine;
            sine = doubled;
            exponent *= 4;
        }
    }
    for (uint i = 2 * levels * axis_count; i < width; ++i)
        own[i] = i == 2 * levels * axis_count;
}
