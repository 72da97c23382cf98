// Stage median: the splat that is the surface in each pixel, at which the transmittance falls to 1/2 or below.
//
//   id = min { i : prod_{j <= i} (1 - alpha_j) <= 1/2 }
// over the splats of the pixel's tile in depth order, with alpha as in composite.h. The median of the depths by weight is
// that splat's: half of the light is stopped before it, or by it (cf. 2DGS, Huang et al. 2024, section 5.1). Unlike the
// expected depth, it does not lie between a surface and what is behind it.
//
// Mapping: one work-item per pixel.
//
// Buffers: N splats packed as in composite_splats.h, M intersections and T tiles as in bin.cl
//   in   splats[N], gauss_ids[M], tile_ranges[T,2]
//   out  ids[H,W], -1 where the transmittance stays above 1/2
// -DTILE        edge of a tile, px
// -DCHANNELS    number of colour channels of the packed splats
// -DRAYS=0|1|2  as in composite_cpu.cl
#include "common.h"

#if !defined(TILE) || TILE < 1
#error "-DTILE must give the edge of a tile in pixels, 1 or more"
#endif
#include "composite_pixels.h"

__kernel void median_splats(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            __global int *ids DIRECTIONS) {
    const size_t p = get_global_id(0);
    if (p >= (size_t)width * height)
        return;
    const int2 pixel = (int2)(p % width, p / width);
    const int tile = pixel.y / TILE * ((width + TILE - 1) / TILE) + pixel.x / TILE;
    const real3 ray = DIRECTIONS_OF(p);
    real transmittance = 1;
    int id = -1;
    for (uint i = tile_ranges[2 * tile]; i < tile_ranges[2 * tile + 1] && id < 0; ++i) {
        const Splat s = splats[gauss_ids[i]];
        const Offset offset = offset_of(pixel, ray, &s);
        Bend bend;
        const real t = splat_exponent(&s, &offset, &bend);
        if (!splat_seen(&s, t))
            continue;
        transmittance *= 1 - LESSER(exp2(t), (real)ALPHA_MAX);
        if (transmittance <= (real)0.5)
            id = gauss_ids[i];
    }
    ids[p] = id;
}
