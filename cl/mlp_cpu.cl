// Stage mlp, variant for CPUs: a network of fully connected layers, and its gradients.
//
//   x_{l+1} = max(x_l W_l, 0),  and without the maximum in the last layer
//   v_x_l = (v_x_{l+1} W_l^T) where x_l > 0,  v_W_l = x_l^T v_x_{l+1}
// See docs/stages/mlp.md; clsplat/reference/mlp.py is the twin, and mlp_gpu.cl the other variant.
//
// Mapping: one work-item per band of rows in mlp_fwd. It takes CHUNK rows through all layers, so that their
// activations are read again from its caches. In mlp_bwd, `items` work-items share the chunks; each adds up its own
// gradient of the weights, and mlp_sum adds those, in the order of the work-items.
// A product is computed in blocks of ROWS rows and 16 columns, which are kept in vector registers: a row of the
// weights is read as vectors, and each value of x is multiplied with all of it.
//
// Buffers, S rows, widths w_0 ... w_L, P weights: in inputs[S,w_0], weights[P]: the matrices [w_l,w_{l+1}], one after
//   the other; out hidden[S (w_1 + ... + w_{L-1})]: the matrices [S,w_l], outputs[S,w_L]. Backward: in
//   v_outputs[S,w_L], turned[P]: each matrix transposed, from mlp_turn; between work[items,2,CHUNK,widest]; out
//   v_inputs[S,columns], parts[items,P], v_weights[P].
// -DWIDTHS   w_0 to w_L, multiples of 16, separated by commas
// -DWIDEST   the largest of them, at most 2048
// -DROWS     rows of a block: 6 for registers of 8 values, 12 for those of 16
#include "common.h"

#if !defined(WIDTHS) || !defined(WIDEST) || WIDEST < 16 || WIDEST > 2048 || WIDEST % 16
#error "-DWIDTHS and -DWIDEST must give the widths of the layers, multiples of 16 up to 2048"
#endif
#if ROWS != 6 && ROWS != 12
#error "-DROWS must be 6 or 12"
#endif

// Rows of a block of the gradient of the weights: they divide 16.
#if ROWS == 12
#define INPUTS 16
#else
#define INPUTS 4
#endif
#define CHUNK 96 // rows: a multiple of both values of ROWS. Those of a layer of 64 take 24 KiB

__constant uint WIDTH[] = {WIDTHS};
#define LAYERS (sizeof(WIDTH) / sizeof(uint) - 1)

// y = x W for `rows` rows of x [.,from], and y [.,to], of the first `to` columns of W, which has `all`. Rows of the last
// block beyond the end repeat the last row. With `gate`, a value of y is 0 where gate is not positive; with `rectify`,
// where y is negative.
static inline void product(const uint rows, const uint from, const uint to, const uint all, const __global real *x,
                           const __global real *w, __global real *y, const __global real *gate, const int rectify) {
    for (uint begin = 0; begin < rows; begin += ROWS) {
        size_t row[ROWS];
#pragma unroll
        for (uint r = 0; r < ROWS; ++r)
            row[r] = LESSER(begin + r, rows - 1);
        for (uint column = 0; column < to; column += 16) {
            real16 sum[ROWS];
#pragma unroll
            for (uint r = 0; r < ROWS; ++r)
                sum[r] = 0;
            for (uint i = 0; i < from; ++i) {
                const real16 weights = load16(w + i * all + column);
#pragma unroll
                for (uint r = 0; r < ROWS; ++r)
                    sum[r] += x[row[r] * from + i] * weights;
            }
#pragma unroll
            for (uint r = 0; r < ROWS; ++r) {
                real16 result = sum[r];
                if (rectify)
                    result = GREATER(result, (real16)0);
                if (gate)
                    result = load16(gate + row[r] * to + column) > 0 ? result : (real16)0;
                store16(y + row[r] * to + column, result);
            }
        }
    }
}

// v_w += x^T v_y, in blocks of INPUTS rows and 16 columns of v_w.
static inline void product_of_columns(const uint rows, const uint from, const uint to, const __global real *x,
                                      const __global real *v_y, __global real *v_w) {
    for (uint begin = 0; begin < from; begin += INPUTS)
        for (uint column = 0; column < to; column += 16) {
            real16 sum[INPUTS];
#pragma unroll
            for (uint i = 0; i < INPUTS; ++i)
                sum[i] = load16(v_w + (begin + i) * to + column);
            for (uint r = 0; r < rows; ++r) {
                const real16 v = load16(v_y + r * to + column);
                const __global real *own = x + r * from + begin;
#pragma unroll
                for (uint i = 0; i < INPUTS; ++i)
                    sum[i] += own[i] * v;
            }
#pragma unroll
            for (uint i = 0; i < INPUTS; ++i)
                store16(v_w + (begin + i) * to + column, sum[i]);
        }
}

__kernel void mlp_fwd(const uint rows, const uint band, const __global real *inputs, const __global real *weights,
                      __global real *hidden, __global real *outputs) {
    const size_t first = get_global_id(0) * band, last = LESSER(first + band, (size_t)rows);
    for (size_t begin = first; begin < last; begin += CHUNK) {
        const uint count = LESSER((size_t)CHUNK, last - begin);
        const __global real *x = inputs + begin * WIDTH[0], *w = weights;
        __global real *layer = hidden;
        for (uint l = 0; l < LAYERS; ++l) {
            const int is_last = l + 1 == LAYERS;
            __global real *y = (is_last ? outputs : layer) + begin * WIDTH[l + 1];
            product(count, WIDTH[l], WIDTH[l + 1], WIDTH[l + 1], x, w, y, 0, !is_last);
            x = y;
            layer += (size_t)rows * WIDTH[l + 1];
            w += WIDTH[l] * WIDTH[l + 1];
        }
    }
}

// The transposed matrices of all layers, by one work-item.
__kernel void mlp_turn(const __global real *weights, __global real *turned) {
    for (uint l = 0; l < LAYERS; ++l) {
        const uint from = WIDTH[l], to = WIDTH[l + 1];
        for (uint i = 0; i < from; ++i)
            for (uint o = 0; o < to; ++o)
                turned[o * from + i] = weights[i * to + o];
        weights += from * to;
        turned += from * to;
    }
}

__kernel void mlp_bwd(const uint rows, const uint items, const uint weight_count, const uint hidden_width,
                      const uint columns, const __global real *inputs, const __global real *turned,
                      const __global real *hidden, const __global real *v_outputs, __global real *work,
                      __global real *v_inputs, __global real *parts) {
    const size_t item = get_global_id(0);
    __global real *own = parts + item * weight_count;
    for (uint i = 0; i < weight_count; ++i)
        own[i] = 0;
    __global real *spare = work + item * 2 * CHUNK * WIDEST;
    for (size_t begin = item * CHUNK; begin < rows; begin += (size_t)items * CHUNK) {
        const uint count = LESSER((size_t)CHUNK, rows - begin);
        const __global real *v_y = v_outputs + begin * WIDTH[LAYERS];
        uint end = weight_count, width_end = hidden_width; // of the matrix, and of the activations before it
        for (uint l = LAYERS; l-- > 0;) {
            const uint from = WIDTH[l], to = WIDTH[l + 1], place = end - from * to;
            width_end -= l > 0 ? from : 0;
            const __global real *x = l > 0 ? hidden + (size_t)rows * width_end + begin * from : inputs + begin * from;
            product_of_columns(count, from, to, x, v_y, own + place);
            const uint needed = l > 0 ? from : columns;
            __global real *v_x = l > 0 ? spare + (l & 1) * CHUNK * WIDEST : v_inputs + begin * columns;
            product(count, to, needed, from, v_y, turned + place, v_x, l > 0 ? x : 0, 0);
            v_y = v_x;
            end = place;
        }
    }
}

#include "mlp_sums.h"
