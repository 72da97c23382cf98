// Stage composite, variant for CPUs: composites splats to pixels, front to back, and propagates gradients back.
//
//   image = sum_i colour_i alpha_i T_i + T_end background,  alpha = 1 - T_end   (Kerbl et al. 2023, equation 3)
// A pixel skips pairs with alpha < ALPHA_MIN, and stops before T would fall to TRANSMITTANCE_MIN or below.
// composite.h contains the mathematics, composite_gpu.cl the variant for GPUs, clsplat/reference/composite.py the
// twin.
//
// Mapping: one work-item per tile. It keeps the pixels of the tile in private memory (they stay in the L1 cache) and
// takes its splats in depth order. Each splat visits the blocks of 4x4 or 4x2 pixels that it meets
// (composite_blocks.h).
//
// Backward pass: it repeats the forward pass from front to back. Let u_i = colour_i . v_image, and let S_i be the
// part of sum_i u_i alpha_i T_i + T_end (background . v_image - v_alpha) that lies behind splat i. Then
//   v_alpha_i = T_i u_i - S_i / (1 - alpha_i).
// S starts as image . v_image - T_end v_alpha, and each splat subtracts its term. So only the image must be stored,
// and transmittances are not recovered by divisions. The sums of a splat over the pixels of a tile are written, as a
// record, to the splat's slot in the unsorted list, where its records are adjacent. composite_sum adds them in a
// fixed order, without atomics.
//
// Buffers: N splats as in project.cl, M intersections and T tiles as in bin.cl, C = CHANNELS
//   in   means2d, conics, extents, opacities, colors, as in project.cl; splats[N], the same, packed by composite_pack;
//        gauss_ids[M], tile_ranges[T,2], background[C], slots[M]
//        rays[N,RAY_REALS] with RAYS, instead of conics in composite_sum
//   out  image[H,W,C], alpha[H,W]; backward: records[M,RECORD], v_means2d[N,2], v_conics[N,3], v_slopes[N,3] with RAYS,
//        v_opacities[N], v_colors[N,C]
// -DTILE=8|16|32   edge of a tile, px; 32 only with -DLANES=16
// -DCHANNELS    number of colour channels, 1 or more
// -DLANES=8|16  number of pixels of a block
// -DRAYS=0|1|2  1, 2: along rays (composite_rays.h), in the image or in a chart of each splat; 2 reads directions[H,W,3],
//               unit vectors of the pixels' rays in the camera's frame
#include "common.h"
#include "composite_blocks.h"

__kernel void composite_fwd(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global real *background, __global real *image,
                            __global real *alpha_image DIRECTIONS) {
    const uint t = get_global_id(0);
    const Box box = tile_box(t, width, height);

    Grid grid = pixel_grid();
    LOAD_DIRECTIONS(grid, &box)
    BlockPixels pixels[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b)
        pixels[b] = pixels_at_first(&grid, b, &box);

    composite_tile(&grid, splats, gauss_ids, tile_ranges[2 * t], tile_ranges[2 * t + 1], &box, TRANSMITTANCE_MIN,
                   pixels);

    for (int b = 0; b < BLOCKS; ++b)
        store_pixels(pixels[b].transmittance, pixels[b].color, background, &box, width, b, image, alpha_image);
}

// The pixels of a block in the backward pass.
typedef struct {
    REALV transmittance, behind, v_color[CHANNELS];
} GradPixels;

// Sums of a splat over the pixels of a tile, lane by lane.
typedef struct {
    Moments moments;
    REALV v_colors[CHANNELS];
} SplatSums;

#define NO_SUMS                                                                                                      \
    {                                                                                                                \
        NO_MOMENTS, {                                                                                                \
            0                                                                                                        \
        }                                                                                                            \
    }

static inline void visit_vjp(const Splat *s, const Visit *visit, GradPixels *pixels, SplatSums *sums) {
    GradPixels *here = &pixels[visit->block];
    MASKV live;
    const REALV weight = splat_over(visit->alpha, TRANSMITTANCE_MIN, &live, &here->transmittance);
    REALV u = 0;
    _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) {
        u += s->color[k] * here->v_color[k];
        sums->v_colors[k] += weight * here->v_color[k];
    }
    const REALV v_sigma = splat_over_vjp(visit->alpha, live, weight, u, &here->behind);
    add_moments(&visit->offset, &visit->bend, v_sigma, &sums->moments);
}

__kernel void composite_bwd(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global uint *slots, const __global real *image, const __global real *alpha_image,
                            const __global real *v_image, const __global real *v_alpha_image,
                            __global real *records DIRECTIONS) {
    const uint t = get_global_id(0);
    const Box box = tile_box(t, width, height);

    Grid grid = pixel_grid();
    LOAD_DIRECTIONS(grid, &box)
    GradPixels pixels[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) {
        pixels[b].transmittance = transmittance_at_first(&grid, b, &box);
        pixels[b].behind =
            load_v_pixels(image, alpha_image, v_image, v_alpha_image, &box, width, b, pixels[b].v_color);
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
    Batch batch;
    uint first = begin;
    for (; first < end; first += BATCH) {
        const Blocks unfinished = unfinished_blocks(&pixels->transmittance, sizeof(GradPixels) / sizeof(REALV));
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, &box, &batch);
        for (uint j = 0; j < count; ++j) {
            fetch_splat(splats, gauss_ids, first + BATCH + j, end);
            fetch_record(records, RECORD, slots, first + j, end);
            const Splat *s = &batch.splats[j];
            Blocks blocks = unfinished & blocks_of(&batch, j);
            SplatSums sums = NO_SUMS;
            if (blocks) {
                // The next visit begins before this one ends: a processor has too few places for operations that wait to
                // overlap the two without that.
                const Sight sight = sight_from(s, &box);
                Visit visit = next_visit(&grid, s, &sight, &blocks);
                while (blocks) {
                    const Visit next = next_visit(&grid, s, &sight, &blocks);
                    visit_vjp(s, &visit, pixels, &sums);
                    visit = next;
                }
                visit_vjp(s, &visit, pixels, &sums);
            }
            const Moments *m = &sums.moments;
            __global real *record = records + (size_t)RECORD * slots[first + j];
#if RAYS
            store8(record, sum_lanes8(m->m, m->mx, m->my, m->mxx, m->mxy, m->myy, m->ml, m->mlx));
            record[8] = sum_lanes(m->mly);
            record[9] = sum_lanes(m->mk);
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) record[MOMENTS + k] = sum_lanes(sums.v_colors[k]);
#elif CHANNELS > 1
            store8(record,
                   sum_lanes8(m->m, m->mu, m->mv, m->muu, m->muv, m->mvv, sums.v_colors[0], sums.v_colors[1]));
            _Pragma("unroll") for (int k = 2; k < CHANNELS; ++k) record[MOMENTS + k] = sum_lanes(sums.v_colors[k]);
#else
            for (int k = 0; k < MOMENTS; ++k)
                record[k] = sum_lanes(((const REALV *)m)[k]);
            record[MOMENTS] = sum_lanes(sums.v_colors[0]);
#endif
        }
    }
    for (uint i = first; i < end; ++i) {
        for (int k = 0; k < RECORD; ++k)
            records[(size_t)RECORD * slots[i] + k] = 0;
    }
}

#include "composite_splats.h"
