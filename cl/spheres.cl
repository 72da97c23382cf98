// Stage spheres: samples of rays between spheres around the unit ball, in the occupied cells of a grid.
//
//   u(s) = s o + (sqrt(1 - s^2 h^2) - s (o . d)) d,  h^2 = |o|^2 - (o . d)^2: where a ray leaves the sphere of radius
//     1/s, on the unit sphere; it is d for s = 0, at infinity           (Fridovich-Keil et al. 2022, "Unbounded scenes")
//   Depth w = 1 - s. The grid has n_z cells of equal depths between the spheres with w = 0 and w = 1.
//   Sample k is at w = lo + offset (hi - lo), hi = (k + 1) / n_z, lo = max(k / n_z, w_first). w_first > 0 where the ray
//     begins, or comes nearest to the centre, outside of the unit ball
//   position = (atan2(u_x, u_z) / 2 pi + 1/2, angle(u, y) / pi, w)
//   length = |(1 + hi) u(1 - hi) - (1 + lo) u(1 - lo)|, that of the contracted ray (Barron et al. 2022, equation 10)
// See docs/stages/spheres.md; clsplat/reference/spheres.py is the twin.
//
// Mapping: one work-item per ray. spheres_count counts the samples in occupied cells; spheres_samples writes them to the
// places that a scan of the counts gives.
//
// Buffers, R rays, S samples, a grid of nx * ny * nz cells: in origins[R,3], directions[R,3] of length 1, offsets[R] in
//   [0, 1), occupied[nz,ny,nx] u8, first[R+1] u32; out counts[R] u32, positions[S,3] in [0, 1], deltas[S],
//   rays_of[S] u32
#include "common.h"

#define PI ((real)3.14159265358979323846)

typedef struct {
    real3 origin, direction;
    real along, apart2; // o . d, and the square of the ray's distance from the centre
    real first;         // depth at which the ray begins
} Ray;

static inline Ray ray_at(const __global real *origins, const __global real *directions, size_t r, real near) {
    Ray ray = {load3(origins, r), load3(directions, r), 0, 0, 0};
    ray.along = dot(ray.origin, ray.direction);
    const real3 nearest = ray.origin - ray.along * ray.direction;
    ray.apart2 = dot(nearest, nearest);
    const real3 begin = nearest + GREATER(near + ray.along, (real)0) * ray.direction;
    const real radius = sqrt(dot(begin, begin));
    ray.first = radius > 1 ? 1 - 1 / radius : 0;
    return ray;
}

// Where the ray leaves a sphere, on the unit sphere.
static inline real3 leaving(const Ray *ray, real depth) {
    const real s = 1 - depth, root = 1 - s * s * ray->apart2;
    return s * ray->origin + (sqrt(GREATER(root, (real)0)) - s * ray->along) * ray->direction;
}

static inline real3 position_at(const Ray *ray, real depth) {
    const real3 u = leaving(ray, depth);
    return (real3)(atan2(u.x, u.z) / (2 * PI) + (real)0.5, atan2(sqrt(u.x * u.x + u.z * u.z), u.y) / PI, depth);
}

static inline uint cell_of(real x, uint cells) {
    return LESSER((uint)(CLAMP(x, (real)0, (real)1) * cells), cells - 1);
}

// Samples of a ray in occupied cells; with `write`, they are stored from `place` on.
static inline uint samples_of(const Ray ray, real offset, const uint3 cells, const __global uchar *occupied,
                              int write, uint place, uint r, __global real *positions, __global real *deltas,
                              __global uint *rays_of) {
    uint count = 0;
    for (uint k = cell_of(ray.first, cells.z); k < cells.z; ++k) {
        const real lo = GREATER(k / (real)cells.z, ray.first), hi = (k + 1) / (real)cells.z;
        const real3 x = position_at(&ray, lo + offset * (hi - lo));
        const size_t cell = cell_of(x.x, cells.x) + (size_t)cells.x * (cell_of(x.y, cells.y) + cells.y * k);
        if (!occupied[cell])
            continue;
        if (write) {
            store3(positions, place + count, x);
            deltas[place + count] = length((1 + hi) * leaving(&ray, hi) - (1 + lo) * leaving(&ray, lo));
            rays_of[place + count] = r;
        }
        ++count;
    }
    return count;
}

__kernel void spheres_count(const uint rays, const uint longitudes, const uint latitudes, const uint depths,
                            const real near, const __global real *origins, const __global real *directions,
                            const __global real *offsets, const __global uchar *occupied, __global uint *counts) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    const uint3 cells = (uint3)(longitudes, latitudes, depths);
    counts[r] = samples_of(ray_at(origins, directions, r, near), offsets[r], cells, occupied, 0, 0, r, 0, 0, 0);
}

__kernel void spheres_samples(const uint rays, const uint longitudes, const uint latitudes, const uint depths,
                              const real near, const __global real *origins, const __global real *directions,
                              const __global real *offsets, const __global uchar *occupied,
                              const __global uint *first, __global real *positions, __global real *deltas,
                              __global uint *rays_of) {
    const size_t r = get_global_id(0);
    if (r >= rays)
        return;
    const uint3 cells = (uint3)(longitudes, latitudes, depths);
    samples_of(ray_at(origins, directions, r, near), offsets[r], cells, occupied, 1, first[r], r, positions, deltas,
               rays_of);
}
