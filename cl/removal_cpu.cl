// Stage removal, variant for CPUs: change of an image's squared error if a single splat is removed, or changes its colour.
//
// In a pixel, a splat has the weight w = alpha T and the colour c. S is the part of the image that lies behind it,
// background included. Removing the splat reduces the image by
//   D = w c - S alpha/(1 - alpha) = w (c - B),   where B = S/(T (1 - alpha)) is the colour visible in its place,
// and increases the sum of squared errors by sum_pixels |D|^2 - 2 r.D, with r = image - target. Another colour c + d
// changes it by sum_pixels w^2 |d|^2 + 2 w r.d. See docs/stages/removal.md; clsplat/reference/removal.py is the twin.
//
// Without the splat, a pixel would continue beyond its stop. Therefore pixels stop here only where the transmittance
// would fall to (1 - ALPHA_MAX) TRANSMITTANCE_MIN. So S/(1 - alpha) omits no more than the stop of a pixel omits in an
// image.
//
// Mapping: one work-item per tile, with its pixels in blocks (composite_blocks.h). A first pass over the splats sums up
// the colours. A second pass, also from front to back, subtracts the part of each splat to find what is behind it. So
// nothing is divided by a transmittance, and alpha/(1 - alpha) is at most 99. The sums of a splat over the tile are
// written, as a record, to the splat's slot in the unsorted list. removal_sum adds up the records of a splat in a fixed
// order, with one work-item per splat and without atomics. removal_gpu.cl is the variant for GPUs.
//
// Buffers: N, M, T, C and splats as in composite_cpu.cl, first_slots[N+1], slots[M] as in bin.cl
//   in   splats[N], gauss_ids[M], tile_ranges[T,2], slots[M], background[C]; residuals[H,W,C], image - target;
//        mask[H,W] uchar, 1 where pixels count
//   out  records[M,6+C]; sums[N,6+C]: change of the squared error, sums of |D|^2, of w, of w^2, of w |r|^2, number of
//        pixels in which the splat is composited, sums of w r
// -DTILE=8|16|32   edge of a tile, px; 32 only with -DLANES=16
// -DCHANNELS    number of colour channels, 1 or more
// -DLANES=8|16  number of pixels of a block
// -DRAYS=0|1|2  as in composite_cpu.cl
#include "common.h"
#include "composite_blocks.h"
#include "removal_sums.h"

#define STOP ((real)(TRANSMITTANCE_MIN * (1 - ALPHA_MAX)))

__kernel void removal(const int width, const int height, const __global Splat *splats, const __global uint *gauss_ids,
                      const __global uint *tile_ranges, const __global uint *slots, const __global real *background,
                      const __global real *residuals, const __global uchar *mask, __global real *records DIRECTIONS) {
    const uint t = get_global_id(0);
    const Box box = tile_box(t, width, height);

    // `counts` is 1 in pixels that count and 0 elsewhere.
    Grid grid = pixel_grid();
    LOAD_DIRECTIONS(grid, &box)
    BlockPixels pixels[BLOCKS]; // with the colour behind the present splat, after composite_tile
    REALV residual[BLOCKS][CHANNELS], squared[BLOCKS], counts[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) {
        pixels[b] = pixels_at_first(&grid, b, &box);
        load_block(residuals, CHANNELS, &box, width, b, residual[b]);
        counts[b] = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            if (lane_inside(&box, b, lane) && mask[lane_pixel(&box, width, b, lane)])
                ((real *)&counts[b])[lane] = 1;
        }
        squared[b] = 0;
        _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) {
            residual[b][k] = counts[b] > 0 ? residual[b][k] : (REALV)0;
            squared[b] += residual[b][k] * residual[b][k];
        }
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
    composite_tile(&grid, splats, gauss_ids, begin, end, &box, STOP, pixels);
    for (int b = 0; b < BLOCKS; ++b) {
        _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) pixels[b].color[k] +=
            ABSOLUTE(pixels[b].transmittance) * background[k];
        pixels[b].transmittance = transmittance_at_first(&grid, b, &box);
    }

    Batch batch;
    uint first = begin;
    for (; first < end; first += BATCH) {
        const Blocks unfinished = unfinished_blocks(&pixels->transmittance, sizeof(BlockPixels) / sizeof(REALV));
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, &box, &batch);
        for (uint j = 0; j < count; ++j) {
            fetch_splat(splats, gauss_ids, first + BATCH + j, end);
            fetch_record(records, SUMS, slots, first + j, end);
            const Splat *s = &batch.splats[j];
            const Sight sight = sight_from(s, &box);
            REALV difference = 0, agreement = 0, weights = 0, squares = 0, shares = 0, pairs = 0;
            REALV pulls[CHANNELS];
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) pulls[k] = 0;
            for (Blocks blocks = unfinished & blocks_of(&batch, j); blocks;) {
                const Visit visit = next_visit(&grid, s, &sight, &blocks);
                const uint b = visit.block;
                const REALV alpha = visit.alpha;
                MASKV live;
                const REALV weight = splat_over(alpha, STOP, &live, &pixels[b].transmittance);
                const REALV ratio = live ? alpha / (1 - alpha) : (REALV)0;
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) {
                    const REALV part = weight * s->color[k];
                    pixels[b].color[k] -= part;
                    const REALV less = part - ratio * pixels[b].color[k];
                    difference += counts[b] * less * less;
                    agreement += less * residual[b][k];
                    pulls[k] += weight * residual[b][k];
                }
                const REALV counted = weight * counts[b];
                weights += counted;
                squares += weight * counted;
                shares += weight * squared[b];
                pairs += weight > 0 ? counts[b] : (REALV)0;
            }
            __global real *record = records + (size_t)SUMS * slots[first + j];
            record[0] = sum_lanes(difference - 2 * agreement);
            record[1] = sum_lanes(difference);
            record[2] = sum_lanes(weights);
            record[3] = sum_lanes(squares);
            record[4] = sum_lanes(shares);
            record[5] = sum_lanes(pairs);
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) record[6 + k] = sum_lanes(pulls[k]);
        }
    }
    for (uint i = first; i < end; ++i) {
        for (int k = 0; k < SUMS; ++k)
            records[(size_t)SUMS * slots[i] + k] = 0;
    }
}
