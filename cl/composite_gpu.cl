// Stage composite, variant for GPUs: composites splats to pixels, front to back, and propagates gradients back.
//
// The equations, the recurrence of the backward pass and the results are those of composite_cpu.cl. composite.h
// contains the mathematics of both. Only the mapping differs.
//
// Forward mapping: one work-group per tile, one work-item per pixel, or for several pixels ITEMS apart if the device
// has no groups of TILE*TILE work-items. The group loads STAGED splats at a time into local memory, and each work-item
// composites them onto its pixels. A work-item whose pixels are finished or outside the image continues to load. The
// group stops when live_pixels, the number of unfinished pixels, is 0. A small splat meets few of a tile's blocks of 8x4
// pixels. The work-item that loads a splat finds these blocks, and work-items with pixels of other blocks skip the splat.
// Work-items that run in lockstep have the pixels of one block or of two, so that they skip it together.
//
// Backward mapping: one work-group of BATCH work-items per segment of SEGMENT splats of a tile's list, one work-item per
// splat of a batch. The pixels of the tile pass from work-item to work-item. So long lists are shared by many groups:
// the forward pass saves the state of the pixels where a segment begins, their transmittance and the colour so far
// (Mallick et al. 2024, "Taming 3DGS", section 4.2, keep it every 32 splats).
//
// Segments have numbers without a count of each tile's: segment k of tile t is the number begin / SEGMENT + t + k, where
// begin is the first entry of the tile's list. A list of n entries has at most (begin + n) / SEGMENT - begin / SEGMENT + 1
// segments, so that no number is used twice; some are not used. States are saved for k > 0 only, at the number
// begin / SEGMENT + k - 1, of which there are fewer than M / SEGMENT.
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
// Buffers: as in composite_cpu.cl; states[M/SEGMENT,1+CHANNELS,TILE^2], the transmittance (0 or less: finished) and the
// colours of the pixels where segments begin; reached[T], the number of entries of the tile's list that pixels met.
// Local memory, in reals (of 4 bytes, or 8 with USE_DOUBLE): forward STAGED (12 + CHANNELS), with RAYS (27 + CHANNELS),
// backward TILE^2 (2 + CHANNELS). With TILE 16, STAGED 64 and CHANNELS 4 this is 4 KiB (RAYS 7.5 KiB) and 6 KiB (double:
// twice as much) of the 32 KiB that OpenCL 1.2 guarantees.
// -DTILE=8|16|32   edge of a tile, px
// -DCHANNELS    number of colour channels, 1 or more
// -DITEMS       number of work-items of the forward work-group, a divisor of TILE*TILE
// -DSTAGED      number of splats that the forward pass loads at a time, 1 or more
// -DBATCH       number of splats per batch of the backward pass, 1 or more; its work-group has BATCH work-items
// -DSEGMENT     number of splats per segment
// -DRAYS=0|1|2  as in composite_cpu.cl
// -DSUBGROUPS=0|1   1: the device has the functions of subgroups, by cl_khr_subgroups or OpenCL 2.1 and later
#include "common.h"

#if !defined(ITEMS) || ITEMS < 1 || TILE * TILE % ITEMS
#error "-DITEMS must divide TILE*TILE, the number of pixels of a tile"
#endif
#include "composite_tiles.h"
#define SQRTV(x) sqrt(x)
#include "composite_bands.h"

#if !defined(STAGED) || STAGED < 1
#error "-DSTAGED must give the number of splats that the forward pass loads at a time, 1 or more"
#endif
#if !defined(SEGMENT) || SEGMENT < 1
#error "-DSEGMENT must give the number of splats per segment, 1 or more"
#endif

#define OWNED (PIXELS / ITEMS) // pixels of a work-item of the forward pass
#define STATE (1 + CHANNELS)   // numbers of a pixel's state

// Number of splats, at most `most`, in the batch at `first` of a list. Batches end where segments end.
static inline uint batch_at(uint first, uint length, uint most) {
    return min(min(most, length - first), SEGMENT - first % SEGMENT);
}

// The blocks of 8x4 pixels of the tile with corner (x0, y0) that a splat meets, as bits, numbered as in pixel_of.
static inline uint blocks_met(const Splat *s, int x0, int y0) {
#if RAYS
    const Outline *e = &s->outline;
    const BandOutline outline = {e->x - x0,   e->y - y0, e->half_height, e->inv_half_height,
                                 e->at_right, e->slope,  e->half_sq};
#else
    const BandOutline outline =
        band_outline(s->x - x0, s->y - y0, s->half_height, s->at_right, s->u_x, s->u_y, s->level);
#endif
    uint blocks = 0;
    for (int row = 0; row < TILE / 4; ++row) {
        real begin, end;
        blocks_in_band(&outline, 4 * row, 4 * row + 3, 8, TILE / 8, &begin, &end);
        for (int column = (int)begin; column < (int)end; ++column)
            blocks |= 1u << (column * (TILE / 4) + row);
    }
    return blocks;
}

// Tile of a segment by its number: the last one whose first segment has at most this number.
static inline uint tile_of(uint number, uint tiles, const __global uint *tile_ranges) {
    uint tile = 0, count = tiles;
    while (count > 1) {
        const uint half_count = count / 2, middle = tile + half_count;
        const int before = tile_ranges[2 * middle] / SEGMENT + middle <= number;
        tile = before ? middle : tile;
        count = before ? count - half_count : half_count;
    }
    return tile;
}

__kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void
composite_fwd(const int width, const int height, const __global Splat *splats, const __global uint *gauss_ids,
              const __global uint *tile_ranges, const __global real *background, __global real *image,
              __global real *alpha_image, const int saves, __global real *states, __global uint *reached DIRECTIONS) {
    __local Splat staged[STAGED];
    __local uint met[STAGED];
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
    uint first = 0;
    for (uint count; first < length; first += count) {
        barrier(CLK_LOCAL_MEM_FENCE); // live_pixels is written, and the last batch is no longer read
        if (live_pixels == 0)
            break;
        count = batch_at(first, length, STAGED);
        if (saves && first > 0 && first % SEGMENT == 0) {
            __global real *state = states + (size_t)(begin / SEGMENT + first / SEGMENT - 1) * STATE * PIXELS;
            for (int o = 0; o < OWNED; ++o) {
                state[lane + o * ITEMS] = transmittance[o];
                for (int k = 0; k < CHANNELS; ++k)
                    state[(1 + k) * PIXELS + lane + o * ITEMS] = sums[o][k];
            }
        }
        for (uint j = lane; j < count; j += ITEMS) {
            const Splat s = splats[gauss_ids[begin + first + j]];
            staged[j] = s;
            met[j] = blocks_met(&s, x0, y0);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int o = 0; o < OWNED; ++o) {
            const int was_live = transmittance[o] > 0;
            const int2 pixel = pixel_of(x0, y0, lane + o * ITEMS);
            const real3 ray = was_live ? DIRECTIONS_OF((size_t)pixel.y * width + pixel.x) : (real3)0;
            const uint block = (lane + o * ITEMS) / 32;
            for (uint j = 0; j < count && transmittance[o] > 0; ++j) {
                if (!(met[j] >> block & 1))
                    continue;
                const Splat s = staged[j];
                const Offset offset = offset_of(pixel, ray, &s);
                Bend bend;
                const real t = splat_exponent(&s, &offset, &bend);
                if (!splat_seen(&s, t)) // in most cases, for all work-items in lockstep
                    continue;
                int live;
                const real weight = splat_over(splat_alpha(1, exp2(t)), TRANSMITTANCE_MIN, &live, &transmittance[o]);
                for (int k = 0; k < CHANNELS; ++k)
                    sums[o][k] += weight * s.color[k];
            }
            if (was_live && transmittance[o] < 0)
                atomic_dec(&live_pixels);
        }
    }

    if (lane == 0)
        reached[tile] = first;
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
              const __global real *states, const __global uint *reached, __global real *records DIRECTIONS) {
    __local real transmittance[PIXELS], behind[PIXELS], v_pixels[CHANNELS][PIXELS];
    __local int unfinished;
    const uint lane = get_local_id(0);
    const int tiles_x = (width + TILE - 1) / TILE, tiles = tiles_x * ((height + TILE - 1) / TILE);
    const uint tile = tile_of(get_group_id(0), tiles, tile_ranges);
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;
    const uint begin = tile_ranges[2 * tile], length = tile_ranges[2 * tile + 1] - begin;
    const uint segment = get_group_id(0) - begin / SEGMENT - tile;
    uint first = segment * SEGMENT;
    if (first >= length)
        return;
    const uint end = min(first + SEGMENT, length);
    // `segment` is 0 where it is not read.
    const __global real *state = states + (size_t)(begin / SEGMENT + segment - (segment > 0)) * STATE * PIXELS;

    for (uint p = lane; p < PIXELS && first < reached[tile]; p += BATCH) {
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
        if (segment > 0) {
            transmittance[p] = state[p];
            for (int k = 0; k < CHANNELS; ++k)
                sum -= state[(1 + k) * PIXELS + p] * v_pixels[k][p];
        }
        behind[p] = sum;
    }
    if (lane == 0)
        unfinished = first < reached[tile];
    barrier(CLK_LOCAL_MEM_FENCE);

    for (uint count; first < end && unfinished; first += count) {
        count = batch_at(first, end, BATCH);
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
                const int seen = splat_seen(&s, t);
                any_live |= !seen;
                if (seen) {
                    const real alpha = splat_alpha(1, exp2(t));
                    real after = transmittance[p];
                    int live;
                    const real weight = splat_over(alpha, TRANSMITTANCE_MIN, &live, &after);
                    any_live |= live;
                    transmittance[p] = after;
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
            // By name: of a struct that is read as an array, Mesa 22.3 sees the first member alone change.
            const real moments[MOMENTS] = MOMENTS_OF(sums);
            for (int k = 0; k < MOMENTS; ++k)
                record[k] = moments[k];
            for (int k = 0; k < CHANNELS; ++k)
                record[MOMENTS + k] = v_colors[k];
        }
        if (lane == count - 1)
            unfinished = any_live;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    for (uint j = first + lane; j < end; j += BATCH) {
        for (int k = 0; k < RECORD; ++k)
            records[(size_t)RECORD * slots[begin + j] + k] = 0;
    }
}
#include "composite_splats.h"
