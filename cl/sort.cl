// Stage sort: stable argsort of unsigned integer keys.
//
//   order is the permutation that sorts keys; equal keys keep their order.
//
// Two algorithms, one result:
//
// Radix sort, least significant digit first (reduce, then scan). The n keys are cut into `groups` blocks,
// block g into GROUP runs of contiguous keys, one per work-item. A pass over one digit of DIGIT_BITS bits:
//   sort_count    each work-item counts the digits of its run in local memory; the block's totals go to
//                 histogram[digit][g]
//   (stage scan)  turns the histogram, digit-major, into the position of each block's first key of each digit
//   sort_scatter  counts again, turns the counts of the runs into positions, and writes keys and values in order
// With GROUP = 1 a block is a sequential counting sort, which is what a CPU core does best; on a GPU a block
// is a work-group. Runs are in the order of work-items, blocks in the order of groups: stable.
//
// Bitonic sort of up to BITONIC keys by one work-group in local memory (Batcher 1968), for short lists. It is
// not stable by itself: the comparison of (key, position) makes it so.
//
// Buffers: keys_in[n], values_in[n] (or their positions where first_pass is 1), keys_out[n], values_out[n],
//          histogram[2^DIGIT_BITS, groups], offsets[2^DIGIT_BITS * groups + 1] its exclusive scan.
// -DKEY_BITS=32|64   width of a key
// -DDIGIT_BITS       bits per pass, 1 to 16
// -DGROUP            work-group size of the radix kernels, at least 1
// -DBITONIC          capacity of the bitonic sort, a power of two, at least 2
// -DBITONIC_GROUP    its work-group size, 1 to BITONIC / 2
#include "common.h"

#if KEY_BITS == 32
typedef uint sort_key;
#define KEY_MAX UINT_MAX
#elif KEY_BITS == 64
typedef ulong sort_key;
#define KEY_MAX ULONG_MAX
#else
#error "-DKEY_BITS must be 32 or 64"
#endif
#if !defined(DIGIT_BITS) || DIGIT_BITS < 1 || DIGIT_BITS > 16
#error "-DDIGIT_BITS must be 1 to 16"
#endif
#if !defined(GROUP) || GROUP < 1
#error "-DGROUP must give the work-group size of the radix kernels, at least 1"
#endif
#if !defined(BITONIC) || BITONIC < 2 || BITONIC & (BITONIC - 1)
#error "-DBITONIC must be a power of two, at least 2"
#endif
#if !defined(BITONIC_GROUP) || BITONIC_GROUP < 1 || BITONIC_GROUP > BITONIC / 2
#error "-DBITONIC_GROUP must be 1 to BITONIC / 2"
#endif

#define DIGITS (1u << DIGIT_BITS)

static inline uint digit_of(sort_key key, uint shift) {
    return (uint)(key >> shift) & (DIGITS - 1);
}

// First key of the run of work-item `lane` of block g; its end is the begin of the next lane.
static inline uint run_begin(uint n, uint groups, uint g, uint lane) {
    const uint run = (n + groups * GROUP - 1) / (groups * GROUP);
    return min(n, (g * GROUP + lane) * run);
}

// counts[digit * GROUP + lane] of this work-group's block; ends with a barrier.
static inline void count_digits(uint n, uint groups, uint shift, const __global sort_key *keys,
                                __local uint *counts) {
    const uint lane = get_local_id(0), g = get_group_id(0);
    for (uint d = 0; d < DIGITS; ++d)
        counts[d * GROUP + lane] = 0;
    const uint end = run_begin(n, groups, g, lane + 1);
    for (uint i = run_begin(n, groups, g, lane); i < end; ++i)
        ++counts[digit_of(keys[i], shift) * GROUP + lane];
    barrier(CLK_LOCAL_MEM_FENCE);
}

__kernel void sort_count(const uint n, const uint groups, const uint shift, const __global sort_key *keys,
                         __global uint *histogram) {
    __local uint counts[DIGITS * GROUP];
    count_digits(n, groups, shift, keys, counts);
    for (uint d = get_local_id(0); d < DIGITS; d += GROUP) {
        uint total = 0;
        for (uint lane = 0; lane < GROUP; ++lane)
            total += counts[d * GROUP + lane];
        histogram[d * groups + get_group_id(0)] = total;
    }
}

__kernel void sort_scatter(const uint n, const uint groups, const uint shift, const uint first_pass,
                           const __global sort_key *keys_in, const __global uint *values_in,
                           const __global uint *offsets, __global sort_key *keys_out, __global uint *values_out) {
    __local uint positions[DIGITS * GROUP];
    count_digits(n, groups, shift, keys_in, positions);
    for (uint d = get_local_id(0); d < DIGITS; d += GROUP) {
        uint position = offsets[d * groups + get_group_id(0)];
        for (uint lane = 0; lane < GROUP; ++lane) {
            const uint count = positions[d * GROUP + lane];
            positions[d * GROUP + lane] = position;
            position += count;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint lane = get_local_id(0);
    const uint end = run_begin(n, groups, get_group_id(0), lane + 1);
    for (uint i = run_begin(n, groups, get_group_id(0), lane); i < end; ++i) {
        const sort_key key = keys_in[i];
        const uint position = positions[digit_of(key, shift) * GROUP + lane]++;
        keys_out[position] = key;
        values_out[position] = first_pass ? i : values_in[i];
    }
}

__kernel void sort_bitonic(const uint n, const __global sort_key *keys_in, __global sort_key *keys_out,
                           __global uint *values_out) {
    __local sort_key keys[BITONIC];
    __local uint values[BITONIC];
    for (uint i = get_local_id(0); i < BITONIC; i += BITONIC_GROUP) {
        // Padding sorts last: no key is larger, and its position breaks the tie with a largest key.
        keys[i] = i < n ? keys_in[i] : KEY_MAX;
        values[i] = i;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint block = 2; block <= BITONIC; block *= 2) {
        for (uint stride = block / 2; stride > 0; stride /= 2) {
            for (uint pair = get_local_id(0); pair < BITONIC / 2; pair += BITONIC_GROUP) {
                const uint low = 2 * stride * (pair / stride) + pair % stride, high = low + stride;
                const bool ascending = (low & block) == 0;
                const sort_key a = keys[low], b = keys[high];
                const uint u = values[low], v = values[high];
                const bool in_order = a < b || (a == b && u < v);
                if (in_order != ascending) {
                    keys[low] = b;
                    keys[high] = a;
                    values[low] = v;
                    values[high] = u;
                }
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
    for (uint i = get_local_id(0); i < n; i += BITONIC_GROUP) {
        keys_out[i] = keys[i];
        values_out[i] = values[i];
    }
}
