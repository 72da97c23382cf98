// Stage voxels: features of points from a sparse grid of corners, the table's gradients, and its total variation.
//
//   features = trilinear interpolation of the rows of the eight corners of a point's cell; a corner without a row has 0
//   total variation of a feature = sum over corners of sqrt(dx^2 + dy^2 + dz^2 + TV_EPS), with the differences to the
//   next corners along x, y and z, 0 where one has no row                          (Fridovich-Keil et al. 2022, eq. 3)
// See docs/stages/voxels.md; clsplat/reference/voxels.py is the twin.
//
// Mapping: voxels_fwd has one work-item per point. The gradient of a row is a sum over the points in their order:
//   voxels_bwd   on a CPU, one work-item per part of the rows, which goes through all points and adds to its own rows
//   voxels_keys, voxels_sums   on a GPU, a work-item per point writes the rows of its corners (the number of rows where
//                there is none); the launch sorts them by a stable sort, and a work-item at the start of each run of
//                equal rows adds up the run. voxels_zero clears the gradients first.
// voxels_tv has one work-item per row of a range, and adds the gradient of the total variation to that of the row.
//
// A grid may be closed in x: then the last corners have the rows of the first ones.
//
// Buffers, S points, a grid of nx * ny * nz cells, M rows: in positions[S,3] in [0, 1], index[nz+1,ny+1,nx+1] u32: row
//   of a corner, NO_ROW without one; table[M,FEATURES]; out features[S,FEATURES]. Backward: in v_features[S,FEATURES]; out
//   v_table[M,FEATURES]; between keys[S,8] u32, sorted keys[8S] u32, order[8S] u32. Total variation: in corners[M] u32,
//   place of each row's corner in `index`; in and out v_table.
// -DFEATURES   features of a corner, at least 1
// -DTV_EPS     constant under the root of the total variation
#include "common.h"

#if !defined(FEATURES) || FEATURES < 1
#error "-DFEATURES must give the number of features, 1 or more"
#endif
#ifndef TV_EPS
#error "-DTV_EPS, the constant under the root of the total variation, must be given"
#endif

#define NO_ROW 0xFFFFFFFFu

typedef struct {
    uint corner;        // in `index`, the one nearest the origin
    uint stride, plane; // in `index`, to the next corners in y and in z
    real along[3];
} Cell;

static inline Cell cell_at(const __global real *positions, size_t s, const uint3 grid) {
    Cell cell;
    const uint cells[3] = {grid.x, grid.y, grid.z};
    uint place[3];
    for (int axis = 0; axis < 3; ++axis) {
        const real x = CLAMP(positions[3 * s + axis], (real)0, (real)1) * cells[axis];
        place[axis] = LESSER((uint)x, cells[axis] - 1);
        cell.along[axis] = x - place[axis];
    }
    cell.stride = grid.x + 1;
    cell.plane = cell.stride * (grid.y + 1);
    cell.corner = place[0] + cell.stride * place[1] + cell.plane * place[2];
    return cell;
}

// Place in `index` of a corner; bits 0, 1 and 2 of k are its sides in x, y and z.
static inline uint corner_of(const Cell *cell, uint k) {
    return cell->corner + (k & 1) + cell->stride * (k >> 1 & 1) + cell->plane * (k >> 2);
}

static inline real weight_of(const Cell *cell, uint k) {
    return (k & 1 ? cell->along[0] : 1 - cell->along[0]) * (k & 2 ? cell->along[1] : 1 - cell->along[1]) *
           (k & 4 ? cell->along[2] : 1 - cell->along[2]);
}

static inline void add_scaled(real *sum, real weight, const __global real *values) {
    for (int i = 0; i < FEATURES; ++i)
        sum[i] += weight * values[i];
}

__kernel void voxels_fwd(const uint points, const uint nx, const uint ny, const uint nz,
                         const __global real *positions, const __global uint *index, const __global real *table,
                         __global real *features) {
    const size_t s = get_global_id(0);
    if (s >= points)
        return;
    const Cell cell = cell_at(positions, s, (uint3)(nx, ny, nz));
    real sum[FEATURES];
    for (int i = 0; i < FEATURES; ++i)
        sum[i] = 0;
    for (uint k = 0; k < 8; ++k) {
        const uint row = index[corner_of(&cell, k)];
        if (row != NO_ROW)
            add_scaled(sum, weight_of(&cell, k), table + (size_t)row * FEATURES);
    }
    for (int i = 0; i < FEATURES; ++i)
        features[s * FEATURES + i] = sum[i];
}

__kernel void voxels_bwd(const uint points, const uint nx, const uint ny, const uint nz, const uint rows,
                         const uint parts, const __global real *positions, const __global uint *index,
                         const __global real *v_features, __global real *v_table) {
    const uint part = get_global_id(0), length = (rows + parts - 1) / parts;
    const uint begin = LESSER(part * length, rows), end = LESSER(begin + length, rows);
    for (size_t i = (size_t)begin * FEATURES; i < (size_t)end * FEATURES; ++i)
        v_table[i] = 0;
    for (uint s = 0; s < points; ++s) {
        const Cell cell = cell_at(positions, s, (uint3)(nx, ny, nz));
        for (uint k = 0; k < 8; ++k) {
            const uint row = index[corner_of(&cell, k)];
            if (row < begin || row >= end) // also without a row
                continue;
            const real weight = weight_of(&cell, k);
            for (int i = 0; i < FEATURES; ++i)
                v_table[(size_t)row * FEATURES + i] += weight * v_features[(size_t)s * FEATURES + i];
        }
    }
}

__kernel void voxels_zero(const uint values, __global real *v_table) {
    const size_t i = get_global_id(0);
    if (i < values)
        v_table[i] = 0;
}

__kernel void voxels_keys(const uint points, const uint nx, const uint ny, const uint nz, const uint rows,
                          const __global real *positions, const __global uint *index, __global uint *keys) {
    const size_t s = get_global_id(0);
    if (s >= points)
        return;
    const Cell cell = cell_at(positions, s, (uint3)(nx, ny, nz));
    for (uint k = 0; k < 8; ++k) {
        const uint row = index[corner_of(&cell, k)];
        keys[8 * s + k] = row == NO_ROW ? rows : row;
    }
}

__kernel void voxels_sums(const uint corners, const uint nx, const uint ny, const uint nz, const uint rows,
                          const __global real *positions, const __global real *v_features,
                          const __global uint *sorted_keys, const __global uint *order, __global real *v_table) {
    const size_t begin = get_global_id(0);
    if (begin >= corners || sorted_keys[begin] == rows || (begin > 0 && sorted_keys[begin] == sorted_keys[begin - 1]))
        return;
    real sum[FEATURES];
    for (int i = 0; i < FEATURES; ++i)
        sum[i] = 0;
    for (size_t j = begin; j < corners && sorted_keys[j] == sorted_keys[begin]; ++j) {
        const uint s = order[j] / 8;
        const Cell cell = cell_at(positions, s, (uint3)(nx, ny, nz));
        add_scaled(sum, weight_of(&cell, order[j] % 8), v_features + (size_t)s * FEATURES);
    }
    for (int i = 0; i < FEATURES; ++i)
        v_table[(size_t)sorted_keys[begin] * FEATURES + i] = sum[i];
}

// Place in `index` of the neighbour of a corner along an axis, a step of 1 or -1 away; NO_ROW outside of the grid.
static inline uint neighbour(const __global uint *index, uint corner, const uint3 cells, int axis, int step) {
    const uint edges[3] = {cells.x + 1, cells.y + 1, cells.z + 1};
    const uint stride = axis == 0 ? 1 : axis == 1 ? edges[0] : edges[0] * edges[1];
    const uint place = corner / stride % edges[axis];
    if (step > 0)
        return place == edges[axis] - 1 ? NO_ROW : corner + stride;
    if (place > 0)
        return corner - stride;
    const bool closed = axis == 0 && index[corner] != NO_ROW && index[corner + cells.x] == index[corner];
    return closed ? corner + cells.x - 1 : NO_ROW;
}

static inline uint row_at(const __global uint *index, uint corner) {
    return corner == NO_ROW ? NO_ROW : index[corner];
}

// Differences of a feature from a row to the next ones, and their length with TV_EPS.
static inline real differences(const __global real *table, const uint *next, uint row, int feature, real *d) {
    real square = TV_EPS;
    for (int axis = 0; axis < 3; ++axis) {
        d[axis] = next[axis] == NO_ROW
                      ? 0
                      : table[(size_t)next[axis] * FEATURES + feature] - table[(size_t)row * FEATURES + feature];
        square += d[axis] * d[axis];
    }
    return sqrt(square);
}

__kernel void voxels_tv(const uint rows, const uint nx, const uint ny, const uint nz, const uint first,
                        const uint count, const real first_weight, const real weight, const __global uint *index,
                        const __global uint *corners, const __global real *table, __global real *v_table) {
    if (get_global_id(0) >= count)
        return;
    const uint row = (first + get_global_id(0)) % rows;
    const uint3 cells = (uint3)(nx, ny, nz);
    uint next[4][3], before[3]; // rows after this one, and after each of those before it
    for (int axis = 0; axis < 3; ++axis) {
        next[3][axis] = row_at(index, neighbour(index, corners[row], cells, axis, 1));
        const uint corner = neighbour(index, corners[row], cells, axis, -1);
        before[axis] = row_at(index, corner);
        for (int other = 0; other < 3; ++other)
            next[axis][other] =
                before[axis] == NO_ROW ? NO_ROW : row_at(index, neighbour(index, corner, cells, other, 1));
    }
    for (int feature = 0; feature < FEATURES; ++feature) {
        real d[3];
        real length = differences(table, next[3], row, feature, d);
        real slope = -(d[0] + d[1] + d[2]) / length;
        for (int axis = 0; axis < 3; ++axis)
            if (before[axis] != NO_ROW) {
                length = differences(table, next[axis], before[axis], feature, d);
                slope += d[axis] / length;
            }
        v_table[(size_t)row * FEATURES + feature] += (feature == 0 ? first_weight : weight) * slope;
    }
}
