// Stage take: rows of an array in another order, some of them repeated, left out or 0.
//
//   out[i] = in[rows[i]], or 0 where rows[i] < 0
// See docs/stages/take.md; clsplat/reference/take.py is the twin.
//
// Mapping: one work-item per value of the result.
//
// Buffers, N rows before and M after, of `width` values: rows[M], below N; in[N,width], out[M,width]
#include "common.h"

__kernel void take_rows(const uint m, const uint width, const __global int *rows, const __global real *in,
                        __global real *out) {
    const size_t i = get_global_id(0);
    if (i >= (size_t)m * width)
        return;
    const int row = rows[i / width];
    out[i] = row < 0 ? 0 : in[(size_t)row * width + i % width];
}
