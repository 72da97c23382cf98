// Stage absgrad: sums over pixels of the absolute gradients with respect to the splats' centres.
//
//   sum over pixels of |v_sigma (a dx + b dy)| and of |v_sigma (b dx + c dy)|   (Ye et al. 2024, "AbsGS")
// with v_sigma per pixel as in composite.h. Terms of opposite signs, as on the two sides of an edge, do not cancel.
// See docs/stages/absgrad.md; clsplat/reference/absgrad.py is the twin.
//
// Mapping: absgrad_tiles has one work-group of BATCH work-items per tile, one work-item per splat of a batch. The pixels
// of the tile pass from work-item to work-item, in the diagonal scheme of composite_gpu.cl; with a BATCH of 1, for CPUs,
// one work-item walks the list and the pixels. absgrad_sum has one work-item per splat, which adds up its records in the
// order of their slots.
//
// Buffers: N splats packed as in composite_splats.h; gauss_ids[M], tile_ranges[T,2], slots[M], first_slots[N+1]
//   as in bin.cl; C channels
//   in   image[H,W,C], alpha[H,W] as composited; v_image[H,W,C], v_alpha[H,W]
//   out  records[M,2], sums of a splat and a tile; sums[N,2], px^-1
// Local memory, in reals: TILE^2 (2 + CHANNELS).
// -DTILE=8|16|32   edge of a tile, px
// -DCHANNELS    number of colour channels
// -DBATCH       number of splats per batch, 1 or more; the work-group has BATCH work-items
// -DSUBGROUPS=0|1   1: the device has the functions of subgroups, by cl_khr_subgroups or OpenCL 2.1 and later
// -DRAYS=0      no evaluation along rays
#include "common.h"

#if RAYS
#error "-DRAYS must be 0: the gradients along rays have other terms"
#endif
#include "composite_tiles.h"

__kernel __attribute__((reqd_work_group_size(BATCH, 1, 1))) void
absgrad_tiles(const int width, const int height, const __global Splat *splats, const __global uint *gauss_ids,
              const __global uint *tile_ranges, const __global uint *slots, const __global real *image,
              const __global real *alpha, const __global real *v_image, const __global real *v_alpha,
              __global real *records) {
    __local real transmittance[PIXELS], behind[PIXELS], v_pixels[CHANNELS][PIXELS];
    const uint tile = get_group_id(0), lane = get_local_id(0);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;

    for (uint p = lane; p < PIXELS; p += BATCH) {
        const int2 pixel = pixel_of(x0, y0, p);
        const int inside = pixel.x < width && pixel.y < height;
        transmittance[p] = inside ? 1 : -1;
        if (!inside)
            continue;
        const size_t i = (size_t)pixel.y * width + pixel.x;
        real sum = -(1 - alpha[i]) * v_alpha[i];
        for (int k = 0; k < CHANNELS; ++k) {
            v_pixels[k][p] = v_image[CHANNELS * i + k];
            sum += image[CHANNELS * i + k] * v_pixels[k][p];
        }
        behind[p] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    const uint begin = tile_ranges[2 * tile], length = tile_ranges[2 * tile + 1] - begin;
    for (uint first = 0; first < length; first += BATCH) {
        const uint count = min((uint)BATCH, length - first), i = begin + first + lane;
        Splat s;
        real2 total = 0;
        if (lane < count)
            s = splats[gauss_ids[i]];
        for (uint step = 0; step < PIXELS + count - 1; ++step) {
            const uint p = step - lane; // wraps to a value beyond PIXELS while no pixel has reached this work-item
            if (lane < count && p < PIXELS && transmittance[p] > 0) {
                const Offset offset = offset_of(pixel_of(x0, y0, p), (real3)0, &s);
                Bend bend;
                const real t = splat_exponent(&s, &offset, &bend);
                if (splat_seen(&s, t)) {
                    const real opacity = splat_alpha(1, exp2(t));
                    real after = transmittance[p], part = behind[p], u = 0;
                    int live;
                    const real weight = splat_over(opacity, TRANSMITTANCE_MIN, &live, &after);
                    for (int k = 0; k < CHANNELS; ++k)
                        u += s.color[k] * v_pixels[k][p];
                    const real v_sigma = splat_over_vjp(opacity, live, weight, u, &part);
                    transmittance[p] = after;
                    behind[p] = part;
                    // sigma is u^2 + v^2 in units of ln 2.
                    total.x += ABSOLUTE(2 * v_sigma * s.u_x * offset.u);
                    total.y += ABSOLUTE(2 * v_sigma * (s.u_y * offset.u + s.v_y * offset.v));
                }
            }
            hand_on();
        }
        if (lane < count)
            store2(records, slots[i], total / (real)LOG2_E);
    }
}

__kernel void absgrad_sum(const uint n, const __global uint *first_slots, const __global real *records,
                          __global real *sums) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    real2 total = 0;
    for (uint slot = first_slots[i]; slot < first_slots[i + 1]; ++slot)
        total += load2(records, slot);
    const real any = total.x + total.y;
    const bool finite = FINITE(any);
    store2(sums, i, finite ? total : (real2)0);
}
