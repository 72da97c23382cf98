// Stage march: samples of rays in the occupied cells of a grid.
//
//   t_0 = t_near + offset step(t_near),  t_{k+1} = t_k + step(t_k),  while t_k < t_far
//   A sample stands for a length. It is kept if the cell of its position is occupied   (Müller et al. 2022, appendix E)
//   CONTRACTED=0: positions p(t) = o + t d, step(t) = max(step, cone t), which is the length; t_near and t_far are where
//     the ray enters and leaves the unit cube
//   CONTRACTED=1: positions p(t) = x/4 + 1/2 of x = o + t d, and of (2 - 1/|x|) x/|x| where |x| > 1 (Barron et al. 2022,
//     equation 10); step(t) = max(step, cone t max(t, 1)); the length is 4 |p(t + step) - p(t)|
// See docs/stages/march.md; clsplat/reference/march.py is the twin.
//
// Mapping: one work-item per ray. march_count counts the samples; march_samples writes them to the places that a scan
// of the counts gives. Without a contraction, an empty cell is left in whole steps at once.
//
// Buffers, R rays, S samples, a grid of G^3 cells: in origins[R,3], directions[R,3] of length 1, offsets[R] in [0, 1),
//   occupied[G,G,G] u8, x fastest, first[R+1] u32; out counts[R] u32, positions[S,3] in [0, 1], deltas[S], rays_of[S] u32
// -DCONTRACTED=0|1   as above
#include "common.h"

#if !defined(CONTRACTED) || CONTRACTED & ~1
#error "-DCONTRACTED must be 0 or 1"
#endif

typedef struct {
    real3 origin, direction;
    real step, cone, near, far; // near and far: those of the ray
} Ray;

static inline Ray ray_at(const __global real *origins, const __global real *directions, size_t r, const real4 march) {
    Ray ray = {load3(origins, r), load3(directions, r), march.x, march.y, march.z, march.w};
#if !CONTRACTED
    for (int axis = 0; axis < 3; ++axis) {
        const real o = ((const real *)&ray.origin)[axis], d = ((const real *)&ray.direction)[axis];
        if (d != 0) {
            const real a = -o / d, b = (1 - o) / d;
            ray.near = GREATER(ray.near, LESSER(a, b));
            ray.far = LESSER(ray.far, GREATER(a, b));
        } else if (o < 0 || o > 1)
            ray.far = ray.near;
    }
#endif
    return ray;
}

static inline real step_at(const Ray *ray, real t) {
    const real wide = ray->cone * t;
#if CONTRACTED
    return GREATER(ray->step, wide * GREATER(t, (real)1));
#else
    return GREATER(ray->step, wide);
#endif
}

static inline real3 position_at(const Ray *ray, real t) {
    real3 x = ray->origin + t * ray->direction;
#if CONTRACTED
    const real norm = sqrt(dot(x, x));
    if (norm > 1)
        x *= (2 - 1 / norm) / norm;
    x = (real)0.25 * x + (real)0.5;
#endif
    return x;
}

// Length of a step from t, at position x, in the field's coordinates.
static inline real length_of(const Ray *ray, real t, real step, real3 x) {
#if CONTRACTED
    return 4 * length(position_at(ray, t + step) - x); // the unit cube is the contracted space, which is four wide
#else
    return step;
#endif
}

static inline int cell_of(real x, int cells) {
    const int i = (int)(x * cells);
    return CLAMP(i, 0, cells - 1);
}

// t of the next sample after an empty cell: the first step beyond it, or one before, by rounding.
static inline real beyond(const Ray *ray, real t, real3 x, int cells) {
    const real step = step_at(ray, t);
#if CONTRACTED
    return t + step;
#else
    real leave = INFINITY;
    for (int axis = 0; axis < 3; ++axis) {
        const real d = ((const real *)&ray->direction)[axis], p = ((const real *)&x)[axis];
        const int cell = cell_of(p, cells);
        if (d != 0)
            leave = LESSER(leave, ((d > 0 ? cell + 1 : cell) / (real)cells - p) / d);
    }
    const real steps = ray->cone == 0 ? floor(leave / step) : 1;
    return t + step * CLAMP(steps, (real)1, (real)4096);
#endif
}

// Kept samples of a ray; with `write`, they are stored from `place` on.
static inline uint samples_of(const Ray ray, real offset, int cells, const __global uchar *occupied, int write,
                              uint place, uint r, __global real *positions, __global real *deltas,
                              __global uint *rays_of) {
    uint count = 0;
    // Far from the origin, a step may be lost in rounding: t, which would stay, ends the ray.
    real t = ray.near + offset * step_at(&ray, ray.near), last = -INFINITY;
    while (t < ray.far && t > last) {
        last = t;
        const real3 x = position_at(&ray, t);
        const size_t cell = cell_of(x.x, cells) + (size_t)cells * (cell_of(x.y, cells) + cells * cell_of(x.z, cells));
        if (!occupied[cell]) {
            t = beyond(&ray, t, x, cells);
            continue;
        }
        const real step = step_at(&ray, t);
        if (write) {
            store3(positions, place + count, x);
            deltas[place + count] = length_of(&ray, t, step, x);
            rays_of[place + count] = r;
        }
        ++count;
        t += step;
    }
    return count;
}

__kernel void march_count(const uint rays, const int cells, const real step, const real cone, const real near,
                          const real far, const __global real *origins, const __global real *directions,
                          const __global real *offsets, const __global uchar *occupied, __global uint *counts) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    const Ray ray = ray_at(origins, directions, r, (real4)(step, cone, near, far));
    counts[r] = samples_of(ray, offsets[r], cells, occupied, 0, 0, r, 0, 0, 0);
}

__kernel void march_samples(const uint rays, const int cells, const real step, const real cone, const real near,
                            const real far, const __global real *origins, const __global real *directions,
                            const __global real *offsets, const __global uchar *occupied, const __global uint *first,
                            __global real *positions, __global real *deltas, __global uint *rays_of) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    const Ray ray = ray_at(origins, directions, r, (real4)(step, cone, near, far));
    samples_of(ray, offsets[r], cells, occupied, 1, first[r], r, positions, deltas, rays_of);
}
