// Tiles of which a work-group composites the pixels, for kernels for GPUs: the pixels' places, and the end of a step of
// the diagonal scheme (composite_gpu.cl).
//
// -DTILE=8|16|32   edge of a tile, px
// -DBATCH       number of splats per batch of the diagonal scheme, its work-items
// -DSUBGROUPS=0|1   1: the device has the functions of subgroups
#ifndef CLSPLAT_COMPOSITE_TILES_H
#define CLSPLAT_COMPOSITE_TILES_H

#if TILE != 8 && TILE != 16 && TILE != 32
#error "-DTILE must be 8, 16 or 32"
#endif
#if !defined(BATCH) || BATCH < 1
#error "-DBATCH must give the number of splats per batch, 1 or more"
#endif
#if !defined(SUBGROUPS) || SUBGROUPS & ~1
#error "-DSUBGROUPS must be 0 or 1"
#endif
#ifdef cl_khr_subgroups
#pragma OPENCL EXTENSION cl_khr_subgroups : enable
#endif
#include "composite_pixels.h"

#define PIXELS (TILE * TILE)

// Position of pixel p of the tile with origin (x0, y0). Pixels are numbered by blocks of 8x4, and these by columns:
// 32 or 64 work-items in lockstep have pixels that lie together, so that more often none of them meets a splat.
static inline int2 pixel_of(int x0, int y0, uint p) {
    const uint block = p / 32, blocks_y = TILE / 4;
    return (int2)(x0 + block / blocks_y * 8 + p % 8, y0 + block % blocks_y * 4 + p / 8 % 4);
}

// Ends a step of the diagonal scheme.
static inline void hand_on(void) {
#if SUBGROUPS
    if (get_num_sub_groups() == 1) {
        sub_group_barrier(CLK_LOCAL_MEM_FENCE);
        return;
    }
#endif
    barrier(CLK_LOCAL_MEM_FENCE);
}

#endif
