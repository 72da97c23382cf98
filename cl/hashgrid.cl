// Stage hashgrid: features of points from tables of several resolutions, and the tables' gradients.
//
//   features of a level: trilinear interpolation of the table's entries at the corners of the point's cell
//   entry of the corner (x, y, z): x + (N + 1) (y + (N + 1) z) where the table has an entry for each corner,
//   otherwise (x xor 2654435761 y xor 805459861 z) mod size             (Müller et al. 2022, equations 1 to 4)
// See docs/stages/hashgrid.md; clsplat/reference/hashgrid.py is the twin.
//
// Mapping: hashgrid_fwd has one work-item per run of `count` points and level. The gradient of an entry is a sum over
// the points that read it, always in the order of the points and their corners, so that it repeats to the bit:
//   hashgrid_bwd   on a CPU, one work-item per part of a level's entries. It goes through all points and adds to its
//                  own part.
//   hashgrid_keys, hashgrid_sums   on a GPU, for one level: a work-item per point writes the entries of its corners.
//                  The launch sorts them by a stable sort, and a work-item at the start of each run of equal entries
//                  adds up the run. hashgrid_zero clears the gradients first.
//
// Buffers, S points, L levels, E entries: in positions[S,3] in [0, 1], table[E,2]; out features[S,L,2]. Backward: in
//   v_features[S,L,2]; out v_table[E,2]; between keys[S,8] u32, sorted keys[8S] u32 and order[8S] u32.
// -DRESOLUTIONS   cells along an edge of each level, separated by commas
// -DOFFSETS       first entry of each level, and the number of all entries, separated by commas
#include "common.h"

#if !defined(RESOLUTIONS) || !defined(OFFSETS)
#error "-DRESOLUTIONS and -DOFFSETS, the cells and entries of each level, must be given"
#endif

__constant uint RESOLUTION[] = {RESOLUTIONS};
__constant uint OFFSET[] = {OFFSETS};
#define LEVELS (sizeof(RESOLUTION) / sizeof(uint))

typedef struct {
    uint cell[3], resolution, size, is_dense;
    real along[3]; // position in the cell, 0 to 1
} Place;

static inline Place place_of(const __global real *positions, size_t s, uint level) {
    Place place;
    place.resolution = RESOLUTION[level];
    place.size = OFFSET[level + 1] - OFFSET[level];
    const ulong edge = place.resolution + 1;
    place.is_dense = edge * edge * edge <= place.size;
    for (int axis = 0; axis < 3; ++axis) {
        const real x = CLAMP(positions[3 * s + axis], (real)0, (real)1) * place.resolution;
        const uint cell = (uint)x;
        place.cell[axis] = LESSER(cell, place.resolution - 1);
        place.along[axis] = x - place.cell[axis];
    }
    return place;
}

// Entry of a corner, from 0 at the start of its level. Bits 0, 1 and 2 of `corner` are its sides in x, y and z.
static inline uint entry_of(const Place *place, uint corner) {
    const uint x = place->cell[0] + (corner & 1), y = place->cell[1] + (corner >> 1 & 1),
               z = place->cell[2] + (corner >> 2);
    if (place->is_dense)
        return x + (place->resolution + 1) * (y + (place->resolution + 1) * z);
    const uint hash = x ^ (y * 2654435761u) ^ (z * 805459861u);
    return (place->size & (place->size - 1)) == 0 ? hash & (place->size - 1) : hash % place->size;
}

static inline real weight_of(const Place *place, uint corner) {
    return (corner & 1 ? place->along[0] : 1 - place->along[0]) *
           (corner & 2 ? place->along[1] : 1 - place->along[1]) *
           (corner & 4 ? place->along[2] : 1 - place->along[2]);
}

__kernel void hashgrid_fwd(const uint points, const uint count, const __global real *positions,
                           const __global real *table, __global real *features) {
    const size_t begin = get_global_id(0) * count, end = LESSER(begin + count, (size_t)points);
    const uint level = get_global_id(1);
    const __global real *entries = table + 2 * (size_t)OFFSET[level];
    for (size_t s = begin; s < end; ++s) {
        const Place place = place_of(positions, s, level);
        real2 sum = 0;
#pragma unroll
        for (uint corner = 0; corner < 8; ++corner)
            sum += weight_of(&place, corner) * load2(entries, entry_of(&place, corner));
        store2(features, s * LEVELS + level, sum);
    }
}

__kernel void hashgrid_bwd(const uint points, const uint parts, const __global real *positions,
                           const __global real *v_features, __global real *v_table) {
    const uint level = get_global_id(0) / parts, part = get_global_id(0) % parts;
    if (level >= LEVELS)
        return;
    const uint size = OFFSET[level + 1] - OFFSET[level], length = (size + parts - 1) / parts;
    const uint begin = LESSER(part * length, size), end = LESSER(begin + length, size);
    __global real *own = v_table + 2 * ((size_t)OFFSET[level] + begin);
    for (uint i = 0; i < 2 * (end - begin); ++i)
        own[i] = 0;
    for (uint s = 0; s < points; ++s) {
        const real2 v = load2(v_features, s * LEVELS + level);
        if (v.x == 0 && v.y == 0)
            continue;
        const Place place = place_of(positions, s, level);
#pragma unroll
        for (uint corner = 0; corner < 8; ++corner) {
            const uint entry = entry_of(&place, corner);
            if (entry >= begin && entry < end)
                store2(own, entry - begin, load2(own, entry - begin) + weight_of(&place, corner) * v);
        }
    }
}

__kernel void hashgrid_zero(const uint values, __global real *v_table) {
    const size_t i = get_global_id(0);
    if (i < values)
        v_table[i] = 0;
}

__kernel void hashgrid_keys(const uint points, const uint level, const __global real *positions,
                            __global uint *keys) {
    const size_t s = get_global_id(0);
    if (s >= points)
        return;
    const Place place = place_of(positions, s, level);
    for (uint corner = 0; corner < 8; ++corner)
        keys[8 * s + corner] = entry_of(&place, corner);
}

__kernel void hashgrid_sums(const uint corners, const uint level, const __global real *positions,
                            const __global real *v_features, const __global uint *sorted_keys,
                            const __global uint *order, __global real *v_table) {
    const size_t begin = get_global_id(0);
    if (begin >= corners || (begin > 0 && sorted_keys[begin] == sorted_keys[begin - 1]))
        return;
    real2 sum = 0;
    for (size_t i = begin; i < corners && sorted_keys[i] == sorted_keys[begin]; ++i) {
        const uint s = order[i] / 8;
        const Place place = place_of(positions, s, level);
        sum += weight_of(&place, order[i] % 8) * load2(v_features, s * LEVELS + level);
    }
    store2(v_table, OFFSET[level] + sorted_keys[begin], sum);
}
