// Stage scan: exclusive prefix sum of unsigned integers.
//
//   out[i] = sum of in[0 .. i-1] for i = 0 .. n; out[n] is the total.
//   If the total exceeds 2^32 - 1, out is undefined. sums[P] holds the true total, which the host checks.
//
// Algorithm: reduce, then scan. Look-back is not possible, because OpenCL does not guarantee forward progress between
// work-groups. Work-item p of P has the contiguous chunk [p ceil(n/P), (p+1) ceil(n/P)).
//   scan_reduce  work-item p writes the sum of its chunk to sums[p]; not needed if there is one chunk
//   scan_down    each work-group adds up the sums of the chunks before its own. Then work-item p writes the prefix sums
//                of its chunk, and the last one the total to sums[P].
// P is small on a CPU (a few chunks per core) and in the thousands on a GPU. It does not affect the result.
//
// Buffers: in[n] u32, sums[P + 1] u64, out[n + 1] u32.
// -DGROUP   work-group size, at least 1
#include "common.h"

#if !defined(GROUP) || GROUP < 1
#error "-DGROUP must give the work-group size, at least 1"
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

__kernel void scan_down(const uint n, const uint chunks, const __global uint *in, __global ulong *sums,
                        __global uint *out) {
    __local ulong totals[GROUP];
    const uint lane = get_local_id(0), p = get_global_id(0), first = p - lane;
    ulong running = 0;
    for (uint i = lane; i < first; i += GROUP)
        running += sums[i];
    totals[lane] = running;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (p >= chunks)
        return;
    running = 0;
    for (uint i = 0; i < GROUP; ++i)
        running += totals[i];
    for (uint i = first; i < p; ++i)
        running += sums[i];
    const uint end = chunk_begin(n, chunks, p + 1);
    for (uint i = chunk_begin(n, chunks, p); i < end; ++i) {
        out[i] = (uint)running;
        running += in[i];
    }
    if (p == chunks - 1) {
        out[n] = (uint)running;
        sums[chunks] = running;
    }
}
