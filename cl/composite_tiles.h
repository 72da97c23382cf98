// Tiles of which a work-group composites the pixels, for kernels for GPUs: the pixels' places, and the end of a step of
// the diagonal scheme (composite_gpu.cl).
//
// -DTILE=8|16   edge of a tile, px
// -DBATCH       number of splats per batch of the diagonal scheme, its work-items
// -DSUBGROUPS=0|1   1: the device has the functions of subgroups
#ifndef CLSPLAT_COMPOSITE_TILES_H
#define CLSPLAT_COMPOSITE_TILES_H

#if TILE != 8 && TILE != 16
#error "-DTILE must be 8 or 16: TILE*TILE work-items must fit the work-groups of every GPU"
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
#define REALV real
#define MASKV int
#include "composite.h"
#include "power.h"

#define PIXELS (TILE * TILE)

// Position of pixel p of the tile with origin (x0, y0).
static inline int2 pixel_of(int x0, int y0, uint p) {
    return (int2)(x0 + p % TILE, y0 + p / TILE);
}

// The argument of a kernel that reads the directions of the pixels' rays, and one that passes it on.
#if RAYS == 2
#define DIRECTIONS       , const __global real *directions
#define DIRECTIONS_OF(p) load3(directions, p)
#else
#define DIRECTIONS
#define DIRECTIONS_OF(p) ((real3)0)
#endif

// A pixel as seen from a splat; `ray` is the direction of its ray.
static inline Offset offset_of(int2 pixel, real3 ray, const Splat *s) {
    Offset o;
#if RAYS == 2
    o.dx = s->axis0[0] * ray.x + s->axis0[1] * ray.y + s->axis0[2] * ray.z;
    o.dy = s->axis1[0] * ray.x + s->axis1[1] * ray.y + s->axis1[2] * ray.z;
    o.along = s->axis2[0] * ray.x + s->axis2[1] * ray.y + s->axis2[2] * ray.z;
#else
    o.dx = pixel.x + (real)0.5 - s->x;
    o.dy = pixel.y + (real)0.5 - s->y;
#if RAYS
    o.along = 1;
#endif
#endif
    return o;
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
