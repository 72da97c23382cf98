// Stage sort: stable argsort of unsigned integer keys.
//
//   order is the permutation that sorts keys; equal keys keep their order.
//
// Two algorithms with the same result:
//
// Radix sort, least significant digit first (reduce, then scan). The n keys are cut into `groups` blocks,
// block g into GROUP runs of contiguous keys, one per work-item. A pass over one digit of DIGIT_BITS bits:
//   sort_count    each work-item counts the digits of its run in local memory; the block's totals go to
//                 histogram[digit][g]
//   (stage scan)  turns the histogram, digit-major, into the position of each block's first key of each digit
//   sort_scatter  counts again if there are several runs, turns the counts into positions, and writes keys and
//                 values in order
// With GROUP = 1 a block is a sequential counting sort, which is fastest on a CPU core; on a GPU a block is a
// work-group. Runs are in the order of work-items and blocks in the order of groups, so that the sort is stable.
//
// Bitonic sort of up to BITONIC keys by one work-group in local memory (Batcher 1968), for short lists. It compares
// pairs (key, position), which makes it stable.
//
// Segments of an array are sorted by one work-group each: short ones by the bitonic sort (sort_short_segments), longer
// ones by passes as above within the work-group (sort_long_segments). Each kernel ignores the segments of the other.
//
// Buffers: keys_in[n], values_in[n] (not read where use_positions is 1: the positions 0 to n - 1 instead),
//          keys_out[n], values_out[n], histogram[2^DIGIT_BITS, groups], offsets[2^DIGIT_BITS * groups + 1] its
//          exclusive scan; ranges[segments,2], begin and end of each.
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

// First key of the run of work-item `lane` of block g. The run ends where that of the next lane begins.
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

__kernel void sort_scatter(const uint n, const uint groups, const uint shift, const uint use_positions,
                           const __global sort_key *keys_in, const __global uint *values_in,
                           const __global uint *offsets, __global sort_key *keys_out, __global uint *values_out) {
    __local uint positions[DIGITS * GROUP];
#if GROUP > 1 // otherwise the offsets of the block are those of its only run
    count_digits(n, groups, shift, keys_in, positions);
#else
    for (uint d = 0; d < DIGITS; ++d)
        positions[d] = 0;
#endif
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
        values_out[position] = use_positions ? i : values_in[i];
    }
}

// Sorts `size` pairs of local memory by (key, value), size a power of two; ends with a barrier.
static inline void bitonic(uint size, __local sort_key *keys, __local uint *values) {
    for (uint block = 2; block <= size; block *= 2) {
        for (uint stride = block / 2; stride > 0; stride /= 2) {
            for (uint pair = get_local_id(0); pair < size / 2; pair += BITONIC_GROUP) {
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
}

// Loads n <= size keys and their positions; ends with a barrier.
static inline void bitonic_load(uint n, uint size, const __global sort_key *keys_in, __local sort_key *keys,
                                __local uint *values) {
    for (uint i = get_local_id(0); i < size; i += BITONIC_GROUP) {
        // Padding is last: no key is larger, and its position decides the tie with a key of the same value.
        keys[i] = i < n ? keys_in[i] : KEY_MAX;
        values[i] = i;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

__kernel void sort_bitonic(const uint n, const uint use_positions, const __global sort_key *keys_in,
                           const __global uint *values_in, __global sort_key *keys_out, __global uint *values_out) {
    __local sort_key keys[BITONIC];
    __local uint values[BITONIC];
    bitonic_load(n, BITONIC, keys_in, keys, values);
    bitonic(BITONIC, keys, values);
    for (uint i = get_local_id(0); i < n; i += BITONIC_GROUP) {
        keys_out[i] = keys[i];
        values_out[i] = use_positions ? values[i] : values_in[values[i]];
    }
}

__kernel void sort_short_segments(const uint use_positions, const __global uint *ranges,
                                  const __global sort_key *keys_in, const __global uint *values_in,
                                  __global uint *values_out) {
    __local sort_key keys[BITONIC];
    __local uint values[BITONIC];
    const uint begin = ranges[2 * get_group_id(0)], length = ranges[2 * get_group_id(0) + 1] - begin;
    const uint n = length <= BITONIC ? length : 0; // the other kernel sorts longer segments
    uint size = 1;
    while (size < n)
        size *= 2;
    bitonic_load(n, size, keys_in + begin, keys, values);
    bitonic(size, keys, values);
    for (uint i = get_local_id(0); i < n; i += BITONIC_GROUP) {
        const uint from = begin + values[i];
        values_out[begin + i] = use_positions ? from : values_in[from];
    }
}

// Passes over one segment, which alternate between the outputs and the spare arrays, so that the last one writes the
// outputs.
__kernel void sort_long_segments(const uint use_positions, const uint bits, const __global uint *ranges,
                                 const __global sort_key *keys_in, const __global uint *values_in,
                                 __global sort_key *keys_out, __global uint *values_out,
                                 __global sort_key *spare_keys, __global uint *spare_values) {
    __local uint counts[DIGITS * GROUP];
    __local uint totals[GROUP];
    const uint lane = get_local_id(0);
    const uint begin = ranges[2 * get_group_id(0)], length = ranges[2 * get_group_id(0) + 1] - begin;
    const uint passes = length > BITONIC ? (bits + DIGIT_BITS - 1) / DIGIT_BITS : 0;
    const uint run = (length + GROUP - 1) / GROUP;
    const uint from = begin + min(length, lane * run), to = begin + min(length, lane * run + run);
    for (uint pass = 0; pass < passes; ++pass) {
        const bool last = (passes - pass) % 2;
        const __global sort_key *keys = pass == 0 ? keys_in : last ? spare_keys : keys_out;
        const __global uint *values = pass == 0 ? values_in : last ? spare_values : values_out;
        __global sort_key *new_keys = last ? keys_out : spare_keys;
        __global uint *new_values = last ? values_out : spare_values;
        const uint shift = pass * DIGIT_BITS;
        for (uint d = 0; d < DIGITS; ++d)
            counts[d * GROUP + lane] = 0;
        for (uint i = from; i < to; ++i)
            ++counts[digit_of(keys[i], shift) * GROUP + lane];
        barrier(CLK_LOCAL_MEM_FENCE);
        // Turns counts, ordered by digit and then by lane, into positions. Each lane takes DIGITS of them.
        uint total = 0;
        for (uint k = lane * DIGITS; k < (lane + 1) * DIGITS; ++k)
            total += counts[k];
        totals[lane] = total;
        barrier(CLK_LOCAL_MEM_FENCE);
        uint position = begin;
        for (uint left = 0; left < lane; ++left)
            position += totals[left];
        for (uint k = lane * DIGITS; k < (lane + 1) * DIGITS; ++k) {
            const uint count = counts[k];
            counts[k] = position;
            position += count;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = from; i < to; ++i) {
            const sort_key key = keys[i];
            const uint at = counts[digit_of(key, shift) * GROUP + lane]++;
            new_keys[at] = key;
            new_values[at] = pass == 0 && use_positions ? i : values[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    }
}
