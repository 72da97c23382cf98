// Stage count: numbers of pairs of a splat and a pixel, for the viewer and for `clsplat bench kernels`.
//
// A pair is evaluated if the pixel is not finished and lies in the box of the splat's extents and in a tile whose
// list contains the splat. It is accepted if it is drawn: alpha >= ALPHA_MIN, and the transmittance behind it stays
// above TRANSMITTANCE_MIN. The rule is that of composite.h in its simplest form. The counts do not depend on
// optimisations of the compositing kernels.
//
// Mapping: one work-item per pixel.
//
// Buffers: N splats as in project.cl, M intersections and T tiles as in bin.cl
//   in   means2d[N,2], conics[N,3], extents[N,2], opacities[N], gauss_ids[M], tile_ranges[T,2]
//   out  evaluated[H,W], accepted[H,W]
// -DTILE   edge of a tile, px
#include "common.h"

#if !defined(TILE) || TILE < 1
#error "-DTILE must give the edge of a tile in pixels, 1 or more"
#endif

__kernel void count_pairs(const int width, const int height, const __global real *means2d,
                          const __global real *conics, const __global real *extents, const __global real *opacities,
                          const __global uint *gauss_ids, const __global uint *tile_ranges, __global uint *evaluated,
                          __global uint *accepted) {
    const size_t p = get_global_id(0);
    if (p >= (size_t)width * height)
        return;
    const int x = p % width, y = p / width;
    const int tile = y / TILE * ((width + TILE - 1) / TILE) + x / TILE;
    uint in_box = 0, drawn = 0;
    real transmittance = 1;
    for (uint i = tile_ranges[2 * tile]; i < tile_ranges[2 * tile + 1]; ++i) {
        const uint g = gauss_ids[i];
        const real2 d = (real2)(x, y) + (real)0.5 - vload2(g, means2d), extent = vload2(g, extents);
        if (fabs(d.x) > extent.x || fabs(d.y) > extent.y)
            continue;
        ++in_box;
        const real3 conic = load3(conics, g);
        const real sigma = (real)0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
        const real alpha = fmin(opacities[g] * exp(-sigma), (real)ALPHA_MAX);
        if (sigma < 0 || alpha < ALPHA_MIN)
            continue;
        transmittance *= 1 - alpha;
        if (transmittance <= TRANSMITTANCE_MIN)
            break;
        ++drawn;
    }
    evaluated[p] = in_box;
    accepted[p] = drawn;
}
