// Stage bin: the list of splats of each tile, in depth order.
//
// The list of a tile contains each splat whose ellipse {alpha >= ALPHA_MIN} may cover the centre of one of its
// pixels, sorted by depth and then by index. The test is exact (ellipse.h), except for a slack in the threshold.
//
// Splats are visited by depth (scheme "global", after a sort of all splats) or by index (scheme "per_tile", which
// sorts the list of each tile afterwards). A stable distribution to the tiles keeps this order within each list.
// Steps, with the stages scan and sort in between:
//   bin_prepare  keys[N], depths as integers with the same order, invisible splats last; ellipses[N], see ellipse.h;
//                with `by_index` also order[N], the splats in the order of the visits
//   (sort)       order[N] of scheme "global"
// On a CPU, a counting sort by tile. Work-item w has the w-th run of splats, and its own counters:
//   bin_histogram  counters[W,T], entries per run and tile; counts[N], number of tiles of splat order[i] (GRADIENTS)
//   bin_totals     totals[T], entries per tile; the counters become the numbers of entries of the preceding runs
//   (scan)         tile_begins[T + 1] with their total M, and first_slots[N + 1] (GRADIENTS)
//   bin_scatter    gauss_ids[M] and slots[M] (GRADIENTS), at the positions given by the counters
//   bin_ranges     tile_ranges[T,2], begin and end of each tile's list
// On a GPU, a radix sort by tile, with one work-item per splat:
//   bin_count    counts[N]
//   (scan)       first_slots[N + 1]
//   bin_emit     for each slot the tile, tiles[M], and the index of the splat, slot_gauss[M]
//   (sort)       the slots by tile, stable, and with GRADIENTS bin_gather
//   bin_bisect   tile_ranges[T,2], begin and end of each tile's list, from the sorted tiles
// Scheme "per_tile" continues with
//   bin_list_keys  the depth key of each entry
//   (sort)         the entries of each tile by this key, stable, and bin_gather
//
// The host does not wait for M before it queues bin_scatter or bin_emit. Lists have room for about as many entries as
// the lists before them. Where M, which is sums[last] of the scan, exceeds this room, these two kernels write nothing;
// they run again with enough room.
//
// Counting and emitting use the same function, walk_tiles, so that they always agree.
//
// Buffers: N splats, M intersections, T = tiles_x tiles_y tiles in row-major order, W runs; see above and project.cl.
// The slots of a splat are adjacent, and numbered in the order of the visits.
// -DTILE            edge of a tile, px
// -DGRADIENTS=0|1   1: bin_histogram and bin_scatter also write the arrays for the backward pass
#include "common.h"
#include "ellipse.h"

#if !defined(TILE) || TILE < 1
#error "-DTILE must give the edge of a tile in pixels, 1 or more"
#endif
#if !defined(GRADIENTS) || GRADIENTS & ~1
#error "-DGRADIENTS must be 0 or 1"
#endif

// Number of rows of tiles that are tested together.
#define ROWS        8
#define ROW_OFFSETS (TILE * (real8)(0, 1, 2, 3, 4, 5, 6, 7))

// Action of walk_tiles on a tile.
#define COUNT   0 // nothing
#define LIST    1 // out_a[slot] = tile, out_b[slot] = g
#define TALLY   2 // ++counters[tile]
#define SCATTER 3 // out_a[counters[tile]] = g, out_b[counters[tile]++] = slot (GRADIENTS)

// Visits the tiles of splat g with ellipse e, whose slots begin at `slot`. Returns their number.
static inline uint walk_tiles(const int task, uint g, Ellipse e, int width, int height, uint slot,
                              __global uint *counters, __global uint *out_a, __global uint *out_b) {
    if (!(e.half_height > 0))
        return 0;
    const int tiles_x = (width + TILE - 1) / TILE, tiles_y = (height + TILE - 1) / TILE;
    // Rows of tiles within the box. If rounding adds a row, the ellipse does not meet it.
    const real top = (e.y - e.half_height) / TILE, bottom = (e.y + e.half_height) / TILE;
    const int begin = top > 0 ? (top < tiles_y ? (int)top : tiles_y) : 0;
    const int end = bottom > 0 ? (bottom < tiles_y ? (int)bottom + 1 : tiles_y) : 0;
    uint count = 0;
    for (int ty = begin; ty < end; ty += ROWS) {
        // Distances of the first and the last row of pixel centres in each row of tiles, which the image may cut off.
        const real8 first_row = ROW_OFFSETS + (ty * TILE + (real)0.5);
        const real8 image_end = height - (real)0.5, tile_end = first_row + (TILE - 1);
        const real8 last_row = LESSER(tile_end, image_end);
        real8 x_min, x_max;
        const mask8 met = ellipse_ranges8(&e, first_row - e.y, last_row - e.y, &x_min, &x_max);
        int8 first, last;
        pixels_between8(e.x + x_min, e.x + x_max, width, &first, &last);
        const int8 listed = TO_INT8(met) & (first <= last);
        const int8 begins = first / TILE, ends = listed ? last / TILE + 1 : 0;
        for (int k = 0; k < ROWS && ty + k < end; ++k) {
            for (int tx = ((const int *)&begins)[k]; tx < ((const int *)&ends)[k]; ++tx, ++count) {
                const uint tile = (ty + k) * tiles_x + tx;
                if (task == LIST) {
                    out_a[slot + count] = tile;
                    out_b[slot + count] = g;
                } else if (task == TALLY) {
                    ++counters[tile];
                } else if (task == SCATTER) {
                    const uint position = counters[tile]++;
                    out_a[position] = g;
#if GRADIENTS
                    out_b[position] = slot + count;
#endif
                }
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

// The bits of positive floating-point numbers have the same order as the numbers. A work-item takes eight splats,
// because on CPUs a vector logarithm is faster than a scalar one.
__kernel void bin_prepare(const uint n, const int by_index, const __global real *means2d, const __global real *conics,
                          const __global real *depths, const __global real *extents, const __global real *opacities,
                          __global depth_key *keys, __global Ellipse *ellipses, __global uint *order) {
    const uint begin = 8 * get_global_id(0);
    if (begin >= n)
        return;
    const uint end = min(n, begin + 8);
    real8 r2 = 0;
    for (uint i = begin; i < end; ++i)
        ((real *)&r2)[i - begin] = opacities[i];
    r2 = ellipse_r2_8(r2);
    for (uint i = begin; i < end; ++i) {
        const real2 centre = (real2)(means2d[2 * i], means2d[2 * i + 1]);
        const real2 extent = (real2)(extents[2 * i], extents[2 * i + 1]);
        keys[i] = extent.x > 0 ? AS_KEY(depths[i]) : LAST;
        ellipses[i] = ellipse_of(centre, load3(conics, i), ((const real *)&r2)[i - begin], extent);
        if (by_index)
            order[i] = i;
    }
}

// The run of a work-item. Runs are taken from both ends alternately: in an order by depth the last runs hold the
// invisible splats, and neighbouring work-items often share a core.
static inline uint run_of(uint w, uint runs) {
    return w % 2 ? runs - 1 - w / 2 : w / 2;
}

static inline uint run_begin(uint n, uint runs, uint run) {
    return (uint)((ulong)n * run / runs);
}

// Number of ellipses that are loaded together, so that their cache misses overlap.
#define BATCH 32

static inline void gather(uint begin, uint end, const __global uint *order, const __global Ellipse *ellipses,
                          Ellipse *batch) {
    for (uint i = begin; i < min(end, begin + BATCH); ++i)
        batch[i - begin] = ellipses[order[i]];
}

__kernel void bin_histogram(const uint n, const uint runs, const uint tile_count, const int width, const int height,
                            const __global uint *order, const __global Ellipse *ellipses, __global uint *counters,
                            __global uint *counts) {
    if (get_global_id(0) >= runs)
        return;
    const uint run = run_of(get_global_id(0), runs);
    counters += (size_t)tile_count * run;
    for (uint t = 0; t < tile_count; ++t)
        counters[t] = 0;
    Ellipse batch[BATCH];
    const uint end = run_begin(n, runs, run + 1);
    for (uint first = run_begin(n, runs, run); first < end; first += BATCH) {
        gather(first, end, order, ellipses, batch);
        for (uint i = first; i < min(end, first + BATCH); ++i) {
            const uint count = walk_tiles(TALLY, 0, batch[i - first], width, height, 0, counters, 0, 0);
#if GRADIENTS
            counts[i] = count;
#endif
        }
    }
}

__kernel void bin_totals(const uint runs, const uint tile_count, __global uint *counters, __global uint *totals) {
    const uint t = get_global_id(0);
    if (t >= tile_count)
        return;
    uint total = 0;
    for (uint run = 0; run < runs; ++run) {
        __global uint *counter = counters + (size_t)tile_count * run + t;
        const uint count = *counter;
        *counter = total;
        total += count;
    }
    totals[t] = total;
}

__kernel void bin_scatter(const uint n, const uint runs, const uint tile_count, const int width, const int height,
                          const __global uint *order, const __global Ellipse *ellipses, __global uint *counters,
                          const __global uint *tile_begins, const __global uint *first_slots, const uint room,
                          const uint last, const __global ulong *sums, __global uint *gauss_ids,
                          __global uint *slots) {
    if (get_global_id(0) >= runs || sums[last] > room)
        return;
    const uint run = run_of(get_global_id(0), runs);
    counters += (size_t)tile_count * run;
    for (uint t = 0; t < tile_count; ++t)
        counters[t] += tile_begins[t];
    Ellipse batch[BATCH];
    const uint end = run_begin(n, runs, run + 1);
    for (uint first = run_begin(n, runs, run); first < end; first += BATCH) {
        gather(first, end, order, ellipses, batch);
        for (uint i = first; i < min(end, first + BATCH); ++i) {
#if GRADIENTS
            const uint slot = first_slots[i];
#else
            const uint slot = 0;
#endif
            walk_tiles(SCATTER, order[i], batch[i - first], width, height, slot, counters, gauss_ids, slots);
        }
    }
}

__kernel void bin_count(const uint n, const int width, const int height, const __global uint *order,
                        const __global Ellipse *ellipses, __global uint *counts) {
    const uint i = get_global_id(0);
    if (i < n)
        counts[i] = walk_tiles(COUNT, 0, ellipses[order[i]], width, height, 0, 0, 0, 0);
}

__kernel void bin_emit(const uint n, const int width, const int height, const __global uint *order,
                       const __global Ellipse *ellipses, const __global uint *first_slots, const uint room,
                       const uint last, const __global ulong *sums, __global uint *tiles, __global uint *slot_gauss) {
    const uint i = get_global_id(0);
    if (i < n && sums[last] <= room)
        walk_tiles(LIST, order[i], ellipses[order[i]], width, height, first_slots[i], 0, tiles, slot_gauss);
}

// Index of the first of the m sorted tiles that is not below t.
static inline uint first_from(uint m, uint t, const __global uint *sorted_tiles) {
    uint begin = 0, end = m;
    while (begin < end) {
        const uint middle = begin + (end - begin) / 2;
        if (sorted_tiles[middle] < t)
            begin = middle + 1;
        else
            end = middle;
    }
    return begin;
}

__kernel void bin_bisect(const uint m, const uint tile_count, const __global uint *sorted_tiles,
                         __global uint *tile_ranges) {
    const uint t = get_global_id(0);
    if (t < tile_count)
        vstore2((uint2)(first_from(m, t, sorted_tiles), first_from(m, t + 1, sorted_tiles)), t, tile_ranges);
}

__kernel void bin_ranges(const uint tile_count, const __global uint *tile_begins, __global uint *tile_ranges) {
    const uint t = get_global_id(0);
    if (t < tile_count)
        vstore2((uint2)(tile_begins[t], tile_begins[t + 1]), t, tile_ranges);
}

__kernel void bin_list_keys(const uint m, const __global uint *gauss_ids, const __global depth_key *keys,
                            __global depth_key *list_keys) {
    const uint i = get_global_id(0);
    if (i < m)
        list_keys[i] = keys[gauss_ids[i]];
}

__kernel void bin_gather(const uint m, const __global uint *permutation, const __global uint *in,
                         __global uint *out) {
    const uint i = get_global_id(0);
    if (i < m)
        out[i] = in[permutation[i]];
}
