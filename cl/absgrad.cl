// Stage absgrad: sums over pixels of the absolute gradients with respect to the splats' centres.
//
//   sum over pixels of |v_sigma (a dx + b dy)| and of |v_sigma (b dx + c dy)|   (Ye et al. 2024, "AbsGS")
// with v_sigma per pixel as in composite.h. Terms of opposite signs, as on the two sides of an edge, do not cancel.
// See docs/stages/absgrad.md; clsplat/reference/absgrad.py is the twin.
//
// Mapping: absgrad_tiles has one work-item per tile, which walks the tile's list from front to back and keeps the state
// of all of its pixels; absgrad_sum has one per splat, in depth order, which adds up its records in the order of their
// slots.
//
// Buffers: N splats packed as in composite_splats.h; gauss_ids[M], tile_ranges[T,2], slots[M], order[N],
//   first_slots[N+1] as in bin.cl; C channels
//   in   image[H,W,C], alpha[H,W] as composited; v_image[H,W,C], v_alpha[H,W]
//   out  records[M,2], sums of a splat and a tile; sums[N,2], px^-1
// -DTILE      edge of a tile, px
// -DCHANNELS  number of colour channels
// -DRAYS=0    no evaluation along rays
#include "common.h"

#if !defined(TILE) || TILE < 1
#error "-DTILE must give the edge of a tile in pixels, 1 or more"
#endif
#if RAYS
#error "-DRAYS must be 0: the gradients along rays have other terms"
#endif
#include "composite_pixels.h"

__kernel void absgrad_tiles(const uint tiles, const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global uint *slots, const __global real *image, const __global real *alpha,
                            const __global real *v_image, const __global real *v_alpha, __global real *records) {
    const size_t tile = get_global_id(0);
    if (tile >= tiles)
        return;
    const int tiles_x = (width + TILE - 1) / TILE;
    const int left = (int)(tile % tiles_x) * TILE, top = (int)(tile / tiles_x) * TILE;
    const int columns = min(TILE, width - left), rows = min(TILE, height - top);
    real transmittance[TILE * TILE], behind[TILE * TILE]; // transmittance 0: compositing has stopped
    for (int k = 0; k < columns * rows; ++k) {
        const size_t p = (size_t)(top + k / columns) * width + left + k % columns;
        real sum = -(1 - alpha[p]) * v_alpha[p];
        for (int c = 0; c < CHANNELS; ++c)
            sum += image[CHANNELS * p + c] * v_image[CHANNELS * p + c];
        transmittance[k] = 1;
        behind[k] = sum;
    }
    for (uint i = tile_ranges[2 * tile]; i < tile_ranges[2 * tile + 1]; ++i) {
        const Splat s = splats[gauss_ids[i]];
        real2 total = 0;
        for (int k = 0; k < columns * rows; ++k) {
            const real before = transmittance[k];
            if (!(before > 0))
                continue;
            const int2 pixel = (int2)(left + k % columns, top + k / columns);
            const Offset offset = offset_of(pixel, (real3)0, &s);
            Bend bend;
            const real t = splat_exponent(&s, &offset, &bend);
            if (!splat_seen(&s, t))
                continue;
            const real opacity = exp2(t), clamped = LESSER(opacity, (real)ALPHA_MAX);
            const real after = before * (1 - clamped);
            transmittance[k] = after > (real)TRANSMITTANCE_MIN ? after : 0;
            if (!(after > (real)TRANSMITTANCE_MIN))
                continue;
            const size_t p = (size_t)pixel.y * width + pixel.x;
            real u = 0;
            for (int c = 0; c < CHANNELS; ++c)
                u += s.color[c] * v_image[CHANNELS * p + c];
            behind[k] -= clamped * before * u;
            const real v_opacity = before * u - behind[k] / (1 - clamped);
            const real v_sigma = opacity < (real)ALPHA_MAX ? -opacity * v_opacity : 0;
            // t has the exponent in units of ln 2, with the sign of -sigma.
            total.x += ABSOLUTE(v_sigma * (2 * s.a * offset.dx + s.b * offset.dy));
            total.y += ABSOLUTE(v_sigma * (s.b * offset.dx + 2 * s.c * offset.dy));
        }
        store2(records, slots[i], total / (real)LOG2_E);
    }
}

__kernel void absgrad_sum(const uint n, const __global uint *order, const __global uint *first_slots,
                          const __global real *records, __global real *sums) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    real2 total = 0;
    for (uint slot = first_slots[i]; slot < first_slots[i + 1]; ++slot)
        total += load2(records, slot);
    const bool finite = 0 * (total.x + total.y) == 0;
    store2(sums, order[i], finite ? total : (real2)0);
}
