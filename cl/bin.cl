// Stage bin: which splats touch which tile, in depth order.
//
// A tile's list holds, by depth and then by index, every splat whose ellipse {alpha >= ALPHA_MIN} may cover
// the centre of one of its pixels: the test is exact (ellipse.h) but for a slack in the threshold. Steps,
// with the stages scan and sort between them:
//   bin_keys    depths as integers that sort like them; invisible splats last
//   (sort)      order[N], the splats by depth
//   bin_count   counts[i], the tiles of splat order[i]
//   (scan)      first_slots[N + 1]
//   bin_emit    slot by slot: tiles[M] and the splat's index slot_gauss[M], a splat's slots side by side
//   (sort)      slots[M], the slots by tile, stable: the depth order survives within a tile
//   bin_ranges  tile_ranges[T,2], begin and end of each tile in the sorted list, and gauss_ids[M]
//
// Mapping: one work-item per splat (bin_keys, bin_count, bin_emit), per tile or intersection (bin_ranges,
// bin_gather). Counting and emitting are one function: they cannot disagree.
//
// Buffers: N splats, M intersections, T = tiles_x tiles_y tiles in row-major order; see above and project.cl.
// -DTILE   edge of a tile, px
#include "common.h"
#include "ellipse.h"

#if !defined(TILE) || TILE < 1
#error "-DTILE must give the edge of a tile in pixels, 1 or more"
#endif

// Walks the tiles of splat g; writes them from slot first on, if emitting. Returns their number.
static inline uint walk_tiles(uint g, int width, int height, const __global real *means2d,
                              const __global real *conics, const __global real *extents,
                              const __global real *opacities, bool emitting, uint first, __global uint *tiles,
                              __global uint *slot_gauss) {
    const real2 extent = vload2(g, extents);
    if (!(extent.x > 0))
        return 0;
    const real2 centre = vload2(g, means2d);
    const real3 conic = load3(conics, g);
    const real r2 = ellipse_r2(opacities[g]);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int2 rows = pixels_between(centre.y - extent.y, centre.y + extent.y, height);
    uint count = 0;
    for (int ty = rows.x / TILE; ty * TILE <= rows.y; ++ty) {
        // Distances of the first and the last row of pixel centres in this row of tiles; the image may cut it off.
        const real lo = ty * TILE + (real)0.5 - centre.y;
        const real hi = min((ty + 1) * TILE, height) - (real)0.5 - centre.y;
        const real2 range = ellipse_range(conic, r2, extent, lo, hi);
        const int2 columns = pixels_between(centre.x + range.x, centre.x + range.y, width);
        if (range.x > range.y || columns.x > columns.y)
            continue;
        for (int tx = columns.x / TILE; tx <= columns.y / TILE; ++tx, ++count) {
            if (emitting) {
                tiles[first + count] = ty * tiles_x + tx;
                slot_gauss[first + count] = g;
            }
        }
    }
    return count;
}

#ifdef USE_DOUBLE
typedef ulong depth_key;
#define AS_KEY as_ulong
#define LAST   ULONG_MAX
#else
typedef uint depth_key;
#define AS_KEY as_uint
#define LAST   UINT_MAX
#endif

// The bits of a positive floating-point number order like the number.
__kernel void bin_keys(const uint n, const __global real *depths, const __global real *extents,
                       __global depth_key *keys) {
    const size_t i = get_global_id(0);
    if (i < n)
        keys[i] = extents[2 * i] > 0 ? AS_KEY(depths[i]) : LAST;
}

__kernel void bin_count(const uint n, const int width, const int height, const __global uint *order,
                        const __global real *means2d, const __global real *conics, const __global real *extents,
                        const __global real *opacities, __global uint *counts) {
    const size_t i = get_global_id(0);
    if (i < n)
        counts[i] = walk_tiles(order[i], width, height, means2d, conics, extents, opacities, false, 0, 0, 0);
}

__kernel void bin_emit(const uint n, const int width, const int height, const __global uint *order,
                       const __global real *means2d, const __global real *conics, const __global real *extents,
                       const __global real *opacities, const __global uint *first_slots, __global uint *tiles,
                       __global uint *slot_gauss) {
    const size_t i = get_global_id(0);
    if (i < n)
        walk_tiles(order[i], width, height, means2d, conics, extents, opacities, true, first_slots[i], tiles,
                   slot_gauss);
}

// Index of the first of the m sorted tiles that is not below `tile`.
static inline uint lower_bound(uint m, const __global uint *sorted_tiles, uint tile) {
    uint begin = 0, end = m;
    while (begin < end) {
        const uint middle = begin + (end - begin) / 2;
        if (sorted_tiles[middle] < tile)
            begin = middle + 1;
        else
            end = middle;
    }
    return begin;
}

__kernel void bin_ranges(const uint m, const uint tile_count, const __global uint *sorted_tiles,
                         __global uint *tile_ranges) {
    const uint t = get_global_id(0);
    if (t >= tile_count)
        return;
    tile_ranges[2 * t] = lower_bound(m, sorted_tiles, t);
    tile_ranges[2 * t + 1] = lower_bound(m, sorted_tiles, t + 1);
}

__kernel void bin_gather(const uint m, const __global uint *slots, const __global uint *slot_gauss,
                         __global uint *gauss_ids) {
    const size_t i = get_global_id(0);
    if (i < m)
        gauss_ids[i] = slot_gauss[slots[i]];
}
