// Stage mlp, variant for GPUs: products of matrices in tiles, one launch per layer. See mlp_cpu.cl for the equations.
//
// Mapping: work-groups of TILE x TILE. In mlp_product, a group computes a tile of 64 rows and TILE columns of y = x W,
// a work-item 64 / TILE rows of a column; tiles of x and W pass through local memory. In mlp_columns, a group computes
// a tile of TILE x TILE of v_W = x^T v_y from the rows of one of `slabs` slabs; mlp_sum adds up the slabs in their
// order. TILE changes no bit.
//
// Buffers, S rows, a layer of widths `from` and `to`: x[S,from], w[from,to], y[S,to]; gate[S,to]; v_y[S,to];
//   parts[slabs,stride], of which the matrix [from,to] begins at `place`; v_weights[P]. Sizes that begin with `x_` and
//   so on are first values in buffers that hold several matrices.
// -DTILE=1|2|4|8|16  edge of a work-group
#include "common.h"

#if !defined(TILE) || TILE < 1 || 16 % TILE
#error "-DTILE must be 1, 2, 4, 8 or 16"
#endif
#define HEIGHT 64 // rows of a tile of y

// y = x W, or y = x W^T if `turned`: then w is [to,from].
__kernel __attribute__((reqd_work_group_size(TILE, TILE, 1))) void
mlp_product(const uint rows, const uint from, const uint to, const uint turned, const uint rectify, const uint gated,
            const uint x_first, const uint w_first, const uint y_first, const uint gate_first, const __global real *x,
            const __global real *w, const __global real *gate, __global real *y) {
    __local real tile_x[HEIGHT][TILE + 1], tile_w[TILE][TILE + 1];
    const uint lane = get_local_id(0), line = get_local_id(1);
    const uint column = get_group_id(0) * TILE + lane;
    const size_t first = (size_t)get_group_id(1) * HEIGHT;
    real sum[HEIGHT / TILE];
    for (uint k = 0; k < HEIGHT / TILE; ++k)
        sum[k] = 0;
    x += (size_t)x_first * rows, y += (size_t)y_first * rows, gate += (size_t)gate_first * rows, w += w_first;
    for (uint begin = 0; begin < from; begin += TILE) {
        for (uint k = 0; k < HEIGHT / TILE; ++k) {
            const size_t row = first + k * TILE + line;
            tile_x[k * TILE + line][lane] = row < rows ? x[row * from + begin + lane] : 0;
        }
        if (turned)
            tile_w[lane][line] = w[(get_group_id(0) * TILE + line) * from + begin + lane];
        else
            tile_w[line][lane] = w[(begin + line) * to + column];
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = 0; i < TILE; ++i)
            for (uint k = 0; k < HEIGHT / TILE; ++k)
                sum[k] += tile_x[k * TILE + line][i] * tile_w[i][lane];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    for (uint k = 0; k < HEIGHT / TILE; ++k) {
        const size_t row = first + k * TILE + line;
        if (row >= rows)
            continue;
        real result = rectify ? GREATER(sum[k], (real)0) : sum[k];
        if (gated)
            result = gate[row * to + column] > 0 ? result : 0;
        y[row * to + column] = result;
    }
}

__kernel __attribute__((reqd_work_group_size(TILE, TILE, 1))) void
mlp_columns(const uint rows, const uint slab, const uint from, const uint to, const uint stride, const uint place,
            const uint x_first, const uint v_first, const __global real *x, const __global real *v_y,
            __global real *parts) {
    __local real tile_x[TILE][TILE + 1], tile_v[TILE][TILE + 1];
    const uint lane = get_local_id(0), line = get_local_id(1);
    const uint column = get_group_id(0) * TILE + lane, input = get_group_id(1) * TILE;
    const size_t begin = (size_t)get_group_id(2) * slab, end = LESSER(begin + slab, (size_t)rows);
    real sum = 0;
    x += (size_t)x_first * rows, v_y += (size_t)v_first * rows;
    for (size_t first = begin; first < end; first += TILE) {
        const size_t row = first + line;
        tile_x[line][lane] = row < end ? x[row * from + input + lane] : 0;
        tile_v[line][lane] = row < end ? v_y[row * to + column] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint r = 0; r < TILE; ++r)
            sum += tile_x[r][line] * tile_v[r][lane];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    parts[(size_t)get_group_id(2) * stride + place + (input + line) * to + column] = sum;
}

#include "mlp_sums.h"
