// Stage bin: the list of splats of each tile, in depth order.
//
// The list of a tile contains each splat whose ellipse {alpha >= ALPHA_MIN} may cover the centre of one of its
// pixels, sorted by depth and then by index. The test is exact (ellipse.h), except for a slack in the threshold.
//
// Splats are visited by depth (scheme "global", after a sort of all splats) or by index (scheme "per_tile", which
// sorts the list of each tile afterwards). A stable distribution to the tiles keeps this order within each list.
// Steps, with the stages scan and sort in between:
//   bin_prepare  keys[N], depths as integers with the same order, invisible splats last; covers[N], the tiles of each
//                splat, and counts[N], their number
//   (scan)       first_slots[N + 1] (GRADIENTS)
//   (sort)       order[N] of scheme "global"; kernels with `by_index` do not read it
// On a CPU, a counting sort by tile. Work-item w has the w-th run of splats, and its own counters:
//   bin_histogram  counters[W,T], entries per run and tile
//   bin_totals     totals[T], entries per tile; the counters become the numbers of entries of the preceding runs
//   (scan)         tile_begins[T + 1] with their total M
//   bin_scatter    gauss_ids[M] and slots[M] (GRADIENTS), at the positions given by the counters
//   bin_ranges     tile_ranges[T,2], begin and end of each tile's list
// On a GPU, a radix sort by tile, with one work-item per splat:
//   (scan)       positions[N + 1], of the counts in the order of the visits
//   bin_emit     for each position tiles[M] and entries[M], the slot or without GRADIENTS the splat; owners[M], the
//                splat of each slot (GRADIENTS)
//   (sort)       the entries by tile, stable, and with GRADIENTS bin_gather
//   bin_bisect   tile_ranges[T,2], begin and end of each tile's list, from the sorted tiles
// Scheme "per_tile" continues with
//   bin_list_keys  the depth key of each entry
//   (sort)         the entries of each tile by this key, stable, and bin_gather
//
// The host does not wait for M before it queues bin_scatter or bin_emit. Lists have room for about as many entries as
// the lists before them. Where M, which is sums[last] of the scan, exceeds this room, these two kernels write nothing;
// they run again with enough room.
//
// Buffers: N splats, M intersections, T = tiles_x tiles_y tiles in row-major order, W runs; see above and project.cl.
// The slots of a splat are adjacent, and numbered by the index of the splat, then by tile.
// -DTILE            edge of a tile, px
// -DGRADIENTS=0|1   1: bin_scatter and bin_emit also write the arrays for the backward pass
// -DLANES=1|8       splats of a work-item of bin_prepare, and rows of tiles that are tested together
#ifndef LANES
#error "-DLANES, the number of splats of a work-item, must be given"
#endif
#include "common.h"
#include "ellipse.h"

#if !defined(TILE) || TILE < 1
#error "-DTILE must give the edge of a tile in pixels, 1 or more"
#endif
#if !defined(GRADIENTS) || GRADIENTS & ~1
#error "-DGRADIENTS must be 0 or 1"
#endif

#if LANES == 8
#define ROW_NUMBERS ((ints)(0, 1, 2, 3, 4, 5, 6, 7))
#else
#define ROW_NUMBERS 0
#endif

#define GEOMETRY                                                                                                     \
    const __global real *means2d, const __global real *conics, const __global real *extents,                         \
        const __global real *opacities
#define GEOMETRY_GIVEN means2d, conics, extents, opacities

// The tiles of a splat: in .x the tile at the corner of their box, and in .yzw a byte for each of up to COVER_ROWS rows,
// the first column in the low nibble and the end of the columns in the high one, both relative to the corner.
typedef uint4 Cover;
#define COVER_ROWS    12
#define COVER_COLUMNS 15
#define LARGE         UINT_MAX // in .x: the tiles do not fit

// The rows k of a cover, below `end`. Where a work-item takes one splat, the loop is unrolled: GPUs keep arrays that are
// indexed by constants in registers.
#if LANES == 1
#define FOR_ROWS(k, end) _Pragma("unroll") for (int k = 0; k < COVER_ROWS; ++k) if (k < (end))
#else
#define FOR_ROWS(k, end) for (int k = 0; k < (end); ++k)
#endif

static inline int tiles_across(int size) {
    return (size + TILE - 1) / TILE;
}

// Rows of tiles within the boxes of ellipses. If rounding adds a row, the ellipse does not meet it.
static inline void tile_rows(const Ellipses *e, int height, ints *begin, ints *end) {
    const reals zero = 0, rows = tiles_across(height);
    const reals top = (e->y - e->half_height) / TILE, bottom = (e->y + e->half_height) / TILE;
    const ints none = 0, last = TO_INTS(CLAMP(bottom, zero, rows)), row_end = last + 1,
               image_end = tiles_across(height);
    *begin = TO_INTS(CLAMP(top, zero, rows));
    *end = TO_INTS((e->half_height > zero) & (bottom > zero)) ? LESSER(row_end, image_end) : none;
}

// Columns of tiles from `begin` to before `end` where ellipses meet a pixel centre of a row of tiles. If there is none,
// end is 0.
static inline void tile_columns(const Ellipses *e, ints row, int width, int height, ints *begin, ints *end) {
    // The first and the last row of pixel centres in the row of tiles, which the image may cut off.
    const reals first_row = REALS_OF(row * TILE) + (real)0.5, image_end = height - (real)0.5;
    const reals tile_end = first_row + (TILE - 1), last_row = LESSER(tile_end, image_end);
    reals x_min, x_max;
    const masks met = ellipse_ranges(e, first_row - e->y, last_row - e->y, &x_min, &x_max);
    ints first, last;
    pixels_between(e->x + x_min, e->x + x_max, width, &first, &last);
    const ints none = 0, column_end = last / TILE + 1;
    *begin = first / TILE;
    *end = (TO_INTS(met) & (first <= last)) ? column_end : none;
}

// Action on a tile of splat g.
#define COUNT   0 // nothing
#define TALLY   1 // ++counters[tile]
#define SCATTER 2 // out_a[counters[tile]] = g, out_b[counters[tile]++] = slot (GRADIENTS)
#define LIST    3 // out_a[position] = tile, out_b[position] = slot, or g without GRADIENTS

static inline void visit(const int task, uint g, uint tile, uint position, uint slot, __global uint *counters,
                         __global uint *out_a, __global uint *out_b) {
    if (task == TALLY) {
        ++counters[tile];
    } else if (task == SCATTER) {
        const uint at = counters[tile]++;
        out_a[at] = g;
#if GRADIENTS
        out_b[at] = slot;
#endif
    } else if (task == LIST) {
        out_a[position] = tile;
        out_b[position] = GRADIENTS ? slot : g;
    }
}

// Visits the tiles of an ellipse that all lanes hold. Returns their number.
static inline uint walk_ellipse(const int task, uint g, const Ellipses *e, int width, int height, uint position,
                                uint slot, __global uint *counters, __global uint *out_a, __global uint *out_b) {
    ints begin, end;
    tile_rows(e, height, &begin, &end);
    uint count = 0;
    for (int row = INT_LANE(begin, 0); row < INT_LANE(end, 0); row += LANES) {
        ints begins, ends;
        tile_columns(e, row + ROW_NUMBERS, width, height, &begins, &ends);
        for (int k = 0; k < LANES && row + k < INT_LANE(end, 0); ++k) {
            for (int column = INT_LANE(begins, k); column < INT_LANE(ends, k); ++column, ++count)
                visit(task, g, (row + k) * tiles_across(width) + column, position + count, slot + count, counters,
                      out_a, out_b);
        }
    }
    return count;
}

// Visits the tiles of splat g, whose positions and slots begin at `position` and `slot`.
static inline void walk_tiles(const int task, uint g, Cover cover, GEOMETRY, int width, int height, uint position,
                              uint slot, __global uint *counters, __global uint *out_a, __global uint *out_b) {
    if (cover.x == LARGE) {
        const reals2 centre = {means2d[2 * g], means2d[2 * g + 1]}, extent = {extents[2 * g], extents[2 * g + 1]};
        const reals3 conic = {conics[3 * g], conics[3 * g + 1], conics[3 * g + 2]};
        const Ellipses e = ellipses_of(centre, conic, opacities[g], extent);
        walk_ellipse(task, g, &e, width, height, position, slot, counters, out_a, out_b);
        return;
    }
    const uint rows[3] = {cover.y, cover.z, cover.w};
    for (int k = 0; k < 3; ++k) {
        uint corner = cover.x + 4 * k * tiles_across(width);
        for (uint row = rows[k]; row; row >>= 8, corner += tiles_across(width)) {
            for (uint column = row & 15; column < (row >> 4 & 15); ++column)
                visit(task, g, corner + column, position++, slot++, counters, out_a, out_b);
        }
    }
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

// The bits of positive floating-point numbers have the same order as the numbers. Counting and emitting read the same
// covers, so that they agree.
__kernel void bin_prepare(const uint n, const int width, const int height, const __global real *depths, GEOMETRY,
                          __global depth_key *keys, __global Cover *covers, __global uint *counts) {
    const uint i = LANES * get_global_id(0);
    if (i >= n)
        return;
    const Ellipses e = ellipses_of(load_vectors2(means2d, i, n), load_vectors3(conics, i, n),
                                   load_numbers(opacities, i, n), load_vectors2(extents, i, n));
    ints row_begin, row_end;
    tile_rows(&e, height, &row_begin, &row_end);
    const ints rows = row_end - row_begin, none = 0;
    int most = 0;
    for (int lane = 0; lane < LANES; ++lane)
        most = GREATER(most, INT_LANE(rows, lane));
    most = LESSER(most, COVER_ROWS);
    ints begins[COVER_ROWS], ends[COVER_ROWS], count = 0, left = tiles_across(width), right = 0;
    FOR_ROWS(k, most) {
        const ints row = row_begin + k;
        tile_columns(&e, row, width, height, &begins[k], &ends[k]);
        ends[k] = row < row_end ? ends[k] : none;
        begins[k] = LESSER(begins[k], ends[k]);
        left = begins[k] < ends[k] ? LESSER(left, begins[k]) : left;
        right = GREATER(right, ends[k]);
        count += ends[k] - begins[k];
    }
    const ints corner = row_begin * tiles_across(width) + left;
    const ints large = (rows > COVER_ROWS) | (right - left > COVER_COLUMNS);
    ints packed[COVER_ROWS / 4] = {0, 0, 0};
    FOR_ROWS(k, most) {
        const ints row = (begins[k] - left) | (ends[k] - left) << 4;
        packed[k / 4] |= begins[k] < ends[k] ? row << 8 * (k % 4) : none;
    }
    for (uint lane = 0; lane < LANES && i + lane < n; ++lane) {
        const uint g = i + lane;
        keys[g] = LANE(e.half_height, lane) > 0 ? AS_KEY(depths[g]) : LAST;
        covers[g] = (uint4)(INT_LANE(corner, lane), INT_LANE(packed[0], lane), INT_LANE(packed[1], lane),
                            INT_LANE(packed[2], lane));
        counts[g] = INT_LANE(count, lane);
        if (INT_LANE(large, lane)) {
            covers[g].x = LARGE;
            const Ellipses same = {
                LANE(e.x, lane),        LANE(e.y, lane),     LANE(e.half_height, lane), LANE(e.inv_half_height, lane),
                LANE(e.at_right, lane), LANE(e.slope, lane), LANE(e.half_sq, lane)};
            counts[g] = walk_ellipse(COUNT, g, &same, width, height, 0, 0, 0, 0, 0);
        }
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

// Number of visits after which a splat is visited whose values are fetched now: cache misses then overlap.
#define AHEAD 32

static inline uint splat_of_visit(uint i, uint end, int by_index, const __global uint *order,
                                  const __global Cover *covers, const __global uint *first_slots) {
    if (by_index)
        return i;
    if (i + AHEAD < end) {
        const uint next = order[i + AHEAD];
        FETCH_TO_READ(&covers[next]);
        if (first_slots)
            FETCH_TO_READ(&first_slots[next]);
    }
    return order[i];
}

__kernel void bin_histogram(const uint n, const uint runs, const uint tile_count, const int width, const int height,
                            const int by_index, const __global uint *order, const __global Cover *covers, GEOMETRY,
                            __global uint *counters) {
    if (get_global_id(0) >= runs)
        return;
    const uint run = run_of(get_global_id(0), runs);
    counters += (size_t)tile_count * run;
    for (uint t = 0; t < tile_count; ++t)
        counters[t] = 0;
    const uint end = run_begin(n, runs, run + 1);
    for (uint i = run_begin(n, runs, run); i < end; ++i) {
        const uint g = splat_of_visit(i, end, by_index, order, covers, 0);
        walk_tiles(TALLY, g, covers[g], GEOMETRY_GIVEN, width, height, 0, 0, counters, 0, 0);
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
                          const int by_index, const __global uint *order, const __global Cover *covers, GEOMETRY,
                          __global uint *counters, const __global uint *tile_begins, const __global uint *first_slots,
                          const uint room, const uint last, const __global ulong *sums, __global uint *gauss_ids,
                          __global uint *slots) {
    if (get_global_id(0) >= runs || sums[last] > room)
        return;
    const uint run = run_of(get_global_id(0), runs);
    counters += (size_t)tile_count * run;
    for (uint t = 0; t < tile_count; ++t)
        counters[t] += tile_begins[t];
    const uint end = run_begin(n, runs, run + 1);
    for (uint i = run_begin(n, runs, run); i < end; ++i) {
        const uint g = splat_of_visit(i, end, by_index, order, covers, GRADIENTS ? first_slots : 0);
        const uint slot = GRADIENTS ? first_slots[g] : 0;
        walk_tiles(SCATTER, g, covers[g], GEOMETRY_GIVEN, width, height, 0, slot, counters, gauss_ids, slots);
    }
}

__kernel void bin_emit(const uint n, const int width, const int height, const int by_index,
                       const __global uint *order, const __global Cover *covers, GEOMETRY,
                       const __global uint *positions, const __global uint *first_slots, const uint room,
                       const uint last, const __global ulong *sums, __global uint *tiles, __global uint *entries,
                       __global uint *owners) {
    const uint i = get_global_id(0);
    if (i >= n || sums[last] > room)
        return;
    const uint g = by_index ? i : order[i];
    uint slot = 0;
#if GRADIENTS
    slot = first_slots[g];
    for (uint s = slot; s < first_slots[g + 1]; ++s)
        owners[s] = g;
#endif
    walk_tiles(LIST, g, covers[g], GEOMETRY_GIVEN, width, height, positions[i], slot, 0, tiles, entries);
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
