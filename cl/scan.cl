// Stage scan: exclusive prefix sum of unsigned integers.
//
//   out[i] = sum of in[0 .. i-1] for i = 0 .. n; out[n] is the total.
//   If the total exceeds 2^32 - 1, out is undefined. sums[P] holds the true total, which the host checks.
//
// Algorithm: reduce, then scan. Look-back is not possible, because OpenCL does not guarantee forward progress between
// work-groups. Work-item p of P has the contiguous chunk [p ceil(n/P), (p+1) ceil(n/P)).
//   scan_reduce  work-item p writes the sum of its chunk to sums[p]                          (P work-items)
//   scan_spine   one work-group turns sums into exclusive prefix sums, the total in sums[P]  (GROUP work-items)
//   scan_down    work-item p rewrites its chunk as prefix sums that start at sums[p]         (P work-items)
// P is small on a CPU (a few chunks per core) and in the thousands on a GPU. It does not affect the result.
//
// Buffers: in[n] u32, sums[P + 1] u64, out[n + 1] u32.
// -DGROUP   work-group size of scan_spine, at least 1
#include "common.h"

#if !defined(GROUP) || GROUP < 1
#error "-DGROUP must give the work-group size of scan_spine, at least 1"
#endif

static inline uint chunk_begin(uint n, uint chunks, uint p) {
    const uint length = (n + chunks - 1) / chunks;
    return min(n, p * length);
}

__kernel void scan_reduce(const uint n, const uint chunks, const __global uint *in, __global ulong *sums) {
    const uint p = get_global_id(0);
    if (p >= chunks)
        return;
    ulong sum = 0;
    for (uint i = chunk_begin(n, chunks, p); i < chunk_begin(n, chunks, p + 1); ++i)
        sum += in[i];
    sums[p] = sum;
}

__kernel void scan_spine(const uint chunks, __global ulong *sums) {
    __local ulong totals[GROUP];
    const uint lane = get_local_id(0);
    const uint begin = chunk_begin(chunks, GROUP, lane), end = chunk_begin(chunks, GROUP, lane + 1);
    ulong total = 0;
    for (uint i = begin; i < end; ++i)
        total += sums[i];
    totals[lane] = total;
    barrier(CLK_LOCAL_MEM_FENCE);
    // Hillis and Steele 1986: after the step of width w, totals[lane] sums the last 2 w lanes.
    for (uint width = 1; width < GROUP; width *= 2) {
        const ulong left = lane >= width ? totals[lane - width] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        totals[lane] += left;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    ulong running = totals[lane] - total;
    for (uint i = begin; i < end; ++i) {
        const ulong value = sums[i];
        sums[i] = running;
        running += value;
    }
    if (lane == GROUP - 1)
        sums[chunks] = running;
}

__kernel void scan_down(const uint n, const uint chunks, const __global uint *in, const __global ulong *sums,
                        __global uint *out) {
    const uint p = get_global_id(0);
    if (p >= chunks)
        return;
    uint running = (uint)sums[p];
    const uint end = chunk_begin(n, chunks, p + 1);
    for (uint i = chunk_begin(n, chunks, p); i < end; ++i) {
        out[i] = running;
        running += in[i];
    }
    if (p == chunks - 1)
        out[n] = running;
}
