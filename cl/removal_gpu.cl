// Stage removal, variant for GPUs: change of an image's squared error if a single splat is removed, or changes its
// colour.
//
// The equations and the results are those of removal_cpu.cl. Only the mapping differs. The first pass over the splats,
// which sums up the colours, is composite_fwd of composite_gpu.cl with the stop of this stage. This is the second one.
//
// Mapping: one work-group of BATCH work-items per tile, one work-item per splat of a batch. The pixels of the tile pass
// from work-item to work-item, in the diagonal scheme of composite_gpu.cl. The state of a pixel is its transmittance
// and the colour behind the last splat. All sums of a splat stay in the registers of its work-item.
//
// Buffers: as in removal_cpu.cl, without background, and
//   in   image[H,W,C], all splats and the background
// Local memory, in reals: TILE^2 (1 + 2 CHANNELS), and TILE^2 bytes. With TILE 16 and CHANNELS 4 this is 9.3 KiB
// (double: 18.3 KiB) of the 32 KiB that OpenCL 1.2 guarantees.
// -DTILE=8|16|32   edge of a tile, px
// -DCHANNELS    number of colour channels, 1 or more
// -DSTOP        transmittance at which a pixel is finished
// -DBATCH       number of splats per batch, 1 or more; the work-group has BATCH work-items
// -DRAYS=0|1|2  as in composite_cpu.cl
// -DSUBGROUPS=0|1   1: the device has the functions of subgroups, by cl_khr_subgroups or OpenCL 2.1 and later
#include "common.h"

#ifndef STOP
#error "-DSTOP must give the transmittance at which a pixel is finished"
#endif
#include "composite_tiles.h"
#include "removal_sums.h"

__kernel __attribute__((reqd_work_group_size(BATCH, 1, 1))) void
removal(const int width, const int height, const __global Splat *splats, const __global uint *gauss_ids,
        const __global uint *tile_ranges, const __global uint *slots, const __global real *image,
        const __global real *residuals, const __global uchar *mask, __global real *records DIRECTIONS) {
    __local real transmittance[PIXELS], behind[CHANNELS][PIXELS], residual[CHANNELS][PIXELS];
    __local uchar counts[PIXELS];
    __local int unfinished;
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
        counts[p] = mask[i];
        for (int k = 0; k < CHANNELS; ++k) {
            behind[k][p] = image[CHANNELS * i + k];
            residual[k][p] = mask[i] ? residuals[CHANNELS * i + k] : 0;
        }
    }
    if (lane == 0)
        unfinished = 1;
    barrier(CLK_LOCAL_MEM_FENCE);

    const uint begin = tile_ranges[2 * tile], length = tile_ranges[2 * tile + 1] - begin;
    uint first = 0;
    for (; first < length && unfinished; first += BATCH) {
        const uint count = min((uint)BATCH, length - first);
        const uint i = begin + first + lane;
        Splat s;
        real difference = 0, agreement = 0, weights = 0, squares = 0, shares = 0, pairs = 0, pulls[CHANNELS];
        int any_live = 0;
        if (lane < count)
            s = splats[gauss_ids[i]];
        for (int k = 0; k < CHANNELS; ++k)
            pulls[k] = 0;

        for (uint step = 0; step < PIXELS + count - 1; ++step) {
            const uint p = step - lane; // wraps to a value beyond PIXELS while no pixel has reached this work-item
            if (lane < count && p < PIXELS && transmittance[p] > 0) {
                const int2 pixel = pixel_of(x0, y0, p);
                const Offset offset = offset_of(pixel, DIRECTIONS_OF((size_t)pixel.y * width + pixel.x), &s);
                Bend bend;
                const real t = splat_exponent(&s, &offset, &bend);
                const real alpha = splat_alpha(splat_seen(&s, t), exp2(t));
                real after = transmittance[p];
                int live;
                const real weight = splat_over(alpha, (real)STOP, &live, &after);
                any_live |= live;
                transmittance[p] = after;
                if (weight > 0) {
                    const real ratio = alpha / (1 - alpha);
                    for (int k = 0; k < CHANNELS; ++k) {
                        const real part = weight * s.color[k], rest = behind[k][p] - part;
                        const real less = part - ratio * rest;
                        behind[k][p] = rest;
                        difference += counts[p] ? less * less : 0;
                        agreement += less * residual[k][p];
                        pulls[k] += weight * residual[k][p];
                        shares += weight * residual[k][p] * residual[k][p];
                    }
                    weights += counts[p] ? weight : 0;
                    squares += counts[p] ? weight * weight : 0;
                    pairs += counts[p] ? 1 : 0;
                }
            }
            hand_on();
        }

        if (lane < count) {
            __global real *record = records + (size_t)SUMS * slots[i];
            record[0] = difference - 2 * agreement;
            record[1] = difference;
            record[2] = weights;
            record[3] = squares;
            record[4] = shares;
            record[5] = pairs;
            for (int k = 0; k < CHANNELS; ++k)
                record[6 + k] = pulls[k];
        }
        if (lane == count - 1)
            unfinished = any_live;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    for (uint j = first + lane; j < length; j += BATCH) {
        for (int k = 0; k < SUMS; ++k)
            records[(size_t)SUMS * slots[begin + j] + k] = 0;
    }
}
