// Where the intervals of a ray lie.
//
//   A ray is divided at edges s in [0, 1].
//   CONTRACTED=0: t = t_near (1 - s) + t_far s, from where the ray enters the unit cube to where it leaves it
//   CONTRACTED=1: g(t) = (1 - s) g(near) + s g(far) with g(t) = t up to 1, and 2 - 1/t beyond: equal in the contracted
//   distance, as points are (Tancik et al. 2023, section 4.3)
//
// The file that includes this documents -DCONTRACTED=0|1.
#ifndef CLSPLAT_SPANS_H
#define CLSPLAT_SPANS_H

#include "common.h"

#if !defined(CONTRACTED) || CONTRACTED & ~1
#error "-DCONTRACTED must be 0 or 1"
#endif

// Distances (near, far) at which a ray begins and ends; equal for one that misses the cube.
static inline real2 ends_of(real3 origin, real3 direction, real near, real far) {
#if !CONTRACTED
    for (int axis = 0; axis < 3; ++axis) {
        const real o = ((const real *)&origin)[axis], d = ((const real *)&direction)[axis];
        if (d != 0) {
            const real a = -o / d, b = (1 - o) / d;
            near = GREATER(near, LESSER(a, b));
            far = LESSER(far, GREATER(a, b));
        } else if (o < 0 || o > 1)
            far = near;
    }
    far = GREATER(far, near);
#endif
    return (real2)(near, far);
}

#if CONTRACTED
static inline real contracted_distance(real t) {
    return t > 1 ? 2 - 1 / t : t;
}
#endif

static inline real distance_at(real s, real2 ends) {
#if CONTRACTED
    const real g = contracted_distance(ends.x) * (1 - s) + contracted_distance(ends.y) * s;
    return g > 1 ? 1 / (2 - g) : g;
#else
    return ends.x * (1 - s) + ends.y * s;
#endif
}

#endif
