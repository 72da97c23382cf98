// Stage composite, variant for GPUs: composites splats to pixels, front to back, and propagates gradients back.
//
// The equations, the recurrence of the backward pass and the results are those of composite_cpu.cl. composite.h
// contains the mathematics of both. Only the mapping differs.
//
// Forward mapping: one work-group per tile, one work-item per pixel, or for several pixels ITEMS apart if the device
// has no groups of TILE*TILE work-items. The group loads BATCH splats at a time into local memory, and each work-item
// composites them onto its pixels. A work-item whose pixels are finished or outside the image continues to load. The
// group stops when live_pixels, the number of unfinished pixels, is 0.
//
// Backward mapping: one work-group of BATCH work-items per tile, one work-item per splat of a batch. The pixels of
// the tile pass from work-item to work-item.
//
// Diagonal scheme of the backward pass: the state of a pixel (transmittance, part behind, gradient of the colour) is
// in local memory. At step s of a batch, work-item t composites its splat over pixel s - t:
//
//          step  0  1  2  3 ...          A pixel meets the splats front to back, one step apart, as in the forward
//   work-item 0  p0 p1 p2 p3 ...         pass. No two work-items have the same pixel at a time. One barrier per step
//   work-item 1     p0 p1 p2 ...         passes the pixels on. All sums of a splat over the pixels of the tile stay in
//   work-item 2        p0 p1 ...         the registers of its work-item: no reduction, no atomics, no subgroups, and
//                                        the same bits in each run.
// A batch takes TILE*TILE + BATCH - 1 steps. The work-item of the last splat sees the final state of each pixel in
// the batch. It stops the group if all pixels are finished; the records of the remaining splats are zeros.
//
// If the device has subgroups, BATCH is the size of a subgroup. A step then ends with a barrier of the subgroup,
// which is almost free on a GPU, and the number of steps in which some work-items have no pixel is smallest. The
// computation, and therefore each bit of the result, is the same.
//
// Buffers: as in composite_cpu.cl.
// Local memory, in reals (of 4 bytes, or 8 with USE_DOUBLE): forward BATCH (11 + CHANNELS), with RAYS (26 + CHANNELS),
// backward TILE^2 (2 + CHANNELS). With TILE 16, BATCH 64 and CHANNELS 4 this is 4 KiB (RAYS 7.5 KiB) and 6 KiB (double:
// twice as much) of the 32 KiB that OpenCL 1.2 guarantees.
// -DTILE=8|16   edge of a tile, px
// -DCHANNELS    number of colour channels, 1 or more
// -DITEMS       number of work-items of the forward work-group, a divisor of TILE*TILE
// -DBATCH       number of splats per batch, 1 or more; the backward work-group has BATCH work-items
// -DRAYS=0|1|2  as in composite_cpu.cl
// -DSUBGROUPS=0|1   1: the device has the functions of subgroups, by cl_khr_subgroups or OpenCL 2.1 and later
#include "common.h"

#if !defined(ITEMS) || ITEMS < 1 || TILE * TILE % ITEMS
#error "-DITEMS must divide TILE*TILE, the number of pixels of a tile"
#endif
#include "composite_tiles.h"

#define OWNED (PIXELS / ITEMS) // pixels of a work-item of the forward pass

__kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void
composite_fwd(const int width, const int height, const __global Splat *splats, const __global uint *gauss_ids,
              const __global uint *tile_ranges, const __global real *background, __global real *image,
              __global real *alpha_image DIRECTIONS) {
    __local Splat staged[BATCH];
    __local int live_pixels;
    const uint tile = get_group_id(0), lane = get_local_id(0);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;

    if (lane == 0)
        live_pixels = min(TILE, width - x0) * min(TILE, height - y0);
    real transmittance[OWNED], sums[OWNED][CHANNELS];
    for (int o = 0; o < OWNED; ++o) {
        const int2 pixel = pixel_of(x0, y0, lane + o * ITEMS);
        transmittance[o] = pixel.x < width && pixel.y < height ? 1 : -1;
        for (int k = 0; k < CHANNELS; ++k)
            sums[o][k] = 0;
    }

    const uint begin = tile_ranges[2 * tile], length = tile_ranges[2 * tile + 1] - begin;
    for (uint first = 0; first < length; first += BATCH) {
        barrier(CLK_LOCAL_MEM_FENCE); // live_pixels is written, and the last batch is no longer read
        if (live_pixels == 0)
            break;
        const uint count = min((uint)BATCH, length - first);
        for (uint j = lane; j < count; j += ITEMS)
            staged[j] = splats[gauss_ids[begin + first + j]];
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int o = 0; o < OWNED; ++o) {
            const int was_live = transmittance[o] > 0;
            const int2 pixel = pixel_of(x0, y0, lane + o * ITEMS);
            const real3 ray = was_live ? DIRECTIONS_OF((size_t)pixel.y * width + pixel.x) : (real3)0;
            for (uint j = 0; j < count && transmittance[o] > 0; ++j) {
                const Splat s = staged[j];
                const Offset offset = offset_of(pixel, ray, &s);
                Bend bend;
                const real t = splat_exponent(&s, &offset, &bend);
                real alpha = exp2(t);
                int live;
                const real weight =
                    splat_over(splat_seen(&s, t), TRANSMITTANCE_MIN, &alpha, &live, &transmittance[o]);
                for (int k = 0; k < CHANNELS; ++k)
                    sums[o][k] += weight * s.color[k];
            }
            if (was_live && transmittance[o] < 0)
                atomic_dec(&live_pixels);
        }
    }

    for (int o = 0; o < OWNED; ++o) {
        const int2 pixel = pixel_of(x0, y0, lane + o * ITEMS);
        if (pixel.x >= width || pixel.y >= height)
            continue;
        const size_t p = (size_t)pixel.y * width + pixel.x;
        for (int k = 0; k < CHANNELS; ++k)
            image[CHANNELS * p + k] = sums[o][k] + fabs(transmittance[o]) * background[k];
        alpha_image[p] = 1 - fabs(transmittance[o]);
    }
}

__kernel __attribute__((reqd_work_group_size(BATCH, 1, 1))) void
composite_bwd(const int width, const int height, const __global Splat *splats, const __global uint *gauss_ids,
              const __global uint *tile_ranges, const __global uint *slots, const __global real *image,
              const __global real *alpha_image, const __global real *v_image, const __global real *v_alpha_image,
              __global real *records DIRECTIONS) {
    __local real transmittance[PIXELS], behind[PIXELS], v_pixels[CHANNELS][PIXELS];
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
        real sum = (alpha_image[i] - 1) * v_alpha_image[i];
        for (int k = 0; k < CHANNELS; ++k) {
            const real v = v_image[CHANNELS * i + k];
            sum += image[CHANNELS * i + k] * v;
            v_pixels[k][p] = v;
        }
        behind[p] = sum;
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
        Moments sums = NO_MOMENTS;
        real v_colors[CHANNELS];
        int any_live = 0;
        if (lane < count)
            s = splats[gauss_ids[i]];
        for (int k = 0; k < CHANNELS; ++k)
            v_colors[k] = 0;

        for (uint step = 0; step < PIXELS + count - 1; ++step) {
            const uint p = step - lane; // wraps to a value beyond PIXELS while no pixel has reached this work-item
            if (lane < count && p < PIXELS && transmittance[p] > 0) {
                const int2 pixel = pixel_of(x0, y0, p);
                const Offset offset = offset_of(pixel, DIRECTIONS_OF((size_t)pixel.y * width + pixel.x), &s);
                Bend bend;
                const real t = splat_exponent(&s, &offset, &bend);
                real alpha = exp2(t), after = transmittance[p];
                int live;
                const real weight = splat_over(splat_seen(&s, t), TRANSMITTANCE_MIN, &alpha, &live, &after);
                any_live |= live;
                transmittance[p] = after;
                if (weight > 0) {
                    real u = 0;
                    for (int k = 0; k < CHANNELS; ++k) {
                        u += s.color[k] * v_pixels[k][p];
                        v_colors[k] += weight * v_pixels[k][p];
                    }
                    real part = behind[p];
                    const real v_sigma = splat_over_vjp(alpha, live, weight, u, &part);
                    behind[p] = part;
                    add_moments(&offset, &bend, v_sigma, &sums);
                }
            }
            hand_on();
        }

        if (lane < count) {
            __global real *record = records + (size_t)RECORD * slots[i];
            for (int k = 0; k < MOMENTS; ++k)
                record[k] = ((const real *)&sums)[k];
            for (int k = 0; k < CHANNELS; ++k)
                record[MOMENTS + k] = v_colors[k];
        }
        if (lane == count - 1)
            unfinished = any_live;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    for (uint j = first + lane; j < length; j += BATCH) {
        for (int k = 0; k < RECORD; ++k)
            records[(size_t)RECORD * slots[begin + j] + k] = 0;
    }
}
#include "composite_splats.h"
